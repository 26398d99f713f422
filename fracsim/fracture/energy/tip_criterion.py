"""Which crack tips advance, and where cracks begin: the criterion of a body with a fracture energy G_c
(docs/theory.md#tip-criterion).

A tip advances by a cell where the configurational force over a disc of 5 h (a ball of 4 h) reaches G_c, once the crack
behind it is as long as the disc (mature). Younger tips and whole material go by stress: its average reaches the
strength f_t, or, at a tip, the mean square over 3 h that of a crack at G_c.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ...forms.waves import rayleigh_speed
from ...mechanics.material_fields import PerCell
from ...mechanics.stress import Stress
from ...mesh.edge_graph import EdgeGraph
from ...mesh.parallel import allgather, sum_over_ranks
from ...mesh.simplices import local_edges
from ..brittle.principal_stress import directions, largest, material_normals, tensors, upper_bound
from ..criterion import Edges
from ..edge_stress import frobenius_norm
from ..strength import Strength, hashed
from .branching import TIPS, each, rotated, unit
from .cut_plane import Cuts, cleave, fork, leave, through_centre
from .mixed_mode import gain, kink
from .neighbour_search import local_size
from .release_rate_bound import Waiting
from .tip_fields import Seen, Sight
from .tip_neighbourhoods import Reach, Tips

Flags = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]

DISC = {2: 5.0, 3: 4.0}  # R over h: the radius of the disc (ball) on which a tip's force is summed
AVERAGE = 3.0  # radius over h on which stress is averaged
CELLS = {2: 2.5, 3: 5.0}  # passes in which a crack gets on by h
APART = {2: 5.0, 3: 0.5}  # h between tips that advance at once
FULL = 1.5  # h beyond R within which there is a split cell once a tip is mature
# mean square of the first principal stress over a disc of radius rho about a tip, in E' G / rho:
# sigma_1 = K / sqrt(2 pi r) cos(t/2) (1 + |sin(t/2)|), (1 / 2 pi^2) int cos^2 (1 + |sin|)^2 dt = 0.334
# and over a ball 3 pi / 8 of that: (3 / 4 rho^3) int rho_z dz rho, rho_z^2 = rho^2 - z^2
NEAR_TIP = {2: 0.334, 3: 0.334 * 3 * np.pi / 8}


@dataclass(frozen=True)
class Proposal:
    """Cells of this rank that cracks would cut: those of tips, or those where cracks would begin.

    Attributes:
        rank: (n, d + 4): 0 for a tip and 1 for a new crack, - sigma_1 in Pa, a hash, the place, and how near no other
            may be, m.
        cells: (n,) local.    stress: (n, d, d) averaged, Pa.
        entry, ahead, turns, branches: (n,) local edge where the crack came in, (n, d) whither it goes, (n,) whether it
            goes just there, not across the first principal stress, and whether it branches; None of new cracks.
    """

    rank: Values
    cells: Ints
    stress: Values
    entry: Ints | None = None
    ahead: Values | None = None
    turns: Flags | None = None
    branches: Flags | None = None

    @property
    def place(self) -> Values:
        """(n, d) m."""
        return self.rank[:, 3:-1]

    def taken(self, rows: Flags) -> Proposal:
        """Some of them."""
        entry = None if self.entry is None else self.entry[rows]
        ahead = None if self.ahead is None else self.ahead[rows]
        turns = None if self.turns is None else self.turns[rows]
        branches = None if self.branches is None else self.branches[rows]
        return Proposal(self.rank[rows], self.cells[rows], self.stress[rows], entry, ahead, turns, branches)


class CrackTips:
    """Cells that cracks cut next.

    Attributes:
        cut: (edges,) where cracks cut local edges, from the end that comes first in the input mesh; NaN elsewhere.
        toughness: G_c in J/m^2, a number or (cells,).    strength: of each edge in each cell.
        cells: (n,) of this rank that were chosen last.    barred: (cells,) not to be cut (tip_constraints).
        onwards: whether tips go on for more than a cell in a pass without inertia.    course: numbers that say whither.
        shares: whether tips of a front in space share its force (crack_front).    forks: whether a tip may become two.
        carried: (edges, n) of tips that run, at the edge by which each came in, the time of the last look in the end.
    """

    onwards, shares, course, forks = True, False, 2, False
    carried: Values | None = None

    def __init__(
        self,
        stress: Stress,
        graph: EdgeGraph,
        strength: Strength,
        toughness: PerCell,
        opened: Values | None = None,
    ) -> None:
        """`opened`: (edges,) where the cracks that are there already cut edges (collective)."""
        self._stress, self._graph, self.strength, self.toughness = stress, graph, strength, toughness
        domain = self._domain = stress.domain
        self.cut: Values = np.full(len(graph.broken), np.nan) if opened is None else opened.copy()
        self._h = local_size(domain)
        self.disc = DISC[domain.dim]
        reach = Reach(self.disc * self._h, AVERAGE * self._h, FULL * self._h)
        self.sight = Sight(stress, graph, reach, forks=self.forks, shares=self.shares)
        waits = domain.dim == 3 and stress.linear and not self.shares
        self._waiting = Waiting(self.sight, stress) if waits else None
        mu, lmbda = np.asarray(stress.material.mu), np.asarray(stress.material.lmbda)
        modulus = 4 * mu * (lmbda + mu) / (lmbda + 2 * mu)  # E' in plane strain; in plane stress of its own lambda
        self._modulus = np.broadcast_to(modulus, (domain.cell_count,))
        self._idle, self._now, self._dt = True, 0.0, np.inf
        self.cells: Ints = np.empty(0, np.int64)
        self.barred: Flags = np.zeros(domain.cell_count, bool)

    def __call__(self, stress: Values, psi: Values) -> tuple[Edges, Values]:
        """The edges that cracks cut now, as loaded as they may be (collective)."""
        tips = self.tips()
        weak = self._weak(stress)
        waits = self._waiting is not None and self._waiting.holds(self._toughness_at(tips), self._now)
        found, begun = sum_over_ranks(self._domain.comm, np.array([0 if waits else len(tips), len(weak)]))
        proposals = [self._grown(self.sight.look(stress, psi)) if found else self._none(0)]
        proposals.append(self._begun(weak, stress) if begun else self._none(1))
        if not found + begun:
            self.cells = np.empty(0, np.int64)
            return np.empty(0, np.int64), np.empty(0)
        chosen = self._chosen(*proposals)
        self.cells = np.concatenate([each.cells for each in chosen])
        edges = self._cut(*chosen)
        return edges, np.ones(len(edges))

    def tips(self) -> Tips:
        """Those of this rank (collective)."""
        return self.sight.follow(self.cut)

    def moving(self, v: Values, a: Values, now: float, dt: float) -> None:
        """The body moves so: (owned dofs,) in m/s and m/s^2, at the end of a step of dt, s."""
        self.sight.motion, self._now, self._dt = (v, a), now, dt

    def memory(self) -> object:
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
        shear = np.sqrt(mu / np.asarray(self._stress.material.density))
        return np.asarray(rayleigh_speed(shear, poisson) / (self.disc * self._h))

    @cached_property
    def _rate(self) -> Values:
        return self.release_rate()

    def pace(self) -> float:
        """Passes a second in which a tip, cell by cell, keeps up with a Rayleigh wave and no more (collective)."""
        fastest = float(np.max(self._rate, initial=0.0))
        return CELLS[self._domain.dim] * self.disc * float(self._domain.comm.allreduce(fastest, op=MPI.MAX))

    # --- what is active ---

    def _grown(self, seen: Seen) -> Proposal:
        """Tips that advance."""
        tips, d = seen.tips, self._domain.dim
        h, toughness = self._h[tips.cell], self._toughness_at(tips)
        most = seen.most()
        reaches = self.shares or bool(np.any(most >= toughness))
        force = seen.forces() if reaches else np.zeros_like(tips.point)
        mature = tips.mature.copy()
        size, turns, branches = np.linalg.norm(force, axis=1), *np.zeros((2, len(tips)), bool)
        ahead, apart = np.where(mature[:, None], force, tips.point - tips.behind), APART[d] * h
        if d == 2:
            size, turned = self._turned(seen.phases(), tips, force)
            mature &= size > 0  # a force back is that of other tips in the disc
            turns, abreast = mature & np.any(turned, axis=1), np.any(tips.parts, axis=1)
            ahead = np.where(turns[:, None], turned, ahead)
            apart = np.where(abreast, APART[3] * h, apart)  # what goes abreast gets on alike
        if self._waiting is not None:
            self._waiting.looked(size if reaches else most, self._now)
        enough, forked = self._ready(size, toughness, tips)
        if self.forks:
            branches = turns & forked
            ahead = np.where(branches[:, None], tips.course, ahead)
        stays = (tips.waits & (size < TIPS * toughness)) | self.barred[tips.cell]
        may = np.flatnonzero((~mature | enough) & ~stays)
        if not len(may):
            return self._none(0)
        mean = seen.means(may)
        sigma = largest(mean)
        active = (sigma > 0) & (mature[may] | (sigma >= self._strength_of(tips.cell[may])))
        weak = np.flatnonzero(~active & (sigma > 0))
        strained = np.sqrt(NEAR_TIP[d] * self._modulus[tips.cell] * toughness / (AVERAGE * h))[may[weak]]
        active[weak] = np.sqrt(seen.squares(may[weak])) >= strained
        rows = may[active]
        rank = self._ranked(0, sigma[active], self._numbers(tips.cell[rows]), tips.point[rows], apart[rows])
        entry = self._entry(tips.cell[rows])
        return Proposal(rank, tips.cell[rows], mean[active], entry, ahead[rows], turns[rows], branches[rows])

    def _toughness_at(self, tips: Tips) -> Values:
        """(n,) G_c of tips, J/m^2."""
        return np.broadcast_to(self.toughness, len(self._h))[tips.cell]

    def _entry(self, cells: Ints) -> Ints:
        """(n,) local edge by which a crack came into cells."""
        return np.argmax(~self._graph.intact(cells), axis=1)

    def _ready(self, size: Values, toughness: Values, tips: Tips) -> tuple[Flags, Flags]:
        """(n,) which tips, on which a force of `size` (n,) acts, reach their G_c, and which go on as two
        (collective)."""
        return size >= toughness, np.zeros(len(tips), bool)

    @staticmethod
    def _turned(psi: Values, tips: Tips, force: Values) -> tuple[Values, Values]:
        """(n,) what cracks under K_I and K_II of phase `psi` (n,) release as they turn, J/m^2, and (n, 2) whither; 0
        where nothing lies behind.

        Of the force that along the crack: the stress along its sides, and the wave in it, push across it besides.
        """
        tangent, abreast = unit(tips.point - tips.behind), np.any(tips.parts, axis=1)
        psi = np.where(abreast, 0.0, psi)
        straight = each(force, tips.ahead, tangent) * gain(psi)
        turned = np.where(abreast[:, None], tips.parts, rotated(tangent, kink(psi)))
        return np.where(np.any(tangent, axis=1), straight, np.linalg.norm(force, axis=1)), turned

    def _weak(self, stress: Values) -> Ints:
        """Whole cells, farther than R from any crack, whose stress reaches the strength."""
        graph, d, least = self._graph, self._domain.dim, self.strength.weakest
        # shear counts twice in the norm: most cells are passed over by a plain sum of squares, in a third of the time
        cells = np.flatnonzero(2 * np.einsum("ni,ni->n", stress, stress) >= least**2).astype(np.int64)
        cells = cells[~(graph.damaged[cells] | self.barred[cells]) & (frobenius_norm(stress[cells], d) >= least)]
        cells = cells[upper_bound(tensors(stress[cells], d)) >= least]
        if len(cells) and len(self.sight.crack.number):
            far = self.sight.crack.tree.query(self.sight.centres[cells])[0]
            cells = cells[far > self.disc * self._h[cells]]
        return cells

    def _begun(self, weak: Ints, stress: Values) -> Proposal:
        """Those of them whose averaged stress does (collective)."""
        mean = self.sight.means_at(weak, stress)
        sigma = largest(mean)
        over = sigma >= self._strength_of(weak)
        cells = weak[over]
        radius = self.disc * self._h[cells]
        centres = self.sight.centres[cells]
        return Proposal(self._ranked(1, sigma[over], centres, centres, radius), cells, mean[over])

    def _none(self, kind: int) -> Proposal:
        """Nothing of a kind."""
        d, none = self._domain.dim, np.empty(0, np.int64)
        return Proposal(np.empty((0, d + 4)), none, np.empty((0, d, d)), none, np.empty((0, d)), none > 0, none > 0)

    def _strength_of(self, cells: Ints) -> Values:
        """(n,) Pa: the mean over the edges of each cell."""
        return np.asarray(self.strength(cells, self._graph.cell_edges[cells]).mean(axis=1))

    def _normals(self, stress: Values, cells: Ints) -> Values:
        """(n, d) unit normals, in the body at rest, of cracks across the first principal stress (n, d, d)."""
        direction = directions(stress, self.sight.centres[cells], 0)
        if self._stress.energy.linear:
            return direction
        return material_normals(
            direction, np.eye(stress.shape[1]) + self.sight.gradients(cells, self._stress.u.x.array)
        )

    def _torn(self) -> Flags:
        """(edges,) edges of cells, on any rank, that have come apart (collective)."""
        flags = np.zeros(len(self._graph.broken), bool)
        flags[self._graph.cell_edges[self._graph.split]] = True
        return self._graph.any_over_ranks(flags)

    # --- what is chosen, and cut ---

    @staticmethod
    def _ranked(kind: int, sigma: Values, key: Values, places: Values, apart: Values) -> Values:
        """Rows of `Proposal.rank`; `key`: (n, ...) of which the hash is, alike on any number of ranks."""
        return np.column_stack([np.full(len(sigma), float(kind)), -sigma, hashed(key), places, apart])

    def _numbers(self, cells: Ints) -> Values:
        """(n, 1) of cells in the input mesh: tips that came in by one edge are at one place."""
        return np.asarray(self._domain.cell_input[cells, None], float)

    def _chosen(self, *proposals: Proposal) -> list[Proposal]:
        """The first of those too near to one another: tips before new cracks, then by sigma_1 (collective)."""
        comm, rank = self._domain.comm, np.concatenate([each.rank for each in proposals])
        if not sum_over_ranks(comm, len(rank))[0]:
            self._idle = True
            return list(proposals)
        parts = allgather(comm, rank)
        every = np.concatenate(parts)
        left = list(np.lexsort(every[:, 2::-1].T))
        keep = np.zeros(len(every), bool)
        while left:
            first = left[0]
            keep[first] = True
            apart = np.linalg.norm(every[left, 3:-1] - every[first, 3:-1], axis=1)
            left = [row for row, far in zip(left, apart > every[first, -1], strict=True) if far]
        start = sum(len(part) for part in parts[: comm.rank])
        own = np.split(keep[start : start + len(rank)], np.cumsum([len(each.rank) for each in proposals])[:-1])
        self._idle = not keep.any()
        return [each.taken(rows) for each, rows in zip(proposals, own, strict=True)]

    def _cut(self, grown: Proposal, begun: Proposal) -> Edges:
        """Remember where the cells are cut, on every rank; (n,) local edges of this one (collective)."""
        if self._idle:
            return np.empty(0, np.int64)
        grows, begins = self._rows(grown, self._way_out(grown)), self._rows(begun, self._through(begun))
        edges, courses = self._remembered(np.concatenate([grows, begins]))
        return self._beyond(edges, courses) if self.onwards and self.sight.motion is None else edges

    def _remembered(self, rows: Values) -> tuple[Edges, Values]:
        """Where edges are cut, from all ranks: (n,) local edges of this one, and (n, course) whither cracks go on from
        there (collective)."""
        every = np.concatenate(allgather(self._domain.comm, rows))
        every = every[np.lexsort(every[:, 5:2:-1].T)]  # neighbours cut the same edge where the first of them does
        keys, first = np.unique(every[:, :2].astype(np.int64), axis=0, return_index=True)
        local, place = self._graph.find_keys(keys)
        new = ~self._graph.broken[local] & np.isnan(self.cut[local])
        chosen = every[first[place[new]]]
        self.cut[local[new]] = chosen[:, 2]
        return local[new], chosen[:, 6:]

    def _beyond(self, edges: Edges, courses: Values) -> Edges:
        """Edges (n,) that were cut just now, and in the plane those of whole cells beyond them, which are cut straight
        on (n, 2); 0: not (collective).

        A tip that turned by K_I and K_II knows where it goes for more than a cell; g, of a disc of 5 h, is the same in
        the next to some per cent. Looked at anew there without a solve it would be that of a body out of balance.
        """
        if self._domain.dim == 3:
            return edges
        graph, way = self._graph, np.zeros((len(self._graph.broken), 2))
        way[edges] = courses
        entered = np.any(way[graph.cell_edges], axis=2)
        cells = np.flatnonzero((entered.sum(axis=1) == 1) & ~(graph.damaged | self.barred)).astype(np.int64)
        entry, turns = np.argmax(entered[cells], axis=1), np.ones(len(cells), bool)
        came = graph.cell_edges[cells, entry]
        place, torn, ahead = self.sight.places(came, self.cut), self._torn()[graph.cell_edges[cells]], way[came]
        cuts = leave(self._corners(cells), entry, place, rotated(ahead, np.pi / 2), ahead, torn)
        self.cells = np.concatenate([self.cells, cells])
        rank = self._ranked(0, np.zeros(len(cells)), place, place, np.zeros(len(cells)))
        further = Proposal(rank, cells, np.empty((len(cells), 2, 2)), entry, ahead, turns, ~turns)
        return np.concatenate([edges, self._remembered(self._rows(further, cuts))[0]])

    def _way_out(self, grown: Proposal) -> Cuts:
        """Where the cells of tips are left (collective)."""
        assert grown.entry is not None and grown.ahead is not None
        corners, normals = self._corners(grown.cells), self._normals(grown.stress, grown.cells)
        if self._domain.dim == 3:
            return cleave(corners, ~self._graph.intact(grown.cells), grown.place, normals)
        assert grown.turns is not None and grown.branches is not None
        normals = np.where(grown.turns[:, None], rotated(grown.ahead, np.pi / 2), normals)
        torn = self._torn()[self._graph.cell_edges[grown.cells]]
        return fork(corners, grown.entry, grown.place, normals, grown.ahead, torn, grown.branches)

    def _through(self, begun: Proposal) -> Cuts:
        return through_centre(self._corners(begun.cells), self._normals(begun.stress, begun.cells))

    def _corners(self, cells: Ints) -> Values:
        return self._domain.nodes[self._domain.cell_nodes[cells]]

    def _rows(self, cracks: Proposal, cuts: Cuts) -> Values:
        """(n, 6 + course) key of each edge that is cut, where, from the end that comes first in the input mesh, its
        rank, and whither the crack goes straight on; 0 where it does not."""
        cells = cracks.cells[cuts.row]
        ends = self._domain.node_input[
            self._domain.cell_nodes[cells[:, None], local_edges(self._domain.dim)[cuts.edge]]
        ]
        share = np.where(ends[:, 0] > ends[:, 1], 1 - cuts.share, cuts.share)
        straight = np.zeros((len(cells), self.course))
        if cracks.turns is not None and cracks.ahead is not None and cracks.ahead.shape[1] == self.course:
            straight[:] = np.where(cracks.turns[:, None], cracks.ahead, 0.0)[cuts.row]
        return np.column_stack([np.sort(ends, axis=1), share, cracks.rank[cuts.row, :3], straight])
