"""Which edges fail: those whose averaged normal stress reaches their strength (docs/theory.md#edge-criterion)."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
import numpy.typing as npt

from ..mechanics.stress import Stress
from ..mesh.edge_graph import EdgeGraph
from ..mesh.parallel import allgather, sum_over_ranks
from .edge_stress import Simplices, greatest_pull
from .strength import Strength

Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Edges = npt.NDArray[np.integer]
ROUND_OFF = 1e-12  # of a stress, by which a bound of it may be too low


class Criterion(Protocol):
    """Finds the edges that fail."""

    @property
    def cut(self) -> Values | None:
        """(edges,) where local edges are cut, from the end that comes first in the input mesh, NaN: nowhere yet; the
        same array for ever. None: it does not say."""

    @property
    def carried(self) -> Values | None:
        """(edges, n) of tips that run, the same array for ever; None: there are none."""

    def __call__(self, stress: Values, psi: Values) -> tuple[Edges, Values]:
        """(n,) local edges and their load over strength, 1 or more.

        `stress` (cells, 3 or 6) in Pa and `psi` (cells,) in J/m^3 are those of the undamaged material. The same edges
        on all ranks once what each has found is joined (collective).
        """

    def moving(self, v: Values, a: Values, now: float, dt: float) -> None:
        """The body moves so: (owned dofs,) in m/s and m/s^2, at the end of a step of dt, s."""

    def memory(self) -> object:
        """What it remembers of earlier passes, never to be written to again."""

    def recall(self, memory: object) -> None:
        """Remember no more than that."""


class Average(Protocol):
    """A non-local average (fracture.nonlocal_average)."""

    def __call__(self, values: Values, active: Flags | None = None) -> Values:
        """Averages (cells, n) of cell values (cells, n); cells not `active` enter none."""

    def reaching(
        self, values: Values, size: Values, bound: float, active: Flags | None = None
    ) -> tuple[npt.NDArray[np.int64], Values]:
        """Cells (m,) whose average may reach a bound, and those averages (m, n)."""


class CarriedStress:
    """The stress that the intact edges of the cells carry, averaged where there is a radius."""

    def __init__(self, stress: Stress, graph: EdgeGraph, average: Average | None, *, whole_tensor: bool) -> None:
        """`whole_tensor`: more is asked of it than the normal stress along intact edges."""
        self._cells, self._graph, self._average, self._comm = Simplices.of(stress), graph, average, stress.domain.comm
        # by edges and locally there is no need: an intact edge has the same normal stress in the whole tensor
        self._leaves_out = whole_tensor or average is not None

    def __call__(self, stress: Values) -> tuple[Values, Flags | None]:
        """What intact edges carry, and which cells enter an average (None: all): split cells carry nothing."""
        graph = self._graph
        if not sum_over_ranks(self._comm, int(graph.damaged.any()))[0]:
            return stress, None
        if self._leaves_out:
            return self._cells.carried(stress, graph), ~graph.split
        carried = stress.copy()
        carried[graph.split] = 0.0
        return carried, ~graph.split

    def reaching(self, carried: Values, active: Flags | None, bound: float) -> tuple[npt.NDArray[np.int64], Values]:
        """Cells whose averaged stress may reach a bound in Pa along some direction, and that stress (collective).

        No average pulls harder than the average of the pulls: most cells are passed over after one product.
        """
        size, bound = greatest_pull(carried, self._cells.dim), bound * (1 - ROUND_OFF)
        if self._average is not None:
            return self._average.reaching(carried, size, bound, active)
        cells = np.flatnonzero(size >= bound)
        return cells, carried[cells]

    def everywhere(self, carried: Values, active: Flags | None) -> Values:
        """(cells, 3 or 6) the averaged stress of all cells (collective)."""
        return carried if self._average is None else self._average(carried, active)


class OverloadedEdges:
    """Edges whose normal stress in one of their cells reaches the strength.

    Attributes:
        strength: of each edge in each cell.
    """

    cut = carried = None

    def __init__(
        self, stress: Stress, graph: EdgeGraph, strength: Strength, average: Average | None, cap: float | None = None
    ) -> None:
        """`cap`: share of all edges that may fail in one pass, those loaded most first."""
        self.strength, self._cells, self._graph = strength, Simplices.of(stress), graph
        self._carried = CarriedStress(stress, graph, average, whole_tensor=False)
        self._most = None if cap is None else math.ceil(cap * graph.index_map.size_global)

    def __call__(self, stress: Values, psi: Values) -> tuple[Edges, Values]:
        """(n,) local edges over their strength and their loads, at most `cap` of all edges in one pass (collective)."""
        carried, active = self._carried(stress)
        edges, load = self.overloaded(*self._carried.reaching(carried, active, self.strength.weakest))
        return (edges, load) if self._most is None else self._strongest(edges, load, self._most)

    def overloaded(self, cells: npt.NDArray[np.int64], averaged: Values) -> tuple[Edges, Values]:
        """Intact local edges of some cells whose normal stress in their stress (n, 3 or 6) reaches the strength."""
        size = greatest_pull(averaged, self._cells.dim)  # most cells are passed over
        may = size >= self.strength.weakest_of(cells) * (1 - ROUND_OFF)
        cells, averaged = cells[may], averaged[may]
        edges = self._graph.cell_edges[cells]
        along = self._cells.normal_stress(cells, averaged)
        strength = self.strength(cells, edges)
        over = (along >= strength) & ~self._graph.broken[edges]
        return edges[over], along[over] / strength[over]

    def _strongest(self, edges: Edges, load: Values, most: int) -> tuple[Edges, Values]:
        """Those of the candidates of all ranks that are loaded most; equal ones by their input nodes (collective)."""
        keys = self._graph.edge_keys(edges.astype(np.int64))
        every = np.concatenate(allgather(self._graph.domain.comm, np.column_stack([keys, -load])))
        order = np.lexsort((every[:, 1], every[:, 0], every[:, 2]))  # the highest ratio first
        _, first = np.unique(every[order, :2], axis=0, return_index=True)
        chosen = every[order][np.sort(first)[:most], :2].astype(np.int64)
        wanted = self._graph.flags_of_keys(chosen) if len(chosen) else np.zeros(len(self._graph.broken), bool)
        return edges[wanted[edges]], load[wanted[edges]]

    def moving(self, v: Values, a: Values, now: float, dt: float) -> None:
        """Stress is all that counts."""

    def memory(self) -> object:
        """Nothing."""
        return None

    def recall(self, memory: object) -> None:
        """Nothing."""
