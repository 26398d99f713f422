"""Which crack tips advance, and where cracks begin: the criterion of a body with a fracture energy G_c (METHOD 12).

A tip advances by a cell where the configurational force over a disc of 5 h reaches G_c, once the crack behind it is as
long as the disc (mature). Younger tips and whole material go by stress: its average reaches the strength f_t, or, at a
tip, the mean square over 3 h that of a crack at G_c.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from scipy.spatial import cKDTree

from ...mechanics.stress import Stress
from ...mesh.edges import EdgeGraph
from ...mesh.ranks import total
from ...mesh.simplices import local_edges
from ...mesh.small_matrices import barycentric_gradients
from ..brittle.principal import directions, largest, material_normals, tensors, upper_bound
from ..cracks import ends_in_order
from ..criterion import Edges
from ..strength import Strength, hashed
from .around import Around, Pairs, local_size
from .cutting import Cuts, leave, through_centre
from .force import eshelby, first_piola, plateau, plateau_gradient

Flags = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]

DISC = 5.0  # R over h: the radius of the disc on which a tip's force is summed
AVERAGE = 3.0  # radius over h on which stress is averaged
CELLS = 2.5  # cells that a crack cuts over a length h
FULL = 1.5  # h beyond R within which there is a split cell once a tip is mature
# mean square of the first principal stress over a disc of radius rho about a tip, in E' G / rho:
# sigma_1 = K / sqrt(2 pi r) cos(t/2) (1 + |sin(t/2)|), (1 / 2 pi^2) int cos^2 (1 + |sin|)^2 dt = 0.334
NEAR_TIP = 0.334


@dataclass(frozen=True)
class Seen:
    """The body as it is: rows of the cells of this rank and those near them, in the order of `Around`.

    Attributes:
        stress: (near, 2, 2) Cauchy stress of the undamaged material, Pa.
        sigma: (near, 2, 2) Eshelby's stress of the body as it is, Pa; 0 far from tips.
        inertia: (near, 2) rho (H^T a - (grad v)^T v), N/m^3; 0 far from tips, and where nothing has a mass.
        split, damaged: (near,) come apart; with a broken edge.
    """

    stress: Values
    sigma: Values
    inertia: Values
    split: Flags
    damaged: Flags


@dataclass(frozen=True)
class Proposal:
    """Cells of this rank that cracks would cut: those of tips, or those where cracks would begin.

    Attributes:
        rank: (n, 6): 0 for a tip and 1 for a new crack, - sigma_1 in Pa, a hash, the place (x, y) and R in m.
        cells: (n,) local.    stress: (n, 2, 2) averaged, Pa.
        entry, ahead: (n,) local edge where the crack came in, and (n, 2) whither it goes; None of new cracks.
    """

    rank: Values
    cells: Ints
    stress: Values
    entry: Ints | None = None
    ahead: Values | None = None

    def taken(self, rows: Flags) -> Proposal:
        """Some of them."""
        entry, ahead = (None if each is None else each[rows] for each in (self.entry, self.ahead))
        return Proposal(self.rank[rows], self.cells[rows], self.stress[rows], entry, ahead)


class CrackTips:
    """Cells that cracks cut next.

    Attributes:
        cut: (edges,) where cracks cut local edges, from the end that comes first in the input mesh; NaN elsewhere.
        toughness: G_c in J/m^2.    strength: of each edge in each cell.
    """

    def __init__(
        self, stress: Stress, graph: EdgeGraph, strength: Strength, toughness: float, opened: Values | None = None
    ) -> None:
        """`opened`: (edges,) where the cracks that are there already cut edges (collective)."""
        self._stress, self._graph, self.strength, self.toughness = stress, graph, strength, toughness
        domain = self._domain = stress.domain
        self.cut: Values = np.full(len(graph.broken), np.nan) if opened is None else opened.copy()
        self._h = local_size(domain)
        self._centres: Values = domain.nodes[domain.cell_nodes].mean(axis=1)
        self._widest: float = domain.comm.allreduce(float(np.max(self._h, initial=0.0)), op=MPI.MAX)
        self._ends = ends_in_order(graph)
        self._around = Around(domain, (DISC + FULL) * self._widest)
        mu, lmbda = np.asarray(stress.material.mu), np.asarray(stress.material.lmbda)
        modulus = 4 * mu * (lmbda + mu) / (lmbda + 2 * mu)  # E' in plane strain; in plane stress of its own lambda
        self._modulus = np.broadcast_to(modulus, (domain.cell_count,))
        self._density = np.broadcast_to(np.asarray(stress.material.density), (domain.cell_count,))
        self._motion: tuple[Values, Values] | None = None
        self._idle = True

    def __call__(self, stress: Values, psi: Values) -> tuple[Edges, Values]:
        """The edges that cracks cut now, as loaded as they may be (collective)."""
        graph = self._graph
        tips = np.flatnonzero(graph.damaged & ~graph.split).astype(np.int64)
        weak = upper_bound(tensors(stress, 2)) >= self.strength.weakest
        weak_cells = np.flatnonzero(weak & ~graph.damaged).astype(np.int64)
        if not total(self._domain.comm, len(tips) + len(weak_cells))[0]:
            return np.empty(0, np.int64), np.empty(0)
        entry, point = self._entries(tips)
        seen = self._look(stress, psi, point)
        edges = self._cut(*self._chosen(self._grown(seen, tips, entry, point), self._begun(seen, weak_cells)))
        return edges, np.ones(len(edges))

    def moving(self, v: Values, a: Values) -> None:
        """The body moves so: (owned dofs,) in m/s and m/s^2."""
        self._motion = v, a

    def memory(self) -> Values:
        """Where cracks cut."""
        return self.cut.copy()

    def recall(self, memory: object) -> None:
        """No more cuts than that."""
        assert isinstance(memory, np.ndarray)
        self.cut[:] = memory

    def release_rate(self) -> Values:
        """(cells,) 1/s, one over the time that a Rayleigh wave takes from a tip to the rim of its disc."""
        mu, lmbda = np.asarray(self._stress.material.mu), np.asarray(self._stress.material.lmbda)
        poisson = lmbda / (2 * (lmbda + mu))
        shear = np.sqrt(mu / self._density)
        return np.asarray(shear * (0.862 + 1.14 * poisson) / (1 + poisson) / (DISC * self._h))  # c_R: Viktorov (1967)

    def pace(self) -> float:
        """Passes a second in which a tip, cell by cell, keeps up with a Rayleigh wave and no more (collective)."""
        fastest = float(np.max(self.release_rate(), initial=0.0))
        return CELLS * DISC * float(self._domain.comm.allreduce(fastest, op=MPI.MAX))

    # --- the body as it is ---

    def _entries(self, tips: Ints) -> tuple[Ints, Values]:
        """(n,) local edge at which the crack came into each tip cell, and (n, 2) where, m."""
        graph = self._graph
        entry = np.argmin(graph.intact(tips), axis=1)
        edges = graph.cell_edges[tips, entry]
        share = np.where(np.isnan(self.cut[edges]), 0.5, self.cut[edges])
        ends = self._domain.nodes[self._ends[edges]]
        return entry, ends[:, 0] + share[:, None] * (ends[:, 1] - ends[:, 0])

    def _look(self, stress: Values, psi: Values, points: Values) -> Seen:
        """What is around (collective)."""
        graph, count = self._graph, len(stress)
        sigma, inertia = np.zeros((count, 2, 2)), np.zeros((count, 2))
        every = np.concatenate(self._domain.comm.allgather(points))
        if len(every):
            near, _ = cKDTree(every).query(self._centres, distance_upper_bound=DISC * self._widest)
            assert self._stress.chi is not None
            cells = np.flatnonzero(np.isfinite(near) & (self._stress.chi.x.array[:count] > 0))
            H = self._gradients(cells, self._stress.u.x.array)
            sigma[cells] = self._eshelby(cells, tensors(stress[cells], 2), psi[cells], H)
            if self._motion is not None:
                kinetic, inertia[cells] = self._moved(cells, H, *map(self._domain.with_ghosts, self._motion))
                sigma[cells] += kinetic[:, None, None] * np.eye(2)
        flags = graph.split[:, None], graph.damaged[:, None]
        rows = [tensors(stress, 2).reshape(-1, 4), sigma.reshape(-1, 4), inertia, *flags]
        seen = self._around.exchange(np.hstack(rows))
        stress, sigma = (seen[:, k : k + 4].reshape(-1, 2, 2) for k in (0, 4))
        return Seen(stress, sigma, seen[:, 8:10], seen[:, 10] > 0, seen[:, 11] > 0)

    def _eshelby(self, cells: Ints, stress: Values, psi: Values, H: Values) -> Values:
        """(n, 2, 2) Pa."""
        P = first_piola(stress, H, linear=self._stress.energy.linear)
        assert self._stress.chi is not None
        chi = self._stress.chi.x.array[cells]
        return eshelby(chi * psi, H, chi[:, None, None] * P)

    def _moved(self, cells: Ints, H: Values, v: Values, a: Values) -> tuple[Values, Values]:
        """(n,) rho v^2 / 2 in J/m^3, and (n, 2) rho (H^T a - (grad v)^T v) in N/m^3, in the middles of cells."""
        nodes, density = self._domain.cell_nodes[cells], self._density[cells]
        speed, push = (field.reshape(-1, 2)[nodes].mean(axis=1) for field in (v, a))
        carried = np.einsum("nik,ni->nk", H, push) - np.einsum("nik,ni->nk", self._gradients(cells, v), speed)
        return density * np.einsum("ni,ni->n", speed, speed) / 2, density[:, None] * carried

    def _gradients(self, cells: Ints, field: Values) -> Values:
        """(n, 2, 2) gradients of a field of nodes (nodes * 2,), H_ij = du_i / dX_j of the displacement."""
        nodes = self._domain.cell_nodes[cells]
        return np.einsum("nai,naj->nij", field.reshape(-1, 2)[nodes], barycentric_gradients(self._domain.nodes[nodes]))

    # --- what is active ---

    def forces(self, seen: Seen, points: Values, radius: Values) -> Values:
        """(n, 2) configurational force on places (n, 2) over discs of `radius` (n,), J/m^2.

        g = - sum V Sigma grad q + sum V q rho (H^T a - (grad v)^T v)
        """
        pairs = self._around.pairs(points, radius)
        slope = plateau_gradient(pairs.apart, radius[pairs.place])
        volumes = self._around.volumes[pairs.cell]
        held = plateau(pairs.distance, radius[pairs.place])[:, None] * seen.inertia[pairs.cell]
        return pairs.sum(volumes[:, None] * (held - np.einsum("nkl,nl->nk", seen.sigma[pairs.cell], slope)))

    def _grown(self, seen: Seen, tips: Ints, entry: Ints, point: Values) -> Proposal:
        """Tips that advance."""
        h = self._h[tips]
        radius = DISC * h
        force = self.forces(seen, point, radius)
        mean, square = self._averages(seen, point, AVERAGE * h)
        sigma = largest(mean)
        behind, mature = self._behind(seen, point, radius, FULL * h)
        size = np.linalg.norm(force, axis=1)
        strained = np.sqrt(NEAR_TIP * self._modulus[tips] * self.toughness / (AVERAGE * h))
        young = (sigma >= self._strength_of(tips)) | (np.sqrt(square) >= strained)
        active = np.flatnonzero(np.where(mature, size >= self.toughness, young) & (sigma > 0))
        ahead = np.where(mature[:, None], force, point - behind)[active]
        rank = self._ranked(0, sigma[active], point[active], radius[active])
        return Proposal(rank, tips[active], mean[active], entry[active], ahead)

    def _begun(self, seen: Seen, weak: Ints) -> Proposal:
        """Whole cells, farther than R from any crack, whose averaged stress reaches the strength."""
        radius = DISC * self._h[weak]
        if not len(weak):
            return Proposal(np.empty((0, 6)), weak, np.empty((0, 2, 2)))
        cracked = self._around.centres[seen.damaged | seen.split]
        if len(cracked):
            far = cKDTree(cracked).query(self._centres[weak])[0] > radius
            weak, radius = weak[far], radius[far]
        mean, _ = self._averages(seen, self._centres[weak], AVERAGE * self._h[weak])
        sigma = largest(mean)
        over = sigma >= self._strength_of(weak)
        cells, sigma = weak[over], sigma[over]
        return Proposal(self._ranked(1, sigma, self._centres[cells], radius[over]), cells, mean[over])

    def _averages(self, seen: Seen, places: Values, radius: Values) -> tuple[Values, Values]:
        """Over cells around places that have not come apart: (n, 2, 2) mean stress in Pa, weighted by 1 - r / radius,
        and (n,) mean square of the positive first principal stress in Pa^2, all alike."""
        pairs = self._around.pairs(places, radius)
        volumes = np.where(seen.split[pairs.cell], 0.0, self._around.volumes[pairs.cell])
        weight = volumes * (1 - pairs.distance / radius[pairs.place])
        stress = seen.stress[pairs.cell]
        mean = _ratio(pairs, weight[:, None, None] * stress, weight)
        square = _ratio(pairs, volumes * np.maximum(largest(stress), 0.0) ** 2, volumes)
        return mean, square

    def _behind(self, seen: Seen, point: Values, radius: Values, beyond: Values) -> tuple[Values, Flags]:
        """(n, 2) the mean of the split cells nearer than R, and whether there are any from R to R + `beyond`."""
        pairs = self._around.pairs(point, radius + beyond)
        split, far = seen.split[pairs.cell], pairs.distance >= radius[pairs.place]
        weight = (split & ~far).astype(float)
        mean = _ratio(pairs, weight[:, None] * pairs.apart, weight)
        return point + mean, pairs.any(split & far)

    def _strength_of(self, cells: Ints) -> Values:
        """(n,) Pa: the mean over the edges of each cell."""
        return np.asarray(self.strength(cells, self._graph.cell_edges[cells]).mean(axis=1))

    def _normals(self, stress: Values, cells: Ints) -> Values:
        """(n, 2) unit normals, in the body at rest, of cracks across the first principal stress (n, 2, 2)."""
        direction = directions(stress, self._centres[cells], 0)
        if self._stress.energy.linear:
            return direction
        return material_normals(direction, np.eye(2) + self._gradients(cells, self._stress.u.x.array))

    def _torn(self) -> Flags:
        """(edges,) edges of cells, on any rank, that have come apart (collective)."""
        flags = np.zeros(len(self._graph.broken), bool)
        flags[self._graph.cell_edges[self._graph.split]] = True
        return self._graph.on_any_rank(flags)

    # --- what is chosen, and cut ---

    @staticmethod
    def _ranked(kind: int, sigma: Values, places: Values, radius: Values) -> Values:
        return np.column_stack([np.full(len(sigma), float(kind)), -sigma, hashed(places), places, radius])

    def _chosen(self, *proposals: Proposal) -> list[Proposal]:
        """Those that are the first within R: tips before new cracks, then by sigma_1 (collective)."""
        comm, rank = self._domain.comm, np.concatenate([each.rank for each in proposals])
        parts = comm.allgather(rank)
        every = np.concatenate(parts)
        left = list(np.lexsort(every[:, 2::-1].T))
        keep = np.zeros(len(every), bool)
        while left:
            first = left[0]
            keep[first] = True
            apart = np.linalg.norm(every[left, 3:5] - every[first, 3:5], axis=1)
            left = [row for row, far in zip(left, apart > every[first, 5], strict=True) if far]
        start = sum(len(part) for part in parts[: comm.rank])
        own = np.split(keep[start : start + len(rank)], np.cumsum([len(each.rank) for each in proposals])[:-1])
        self._idle = not keep.any()
        return [each.taken(rows) for each, rows in zip(proposals, own, strict=True)]

    def _cut(self, grown: Proposal, begun: Proposal) -> Edges:
        """Remember where the cells are cut, on every rank; (n,) local edges of this one (collective)."""
        if self._idle:
            return np.empty(0, np.int64)
        graph = self._graph
        grows, begins = self._rows(grown.cells, self._way_out(grown)), self._rows(begun.cells, self._through(begun))
        every = np.concatenate(self._domain.comm.allgather(np.concatenate([grows, begins])))
        keys, first = np.unique(every[:, :2].astype(np.int64), axis=0, return_index=True)
        local, place = graph.find_keys(keys)
        new = ~graph.broken[local]
        self.cut[local[new]] = every[first[place[new]], 2]
        return local[new]

    def _way_out(self, grown: Proposal) -> Cuts:
        """Where the cells of tips are left (collective)."""
        assert grown.entry is not None and grown.ahead is not None
        torn = self._torn()[self._graph.cell_edges[grown.cells]]
        normals = self._normals(grown.stress, grown.cells)
        return leave(self._corners(grown.cells), grown.entry, grown.rank[:, 3:5], normals, grown.ahead, torn)

    def _through(self, begun: Proposal) -> Cuts:
        return through_centre(self._corners(begun.cells), self._normals(begun.stress, begun.cells))

    def _corners(self, cells: Ints) -> Values:
        return self._domain.nodes[self._domain.cell_nodes[cells]]

    def _rows(self, cells: Ints, cuts: Cuts) -> Values:
        """(n, 3) key of each edge that is cut and where, from the end that comes first in the input mesh."""
        cells = cells[cuts.row]
        ends = self._domain.node_input[self._domain.cell_nodes[cells[:, None], local_edges(2)[cuts.edge]]]
        share = np.where(ends[:, 0] > ends[:, 1], 1 - cuts.share, cuts.share)
        return np.column_stack([np.sort(ends, axis=1), share])


def _ratio(pairs: Pairs, values: Values, weight: Values) -> Values:
    """(places, ...) sums of (pairs, ...) weighted values over those of the weights; 0 where there is no weight."""
    whole = pairs.sum(weight).reshape(-1, *[1] * (values.ndim - 1))
    return np.divide(pairs.sum(values), whole, out=np.zeros((pairs.count, *values.shape[1:])), where=whole > 0)
