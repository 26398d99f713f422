"""Initiation of cracks in cells far from any crack, and the selection of cells that are cut in one pass.

Equations: docs/theory.md#tip-criterion.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import numpy.typing as npt

from ...mechanics.stress import Stress
from ...mesh.domain import Domain
from ...mesh.edge_graph import EdgeGraph
from ...mesh.parallel import allgather, sum_over_ranks
from ..edge_stress import frobenius_norm
from ..principal_stress import first_principal_stress, principal_stress_bound, symmetric_tensors
from ..strength import EdgeStrength, hash_points
from .critical_distance import CriticalDistance, start_points
from .tip_fields import TipFieldEvaluator
from .tip_parameters import TIP

Flags = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]

# First column of the rank of a proposal: tips come before new cracks.
TIP_ADVANCE, NEW_CRACK = 0, 1


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


def rank_rows(kind: int, sigma: Values, key: Values, points: Values, exclusion: Values) -> Values:
    """Return the rows of `CutProposal.rank`.

    Args:
        kind: TIP_ADVANCE or NEW_CRACK.
        sigma: (n,) first principal stress, Pa, or load; cells are selected from the largest on.
        key: (n, ...) numbers that the hash is of, the same on any number of ranks.
        points: (n, d) m.
        exclusion: (n,) distance within which no other cell may be cut, m.
    """
    return np.column_stack([np.full(len(sigma), float(kind)), -sigma, hash_points(key), points, exclusion])


def select_proposals(domain: Domain, *proposals: CutProposal) -> tuple[list[CutProposal], bool]:
    """Select the cells that are cut, in order of rank, none within the distance of an earlier one (collective).

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
    """A crack starts where strength and energy are reached, farther than R from any crack.

    The first principal stress over the strength of a cell is at least 1, and the largest within the critical distance.
    The mean stress ahead of the cell is at least the threshold of `CriticalDistance`.
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
        self._graph, self._strength, self._evaluator, self._disc = graph, strength, evaluator, disc
        self._domain, self._dim, self._start = stress.domain, stress.domain.dim, start
        # The most loaded cell as far as a crack of the critical distance, or its tip, may reach.
        self._distance = np.maximum(TIP.start_distance / TIP.disc_radius[self._dim] * disc, start.radius)

    @cached_property
    def _points(self) -> Values:
        """(cells, d) points from which cracks start, m (collective where they are first asked for)."""
        return start_points(self._domain)

    def find_cells(self, stress: Values, excluded: Flags) -> Ints:
        """Find intact cells, farther than R from any crack, whose local stress (cells, 3 or 6) may be large enough."""
        graph, d, minimum = self._graph, self._dim, self._strength.minimum
        # Shear counts twice in the norm: a plain sum of squares excludes most cells in a third of the time.
        cells = np.flatnonzero(2 * np.einsum("ni,ni->n", stress, stress) >= minimum**2).astype(np.int64)
        cells = cells[~(graph.damaged[cells] | excluded[cells]) & (frobenius_norm(stress[cells], d) >= minimum)]
        cells = cells[principal_stress_bound(symmetric_tensors(stress[cells], d)) >= minimum]
        cut_cells = self._evaluator.cut_cells
        # Near a crack the tip decides, not the stress of single cells.
        if len(cells) and len(cut_cells.number):
            distance = cut_cells.tree.query(self._evaluator.centres[cells])[0]
            cells = cells[distance > self._disc[cells]]
        return cells

    def propose_cuts(self, cells: Ints, stress: Values) -> CutProposal:
        """Propose the cells (m,) of (n,) in which cracks start (collective)."""
        load = self._load(stress)
        cells = cells[load[cells] >= 1]
        cells = cells[self._evaluator.find_largest(cells, load, self._distance[cells])]
        normals = self._evaluator.crack_normals(symmetric_tensors(stress[cells], self._dim), cells)
        mean = self._evaluator.mean_stress_ahead(self._points[cells], normals, self._start.radius[cells], stress)
        overloaded = first_principal_stress(mean) >= self._start.threshold[cells]
        cells = cells[overloaded]
        centres, exclusion = self._evaluator.centres[cells], np.maximum(self._disc, self._start.radius)[cells]
        rank = rank_rows(NEW_CRACK, load[cells], centres, centres, exclusion)
        return CutProposal(rank, cells, mean[overloaded])

    def _load(self, stress: Values) -> Values:
        """Return the first principal stress over the strength (cells,) of unsplit cells, 0 far below the strength."""
        load = np.zeros(len(stress))
        cells = np.flatnonzero(~self._graph.split & (frobenius_norm(stress, self._dim) >= self._strength.minimum))
        sigma = first_principal_stress(symmetric_tensors(stress[cells], self._dim))
        load[cells] = sigma / cell_strength(self._strength, self._graph, cells)
        return load
