"""The part of the fracture pass that starts surfaces and breaks the edges that they cut."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ...mechanics.stress import Stress
from ...mesh.edge_graph import EdgeGraph
from ...mesh.parallel import from_root, gather, sum_over_ranks
from ...mesh.simplices import local_edges
from ..criterion import Average, CarriedStress, Edges
from ..strength import Strength
from .crack_level_set import DirectionField
from .grains import SurfaceRules
from .principal_stress import largest, tensors, upper_bound
from .surface_pass import Load, Opened, Pattern

Cells = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]

SPACING = 4.0  # default distance of starts, in sides of a mean cell's cube: about two mesh edges


class BrittleSurfaces:
    """Surfaces where the averaged principal stress of cells reaches their strength, the mean over their edges.

    Attributes:
        starts: (n, d) where the surfaces so far have started, m; the same on every rank.
        cut: (edges,) where surfaces cut local edges, from the end that comes first in the input mesh; NaN elsewhere.
        spacing: least distance of starts, m.
    """

    carried = None

    def __init__(
        self, stress: Stress, graph: EdgeGraph, strength: Strength, average: Average | None, rules: SurfaceRules
    ) -> None:
        self._stress, self._graph, self.strength, self._rules = stress, graph, strength, rules
        self._domain = stress.domain
        self._carried = CarriedStress(stress, graph, average, whole_tensor=True)
        self.spacing = rules.spacing if rules.spacing is not None else SPACING * self._domain.mean_edge_length
        self.starts: Values = np.empty((0, self._domain.dim))
        self.cut: Values = np.full(len(graph.broken), np.nan)
        self.kept_back = 0  # surfaces that may not start now
        self._pattern: Pattern | None = None

    @property
    def left(self) -> int:
        """Surfaces that may still start."""
        return self._rules.surfaces - len(self.starts) - self.kept_back

    def __call__(self, stress: Values, psi: Values | None = None) -> tuple[Edges, Values]:
        """The edges that new surfaces cut; once all surfaces are used up nothing breaks."""
        none = np.empty(0, np.int64), np.empty(0)
        if not self.left:
            return none
        carried, active = self._carried(stress)
        load = self._overloaded(*self._carried.reaching(carried, active, self.strength.weakest))
        if not sum_over_ranks(self._domain.comm, len(load.cell))[0]:
            return none
        parts = gather(self._domain.comm, load)
        field = self._field(self._carried.everywhere(carried, active)) if self._rules.curved else None
        broken = self._graph.broken_keys()
        opened: Opened = from_root(self._domain.comm, lambda: self._open(parts, broken, field))
        self.starts = np.concatenate([self.starts, opened.starts])
        edges = self._cut_edges(opened)
        return edges, np.ones(len(edges))

    def moving(self, v: Values, a: Values, now: float, dt: float) -> None:
        """Stress is all that counts."""

    def memory(self) -> tuple[Values, Values]:
        """Where surfaces have started, and where they cut."""
        return self.starts, self.cut.copy()

    def recall(self, memory: object) -> None:
        """No more surfaces than that."""
        assert isinstance(memory, tuple)
        self.starts, self.cut[:] = memory

    def _overloaded(self, cells: Cells, averaged: Values) -> Load:
        """Those of the cells whose largest principal stress reaches their strength."""
        dim = self._domain.dim
        stress = tensors(averaged, dim)
        may = np.flatnonzero(upper_bound(stress) >= self.strength.weakest)
        cells, stress = cells[may], stress[may]
        load = largest(stress) / self._strength_of(cells)
        over = np.flatnonzero(load >= 1)
        cells = cells[over]
        return Load(self._domain.cell_input[cells], load[over], stress[over], self._gradients(cells))

    def _strength_of(self, cells: Cells) -> Values:
        """(n,) Pa: the mean over the edges of each cell."""
        return np.asarray(self.strength(cells, self._graph.cell_edges[cells]).mean(axis=1))

    def _gradients(self, cells: Cells) -> Values:
        """(n, d, d) F of the configuration that the stress belongs to: x_k - x_0 = F (X_k - X_0). Of quadratic cells
        the mean, as stress is: that of linear cells with `_mean_corners`."""
        rest, now = self._domain.nodes[self._domain.cell_nodes[cells]], self._stress.cell_corners(cells)
        if self._domain.order == 2 and not self._stress.energy.linear:
            now = self._mean_corners(cells)
        span, moved = (corners[:, 1:] - corners[:, :1] for corners in (rest, now))
        return np.swapaxes(np.linalg.solve(span, moved), 1, 2)

    def _mean_corners(self, cells: Cells) -> Values:
        """(n, d + 1, d) corners of the straight cells with the mean gradient of quadratic ones, but for a shift, m.

        It is the gradient at the centroid, where the shape functions l_i (2 l_i - 1) of corners have the slope
        (4 / (d + 1) - 1) grad l_i and 4 l_i l_j of middles 4 / (d + 1) (grad l_i + grad l_j).
        """
        domain, d = self._domain, self._domain.dim
        x = domain.nodes + self._stress.u.x.array.reshape(-1, d)
        middles, share = x[domain.cell_midside_nodes[cells]], 4 / (d + 1)
        result: Values = (share - 1) * x[domain.cell_nodes[cells]]
        for number, ends in enumerate(local_edges(d)):
            result[:, ends] += share * middles[:, number, None]
        return result

    def _field(self, averaged: Values) -> tuple[Any, ...]:
        """Stress, F and strength of all cells in input order, on rank 0 (collective)."""
        every = np.arange(self._domain.cell_count)
        stress = tensors(averaged, self._domain.dim)
        parts = stress, self._gradients(every), self._strength_of(every)
        return tuple(self._domain.gather_cells(part) for part in parts)

    def _open(self, parts: Any, broken: Any, field: tuple[Any, ...] | None) -> Opened:
        """What the pass opens, on rank 0."""
        if self._pattern is None:
            assert self._domain.source is not None
            settle = self._stress.chi is not None
            self._pattern = Pattern(self._domain.source, self._rules, self.spacing, settle)
        load = Load(*(np.concatenate([getattr(part, name) for part in parts]) for name in Load.__annotations__))
        order = np.argsort(load.cell)
        load = Load(*(getattr(load, name)[order] for name in Load.__annotations__))
        most = min(self.left, self._rules.per_pass or self.left)
        along = DirectionField.of(self._pattern.body, *field) if field is not None else None
        return self._pattern.open(load, broken, self.starts, most, along)

    def _cut_edges(self, opened: Opened) -> Edges:
        """(n,) local edges that are cut; where is kept."""
        local, place = self._graph.find_keys(opened.keys)
        self.cut[local] = opened.cut[place]
        return local
