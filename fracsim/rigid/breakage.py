"""Fracture of a body under contact forces: analyses of the body, and of its fragments in turn.

Surfaces open where the averaged principal stress reaches the strength. The fragments that result are analysed under the
forces that act on them, until nothing more breaks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from ..fracture.brittle.surface_criterion import BrittleSurfaces
from ..fracture.criterion import CellAverage
from ..fracture.edge_stress import frobenius_norm
from ..fracture.nonlocal_average import NeighbourAverage
from ..mechanics.stress import Stress
from ..mesh.edge_graph import EdgeGraph
from ..mesh.fragments import Fragments, find_fragments
from ..mesh.input_topology import MeshTopology
from ..solvers.petsc_options import PetscOptions
from .surface_loads import PointLoads, distribute_on_circles, locate_forces

if TYPE_CHECKING:
    from .denting import DentedShape, PlasticDenting

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

# Fraction of its stiffness that a split cell keeps if all its parts belong to one fragment: a crack that ends in the
# body is open, and the nodes between its faces stay in place.
CRACKED_CELL_STIFFNESS = 1e-3


class FragmentAverage:
    """Average of cell values over the cells of one fragment, by another average.

    Attributes:
        in_fragment: (cells,) flags of the cells of the fragment.
    """

    def __init__(self, average: CellAverage | None, count: int) -> None:
        """Begin with all cells, `count` of them; `average`: None: values are taken as they are."""
        self._average = average
        self.in_fragment: Flags = np.ones(count, bool)

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


class BodyAnalysis(Protocol):
    """Quasi-static analysis of one free body.

    Attributes:
        cell_fractions: (cells,) fraction of each cell that belongs to the body.
    """

    cell_fractions: Values

    @property
    def cg_iterations(self) -> int:
        """Iterations of CG in the last solve."""

    def __call__(self, force: Values) -> Values:
        """Return displacements under forces (nodes of the mesh, d), N."""

    def destroy(self) -> None:
        """Free memory."""


class StiffnessOperator(Protocol):
    """Stiffness of bodies that are parts of one mesh; see free_body_analysis and shell_analysis."""

    stress: Stress

    @property
    def beam_thickness(self) -> float:
        """Thickness of the most slender part of a body, m."""

    def whole_body(self, options: PetscOptions | None = None) -> BodyAnalysis:
        """Return the analysis of all cells."""

    def make_body(self, cell_fractions: Values, options: PetscOptions | None = None) -> BodyAnalysis:
        """Return the analysis of cells with fractions (cells,)."""

    def cell_stress(self, u: Values, cell_fractions: Values) -> Values:
        """Return stresses (cells, 3 or 6), Pa, of displacements u."""


class BreakableBody:
    """Fragments of one mesh (one rank).

    Attributes:
        graph: edges of the mesh.
        fragments: connected parts under intact edges.
        analyses: number of analyses so far.
        cg_iterations: iterations of CG in them.
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
        self._check_abort = check_abort
        self._stiffness, self._criterion, self._average, self._options = stiffness, criterion, average, options
        self._denting = denting
        self._domain, self.graph, self.analyses, self.cg_iterations = stiffness.stress.domain, graph, 0, 0
        self._corners = np.ascontiguousarray(self._domain.cell_nodes.T)
        # analyses by the lowest node of the fragment
        self._bodies: dict[int, BodyAnalysis] = {}
        self._node_of_input = np.argsort(self._domain.input_numbering.nodes)
        self._find_fragments()

    def _find_fragments(self) -> None:
        self.fragments: Fragments = find_fragments(self.graph)
        self._lengths: Values | None = None

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
        self._find_fragments()

    # --- loads ---

    def fragment_of(self, name: int) -> int:
        """Return the number of the fragment that a node of the input mesh belongs to."""
        return int(self.fragments.node_fragment[self._node_of_input[name]])

    def may_break(self, fragment: int, force: float) -> bool:
        """Return whether forces, the sum of whose sizes is `force`, N, could break a fragment or make it yield.

        The bound is the stress of a beam of the length of the fragment and the least thickness. There must be
        surfaces left.
        """
        if not self.surfaces_left:
            return False
        if self._lengths is None:
            self._lengths = self._fragment_lengths()
        h = self._stiffness.beam_thickness
        weakest = self._weakest_stress()
        return bool(2 * force * max(float(self._lengths[fragment]), h) / h**3 >= weakest)

    def _weakest_stress(self) -> float:
        """Return the least stress, Pa, at which a cell yields or a surface opens."""
        if self._criterion is not None:
            return self._criterion.strength.minimum
        assert self._denting is not None
        return self._denting.min_yield_stress

    def _fragment_lengths(self) -> Values:
        """Return the diagonals (fragments,), m, of the bounding boxes of fragments."""
        fragment, X = self.fragments.node_fragment, self._domain.nodes
        order = np.argsort(fragment, kind="stable")
        start = np.searchsorted(fragment[order], np.arange(int(fragment.max()) + 1))
        sides = np.maximum.reduceat(X[order], start) - np.minimum.reduceat(X[order], start)
        return np.asarray(np.linalg.norm(sides, axis=1))

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
        cells = self._domain.cell_nodes[self.fragment_cell_fractions(fragment) > 0].astype(np.int64)
        return locate_forces(self._domain.nodes, cells, points, force)

    # --- analyses ---

    def fragment_cell_fractions(self, fragment: int) -> Values:
        """Return the fraction (cells,) of each cell that belongs to a fragment: the share of its nodes."""
        fractions = self._count_corners(self.fragments.node_fragment == fragment) / len(self._corners)
        fractions[self.graph.split & (fractions == 1)] = CRACKED_CELL_STIFFNESS
        return fractions

    def _count_corners(self, nodes: Flags) -> npt.NDArray[np.int8]:
        """Return how many corners (cells,) of each cell have a flag (nodes,)."""
        # a tenth of the time of a sum over an axis
        flags = nodes.view(np.int8)
        return np.asarray(sum(flags[corner] for corner in self._corners))

    def analyse(self, fragment: int, loads: PointLoads) -> Values:
        """Return the stresses (cells, 3 or 6), Pa, of a fragment under loads; 0 in all other cells.

        Raises NotConverged, and StepAborted if the run is to stop.
        """
        if self._check_abort is not None:
            self._check_abort()
        body = self._body(fragment)
        self.analyses += 1
        u = body(loads.nodal_forces(len(self._domain.nodes)))
        self.cg_iterations += body.cg_iterations
        return self._stiffness.cell_stress(u, body.cell_fractions)

    def _body(self, fragment: int) -> BodyAnalysis:
        """Return the analysis of a fragment, which is kept until the fragment breaks.

        The analysis of all cells serves all instances of the mesh.
        """
        key = self._lowest_node(fragment)
        if key not in self._bodies:
            fractions = self.fragment_cell_fractions(fragment)
            if np.all(fractions == 1):
                return self._stiffness.whole_body(self._options)
            self._bodies[key] = self._stiffness.make_body(fractions, self._options)
        return self._bodies[key]

    def _lowest_node(self, fragment: int) -> int:
        return int(np.flatnonzero(self.fragments.node_fragment == fragment)[0])

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
        analyses, iterations = self.analyses, self.cg_iterations
        criterion.reserve(criterion.remaining - max_surfaces)
        try:
            self.break_fragments(self.fragment_of(name), loads)
        finally:
            new_starts = criterion.starts[len(starts) :]
            criterion.set_starts(starts)
            criterion.reserve(0)
        edges = np.flatnonzero(self.graph.broken & ~broken)
        effort = self.analyses - analyses, self.cg_iterations - iterations
        self.analyses, self.cg_iterations = analyses, iterations
        return ImpactOutcome(name, self.graph.keys.of_edges(edges), criterion.cut_positions[edges], new_starts, *effort)

    def _find_dent(self, name: int, loads: PointLoads, energy: float) -> ImpactOutcome:
        """Return the shape that loads leave. Raises NotConverged."""
        assert self._denting is not None
        fragment, iterations, analyses = self.fragment_of(name), self.cg_iterations, self.analyses
        body, stress = self._body(fragment), self.analyse(fragment, loads)
        shape = self._denting(body, stress, energy)  # type: ignore[arg-type]
        self.cg_iterations += body.cg_iterations if shape is not None else 0
        effort = self.analyses - analyses, self.cg_iterations - iterations
        self.analyses, self.cg_iterations = analyses, iterations
        return ImpactOutcome(name, np.empty((0, 2), np.int64), np.empty(0), np.empty((0, 3)), *effort, shape)

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
                self._discard_body(self._lowest_node(fragment))
            criterion.set_cuts(local, cut[order][row])
            flags = np.zeros(len(self.graph.broken), bool)
            flags[local] = True
            self.graph.break_edges(flags)
            self._find_fragments()
        criterion.set_starts(np.concatenate([criterion.starts, *(outcome.surface_starts for outcome in outcomes)]))
        self.analyses += sum(outcome.analyses for outcome in outcomes)
        self.cg_iterations += sum(outcome.cg_iterations for outcome in outcomes)

    def destroy(self, *, owns_operator: bool) -> None:
        """Free the memory of the analyses; `owns_operator`: no other instance has this mesh."""
        for node in [*self._bodies]:
            self._discard_body(node)
        if owns_operator:
            self._stiffness.whole_body(self._options).destroy()

    # --- fracture ---

    def break_fragments(self, fragment: int, loads: PointLoads) -> int:
        """Break a fragment, and the fragments that result, until nothing more breaks; return the number of edges."""
        if self._criterion is None:
            return 0
        broken, waiting = 0, [self._lowest_node(fragment)]
        while waiting:
            node = waiting.pop()
            fragment = int(self.fragments.node_fragment[node])
            nodes = self.fragments.node_fragment == fragment
            own_loads = loads.select(nodes[loads.owner])
            if not len(own_loads.force) or not self._has_unsplit_cell(nodes):
                continue
            count = self._fracture_pass(fragment, nodes, own_loads)
            broken += count
            if count:
                self._discard_body(node)
                self._find_fragments()
                waiting += self._lowest_nodes(nodes)
        return broken

    def _has_unsplit_cell(self, nodes: Flags) -> bool:
        """Return whether a fragment with these nodes (nodes,) has an unsplit cell."""
        return bool(np.any(self._inner_cells(nodes) & ~self.graph.split))

    def _inner_cells(self, nodes: Flags) -> Flags:
        """Return (cells,) flags of cells all of whose nodes have a flag (nodes,)."""
        return np.asarray(self._count_corners(nodes) == len(self._corners))

    def _fracture_pass(self, fragment: int, nodes: Flags, loads: PointLoads) -> int:
        """Analyse a fragment once, break its edges, and return their number."""
        assert self._criterion is not None
        stress = self.analyse(fragment, loads)
        self._average.in_fragment = self._inner_cells(nodes)
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
        """Return whether no average can reach the strength, since no cell of the fragment does.

        With damaged cells this is not known: a cell in which a crack ends may have an average above its own stress.
        """
        assert self._criterion is not None
        cells = np.flatnonzero(self._average.in_fragment & ~self.graph.split)
        size = frobenius_norm(stress[cells], self._domain.dim)
        below = float(size.max(initial=0.0)) < self._criterion.strength.minimum * (1 - 1e-9)
        return below and not self.graph.damaged[cells].any()

    def _lowest_nodes(self, nodes: Flags) -> list[int]:
        """Return the lowest node of each fragment that has some of these nodes (nodes,), the last fragment first."""
        numbers = np.flatnonzero(nodes)
        _, first = np.unique(self.fragments.node_fragment[numbers], return_index=True)
        return [int(node) for node in numbers[first][::-1]]

    def _discard_body(self, node: int) -> None:
        """Free the analysis of the fragment with this lowest node."""
        if (body := self._bodies.pop(node, None)) is not None:
            body.destroy()
