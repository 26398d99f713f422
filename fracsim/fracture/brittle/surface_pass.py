"""Pass of brittle surfaces on rank 0: surfaces open one after the other in the arrays of the input mesh.

Surfaces start at the most loaded cells first, and no start is nearer than a spacing to another (non-maximum
suppression). Equations: docs/theory.md#brittle-surfaces.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...meshes.data import MeshData
from ..principal_stress import first_principal_directions, material_normals
from .crack_level_set import CurvedLevelSet, DirectionField, plane_distance
from .grains import GrainBoundaries, SurfaceParameters
from .surface_cut import (
    CrossedCells,
    SurfaceCutMesh,
    level_set_cut_positions,
    reassign_isolated_nodes,
    sides_of_level_set,
)

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


class StartCandidates:
    """Cells at which a surface of one pass may start.

    Attributes:
        points: (n, d) centroids of the candidates, m.
        spacing: least distance between starts, also to those of earlier passes, m.
    """

    def __init__(self, points: Values, load: Values, spacing: float, earlier_starts: Values) -> None:
        """Order the candidates by load (n,), the highest first; equal loads keep their order."""
        self.points, self.spacing = points, spacing
        self._remaining: Ints = np.argsort(-load, kind="stable")
        for point in earlier_starts:
            self.exclude_near(point)

    def pop_most_loaded(self) -> int | None:
        """Remove and return the most loaded candidate; None if none is left."""
        if not len(self._remaining):
            return None
        chosen = int(self._remaining[0])
        self._remaining = self._remaining[1:]
        return chosen

    def exclude_near(self, point: Values, share: float = 1.0) -> None:
        """Remove the candidates nearer to a point (d,) than a share of the spacing."""
        arm = self.points[self._remaining] - point
        self._remaining = self._remaining[np.einsum("ni,ni->n", arm, arm) >= (share * self.spacing) ** 2]

    def discard(self, candidates: npt.NDArray[np.bool_]) -> None:
        """Remove the flagged candidates (n,)."""
        self._remaining = self._remaining[~candidates[self._remaining]]


@dataclass(frozen=True)
class OverloadedCells:
    """Cells whose first principal stress reaches the strength.

    Attributes:
        cell: (n,) numbers in the input mesh.
        load: (n,) first principal stress over strength.
        stress: (n, d, d) Cauchy stress, Pa.
        gradient: (n, d, d) deformation gradient F.
    """

    cell: Ints
    load: Values
    stress: Values
    gradient: Values


@dataclass(frozen=True)
class OpenedSurfaces:
    """Surfaces opened in a pass.

    Attributes:
        starts: (s, d) points where they start, m.
        keys: (n, 2) nodes of the edges that they cut, the lower first.
        cut_positions: (n,) positions of the cuts from the lower node.
    """

    starts: Values
    keys: Ints
    cut_positions: Values


class SurfacePass:
    """Opens surfaces in a mesh, on the rank that has the input mesh.

    Attributes:
        mesh: the input mesh.
        parameters: parameters of the surfaces.
        grains: grain boundaries, None without grains.
    """

    def __init__(self, mesh: MeshData, parameters: SurfaceParameters, spacing: float, retain_nodes: bool) -> None:
        """Prepare the mesh; `retain_nodes`: nodes left without an unsplit cell move to the surface's other side."""
        self.mesh, self.parameters = SurfaceCutMesh(mesh), parameters
        self._spacing, self._retain_nodes = spacing, retain_nodes
        grains = parameters.grains
        self.grains = GrainBoundaries(self.mesh, grains, retain_nodes) if grains is not None else None

    def open_surfaces(
        self, load: OverloadedCells, broken_keys: Ints, earlier_starts: Values, count: int,
        field: DirectionField | None = None,
    ) -> OpenedSurfaces:  # fmt: skip
        """Open up to `count` surfaces, from the most loaded cells.

        A cell that a surface of this pass cuts is relieved: no other surface starts there.

        Args:
            load: candidates.
            broken_keys: (n, 2) nodes of broken edges.
            earlier_starts: (n, d) starts of earlier passes, m.
            count: largest number of surfaces.
            field: principal directions for curved surfaces; None for planes.
        """
        mesh, points = self.mesh, self.mesh.centroids[load.cell]
        directions = first_principal_directions(load.stress, points, mesh.size, self.parameters.seed)
        normals = material_normals(directions, load.gradient)
        damage = _PassDamage(mesh, broken_keys)
        candidates = StartCandidates(points, load.load, self._spacing, earlier_starts)
        starts: list[Values] = []
        while len(starts) < count and (start := candidates.pop_most_loaded()) is not None:
            cell = int(load.cell[start])
            if self._open_surface(damage, cell, normals[start], field):
                starts.append(points[start])
                candidates.exclude_near(points[start])
                candidates.discard(damage.touched[load.cell])
            elif self.grains is None:
                # There is no room for two sides with unsplit cells: no surface starts within half of the spacing.
                candidates.exclude_near(points[start], 0.5)
            else:
                # All edges around this grain are broken.
                candidates.discard(self.grains.cell_grain[load.cell] == self.grains.cell_grain[cell])
        new = np.flatnonzero(~np.isnan(damage.cut_positions))
        return OpenedSurfaces(
            np.array(starts).reshape(-1, mesh.dim), mesh.edges[new].astype(np.int64), damage.cut_positions[new]
        )

    def _open_surface(self, damage: _PassDamage, cell: int, normal: Values, field: DirectionField | None) -> bool:
        """Open the surface through a cell; return whether it cuts anything."""
        grains = self.grains
        if grains is None:
            return self._cut_level_set(damage, cell, *self._level_set(damage, cell, normal, field))
        grain = int(grains.cell_grain[cell])
        if grains.mode == "replace":
            sides = grains.node_grain == grain
            crossed = CrossedCells.from_sides(self.mesh, sides, damage.broken)
            return self._cut_grain_boundaries(grains, damage, crossed, None)
        phi = self._level_set(damage, cell, normal, field)[1]
        sides = sides_of_level_set(grains.average_by_grain(phi), self.mesh.tolerance)[grains.node_grain]
        crossed = CrossedCells.from_sides(self.mesh, sides, damage.broken)
        return self._cut_grain_boundaries(grains, damage, crossed, grains.edges_of(grain))

    def _level_set(
        self, damage: _PassDamage, cell: int, normal: Values, field: DirectionField | None
    ) -> tuple[Flags | None, Values]:
        """Return the nodes (nodes,) where phi is defined (None: everywhere), and phi (nodes,), m."""
        mesh, origin, defined = self.mesh, self.mesh.centroids[cell], None
        if field is None:
            phi = plane_distance(mesh.points, origin, normal)
        else:
            curved = CurvedLevelSet(mesh, field, damage.broken)
            phi = curved(cell, origin, normal)
            defined = ~np.isnan(phi)
            # Whether a node of the surface has a cell on its own side depends on the nodes around it.
            required = self._flag_neighbours(defined) if self.grains is None else np.ones_like(defined)
            phi = curved.extrapolate_to(required)
        return defined, phi * self._sign(phi, cell)

    def _flag_neighbours(self, nodes: Flags) -> Flags:
        """Flag the nodes (nodes,) of all cells around flagged nodes."""
        result = nodes.copy()
        result[self.mesh.cells[self.mesh.flag_with_nodes(nodes)]] = True
        return result

    def _sign(self, phi: Values, cell: int) -> float:
        """Return 1 or -1, so that the lowest node of the cell that is not on the surface is on the positive side."""
        # A principal direction has no sign. Nodes on the surface belong to the positive side.
        nodes = np.sort(self.mesh.cells[cell])
        off_surface = np.flatnonzero(np.abs(phi[nodes]) > self.mesh.tolerance)
        return 1.0 if not len(off_surface) or phi[nodes[off_surface[0]]] > 0 else -1.0

    def _cut_level_set(self, damage: _PassDamage, cell: int, defined: Flags | None, phi: Values) -> bool:
        """Cut the edges where phi changes its sign, as far as the surface through the cell reaches."""
        mesh, sides = self.mesh, sides_of_level_set(phi, self.mesh.tolerance)
        complete = None if defined is None else ~mesh.flag_with_nodes(~defined)
        if self._retain_nodes:
            usable = damage.unsplit if defined is None else damage.unsplit & mesh.flag_with_nodes(defined)
            sides = reassign_isolated_nodes(mesh, sides, usable, defined)
        crossed = CrossedCells.from_sides(mesh, sides, damage.broken, complete)
        edges = crossed.connected_open_edges(mesh.dim, mesh.cell_edges[cell])
        return damage.record_cuts(crossed, edges, level_set_cut_positions(phi, sides, mesh.edges[edges]))

    def _cut_grain_boundaries(
        self, grains: GrainBoundaries, damage: _PassDamage, crossed: CrossedCells, seeds: Ints | None
    ) -> bool:
        """Cut the grain boundaries that are crossed, or of these the ones that are linked to seed edges."""
        edges = crossed.all_open_edges() if seeds is None else crossed.connected_open_edges(self.mesh.dim, seeds)
        return damage.record_cuts(crossed, edges, grains.cut_positions_of(edges))


class _PassDamage:
    """Damage during a pass.

    Attributes:
        broken: (edges,) broken edges.
        cut_positions: (edges,) positions of the cuts of this pass, NaN elsewhere.
        unsplit: (cells,) cells that are not split.
        touched: (cells,) cells with an edge cut in this pass.
    """

    def __init__(self, mesh: SurfaceCutMesh, broken_keys: Ints) -> None:
        self._mesh = mesh
        self.broken = mesh.edge_flags(broken_keys)
        self.cut_positions: Values = np.full(len(self.broken), np.nan)
        self.unsplit = mesh.flag_unsplit(np.arange(len(mesh.cells)), self.broken)
        self.touched = np.zeros(len(mesh.cells), bool)

    def record_cuts(self, crossed: CrossedCells, edges: Ints, cut_positions: Values) -> bool:
        """Break edges (n,) of crossed cells; return whether there are any."""
        self.broken[edges], self.cut_positions[edges] = True, cut_positions
        cells = crossed.cells_with_edges(edges, len(self.broken))
        self.touched[cells] = True
        self.unsplit[cells] = self._mesh.flag_unsplit(cells, self.broken)
        return len(edges) > 0
