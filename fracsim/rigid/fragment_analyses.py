"""Analyses of the fragments of one mesh under contact forces (one rank)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
import numpy.typing as npt

from ..mechanics.stress import Stress
from ..mesh.edge_graph import EdgeGraph
from ..mesh.fragments import Fragments, find_fragments
from ..solvers.petsc_options import PetscOptions
from .surface_loads import PointLoads

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


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


class FragmentCells:
    """Fragments of a mesh, connected by intact edges, and the cells and nodes that belong to them."""

    def __init__(self, graph: EdgeGraph) -> None:
        self._graph, self._domain = graph, graph.domain
        # one row for each corner, since sums over rows are fast
        self._corners = np.ascontiguousarray(self._domain.cell_nodes.T)
        self._node_of_input = np.argsort(self._domain.input_numbering.nodes)
        self.update()

    def update(self) -> None:
        """Find the fragments after edges broke."""
        self._fragments: Fragments = find_fragments(self._graph)
        self._diagonals: Values | None = None

    @property
    def count(self) -> int:
        """Number of fragments."""
        return self._fragments.count

    @property
    def node_fragment(self) -> Ints:
        """Fragment (nodes,) of every node."""
        return self._fragments.node_fragment

    def containing(self, name: int) -> int:
        """Return the fragment that a node of the input mesh belongs to."""
        return int(self.node_fragment[self._node_of_input[name]])

    def lowest_node(self, fragment: int) -> int:
        """Return the lowest node of a fragment."""
        return int(np.flatnonzero(self.node_fragment == fragment)[0])

    def lowest_nodes(self, nodes: Flags) -> list[int]:
        """Return the lowest node of each fragment that has some of these nodes (nodes,), the last fragment first."""
        numbers = np.flatnonzero(nodes)
        _, first = np.unique(self.node_fragment[numbers], return_index=True)
        return [int(node) for node in numbers[first][::-1]]

    @property
    def diagonals(self) -> Values:
        """Diagonals (fragments,) of the bounding boxes of fragments, m."""
        if self._diagonals is None:
            fragment, X = self.node_fragment, self._domain.nodes
            order = np.argsort(fragment, kind="stable")
            start = np.searchsorted(fragment[order], np.arange(int(fragment.max()) + 1))
            sides = np.maximum.reduceat(X[order], start) - np.minimum.reduceat(X[order], start)
            self._diagonals = np.asarray(np.linalg.norm(sides, axis=1))
        return self._diagonals

    def cell_fractions(self, fragment: int) -> Values:
        """Return the fraction (cells,) of each cell that belongs to a fragment: the share of its nodes."""
        fractions = self._count_corners(self.node_fragment == fragment) / len(self._corners)
        # Share of its stiffness that a split cell keeps if all its parts belong to one fragment: a crack that ends in
        # the body is open, and the nodes between its faces stay in place.
        fractions[self._graph.split & (fractions == 1)] = 1e-3
        return fractions

    def inner_cells(self, nodes: Flags) -> Flags:
        """Return (cells,) flags of cells all of whose nodes have a flag (nodes,)."""
        return np.asarray(self._count_corners(nodes) == len(self._corners))

    def has_unsplit_cell(self, nodes: Flags) -> bool:
        """Return whether a fragment with these nodes (nodes,) has an unsplit cell."""
        return bool(np.any(self.inner_cells(nodes) & ~self._graph.split))

    def _count_corners(self, nodes: Flags) -> npt.NDArray[np.int8]:
        """Return how many corners (cells,) of each cell have a flag (nodes,)."""
        # a tenth of the time of a sum over an axis
        flags = nodes.view(np.int8)
        return np.asarray(sum(flags[corner] for corner in self._corners))


class FragmentAnalyses:
    """Analyses of fragments, each of which is kept until its fragment breaks.

    Attributes:
        stiffness: of the mesh.
        count: number of analyses so far.
        cg_iterations: iterations of CG in them.
    """

    def __init__(
        self,
        stiffness: StiffnessOperator,
        fragments: FragmentCells,
        options: PetscOptions | None,
        check_abort: Callable[[], None] | None,
    ) -> None:
        """Begin without analyses.

        Args:
            stiffness: of the mesh.
            fragments: of the mesh, as they are at each call.
            options: of PETSc.
            check_abort: called before an analysis; raises StepAborted if the run is to stop.
        """
        self.stiffness, self._fragments, self._options, self._check_abort = stiffness, fragments, options, check_abort
        self.count = self.cg_iterations = 0
        # by the lowest node of the fragment
        self._bodies: dict[int, BodyAnalysis] = {}

    def analyse(self, fragment: int, loads: PointLoads) -> Values:
        """Return the stresses (cells, 3 or 6), Pa, of a fragment under loads; 0 in all other cells.

        Raises NotConverged, and StepAborted if the run is to stop.
        """
        if self._check_abort is not None:
            self._check_abort()
        body = self.body(fragment)
        self.count += 1
        u = body(loads.nodal_forces(len(self.stiffness.stress.domain.nodes)))
        self.cg_iterations += body.cg_iterations
        return self.stiffness.cell_stress(u, body.cell_fractions)

    def body(self, fragment: int) -> BodyAnalysis:
        """Return the analysis of a fragment; that of all cells serves all instances of the mesh."""
        key = self._fragments.lowest_node(fragment)
        if key not in self._bodies:
            fractions = self._fragments.cell_fractions(fragment)
            if np.all(fractions == 1):
                return self.stiffness.whole_body(self._options)
            self._bodies[key] = self.stiffness.make_body(fractions, self._options)
        return self._bodies[key]

    def discard(self, lowest_node: int) -> None:
        """Free the analysis of the fragment with this lowest node."""
        if (body := self._bodies.pop(lowest_node, None)) is not None:
            body.destroy()

    def destroy(self, *, owns_operator: bool) -> None:
        """Free the memory of the analyses; `owns_operator`: no other instance has this mesh."""
        for node in [*self._bodies]:
            self.discard(node)
        if owns_operator:
            self.stiffness.whole_body(self._options).destroy()
