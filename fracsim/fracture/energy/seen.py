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
from .front import WIDTH, Front, advance

Flags = npt.NDArray[np.bool_]
Cells = npt.NDArray[np.integer]
Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]

LEAST = 0.05  # of R: a shorter advance is that of no front
FACED = 0.1  # of R^2: area of the body's surface within a disc from which on it is there
LEAST_DISC = 3.0  # R over h is more: polygons reach as far as a cell beyond their cell's centre


@dataclass(frozen=True)
class Seen:
    """The body as it is: rows of the cells of this rank and those near them, in the order of `around`.

    Attributes:
        stress: (near, d, d) Cauchy stress of the undamaged material, Pa; 0 far from where anybody looks.
        sigma: (near, d, d) Eshelby's stress of the body as it is, Pa; 0 far from tips.
        inertia: (near, d) rho (H^T a - (grad v)^T v), N/m^3; 0 far from tips, and where nothing has a mass.
        split, damaged: (near,) come apart; with a broken edge.
        inside: (near, d) from the centre of a split cell to the middle of the crack in it, m.
        polygons: (near, WIDTH) of split cells (front); None in the plane, where an advance makes its own length.
    """

    around: Around
    stress: Values
    sigma: Values
    inertia: Values
    split: Flags
    damaged: Flags
    inside: Values
    polygons: Values | None = None

    @property
    def cracked(self) -> Values:
        """(n, d) centres of the cells with a broken edge, m."""
        return self.around.centres[self.damaged | self.split]

    def forces(self, points: Values, radius: Values) -> Values:
        """(n, d) configurational force on places (n, d) over discs of `radius` (n,), J/m^2.

        g = - sum V Sigma grad q + sum V q rho (H^T a - (grad v)^T v)

        In space that along the advance of a crack, over the area it makes: (g . a) a / |a|^3, a of `front`.
        """
        pairs = self.around.pairs(points, radius)
        slope = plateau_gradient(pairs.apart, radius[pairs.place])
        volumes = self.around.volumes[pairs.cell]
        held = plateau(pairs.distance, radius[pairs.place])[:, None] * self.inertia[pairs.cell]
        force = pairs.sum(volumes[:, None] * (held - np.einsum("nkl,nl->nk", self.sigma[pairs.cell], slope)))
        if self.polygons is None:
            return force
        ahead = self._advance(points, radius, pairs.sum(volumes[:, None] * slope))
        length = np.linalg.norm(ahead, axis=1)
        along = np.einsum("nk,nk->n", force, ahead)
        share = np.divide(along, length**3, out=np.zeros(len(points)), where=length > LEAST * radius)
        return share[:, None] * ahead

    def _advance(self, points: Values, radius: Values, surface: Values) -> Values:
        """(n, 3) the crack that an advance of places makes, m; along the body's `surface` where it ends there.

        `surface`: (n, 3) int q n dA of the body, m^2: an advance across it would move the body's own surface. A front
        that has the surface ahead goes for it.
        """
        assert self.polygons is not None
        pairs = self.around.pairs(points, radius * (1 + 1 / LEAST_DISC))
        rows = np.flatnonzero(self.split[pairs.cell])
        place, cell = pairs.place[rows], pairs.cell[rows]
        ahead = np.zeros((len(points), 3))
        np.add.at(ahead, place, advance(self.polygons[cell], points[place], radius[place]))
        size = np.linalg.norm(surface, axis=1)
        normal = np.divide(
            surface, size[:, None], out=np.zeros_like(surface), where=size[:, None] > FACED * radius[:, None] ** 2
        )
        along = ahead - np.einsum("nk,nk->n", ahead, normal)[:, None] * normal
        turned = np.einsum("nk,nk->n", along, along) >= np.einsum("nk,nk->n", ahead, ahead) / 2
        return np.where(turned[:, None], along, ahead)

    def averages(self, places: Values, radius: Values) -> tuple[Values, Values]:
        """Over cells around places that have not come apart: (n, d, d) mean stress in Pa, weighted by 1 - r / radius,
        and (n,) mean square of the positive first principal stress in Pa^2, all alike."""
        pairs = self.around.pairs(places, radius)
        volumes = np.where(self.split[pairs.cell], 0.0, self.around.volumes[pairs.cell])
        weight = volumes * (1 - pairs.distance / radius[pairs.place])
        stress = self.stress[pairs.cell]
        mean = _ratio(pairs, weight[:, None, None] * stress, weight)
        square = _ratio(pairs, volumes * np.maximum(largest(stress), 0.0) ** 2, volumes)
        return mean, square

    def behind(self, point: Values, radius: Values, beyond: Values) -> tuple[Values, Flags]:
        """(n, d) the middle of the crack nearer than R, and whether there is any from R to R + `beyond`."""
        pairs = self.around.pairs(point, radius + beyond)
        split, far = self.split[pairs.cell], pairs.distance >= radius[pairs.place]
        weight = (split & ~far).astype(float)
        mean = _ratio(pairs, weight[:, None] * (pairs.apart + self.inside[pairs.cell]), weight)
        return point + mean, pairs.any(split & far)


class Sight:
    """What makes a `Seen` of the body.

    Attributes:
        centres: (cells, d) of the cells of this rank, m.
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
        self._front = Front(domain, graph)

    def middles(self, cells: Ints, cut: Values) -> Values:
        """(n, d) mean of the places where cells (n,) are cut, m."""
        return self._front.middles(cells, cut)

    def look(self, stress: Values, psi: Values, points: Values, others: Values, cut: Values) -> Seen:
        """What is around the tips at `points` (n, d), and `others` (m, d) where cracks may begin (collective).

        `cut`: (edges,) where cracks cut local edges.
        """
        graph, count, d = self._graph, len(stress), self._domain.dim
        rows, parts = np.zeros((count, 2 * d * (d + 1) + 2)), [d * d, 2 * d * d, 2 * d * d + d]
        tensor, sigma, inertia, inside = np.split(rows[:, :-2], parts, axis=1)  # views
        cells = self.around.wanted(np.concatenate([points, others]))
        tensor[cells] = tensors(stress[cells], d).reshape(-1, d * d)
        rows[cells, -2], rows[cells, -1] = graph.split[cells], graph.damaged[cells]
        assert self._stress.chi is not None
        cells = self.around.wanted(points)
        split = cells[graph.split[cells]]
        inside[split] = self._front.middles(split, cut) - self.centres[split]
        cells = cells if self._stress.closes else cells[self._stress.chi.x.array[cells] > 0]
        H = self.gradients(cells, self._stress.u.x.array)
        sigma[cells] = self._eshelby(cells, tensors(stress[cells], d), psi[cells], H).reshape(-1, d * d)
        if self.motion is not None:
            kinetic, inertia[cells] = self._moved(cells, H, *map(self._domain.with_ghosts, self.motion))
            sigma[cells] += kinetic[:, None] * np.eye(d).ravel()
        seen = self.around.exchange(rows)
        tensor, sigma, inertia, inside = np.split(seen[:, :-2], parts, axis=1)
        tensor, sigma = tensor.reshape(-1, d, d), sigma.reshape(-1, d, d)
        polygons = self._polygons(split, cut) if d == 3 else None
        return Seen(self.around, tensor, sigma, inertia, seen[:, -2] > 0, seen[:, -1] > 0, inside, polygons)

    def _polygons(self, cells: Ints, cut: Values) -> Values:
        """(near, WIDTH) of the split cells (n,) around tips (collective)."""
        rows = np.zeros((len(self.centres), WIDTH))
        rows[cells] = self._front.rows(cells, cut)
        return self.around.exchange(rows)

    def _eshelby(self, cells: Ints, stress: Values, psi: Values, H: Values) -> Values:
        """(n, d, d) Pa."""
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
        first, second = local_edges(self._domain.dim).T
        stiff = np.broadcast_to(spring_modulus(material, self._domain.dim, len(first)), (len(self.centres),))[cells]
        modulus = (share * stiff)[:, None] * ~graph.intact(cells)
        return springs(nodes[:, second] - nodes[:, first], modulus, H, linear=self._stress.energy.linear)

    def _moved(self, cells: Ints, H: Values, v: Values, a: Values) -> tuple[Values, Values]:
        """(n,) rho v^2 / 2 in J/m^3, and (n, d) rho (H^T a - (grad v)^T v) in N/m^3, in the middles of cells."""
        nodes, density = self._domain.cell_nodes[cells], self._density[cells]
        speed, push = (field.reshape(-1, self._domain.dim)[nodes].mean(axis=1) for field in (v, a))
        carried = np.einsum("nik,ni->nk", H, push) - np.einsum("nik,ni->nk", self.gradients(cells, v), speed)
        return density * np.einsum("ni,ni->n", speed, speed) / 2, density[:, None] * carried

    def gradients(self, cells: Ints, field: Values) -> Values:
        """(n, d, d) gradients of a field of nodes (nodes * d,), H_ij = du_i / dX_j of the displacement."""
        nodes = self._domain.cell_nodes[cells]
        values = field.reshape(-1, self._domain.dim)[nodes]
        return np.einsum("nai,naj->nij", values, barycentric_gradients(self._domain.nodes[nodes]))


def _ratio(pairs: Pairs, values: Values, weight: Values) -> Values:
    """(places, ...) sums of (pairs, ...) weighted values over those of the weights; 0 where there is no weight."""
    whole = pairs.sum(weight).reshape(-1, *[1] * (values.ndim - 1))
    return np.divide(pairs.sum(values), whole, out=np.zeros((pairs.count, *values.shape[1:])), where=whole > 0)
