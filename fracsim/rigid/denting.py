"""What a blow leaves behind in a body that flows: it is dented or bent (docs/theory.md#denting; B07 7.2).

Cells whose von Mises stress q = sqrt(3/2 s : s) exceeds their yield stress k flow, with linear hardening H,

    eps_p = 3/2 (q - k) / H  s / q,   k' = q,

so that a load that is looked at twice, or in steps, flows once. The body takes the shape that these strains leave in it
where nothing loads it, by the operator of its analysis,

    K u = int B^T C eps_p,   C eps_p = 2 G eps_p,

and pieces of it that turn by more than small angles turn as they are: with e and w the symmetric and the skew part of
grad u, the places x are those nearest to the deformation of each cell, by least squares (a Poisson equation),

    min sum V |grad x - exp(w) (1 + e)|^2.

Along a uniaxial stress this is x += alpha (u - u_k), alpha = E / H, with u_k the displacement at which the body begins
to flow: B07's step along u, from there on. Moving the nodes that flow by alpha u, and no others, would depend on which
of all rigid motions u has, and leave the ends of a bent rod where they are. Stress is that of the elastic body: flow
hands none of it on.

A body that bends or flows is struck for longer than Hertz's time, and less hard. So forces are at most as many times
theirs, l <= 1, as the energy E of the blow can pay for: what it strains the body with, and what flow takes,

    l^2 U + sum V ((l q)^2 - k^2)_+ / (2 H) <= E,   U = int sigma : eps / 2,

piecewise linear in l^2. (B07 spends what it likes: a rod of steel 4 cm thick that comes at 5 m/s bent by 45 degrees,
which takes 3 kJ; it has 70 J.)
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
    from .free_body_analysis import FreeBody, Stiffness

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


BORNE = 2.8  # mean pressure, in yield stresses, of a ball on what flows


@dataclass(frozen=True)
class Shape:
    """What flow has made of a mesh: `points` (N, 3) where its nodes are at rest, m, and `yields` (C,) the yield stress
    of its cells, Pa, both in the order of the input mesh."""

    points: Values
    yields: Values


class Flow:
    """Of the cells of one mesh (one rank)."""

    def __init__(self, stiffness: Stiffness, yields: Values, hardening: float) -> None:
        """`yields`: (cells,) yield stress now, Pa; `hardening`: H > 0, Pa per unit of plastic strain."""
        self._stiffness, self._yields, self._hardening = stiffness, yields, hardening
        self._domain = stiffness.stress.domain
        material = stiffness.stress.material
        self._shear = np.broadcast_to(material.mu, yields.shape)
        self._bulk = np.broadcast_to(material.lmbda, yields.shape) + 2 / 3 * self._shear

    @property
    def weakest(self) -> float:
        """The least stress at which a cell flows, Pa."""
        return float(self._yields.min())

    def pressed(self, force: Values) -> Values:
        """(k,) m, least radii of the circles that forces (k, 3) press on: what flows bears 2.8 times its yield stress
        in the mean (D. Tabor; K. L. Johnson, Contact Mechanics, 1985, sec. 6.3)."""
        return np.asarray(np.sqrt(np.linalg.norm(force, axis=1) / (np.pi * BORNE * self.weakest)))

    def __call__(self, body: FreeBody, stress: Values, energy: float = np.inf) -> Shape | None:
        """The shape that a stress (cells, 6) of forces with an energy to spend, J, leaves a body in, of cells that are
        all its own or not at all; None: it does not flow. Raises NotConverged, also where it would be turned inside
        out."""
        s, q = deviator(stress)
        share = self._paid(stress, q, energy)
        s, q = share * s, share * q
        over = (q > self._yields) & (body.share > 0)
        if not np.any(over):
            return None
        domain, source = self._domain, self._domain.source
        assert source is not None
        cells = np.flatnonzero(body.share)
        nodes = domain.cell_nodes[cells]
        gradients = barycentric_gradients(domain.nodes[nodes])
        much = 3 * self._shear * np.where(over, 1 - self._yields / np.where(over, q, 1.0), 0.0) / self._hardening
        each = np.einsum("c,cij,cnj->cni", domain.volumes[cells] * much[cells], s[cells], gradients)
        force = np.zeros((len(domain.nodes), 3))
        np.add.at(force, nodes, each)
        u = body(force)
        place = np.zeros(len(domain.nodes), np.int64)
        place[body.nodes] = np.arange(len(body.nodes))
        gradient = np.einsum("cni,cnj->cij", u[nodes], gradients)
        F = turned_strain(gradient)
        own, corners, volumes = domain.nodes[body.nodes], place[nodes], domain.volumes[cells]
        points = source.points.copy()
        points[domain.node_input[body.nodes]] = settled(
            own, fitted(own, corners, gradients, volumes, F), corners, volumes
        )
        crushed = np.linalg.eigvalsh(gradient + np.swapaxes(gradient, 1, 2))[:, 0] <= -2
        if bad := max(np.count_nonzero(crushed), np.count_nonzero(signed_measures(points, source.cells) <= 0)):
            strain = float((much * q / (3 * self._shear)).max())
            raise NotConverged(
                f"a blow of {q.max():.3g} Pa would turn {bad} cells of it inside out (plastic strain {strain:.2g}): "
                f"raise plasticity.hardening ({self._hardening:g} Pa) or yield_stress, or strike less hard"
            )
        yields = np.empty_like(q)
        yields[domain.cell_input] = np.where(over, q, self._yields)
        return Shape(points, yields)

    def _paid(self, stress: Values, q: Values, energy: float) -> float:
        """l, of stresses (cells, 6) with von Mises' q (cells,), Pa."""
        if energy == np.inf:
            return 1.0
        volumes, pressure = self._domain.volumes, stress[:, :3].mean(axis=1)
        elastic = float(volumes @ (q**2 / (6 * self._shear) + pressure**2 / (2 * self._bulk)))
        over = np.flatnonzero(q > self._yields)
        begins = (self._yields[over] / q[over]) ** 2  # l^2 from which on each flows
        over, begins = over[order := np.argsort(begins)], begins[order]
        each = volumes[over] / (2 * self._hardening)
        slope = elastic + np.concatenate([[0.0], np.cumsum(each * q[over] ** 2)])
        start = np.concatenate([[0.0], np.cumsum(each * self._yields[over] ** 2)])
        spent = slope[:-1] * begins - start[:-1]  # where each begins to flow
        k = np.searchsorted(spent, energy)
        return float(np.sqrt(min((energy + start[k]) / slope[k], 1.0)))


def deviator(stress: Values) -> tuple[Values, Values]:
    """(n, 3, 3) s and (n,) von Mises' q of stresses (n, 6), Pa."""
    sigma = np.empty((len(stress), 3, 3))
    for k, (i, j) in enumerate(SYMMETRIC_COMPONENTS[3]):
        sigma[:, i, j] = sigma[:, j, i] = stress[:, k]
    s = sigma - np.trace(sigma, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
    return s, np.asarray(np.sqrt(1.5 * np.einsum("nij,nij->n", s, s)))


def turned_strain(gradient: Values) -> Values:
    """(n, 3, 3) exp(w) (1 + e) of gradients of displacement (n, 3, 3)."""
    across = np.swapaxes(gradient, 1, 2)
    skew = (gradient - across) / 2
    turn = Rotation.from_rotvec(np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)).as_matrix()
    return np.asarray(turn @ (np.eye(3) + (gradient + across) / 2))


def fitted(points: Values, cells: Ints, gradients: Values, volumes: Values, F: Values) -> Values:
    """(n, 3) places of connected nodes at rest at points (n, 3), the first of which stays, whose gradients in cells
    (m, 4) of volumes (m,) are nearest to F (m, 3, 3)."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.linalg import splu

    entries = np.einsum("c,cai,cbi->cab", volumes, gradients, gradients)
    rows, columns = np.repeat(cells, 4, axis=1).ravel(), np.tile(cells, 4).ravel()
    matrix = coo_matrix((entries.ravel(), (rows, columns)), shape=(len(points),) * 2).tocsc()
    load = np.zeros((len(points), 3))
    np.add.at(load, cells, np.einsum("c,cij,caj->cai", volumes, F - np.eye(3), gradients))
    factors = splu(matrix[1:, 1:], permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return points + np.concatenate([np.zeros((1, 3)), factors.solve(load[1:])])


def settled(points: Values, moved: Values, cells: Ints, mass: Values) -> Values:
    """Places `moved` (n, 3), with the rigid motion that brings cells (m, 4) of masses (m,) nearest to where they were,
    at `points` (n, 3): flow has no momentum, and none about the centre."""
    before, now = points[cells], moved[cells]
    middle, centre = (np.average(each.mean(axis=1), axis=0, weights=mass) for each in (before, now))
    before, now = before - middle, now - centre
    # int x y^T of linear x and y over a tetrahedron: V / 20 (sum x_i y_i^T + sum x_i sum y_i^T)
    both = np.einsum("c,cni,cnj->ij", mass, before, now)
    both += np.einsum("c,ci,cj->ij", mass, before.sum(axis=1), now.sum(axis=1))
    turn = polar_rotation(both[None] / np.linalg.norm(both))[0]
    return np.asarray((moved - centre) @ turn.T + middle)
