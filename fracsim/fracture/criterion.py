"""Fracture criterion: edges fail where their averaged normal stress reaches their strength.

Equations: docs/theory.md#edge-criterion.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np
import numpy.typing as npt

from ..mechanics.stress import Stress
from ..mesh.edge_graph import EdgeGraph
from ..mesh.parallel import allgather, sum_over_ranks
from .edge_stress import EdgeStressOperator, edge_vectors, normal_stress_bound
from .strength import EdgeStrength

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
Edges = npt.NDArray[np.integer]


class FractureCriterion(Protocol):
    """Interface of a criterion: it finds the edges that fail in a fracture pass."""

    @property
    def cut_positions(self) -> Values | None:
        """Positions of the cuts of local edges, (edges,), dimensionless.

        0 is the end that comes first in the input mesh, 1 the other end, NaN an edge that is not cut. It is the same
        array object during the whole run. None: the criterion does not determine positions.
        """

    @property
    def tip_states(self) -> Values | None:
        """States of moving crack tips, (edges, n), the same array object during the run; None without such tips."""

    def __call__(self, stress: Values, psi: Values) -> tuple[Edges, Values]:
        """Find the edges that fail (collective).

        Args:
            stress: (cells, 3 or 6) Cauchy stress of the undamaged material, Pa.
            psi: (cells,) elastic energy density of the undamaged material, J/m^3.

        Returns:
            Local edges (n,) and their load over strength (n,), 1 or more. The union over all ranks does not depend on
            the number of ranks.
        """

    def set_motion(self, v: Values, a: Values, now: float, dt: float) -> None:
        """Store velocity (owned dofs,) in m/s and acceleration in m/s^2 at the end `now` of a step of `dt`, s."""

    def snapshot(self) -> object:
        """Return a copy of the history variables, never written to afterwards."""

    def restore(self, saved: object) -> None:
        """Restore the history variables that `snapshot` returned."""

    def restore_cuts(self, cut_positions: Values, tip_states: Values | None) -> None:
        """Restore the cut positions (edges,) and the states of tips (edges, n) that a checkpoint stored."""


class CellAverage(Protocol):
    """Interface of a non-local average over cells (fracture.nonlocal_average)."""

    def __call__(self, values: Values, active: Flags | None = None) -> Values:
        """Average cell values (cells, n) at all cells; inactive cells are left out of the averages."""

    def find_averages_above(
        self, values: Values, norms: Values, bound: float, active: Flags | None = None
    ) -> tuple[Ints, Values]:
        """Find the cells (m,) whose average may reach `bound`, and their averages (m, n)."""


class IntactEdgeStress:
    """The stress that intact edges carry, averaged over cells if an average is given."""

    def __init__(self, stress: Stress, graph: EdgeGraph, average: CellAverage | None, *, whole_tensor: bool) -> None:
        """Prepare the reduction of the stress by broken edges.

        Args:
            stress: stress of the body; its configuration is that of the edges.
            graph: edges and their damage.
            average: non-local average, None for the local stress.
            whole_tensor: the caller needs more of the tensor than the normal stress along intact edges.
        """
        self._edge_stress = EdgeStressOperator.from_stress(stress)
        self._graph, self._average, self._comm = graph, average, stress.domain.comm
        # The local normal stress along an intact edge is the same with and without the broken edges.
        self._removes_broken_edges = whole_tensor or average is not None

    def __call__(self, stress: Values) -> tuple[Values, Flags | None]:
        """Return the stress (cells, 3 or 6) that intact edges carry, and the cells that enter averages (None: all)."""
        graph = self._graph
        if not sum_over_ranks(self._comm, int(graph.damaged.any()))[0]:
            return stress, None
        if self._removes_broken_edges:
            return self._edge_stress.intact_edge_stress(stress, graph), ~graph.split
        carried = stress.copy()
        carried[graph.split] = 0.0
        return carried, ~graph.split

    def find_averages_above(self, carried: Values, active: Flags | None, bound: float) -> tuple[Ints, Values]:
        """Find cells whose averaged stress may reach `bound` (Pa) in some direction, and that stress (collective)."""
        # The largest normal stress of an average is at most the average of the largest normal stresses: a scalar
        # average excludes most cells.
        norms = normal_stress_bound(carried, self._edge_stress.dim)
        if self._average is not None:
            return self._average.find_averages_above(carried, norms, bound, active)
        cells = np.flatnonzero(norms >= bound)
        return cells, carried[cells]

    def average_all(self, carried: Values, active: Flags | None) -> Values:
        """Return the averaged stress (cells, 3 or 6) of all cells (collective)."""
        return carried if self._average is None else self._average(carried, active)


class OverloadedEdges:
    """Criterion: an edge fails if its normal stress in one of its cells reaches the strength (M22, section 3.4).

    Attributes:
        strength: strength of each edge in each cell, Pa.
    """

    cut_positions = tip_states = None

    def __init__(
        self,
        stress: Stress,
        graph: EdgeGraph,
        strength: EdgeStrength,
        average: CellAverage | None,
        cap: float | None = None,
    ) -> None:
        """Build the criterion; `cap` is the largest share of all edges that fails in one pass, most loaded first."""
        self.strength, self._graph = strength, graph
        self._edge_stress = EdgeStressOperator.from_stress(stress)
        self._carried = IntactEdgeStress(stress, graph, average, whole_tensor=False)
        self._max_edges = None if cap is None else math.ceil(cap * graph.index_map.size_global)

    def __call__(self, stress: Values, psi: Values) -> tuple[Edges, Values]:
        """Find the local edges (n,) that fail, and their load over strength (n,) (collective)."""
        carried, active = self._carried(stress)
        edges, load = self.find_overloaded(*self._carried.find_averages_above(carried, active, self.strength.minimum))
        return (edges, load) if self._max_edges is None else self._select_most_loaded(edges, load, self._max_edges)

    def find_overloaded(self, cells: Ints, averaged: Values) -> tuple[Edges, Values]:
        """Find the intact edges of cells (n,) whose normal stress under `averaged` (n, 3 or 6) reaches the strength."""
        # One scalar a cell excludes most cells before the normal stress of their edges is computed.
        norms = normal_stress_bound(averaged, self._edge_stress.dim)
        candidate = norms >= self.strength.minimum_in(cells)
        cells, averaged = cells[candidate], averaged[candidate]
        edges = self._graph.cell_edges[cells]
        normal_stress = self._edge_stress.normal_stress(cells, averaged)
        strength = self.strength(cells, edges)
        fails = (normal_stress >= strength) & ~self._graph.broken[edges]
        return edges[fails], normal_stress[fails] / strength[fails]

    def _select_most_loaded(self, edges: Edges, load: Values, count: int) -> tuple[Edges, Values]:
        """Select the `count` most loaded edges of all ranks; ties are ordered by input nodes (collective)."""
        keys = self._graph.keys.of_edges(edges.astype(np.int64))
        rows = np.concatenate(allgather(self._graph.domain.comm, np.column_stack([keys, -load])))
        order = np.lexsort((rows[:, 1], rows[:, 0], rows[:, 2]))  # the highest ratio first
        _, first = np.unique(rows[order, :2], axis=0, return_index=True)
        chosen = rows[order][np.sort(first)[:count], :2].astype(np.int64)
        selected = self._graph.keys.edge_flags(chosen) if len(chosen) else np.zeros(len(self._graph.broken), bool)
        return edges[selected[edges]], load[selected[edges]]

    def set_motion(self, v: Values, a: Values, now: float, dt: float) -> None:
        """Do nothing: the criterion depends on the stress alone."""

    def snapshot(self) -> object:
        """Return None: the criterion has no history."""
        return None

    def restore(self, saved: object) -> None:
        """Do nothing: the criterion has no history."""

    def restore_cuts(self, cut_positions: Values, tip_states: Values | None) -> None:
        """Do nothing: the criterion does not determine cuts."""


EdgeLoad = Callable[[Values, Values, Values], Values]


class UserCriterion(OverloadedEdges):
    """Criterion of the user: an edge fails if the load that a function gives in one of its cells reaches 1.

    The function has arguments stress (n, d, d) in Pa, averaged as the study asks, unit edge vectors (n, k, d) and
    strengths (n, k) in Pa. It returns loads (n, k). Stress and edges are those of the present configuration.
    """

    def __init__(
        self,
        load: EdgeLoad,
        stress: Stress,
        graph: EdgeGraph,
        strength: EdgeStrength,
        average: CellAverage | None,
        cap: float | None = None,
    ) -> None:
        """Build the criterion; the arguments are those of `OverloadedEdges`, after the function."""
        super().__init__(stress, graph, strength, average, cap)
        self._load, self._stress = load, stress
        self._carried = IntactEdgeStress(stress, graph, average, whole_tensor=True)

    def __call__(self, stress: Values, psi: Values) -> tuple[Edges, Values]:
        """Find the local edges (n,) that fail, and their loads (n,) (collective)."""
        averaged = self._carried.average_all(*self._carried(stress))
        cells, edges = np.arange(len(averaged)), self._graph.cell_edges
        vectors = edge_vectors(self._stress.cell_corners(cells))
        length = np.linalg.norm(vectors, axis=2, keepdims=True)
        directions = np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0)
        load = np.asarray(self._load(full_tensors(averaged), directions, self.strength(cells, edges)), float)
        fails = (load >= 1) & ~self._graph.broken[edges] & ~self._graph.split[:, None]
        overloaded = edges[fails], load[fails]
        return overloaded if self._max_edges is None else self._select_most_loaded(*overloaded, self._max_edges)


def full_tensors(components: Values) -> Values:
    """Return symmetric tensors (n, d, d) of components (n, 3 or 6): the normal ones, then xy, or xy, xz and yz."""
    dim = 2 if components.shape[1] == 3 else 3
    tensors = np.empty((len(components), dim, dim))
    pairs = [(i, i) for i in range(dim)] + [(i, j) for i in range(dim) for j in range(i + 1, dim)]
    for column, (i, j) in enumerate(pairs):
        tensors[:, i, j] = tensors[:, j, i] = components[:, column]
    return tensors
