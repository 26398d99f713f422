"""Fracture of a body under contact forces: analyses of the body, and of its fragments in turn.

Surfaces open where the averaged principal stress reaches the strength. The fragments that result are analysed under the
forces that act on them, until nothing more breaks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ..fracture.brittle.surface_criterion import BrittleSurfaces
from ..fracture.criterion import CellAverage
from ..fracture.edge_stress import normal_stress_bound
from ..fracture.nonlocal_average import NeighbourAverage
from ..mesh.edge_graph import EdgeGraph
from ..mesh.input_topology import MeshTopology
from ..solvers.petsc_options import PetscOptions
from .fragment_analyses import FragmentAnalyses, FragmentCells, StiffnessOperator
from .surface_loads import PointLoads, distribute_on_circles, locate_forces

if TYPE_CHECKING:
    from .denting import DentedShape, PlasticDenting

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


class FragmentAverage:
    """Average of cell values over the cells of one fragment, by another average.

    Attributes:
        in_fragment: (cells,) flags of the cells of the fragment.
    """

    def __init__(self, average: CellAverage | None, count: int) -> None:
        """Begin with all cells, `count` of them; `average`: None: values are taken as they are."""
        self._average = average
        self.in_fragment: Flags = np.ones(count, bool)

    def restrict_to(self, cells: Flags) -> None:
        """Average over flagged cells (cells,), those of another fragment."""
        self.in_fragment = cells

    def __call__(self, values: Values, active: Flags | None = None) -> Values:
        """Return averages (cells, n) of values (cells, n) over active cells of the fragment; 0 outside of it."""
        values = np.where(self.in_fragment[:, None], values, 0.0)
        return values if self._average is None else self._average(values, self._active_in_fragment(active))

    def find_averages_above(
        self, values: Values, norms: Values, bound: float, active: Flags | None = None
    ) -> tuple[npt.NDArray[np.int64], Values]:
        """Return cells (m,) of the fragment whose average may reach a bound, and their averages (m, n)."""
        if self._average is None:
            cells = np.flatnonzero((norms >= bound) & self.in_fragment)
            return cells, values[cells]
        if isinstance(self._average, NeighbourAverage):
            cells = np.flatnonzero(self.in_fragment)
            return self._average.find_averages_above_in(cells, values, norms, bound, self._active_in_fragment(active))
        cells, averages = self._average.find_averages_above(values, norms, bound, self._active_in_fragment(active))
        inside = self.in_fragment[cells]
        return cells[inside], averages[inside]

    def _active_in_fragment(self, active: Flags | None) -> Flags:
        return self.in_fragment if active is None else self.in_fragment & active


@dataclass(frozen=True)
class ImpactOutcome:
    """Result of the analyses of one body under contact forces.

    Attributes:
        body_name: name of the body.
        edge_keys: (n, 2) keys of the edges that break.
        edge_cuts: (n,) where they are cut.
        surface_starts: (k, 3) points where surfaces start, m.
        analyses: number of analyses.
        cg_iterations: iterations of CG in them.
        shape: of its mesh after plastic flow; None: it did not yield.
    """

    body_name: int
    edge_keys: Ints
    edge_cuts: Values
    surface_starts: Values
    analyses: int
    cg_iterations: int
    shape: DentedShape | None = None


class BreakableBody:
    """Fragments of one mesh (one rank).

    Attributes:
        graph: edges of the mesh.
        fragments: connected parts under intact edges.
        analyses: of the fragments.
    """

    def __init__(
        self,
        stiffness: StiffnessOperator,
        graph: EdgeGraph,
        criterion: BrittleSurfaces | None,
        average: FragmentAverage,
        options: PetscOptions | None = None,
        denting: PlasticDenting | None = None,
        check_abort: Callable[[], None] | None = None,
    ) -> None:
        """Find the fragments.

        Args:
            stiffness: of the mesh.
            graph: edges of the mesh.
            criterion: where surfaces open; None: nothing breaks.
            average: the one that the criterion uses.
            options: of PETSc.
            denting: plastic flow of a body that does not break; None: nothing yields.
            check_abort: called before an analysis; raises StepAborted if the run is to stop.
        """
        self.graph, self.fragments = graph, FragmentCells(graph)
        self.analyses = FragmentAnalyses(stiffness, self.fragments, options, check_abort)
        self._domain, self._criterion, self._average, self._denting = graph.domain, criterion, average, denting

    # --- damage and checkpoints ---

    def input_damage(self) -> tuple[npt.NDArray[np.uint8], Values]:
        """Return patterns (C,) of cells and cut positions (E,) of edges, in the order of the input mesh."""
        domain, source = self._domain, self._domain.input_mesh
        assert source is not None
        pattern = np.empty(domain.cell_count, np.uint8)
        pattern[domain.input_numbering.cells] = self.graph.pattern
        edges = np.arange(len(self.graph.broken))
        cut = np.full(len(edges), np.nan)
        if self._criterion is not None:
            cut[MeshTopology(source).find_edges(self.graph.keys.of_edges(edges))] = self._criterion.cut_positions
        return pattern, cut

    def to_checkpoint(self) -> dict[str, npt.NDArray[Any]]:
        """Return keys (n, 2) of broken edges, where they are cut, and where surfaces started."""
        if self._criterion is None:
            return {}
        keys, cut = self.graph.gather_broken(self._criterion.cut_positions[:, None])  # type: ignore[misc]
        return {"broken": keys, "cut": cut, "starts": self._criterion.starts}

    def from_checkpoint(self, arrays: dict[str, npt.NDArray[Any]]) -> None:
        """Restore the damage that `to_checkpoint` stored."""
        if self._criterion is None:
            return
        self.graph.break_edges(self.graph.keys.edge_flags(arrays["broken"]))
        local, row = self.graph.keys.find_edges(arrays["broken"])
        self._criterion.set_cuts(local, arrays["cut"][row, 0])
        self._criterion.set_starts(arrays["starts"])
        self.fragments.update()

    # --- loads ---

    def may_break(self, fragment: int, force: float) -> bool:
        """Return whether forces, the sum of whose sizes is `force`, N, could break a fragment or make it yield."""
        if not self.surfaces_left:
            return False
        # upper bound: bending stress of a beam of the length of the fragment and the least thickness
        h = self.analyses.stiffness.beam_thickness
        length = max(float(self.fragments.diagonals[fragment]), h)
        return bool(2 * force * length / h**3 >= self._weakest_stress())

    def _weakest_stress(self) -> float:
        """Return the least stress, Pa, at which a cell yields or a surface opens."""
        if self._criterion is not None:
            return self._criterion.strength.minimum
        assert self._denting is not None
        return self._denting.min_yield_stress

    def distribute_forces(
        self, fragment: int, points: Values, force: Values, radius: Values | None = None
    ) -> PointLoads:
        """Return forces (k, d), N, at points (k, d), m, of a fragment at rest as loads on its cells.

        `radius`: (k,) of the circles that they press on, m; None: they act at points.
        """
        if radius is not None:
            if self._denting is not None:
                radius = np.maximum(radius, self._denting.min_contact_radii(force))
            points, force = distribute_on_circles(points, force, radius, self._domain.mean_edge_length)
        cells = self._domain.cell_nodes[self.fragments.cell_fractions(fragment) > 0].astype(np.int64)
        return locate_forces(self._domain.nodes, cells, points, force)

    # --- outcomes ---

    @property
    def surfaces_left(self) -> int:
        """Number of surfaces that may still open; 1 for a body that yields, since its blows are analysed in turn."""
        return int(self._denting is not None) if self._criterion is None else self._criterion.remaining

    @property
    def can_break(self) -> bool:
        """Whether a surface may still open."""
        return self._criterion is not None and self._criterion.remaining > 0

    def find_outcome(self, name: int, loads: PointLoads, max_surfaces: int, energy: float = np.inf) -> ImpactOutcome:
        """Analyse a body under loads. The outcome counts only after `apply_outcomes`.

        Args:
            name: a node of the input mesh that belongs to the body.
            loads: on the body.
            max_surfaces: surfaces that may open.
            energy: that plastic flow may dissipate, J.

        Raises:
            NotConverged: an analysis failed.
        """
        criterion = self._criterion
        if criterion is None:
            return self._find_dent(name, loads, energy)
        broken, starts = self.graph.broken.copy(), criterion.starts
        analyses, iterations = self.analyses.count, self.analyses.cg_iterations
        criterion.reserve(criterion.remaining - max_surfaces)
        try:
            self.break_fragments(self.fragments.containing(name), loads)
        finally:
            # surfaces count only once the outcome is applied
            new_starts = criterion.starts[len(starts) :]
            criterion.set_starts(starts)
            criterion.reserve(0)
        edges = np.flatnonzero(self.graph.broken & ~broken)
        effort = self.analyses.count - analyses, self.analyses.cg_iterations - iterations
        return ImpactOutcome(name, self.graph.keys.of_edges(edges), criterion.cut_positions[edges], new_starts, *effort)

    def _find_dent(self, name: int, loads: PointLoads, energy: float) -> ImpactOutcome:
        """Return the shape that loads leave. Raises NotConverged."""
        assert self._denting is not None
        fragment = self.fragments.containing(name)
        body, stress = self.analyses.body(fragment), self.analyses.analyse(fragment, loads)
        iterations = body.cg_iterations
        shape = self._denting(body, stress, energy)  # type: ignore[arg-type]
        # plastic flow takes a second solve, by the same analysis
        iterations += body.cg_iterations if shape is not None else 0
        return ImpactOutcome(name, np.empty((0, 2), np.int64), np.empty(0), np.empty((0, 3)), 1, iterations, shape)

    def apply_outcomes(self, outcomes: list[ImpactOutcome]) -> None:
        """Break the edges that analyses on any rank found."""
        criterion = self._criterion
        if criterion is None or not outcomes:
            return
        keys = np.concatenate([outcome.edge_keys for outcome in outcomes])
        cut = np.concatenate([outcome.edge_cuts for outcome in outcomes])
        order = np.lexsort(keys.T[::-1])
        local, row = self.graph.keys.find_edges(keys[order])
        new = ~self.graph.broken[local]
        if np.any(new):
            for fragment in np.unique(self.fragments.node_fragment[self.graph.edge_nodes[local[new]]]):
                self.analyses.discard(self.fragments.lowest_node(fragment))
            criterion.set_cuts(local, cut[order][row])
            flags = np.zeros(len(self.graph.broken), bool)
            flags[local] = True
            self.graph.break_edges(flags)
            self.fragments.update()
        criterion.set_starts(np.concatenate([criterion.starts, *(outcome.surface_starts for outcome in outcomes)]))

    # --- fracture ---

    def break_fragments(self, fragment: int, loads: PointLoads) -> int:
        """Break a fragment, and the fragments that result, until nothing more breaks; return the number of edges."""
        if self._criterion is None:
            return 0
        broken, pending = 0, [self.fragments.lowest_node(fragment)]
        while pending:
            node = pending.pop()
            fragment = int(self.fragments.node_fragment[node])
            nodes = self.fragments.node_fragment == fragment
            own_loads = loads.select(nodes[loads.owner])
            if not len(own_loads.force) or not self.fragments.has_unsplit_cell(nodes):
                continue
            count = self._fracture_pass(fragment, nodes, own_loads)
            broken += count
            if count:
                self.analyses.discard(node)
                self.fragments.update()
                pending += self.fragments.lowest_nodes(nodes)
        return broken

    def _fracture_pass(self, fragment: int, nodes: Flags, loads: PointLoads) -> int:
        """Analyse a fragment once, break its edges, and return their number."""
        assert self._criterion is not None
        stress = self.analyses.analyse(fragment, loads)
        self._average.restrict_to(self.fragments.inner_cells(nodes))
        if self._is_surely_safe(stress):
            return 0
        edges, _ = self._criterion(stress)
        flags = np.zeros(len(self.graph.broken), bool)
        flags[edges] = True
        ends = self.graph.edge_nodes.T
        # the boundary of a grain may continue in other fragments
        count = self.graph.break_edges(flags & nodes[ends[0]] & nodes[ends[1]])
        return count + self.graph.break_unloaded_edges() if count else 0

    def _is_surely_safe(self, stress: Values) -> bool:
        """Return whether no average can reach the strength, since no cell of the fragment does."""
        assert self._criterion is not None
        cells = np.flatnonzero(self._average.in_fragment & ~self.graph.split)
        bounds = normal_stress_bound(stress[cells], self._domain.dim)
        below = float(bounds.max(initial=0.0)) < self._criterion.strength.minimum * (1 - 1e-9)
        # a cell in which a crack ends may have an average above its own stress
        return below and not self.graph.damaged[cells].any()
