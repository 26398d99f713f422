"""The body as crack tips see it: stress, the force on them, what lies behind; at any number of ranks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ...forms.closing import spring_modulus
from ...mechanics.stress import Stress
from ...mesh.edges import EdgeGraph
from ...mesh.simplices import local_edges
from ...mesh.small_matrices import barycentric_gradients
from ..brittle.principal import largest, tensors
from .around import Around, Pairs
from .force import eshelby, first_piola, plateau, plateau_gradient, springs

Flags = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Seen:
    """The body as it is: rows of the cells of this rank and those near them, in the order of `around`.

    Attributes:
        stress: (near, 2, 2) Cauchy stress of the undamaged material, Pa; 0 far from where anybody looks.
        sigma: (near, 2, 2) Eshelby's stress of the body as it is, Pa; 0 far from tips.
        inertia: (near, 2) rho (H^T a - (grad v)^T v), N/m^3; 0 far from tips, and where nothing has a mass.
        split, damaged: (near,) come apart; with a broken edge.
    """

    around: Around
    stress: Values
    sigma: Values
    inertia: Values
    split: Flags
    damaged: Flags

    @property
    def cracked(self) -> Values:
        """(n, 2) centres of the cells with a broken edge, m."""
        return self.around.centres[self.damaged | self.split]

    def forces(self, points: Values, radius: Values) -> Values:
        """(n, 2) configurational force on places (n, 2) over discs of `radius` (n,), J/m^2.

        g = - sum V Sigma grad q + sum V q rho (H^T a - (grad v)^T v)
        """
        pairs = self.around.pairs(points, radius)
        slope = plateau_gradient(pairs.apart, radius[pairs.place])
        volumes = self.around.volumes[pairs.cell]
        held = plateau(pairs.distance, radius[pairs.place])[:, None] * self.inertia[pairs.cell]
        return pairs.sum(volumes[:, None] * (held - np.einsum("nkl,nl->nk", self.sigma[pairs.cell], slope)))

    def averages(self, places: Values, radius: Values) -> tuple[Values, Values]:
        """Over cells around places that have not come apart: (n, 2, 2) mean stress in Pa, weighted by 1 - r / radius,
        and (n,) mean square of the positive first principal stress in Pa^2, all alike."""
        pairs = self.around.pairs(places, radius)
        volumes = np.where(self.split[pairs.cell], 0.0, self.around.volumes[pairs.cell])
        weight = volumes * (1 - pairs.distance / radius[pairs.place])
        stress = self.stress[pairs.cell]
        mean = _ratio(pairs, weight[:, None, None] * stress, weight)
        square = _ratio(pairs, volumes * np.maximum(largest(stress), 0.0) ** 2, volumes)
        return mean, square

    def behind(self, point: Values, radius: Values, beyond: Values) -> tuple[Values, Flags]:
        """(n, 2) the mean of the split cells nearer than R, and whether there are any from R to R + `beyond`."""
        pairs = self.around.pairs(point, radius + beyond)
        split, far = self.split[pairs.cell], pairs.distance >= radius[pairs.place]
        weight = (split & ~far).astype(float)
        mean = _ratio(pairs, weight[:, None] * pairs.apart, weight)
        return point + mean, pairs.any(split & far)


class Sight:
    """What makes a `Seen` of the body.

    Attributes:
        centres: (cells, 2) of the cells of this rank, m.
        motion: (owned dofs,) velocity in m/s and acceleration in m/s^2; None where nothing moves.
    """

    def __init__(self, stress: Stress, graph: EdgeGraph, disc: Values, beyond: Values) -> None:
        """`disc`, `beyond`: (cells,) radius of the disc around a tip there, and how far beyond it anybody looks, m
        (collective)."""
        self._stress, self._graph = stress, graph
        domain = self._domain = stress.domain
        self.centres: Values = domain.nodes[domain.cell_nodes].mean(axis=1)
        self.motion: tuple[Values, Values] | None = None
        farthest = float(np.max(disc + beyond, initial=0.0))
        self.around = Around(domain, float(domain.comm.allreduce(farthest, op=MPI.MAX)))
        self._density = np.broadcast_to(np.asarray(stress.material.density), (domain.cell_count,))

    def look(self, stress: Values, psi: Values, points: Values, others: Values) -> Seen:
        """What is around the tips at `points` (n, 2), and `others` (m, 2) where cracks may begin (collective)."""
        graph, count = self._graph, len(stress)
        rows = np.zeros((count, 12))
        cells = self.around.wanted(np.concatenate([points, others]))
        rows[cells, :4] = tensors(stress[cells], 2).reshape(-1, 4)
        rows[cells, 10], rows[cells, 11] = graph.split[cells], graph.damaged[cells]
        assert self._stress.chi is not None
        cells = self.around.wanted(points)
        cells = cells if self._stress.closes else cells[self._stress.chi.x.array[cells] > 0]
        H = self.gradients(cells, self._stress.u.x.array)
        sigma = self._eshelby(cells, tensors(stress[cells], 2), psi[cells], H)
        if self.motion is not None:
            kinetic, rows[cells, 8:10] = self._moved(cells, H, *map(self._domain.with_ghosts, self.motion))
            sigma += kinetic[:, None, None] * np.eye(2)
        rows[cells, 4:8] = sigma.reshape(-1, 4)
        seen = self.around.exchange(rows)
        stress, sigma = (seen[:, k : k + 4].reshape(-1, 2, 2) for k in (0, 4))
        return Seen(self.around, stress, sigma, seen[:, 8:10], seen[:, 10] > 0, seen[:, 11] > 0)

    def _eshelby(self, cells: Ints, stress: Values, psi: Values, H: Values) -> Values:
        """(n, 2, 2) Pa."""
        P = first_piola(stress, H, linear=self._stress.energy.linear)
        assert self._stress.chi is not None
        chi = self._stress.chi.x.array[cells]
        psi, P = chi * psi, chi[:, None, None] * P
        if self._stress.closes:
            pressed, push = self._pressed(cells, 1 - chi, H)
            psi, P = psi + pressed, P + push
        return eshelby(psi, H, P)

    def _pressed(self, cells: Ints, share: Values, H: Values) -> tuple[Values, Values]:
        """psi (n,) in J/m^3 and P (n, d, d) in Pa of the broken edges of cells, with `share` of their springs."""
        graph, material = self._graph, self._stress.material
        nodes = self._domain.nodes[self._domain.cell_nodes[cells]]
        first, second = local_edges(2).T
        stiff = np.broadcast_to(spring_modulus(material, 2, len(first)), (len(self.centres),))[cells]
        modulus = (share * stiff)[:, None] * ~graph.intact(cells)
        return springs(nodes[:, second] - nodes[:, first], modulus, H, linear=self._stress.energy.linear)

    def _moved(self, cells: Ints, H: Values, v: Values, a: Values) -> tuple[Values, Values]:
        """(n,) rho v^2 / 2 in J/m^3, and (n, 2) rho (H^T a - (grad v)^T v) in N/m^3, in the middles of cells."""
        nodes, density = self._domain.cell_nodes[cells], self._density[cells]
        speed, push = (field.reshape(-1, 2)[nodes].mean(axis=1) for field in (v, a))
        carried = np.einsum("nik,ni->nk", H, push) - np.einsum("nik,ni->nk", self.gradients(cells, v), speed)
        return density * np.einsum("ni,ni->n", speed, speed) / 2, density[:, None] * carried

    def gradients(self, cells: Ints, field: Values) -> Values:
        """(n, 2, 2) gradients of a field of nodes (nodes * 2,), H_ij = du_i / dX_j of the displacement."""
        nodes = self._domain.cell_nodes[cells]
        return np.einsum("nai,naj->nij", field.reshape(-1, 2)[nodes], barycentric_gradients(self._domain.nodes[nodes]))


def _ratio(pairs: Pairs, values: Values, weight: Values) -> Values:
    """(places, ...) sums of (pairs, ...) weighted values over those of the weights; 0 where there is no weight."""
    whole = pairs.sum(weight).reshape(-1, *[1] * (values.ndim - 1))
    return np.divide(pairs.sum(values), whole, out=np.zeros((pairs.count, *values.shape[1:])), where=whole > 0)
