"""Permanent deformation of bodies by blows: dents and bends (docs/theory.md#denting; B07, section 7.2).

Cells whose von Mises stress q = sqrt(3/2 s : s) exceeds their yield stress k yield, with linear hardening H,

    eps_p = 3/2 (q - k) / H  s / q,   k' = q,

so that a load that is analysed twice, or in steps, causes the same strain once. The body takes the shape that these
strains leave in it without load, by the operator of its analysis,

    K u = int B^T C eps_p,   C eps_p = 2 G eps_p.

Rotations may be large: with the symmetric part e and the skew part w of grad u, the new positions x minimise

    sum V |grad x - exp(w) (1 + e)|^2.

The forces of a blow are multiplied by l <= 1 such that its energy E pays for the strain and for the flow,

    l^2 U + sum V ((l q)^2 - k^2)_+ / (2 H) <= E,   U = int sigma : eps / 2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from ..errors import NotConverged
from ..forms.kinematics import SYMMETRIC_COMPONENTS
from ..mesh.small_matrices import barycentric_gradients, polar_rotation
from ..meshes.topology import signed_measures

if TYPE_CHECKING:
    from .free_body_analysis import SolidBody, SolidStiffness

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class DentedShape:
    """Shape of a mesh after plastic flow, in the order of the input mesh.

    Attributes:
        points: (N, 3) positions of the nodes at rest, m.
        yield_stress: (C,) of the cells, Pa.
    """

    points: Values
    yield_stress: Values


class PlasticDenting:
    """Plastic flow of the cells of one mesh under blows (one rank)."""

    def __init__(self, stiffness: SolidStiffness, yield_stress: Values, hardening: float) -> None:
        """Keep the material.

        Args:
            stiffness: operator of the mesh.
            yield_stress: (cells,) present yield stress, Pa.
            hardening: H > 0, Pa per unit of plastic strain.
        """
        self._stiffness, self._yield_stress, self._hardening = stiffness, yield_stress, hardening
        self._domain = stiffness.stress.domain
        material = stiffness.stress.material
        self._shear = np.broadcast_to(material.mu, yield_stress.shape)
        self._bulk = np.broadcast_to(material.lmbda, yield_stress.shape) + 2 / 3 * self._shear

    @property
    def min_yield_stress(self) -> float:
        """Least yield stress of all cells, Pa."""
        return float(self._yield_stress.min())

    def min_contact_radii(self, force: Values) -> Values:
        """Return the least radii (k,), m, of the circles that forces (k, 3), N, press on a yielding body."""
        size = np.linalg.norm(force, axis=1)
        # the mean pressure under a ball on a yielding body is 2.8 yield stresses (D. Tabor; K. L. Johnson 1985,
        # section 6.3)
        return np.asarray(np.sqrt(size / (np.pi * 2.8 * self.min_yield_stress)))

    def __call__(self, body: SolidBody, stress: Values, energy: float = np.inf) -> DentedShape | None:
        """Return the shape after a blow; None if no cell yields.

        Args:
            body: that the stress acts in; each cell belongs to it entirely or not at all.
            stress: (cells, 6) of the blow, Pa.
            energy: of the blow, J.

        Raises:
            NotConverged: an analysis failed, or cells would be inverted.
        """
        s, q = deviator(stress)
        factor = self._affordable_factor(stress, q, energy)
        s, q = factor * s, factor * q
        yields = (q > self._yield_stress) & (body.cell_fractions > 0)
        if not np.any(yields):
            return None
        domain, source = self._domain, self._domain.input_mesh
        assert source is not None
        cells = np.flatnonzero(body.cell_fractions)
        nodes = domain.cell_nodes[cells]
        gradients = barycentric_gradients(domain.nodes[nodes])
        relative_excess = np.where(yields, 1 - self._yield_stress / np.where(yields, q, 1.0), 0.0)
        # 2 G eps_p = stress_factor s
        stress_factor = 3 * self._shear * relative_excess / self._hardening
        weight = domain.volumes[cells] * stress_factor[cells]
        force = np.zeros((len(domain.nodes), 3))
        np.add.at(force, nodes, np.einsum("c,cij,cnj->cni", weight, s[cells], gradients))
        u = body(force)
        row_of_node = np.zeros(len(domain.nodes), np.int64)
        row_of_node[body.nodes] = np.arange(len(body.nodes))
        gradient = np.einsum("cni,cnj->cij", u[nodes], gradients)
        F = finite_gradient(gradient)
        at_rest, corners, volumes = domain.nodes[body.nodes], row_of_node[nodes], domain.volumes[cells]
        points = source.points.copy()
        points[domain.input_numbering.nodes[body.nodes]] = remove_rigid_motion(
            at_rest, fit_positions(at_rest, corners, gradients, volumes, F), corners, volumes
        )
        crushed = np.linalg.eigvalsh(gradient + np.swapaxes(gradient, 1, 2))[:, 0] <= -2
        inverted = np.count_nonzero(signed_measures(points, source.cells) <= 0)
        if bad := max(np.count_nonzero(crushed), inverted):
            strain = float((stress_factor * q / (3 * self._shear)).max())
            raise NotConverged(
                f"a blow of {q.max():.3g} Pa would turn {bad} cells of it inside out (plastic strain {strain:.2g}): "
                f"raise plasticity.hardening ({self._hardening:g} Pa) or yield_stress, or strike less hard"
            )
        yield_stress = np.empty_like(q)
        yield_stress[domain.input_numbering.cells] = np.where(yields, q, self._yield_stress)
        return DentedShape(points, yield_stress)

    def _affordable_factor(self, stress: Values, q: Values, energy: float) -> float:
        """Return l for stresses (cells, 6) with von Mises stress q (cells,), Pa, and an energy, J.

        The energy is piecewise linear in l^2.
        """
        if energy == np.inf:
            return 1.0
        volumes, pressure = self._domain.volumes, stress[:, :3].mean(axis=1)
        elastic = float(volumes @ (q**2 / (6 * self._shear) + pressure**2 / (2 * self._bulk)))
        over = np.flatnonzero(q > self._yield_stress)
        # l^2 at which each cell begins to yield
        onset = (self._yield_stress[over] / q[over]) ** 2
        over, onset = over[order := np.argsort(onset)], onset[order]
        weight = volumes[over] / (2 * self._hardening)
        slope = elastic + np.concatenate([[0.0], np.cumsum(weight * q[over] ** 2)])
        offset = np.concatenate([[0.0], np.cumsum(weight * self._yield_stress[over] ** 2)])
        spent_at_onset = slope[:-1] * onset - offset[:-1]
        k = np.searchsorted(spent_at_onset, energy)
        return float(np.sqrt(min((energy + offset[k]) / slope[k], 1.0)))


def deviator(stress: Values) -> tuple[Values, Values]:
    """Return the deviators s (n, 3, 3) and the von Mises stresses q (n,) of stresses (n, 6), Pa."""
    sigma = np.empty((len(stress), 3, 3))
    for k, (i, j) in enumerate(SYMMETRIC_COMPONENTS[3]):
        sigma[:, i, j] = sigma[:, j, i] = stress[:, k]
    s = sigma - np.trace(sigma, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
    return s, np.asarray(np.sqrt(1.5 * np.einsum("nij,nij->n", s, s)))


def finite_gradient(gradient: Values) -> Values:
    """Return the deformation gradients exp(w) (1 + e) (n, 3, 3) of displacement gradients (n, 3, 3)."""
    transposed = np.swapaxes(gradient, 1, 2)
    skew = (gradient - transposed) / 2
    axial = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
    rotation = Rotation.from_rotvec(axial).as_matrix()
    return np.asarray(rotation @ (np.eye(3) + (gradient + transposed) / 2))


def fit_positions(points: Values, cells: Ints, gradients: Values, volumes: Values, F: Values) -> Values:
    """Return the positions (n, 3) whose gradients are closest to F by least squares: a Poisson equation.

    Args:
        points: (n, 3) positions at rest of connected nodes, of which the first one stays, m.
        cells: (m, 4) corners.
        gradients: (m, 4, 3) of the barycentric coordinates, 1/m.
        volumes: (m,) m^3.
        F: (m, 3, 3) wanted deformation gradients.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.linalg import splu

    entries = np.einsum("c,cai,cbi->cab", volumes, gradients, gradients)
    rows, columns = np.repeat(cells, 4, axis=1).ravel(), np.tile(cells, 4).ravel()
    matrix = coo_matrix((entries.ravel(), (rows, columns)), shape=(len(points),) * 2).tocsc()
    load = np.zeros((len(points), 3))
    np.add.at(load, cells, np.einsum("c,cij,caj->cai", volumes, F - np.eye(3), gradients))
    factors = splu(matrix[1:, 1:], permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return points + np.concatenate([np.zeros((1, 3)), factors.solve(load[1:])])


def remove_rigid_motion(points: Values, moved: Values, cells: Ints, mass: Values) -> Values:
    """Return positions `moved` (n, 3) after the rigid motion that brings cells closest to where they were.

    Plastic flow transmits no momentum, and no angular momentum about the centre.

    Args:
        points: (n, 3) positions before, m.
        moved: (n, 3) positions after, m.
        cells: (m, 4) corners.
        mass: (m,) of the cells, in any unit.
    """
    before, after = points[cells], moved[cells]
    centre, new_centre = (np.average(x.mean(axis=1), axis=0, weights=mass) for x in (before, after))
    before, after = before - centre, after - new_centre
    # int x y^T of linear x and y over a tetrahedron: V / 20 (sum x_i y_i^T + sum x_i sum y_i^T)
    covariance = np.einsum("c,cni,cnj->ij", mass, before, after)
    covariance += np.einsum("c,ci,cj->ij", mass, before.sum(axis=1), after.sum(axis=1))
    rotation = polar_rotation(covariance[None] / np.linalg.norm(covariance))[0]
    return np.asarray((moved - new_centre) @ rotation.T + centre)
