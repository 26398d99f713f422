"""Initiation of cracks in cells far from any crack, and the selection of cells that are cut in one pass.

Equations: docs/theory.md#tip-criterion.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import Protocol

import numpy as np
import numpy.typing as npt

from ...mechanics.stress import Stress
from ...mesh.domain import Domain
from ...mesh.edge_graph import EdgeGraph
from ...mesh.ghost_exchange import min_over_ranks
from ...mesh.parallel import allgather, sum_over_ranks
from ..edge_stress import normal_stress_bound
from ..principal_stress import first_principal_stress, symmetric_tensors
from ..strength import EdgeStrength, hash_points
from .critical_distance import CriticalDistance, StartPlaces, average_at_nodes, find_start_places
from .tip_fields import TipFieldEvaluator
from .tip_parameters import TIP

Flags = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


class CutKind(IntEnum):
    """First column of the rank of a proposal: tips come before new cracks."""

    TIP_ADVANCE = 0
    NEW_CRACK = 1


@dataclass(frozen=True)
class CutProposal:
    """Cells of this rank that cracks would cut: those of tips, or those in which cracks would start.

    Attributes:
        rank: (n, d + 4) order of the cells: kind, - sigma_1 in Pa or - load, a hash, the point (d) in m, and the
            distance in m within which no other cell of the pass may be cut.
        cells: (n,) local cells.
        stress: (n, d, d) averaged stress, Pa.
        entry: (n,) local edges by which cracks came in; None for new cracks, as the following.
        ahead: (n, d) directions of the cracks; of those that turn, as long as they are cut beyond the cell, m.
        turns: (n,) the crack follows `ahead` exactly, not the plane across the first principal stress.
        branches: (n,) the crack branches.
    """

    rank: Values
    cells: Ints
    stress: Values
    entry: Ints | None = None
    ahead: Values | None = None
    turns: Flags | None = None
    branches: Flags | None = None

    @property
    def point(self) -> Values:
        """(n, d) points of the tips, or centroids, m."""
        return self.rank[:, 3:-1]

    def select(self, rows: Flags) -> CutProposal:
        """Return the proposal of flagged cells (n,)."""
        entry = None if self.entry is None else self.entry[rows]
        ahead = None if self.ahead is None else self.ahead[rows]
        turns = None if self.turns is None else self.turns[rows]
        branches = None if self.branches is None else self.branches[rows]
        return CutProposal(self.rank[rows], self.cells[rows], self.stress[rows], entry, ahead, turns, branches)


def empty_proposal(dim: int, course_width: int) -> CutProposal:
    """Return a proposal without cells; `course_width`: numbers that describe the course of a crack."""
    none = np.empty(0, np.int64)
    ahead, no = np.empty((0, course_width)), none > 0
    return CutProposal(np.empty((0, dim + 4)), none, np.empty((0, dim, dim)), none, ahead, no, no)


def rank_rows(kind: CutKind, sigma: Values, key: Values, points: Values, exclusion: Values) -> Values:
    """Return the rows of `CutProposal.rank`.

    A hash changes each stress by 1e-6 at most. So cells that mirror each other have one order on any number of ranks,
    where their stress differs by the error of the solution.

    Args:
        kind: advance of a tip, or new crack.
        sigma: (n,) first principal stress, Pa, or load; cells are selected from the largest on.
        key: (n, ...) numbers that the hash is of, the same on any number of ranks.
        points: (n, d) m.
        exclusion: (n,) distance within which no other cell may be cut, m.
    """
    hashed = hash_points(key)
    order = -sigma * (1 - TIP.tie_break * hashed)
    return np.column_stack([np.full(len(sigma), float(kind)), order, hashed, points, exclusion])


def select_proposals(
    domain: Domain, *proposals: CutProposal, one_start: bool = False
) -> tuple[list[CutProposal], bool]:
    """Select the cells that are cut, in order of rank, none within the distance of an earlier one (collective).

    Args:
        domain: gives the ranks.
        proposals: of this rank.
        one_start: whether one new crack at most is selected, and only where no tip advances.

    Returns:
        The selected parts of the proposals of this rank, and whether any rank has any.
    """
    comm, rank = domain.comm, np.concatenate([proposal.rank for proposal in proposals])
    if not sum_over_ranks(comm, len(rank))[0]:
        return list(proposals), False
    parts = allgather(comm, rank)
    rows = np.concatenate(parts)
    # By kind, then by stress, then by hash.
    remaining = list(np.lexsort(rows[:, 2::-1].T))
    if one_start:
        tips = [row for row in remaining if rows[row, 0] == CutKind.TIP_ADVANCE]
        remaining = tips or remaining[:1]
    selected = np.zeros(len(rows), bool)
    while remaining:
        first = remaining[0]
        selected[first] = True
        distance = np.linalg.norm(rows[remaining, 3:-1] - rows[first, 3:-1], axis=1)
        remaining = [row for row, far in zip(remaining, distance > rows[first, -1], strict=True) if far]
    # Every rank selects from all rows, and keeps its own.
    start = sum(len(part) for part in parts[: comm.rank])
    of_this_rank = selected[start : start + len(rank)]
    flags = np.split(of_this_rank, np.cumsum([len(proposal.rank) for proposal in proposals])[:-1])
    chosen = [proposal.select(rows) for proposal, rows in zip(proposals, flags, strict=True)]
    return chosen, bool(selected.any())


def cell_strength(strength: EdgeStrength, graph: EdgeGraph, cells: Ints) -> Values:
    """Return the mean strength (n,) over the edges of cells (n,), Pa."""
    return np.asarray(strength(cells, graph.cell_edges[cells]).mean(axis=1))


class Initiation(Protocol):
    """Interface of the rule by which new cracks start."""

    def find_cells(self, stress: Values, excluded: Flags) -> Ints:
        """Find candidate cells by the local stress (cells, 3 or 6), Pa; `excluded`: (cells,) not to be cut."""

    def propose_cuts(self, cells: Ints, stress: Values) -> CutProposal:
        """Propose the candidates (n,) in which cracks start (collective)."""


class CrackInitiation:
    """A crack starts where strength and energy are reached, far from any crack.

    The first principal stress over the strength of a cell is at least 1, and the largest of such cells within 2 h. The
    mean stress ahead of the cell is at least the threshold of `CriticalDistance`.
    """

    def __init__(
        self,
        stress: Stress,
        graph: EdgeGraph,
        strength: EdgeStrength,
        evaluator: TipFieldEvaluator,
        disc: Values,
        start: CriticalDistance,
    ) -> None:
        """Build the rule (collective); `disc`: (cells,) R, m; `start`: the critical distance."""
        self._graph, self._strength, self._evaluator = graph, strength, evaluator
        self._domain, self._dim, self._start = stress.domain, stress.domain.dim, start
        self._resolution = TIP.start_distance / TIP.disc_radius[self._dim] * disc
        # The disc of a tip, or the mean ahead of a place, must not belong to two cracks.
        self._distance = np.maximum(disc, start.radius)

    @cached_property
    def _places(self) -> StartPlaces:
        """Places at which cracks start (collective at the first use)."""
        return find_start_places(self._domain)

    def find_cells(self, stress: Values, excluded: Flags) -> Ints:
        """Find intact cells, far from any crack, whose local stress (cells, 3 or 6) may be large enough."""
        graph = self._graph
        overloaded = normal_stress_bound(stress, self._dim) >= self._strength.minimum
        cells = np.flatnonzero(overloaded & ~(graph.damaged | excluded)).astype(np.int64)
        cut_cells = self._evaluator.cut_cells
        # Near a crack the tip decides, not the stress of single cells.
        if len(cells) and len(cut_cells.number):
            distance = cut_cells.tree.query(self._evaluator.centres[cells])[0]
            cells = cells[distance > self._distance[cells]]
        return cells

    def propose_cuts(self, cells: Ints, stress: Values) -> CutProposal:
        """Propose the cells (m,) of (n,) in which cracks start (collective)."""
        evaluator, load = self._evaluator, np.zeros(len(stress))
        start_places = self._places
        sigma = first_principal_stress(symmetric_tensors(stress[cells], self._dim))
        # Where no notch concentrates it, the stress of one cell differs from that of its neighbours by error alone.
        smooth = average_at_nodes(self._domain, stress, cells, start_places.weights[cells])
        smooth_sigma = first_principal_stress(symmetric_tensors(smooth, self._dim))
        sigma = np.where(start_places.notched[cells], sigma, np.minimum(sigma, smooth_sigma))
        # Where no crack may start the load is left out: it may be largest around a tip at rest.
        load[cells] = sigma / cell_strength(self._strength, self._graph, cells)
        cells = cells[self._is_largest(cells, load)]
        normals = evaluator.crack_normals(symmetric_tensors(stress[cells], self._dim), cells)
        radii = self._start.radius[cells], self._start.least_radius[cells]
        mean = evaluator.mean_stress_ahead(start_places.points[cells], normals, *radii, stress)
        overloaded = first_principal_stress(mean) >= self._start.threshold[cells]
        cells = cells[overloaded]
        centres = evaluator.centres[cells]
        rank = rank_rows(CutKind.NEW_CRACK, load[cells], centres, centres, self._distance[cells])
        return CutProposal(rank, cells, mean[overloaded])

    def _is_largest(self, cells: Ints, load: Values) -> Flags:
        """Return which cells (n,) have a load of 1 at least, the largest within 2 h (collective).

        `load`: (cells,) of all. Neighbours at a node are compared first: there are a hundred times as many cells as
        places, and each has some hundred cells within 2 h.
        """
        corners, nodes = self._domain.cell_nodes[cells], self._domain.space.dofmap.index_map
        at_node = np.zeros(nodes.size_local + nodes.num_ghosts)
        np.maximum.at(at_node, corners, load[cells, None])
        at_node = -min_over_ranks(nodes, -at_node)
        around = at_node[corners].max(axis=1, initial=0.0)
        is_largest = np.asarray((load[cells] >= 1) & (around * (1 - TIP.force_round_off) <= load[cells]))
        rows = np.flatnonzero(is_largest)
        is_largest[rows] = self._evaluator.find_largest(cells[rows], load, self._resolution[cells[rows]])
        return is_largest
