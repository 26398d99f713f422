"""Criterion of brittle surfaces: surfaces start where stress reaches the strength, and break the edges that they cut.

Geometry is computed on rank 0 in the input mesh, and only in passes in which a surface starts, so that the pattern is
the same on any number of ranks. Equations: docs/theory.md#brittle-surfaces.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ...mechanics.stress import Stress
from ...mesh.edge_graph import EdgeGraph
from ...mesh.parallel import from_root, gather, sum_over_ranks
from ...mesh.simplices import local_edges
from ...meshes.data import MeshData
from ..criterion import CellAverage, Edges, IntactEdgeStress
from ..edge_stress import normal_stress_bound
from ..principal_stress import first_principal_stress, symmetric_tensors
from ..strength import EdgeStrength
from .crack_level_set import DirectionField
from .grains import SurfaceParameters
from .surface_pass import OpenedSurfaces, OverloadedCells, SurfacePass

Cells = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


class BrittleSurfaces:
    """Criterion: a surface starts where the averaged first principal stress of a cell reaches its strength.

    The strength of a cell is the mean over its edges.

    Attributes:
        strength: strength of each edge in each cell, Pa.
        spacing: least distance between starts, m.
        starts: (n, d) points where the surfaces started so far, m; the same on every rank.
        cut_positions: (edges,) cuts of local edges, 0 at the end that comes first in the input mesh to 1 at the other;
            NaN elsewhere.
    """

    tip_states = None

    def __init__(
        self,
        stress: Stress,
        graph: EdgeGraph,
        strength: EdgeStrength,
        average: CellAverage | None,
        parameters: SurfaceParameters,
    ) -> None:
        self._stress, self._graph, self.strength, self._parameters = stress, graph, strength, parameters
        self._domain = stress.domain
        self._carried = IntactEdgeStress(stress, graph, average, whole_tensor=True)
        spacing = parameters.spacing
        # The mean edge is the side of a cube of the mean cell's volume: 4 of them are about two mesh edges.
        self.spacing = spacing if spacing is not None else 4.0 * self._domain.mean_edge_length
        self.starts: Values = np.empty((0, self._domain.dim))
        self.cut_positions: Values = np.full(len(graph.broken), np.nan)
        self._reserved = 0
        self._surface_pass: SurfacePass | None = None

    @property
    def remaining(self) -> int:
        """Number of surfaces that may still start."""
        return self._parameters.surfaces - len(self.starts) - self._reserved

    def set_starts(self, starts: Values) -> None:
        """Replace the points (n, d), m, where the surfaces started so far."""
        self.starts = starts

    def reserve(self, count: int) -> None:
        """Reserve surfaces for later: `count` of the remaining ones may not start at present."""
        self._reserved = count

    def __call__(self, stress: Values, psi: Values | None = None) -> tuple[Edges, Values]:
        """Find the local edges (n,) that new surfaces cut, with loads of 1 (collective).

        Args:
            stress: (cells, 3 or 6) Cauchy stress of the undamaged material, Pa.
            psi: not used.
        """
        none = np.empty(0, np.int64), np.empty(0)
        if not self.remaining:
            return none
        carried, active = self._carried(stress)
        cells, averaged = self._carried.find_averages_above(carried, active, self.strength.minimum)
        load = self._find_overloaded(cells, averaged)
        if not sum_over_ranks(self._domain.comm, len(load.cell))[0]:
            return none
        parts = gather(self._domain.comm, load)
        field = self._cell_fields(self._carried.average_all(carried, active)) if self._parameters.curved else None
        broken, mesh = self._graph.broken_keys(), self._domain.input_mesh
        opened: OpenedSurfaces = from_root(self._domain.comm, lambda: self._open_on_root(mesh, parts, broken, field))
        self.starts = np.concatenate([self.starts, opened.starts])
        edges = self._store_cuts(opened)
        return edges, np.ones(len(edges))

    def set_motion(self, v: Values, a: Values, now: float, dt: float) -> None:
        """Do nothing: the criterion depends on the stress alone."""

    def snapshot(self) -> tuple[Values, Values]:
        """Return the starts (n, d) and the cut positions (edges,)."""
        return self.starts, self.cut_positions.copy()

    def restore(self, saved: object) -> None:
        """Restore the starts and cut positions that `snapshot` returned."""
        assert isinstance(saved, tuple)
        self.starts, self.cut_positions[:] = saved

    def restore_cuts(self, cut_positions: Values, tip_states: Values | None) -> None:
        """Restore the cut positions (edges,) that a checkpoint stored."""
        self.cut_positions[:] = cut_positions

    def set_cuts(self, edges: Edges, positions: Values) -> None:
        """Set the cut positions (n,) of local edges (n,)."""
        self.cut_positions[edges] = positions

    def _find_overloaded(self, cells: Cells, averaged: Values) -> OverloadedCells:
        """Find those of cells (n,) whose first principal stress reaches their strength."""
        dim = self._domain.dim
        candidates = np.flatnonzero(normal_stress_bound(averaged, dim) >= self.strength.minimum)
        cells, stress = cells[candidates], symmetric_tensors(averaged[candidates], dim)
        load = first_principal_stress(stress) / self._cell_strength(cells)
        overloaded = np.flatnonzero(load >= 1)
        cells = cells[overloaded]
        return OverloadedCells(
            self._domain.input_numbering.cells[cells], load[overloaded], stress[overloaded], self._gradients(cells)
        )

    def _cell_strength(self, cells: Cells) -> Values:
        """Return the mean strength (n,) over the edges of cells, Pa."""
        return np.asarray(self.strength(cells, self._graph.cell_edges[cells]).mean(axis=1))

    def _gradients(self, cells: Cells) -> Values:
        """Return F (n, d, d) of the configuration of the stress, x_k - x_0 = F (X_k - X_0).

        For quadratic cells it is the mean, as the stress is: that of the linear cells with `_mean_corners`.
        """
        reference, present = self._domain.nodes[self._domain.cell_nodes[cells]], self._stress.cell_corners(cells)
        if self._domain.order == 2 and not self._stress.energy.linear:
            present = self._mean_corners(cells)
        reference_edges, present_edges = (corners[:, 1:] - corners[:, :1] for corners in (reference, present))
        return np.swapaxes(np.linalg.solve(reference_edges, present_edges), 1, 2)

    def _mean_corners(self, cells: Cells) -> Values:
        """Return corners (n, d + 1, d), m, of straight cells with the mean gradient of quadratic ones, but for a shift.

        The mean gradient is that at the centroid, where the shape functions l_i (2 l_i - 1) of corners have the
        gradient (4 / (d + 1) - 1) grad l_i, and 4 l_i l_j of midside nodes 4 / (d + 1) (grad l_i + grad l_j).
        """
        domain, d = self._domain, self._domain.dim
        x = domain.nodes + self._stress.u.x.array.reshape(-1, d)
        midside, share = x[domain.cell_midside_nodes.of_edges[cells]], 4 / (d + 1)
        result: Values = (share - 1) * x[domain.cell_nodes[cells]]
        for number, ends in enumerate(local_edges(d)):
            result[:, ends] += share * midside[:, number, None]
        return result

    def _cell_fields(self, averaged: Values) -> tuple[Any, ...]:
        """Gather stress, F and strength of all cells in input order on rank 0 (collective)."""
        cells = np.arange(self._domain.cell_count)
        stress = symmetric_tensors(averaged, self._domain.dim)
        fields = stress, self._gradients(cells), self._cell_strength(cells)
        return tuple(self._domain.input_numbering.gather_cells(values) for values in fields)

    def _open_on_root(
        self, mesh: MeshData | None, parts: Any, broken: Any, field: tuple[Any, ...] | None
    ) -> OpenedSurfaces:
        """Open the surfaces of the pass, on rank 0, from the overloaded cells of all ranks."""
        # The topology of the input mesh is built when the first surface starts.
        if self._surface_pass is None:
            assert mesh is not None
            retain_nodes = self._stress.chi is not None
            self._surface_pass = SurfacePass(mesh, self._parameters, self.spacing, retain_nodes)
        names = OverloadedCells.__annotations__
        load = OverloadedCells(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))
        # In the order of the input mesh, whatever the ranks.
        order = np.argsort(load.cell)
        load = OverloadedCells(*(getattr(load, name)[order] for name in names))
        count = min(self.remaining, self._parameters.per_pass or self.remaining)
        directions = DirectionField.from_cells(self._surface_pass.mesh, *field) if field is not None else None
        return self._surface_pass.open_surfaces(load, broken, self.starts, count, directions)

    def _store_cuts(self, opened: OpenedSurfaces) -> Edges:
        """Store the cut positions; return the local edges (n,) that are cut."""
        local, row = self._graph.keys.find_edges(opened.keys)
        self.set_cuts(local, opened.cut_positions[row])
        return local
