"""What a mesh file holds, whatever its format, and how it becomes a simplex mesh with named groups."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from .data import Indices, MeshData, MeshError, Points
from .topology import boundary_facets, distinct_rows, facets_where

CORNERS = {"line": 2, "triangle": 3, "tetra": 4}
LAGRANGE = {"VTK_LAGRANGE_CURVE": "line", "VTK_LAGRANGE_TRIANGLE": "triangle", "VTK_LAGRANGE_TETRAHEDRON": "tetra"}
DIMENSIONS = {"vertex": 0, "line": 1, "triangle": 2, "quad": 2, "polygon": 2}  # every other kind is a solid


@dataclass(frozen=True)
class Block:
    """Cells of one kind.

    Attributes:
        kind: meshio's name of the cell type: "tetra", "triangle6", "hexahedron", ...
        nodes: (m, k) node numbers, the corners first.
    """

    kind: str
    nodes: Indices

    @property
    def shape(self) -> str:
        """The kind without its order: "tetra" for tetra10 and for VTK's Lagrange cells."""
        return LAGRANGE.get(self.kind, self.kind.rstrip("0123456789"))

    @property
    def dim(self) -> int:
        return DIMENSIONS.get(self.shape, 3)

    @property
    def corners(self) -> Indices:
        return self.nodes[:, : CORNERS[self.shape]]


@dataclass(frozen=True)
class Contents:
    """The arrays of a mesh file.

    Attributes:
        points: (n, 2 or 3) [m].
        blocks: cells of all kinds and dimensions.
        sets: name -> for each block the numbers of its cells that belong to the set.
        point_sets: name -> node numbers.
        copies: a cell is listed once for each set it is in, as in Gmsh's version 2 files.
        notes: what the user should know of the reading.
    """

    points: Points
    blocks: list[Block]
    sets: dict[str, list[Indices]]
    point_sets: dict[str, Indices] = field(default_factory=dict)
    copies: bool = False
    notes: tuple[str, ...] = ()

    def simplices(self, source: str) -> MeshData:
        """The tetrahedra, or where there are none the triangles of a plane mesh; sets as facet groups and regions.

        Raises:
            MeshError: no cells, or cells of the highest dimension that are no simplices, or a surface in space;
                `source` names the file in the message.
        """
        solids = [block.dim for block in self.blocks if len(block.nodes)]
        dim = max(solids, default=0)
        if dim < 2:
            raise MeshError(f"{source} holds no triangles or tetrahedra ({self._census(range(4))}).")
        self._refuse_other_shapes(source, dim)
        points, notes = self._flattened(source) if dim == 2 else (self.points, ())
        mine = [i for i, block in enumerate(self.blocks) if block.dim == dim and len(block.nodes)]
        below = [i for i, block in enumerate(self.blocks) if block.shape == ("line" if dim == 2 else "triangle")]
        cells = np.concatenate([self.blocks[i].corners for i in mine])
        regions = self._cell_sets(mine)
        if self.copies:
            cells, regions = _each_once(cells, regions)
        groups = self._facet_sets(below) | self._node_groups(cells, len(points))
        return MeshData(points, cells, groups, regions, self.notes + notes + self._order_note(mine))

    def _census(self, dims: range) -> str:
        """For example "12 hexahedron, 4 tetra"."""
        counts: dict[str, int] = {}
        for block in self.blocks:
            if block.dim in dims:
                counts[block.kind] = counts.get(block.kind, 0) + len(block.nodes)
        return ", ".join(f"{count} {kind}" for kind, count in counts.items()) or "no cells at all"

    def _refuse_other_shapes(self, source: str, dim: int) -> None:
        allowed = "triangle" if dim == 2 else "tetra"
        if any(block.dim == dim and block.shape != allowed and len(block.nodes) for block in self.blocks):
            raise MeshError(
                f"{source} holds {self._census(range(dim, dim + 1))}; only {allowed} cells can be used. Cut the others "
                f"into simplices, or mesh the body with {'triangles' if dim == 2 else 'tetrahedra'} only."
            )

    def _flattened(self, source: str) -> tuple[Points, tuple[str, ...]]:
        """The points of a plane mesh without their third coordinate."""
        if self.points.shape[1] == 2:
            return self.points, ()
        used = np.unique(np.concatenate([block.corners.ravel() for block in self.blocks if block.dim == 2]))
        used = used[(used >= 0) & (used < len(self.points))]
        body = self.points[used][np.isfinite(self.points[used]).all(axis=1)]
        size, height = np.ptp(body[:, :2], axis=0).max(), np.ptp(body[:, 2])
        if height > 1e-6 * size:
            raise MeshError(
                f"{source} holds a surface of triangles in space, not a plane mesh (z varies by {height:.3g} m). To "
                "fill a closed surface with tetrahedra, give it as [mesh] surface = ... with a size h; a plane mesh "
                "must lie in a plane of constant z."
            )
        level = float(body[0, 2])
        note = f"The plane mesh lies at z = {level:.6g} m; z is left out." if abs(level) > 1e-6 * size else ""
        return np.ascontiguousarray(self.points[:, :2]), (note,) if note else ()

    def _order_note(self, mine: list[int]) -> tuple[str, ...]:
        curved = sum(len(self.blocks[i].nodes) for i in mine if self.blocks[i].kind != self.blocks[i].shape)
        if not curved:
            return ()
        return (f"{curved} cells are of second or higher order; only their corner nodes are kept (straight edges).",)

    def _facet_sets(self, blocks: list[int]) -> dict[str, Indices]:
        groups = {}
        for name, members in self.sets.items():
            facets = [self.blocks[i].corners[members[i]] for i in blocks if len(members[i])]
            if facets:
                groups[name] = np.concatenate(facets)
        return groups

    def _cell_sets(self, blocks: list[int]) -> dict[str, Indices]:
        starts = np.cumsum([0] + [len(self.blocks[i].nodes) for i in blocks])
        regions = {}
        for name, members in self.sets.items():
            cells = np.concatenate([start + members[i] for start, i in zip(starts, blocks, strict=False)])
            if len(cells):
                regions[name] = cells.astype(np.int64)
        return regions

    def _node_groups(self, cells: Indices, count: int) -> dict[str, Indices]:
        """Node sets become the groups of the boundary facets all of whose nodes they hold."""
        if not self.point_sets:
            return {}
        boundary = boundary_facets(cells)
        groups = {}
        for name, nodes in self.point_sets.items():
            marked = np.zeros(count, bool)
            marked[nodes] = True
            facets = facets_where(boundary, marked)
            if len(facets) and name not in self.sets:
                groups[name] = facets
        return groups


def _each_once(cells: Indices, regions: dict[str, Indices]) -> tuple[Indices, dict[str, Indices]]:
    """Cells without copies, and the regions renumbered."""
    _, _, place = distinct_rows(np.sort(cells, axis=1))
    _, first, number = np.unique(place, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    return cells[first[order]], {name: np.unique(rank[number[members]]) for name, members in regions.items()}
