"""Contents of a mesh file in arrays, and their conversion to a simplex mesh with named groups."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from .cell_cutting import FACES, PLURALS, orient_simplices, split_into_tetrahedra, split_quads
from .data import Indices, MeshData, MeshError, Points, list_some
from .file_text import refuse_file
from .topology import Mask, boundary_facets, distinct_rows, facets_on_nodes, positions_of

CORNERS = {"vertex": 1, "line": 2, "triangle": 3, "quad": 4, "tetra": 4, "pyramid": 5, "wedge": 6, "hexahedron": 8}
LAGRANGE = {
    "VTK_LAGRANGE_CURVE": "line",
    "VTK_LAGRANGE_TRIANGLE": "triangle",
    "VTK_LAGRANGE_QUADRILATERAL": "quad",
    "VTK_LAGRANGE_TETRAHEDRON": "tetra",
    "VTK_LAGRANGE_HEXAHEDRON": "hexahedron",
    "VTK_LAGRANGE_WEDGE": "wedge",
    "VTK_LAGRANGE_PYRAMID": "pyramid",
}
DIMENSIONS = {"vertex": 0, "line": 1, "triangle": 2, "quad": 2, "polygon": 2}  # all other shapes are solids
# shape -> columns of the corners of each facet
FACETS: dict[str, tuple[tuple[int, ...], ...]] = {
    "triangle": ((0, 1), (1, 2), (2, 0)),
    "quad": ((0, 1), (1, 2), (2, 3), (3, 0)),
    "tetra": ((0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)),
    **FACES,
}


@dataclass(frozen=True)
class DamageLimits:
    """How many nodes or elements of a file may be missing before it is refused or a note asks whether it is whole."""

    # Nodes without a cell. Reference points and centres of arcs are usual; more than a tenth means lost cells.
    lost_nodes: int = 3
    lost_share: float = 0.1  # of all nodes
    lost_share_at_end: float = 0.01  # of all nodes, where the file ends with the list of elements
    # Unused element numbers. Many are usual where elements were deleted on purpose; a few may be lost lines.
    gaps: int = 3
    gap_share: float = 0.01  # of all elements

    def too_many_lost(self, lost: int, nodes: int, at_end: bool = False) -> bool:
        """Whether so many of `nodes` nodes without a cell mean that cells are missing."""
        return lost > max(self.lost_nodes, (self.lost_share_at_end if at_end else self.lost_share) * nodes)

    def gaps_in(self, numbers: Indices, first: int) -> tuple[int, int]:
        """How many element numbers from `first` on are unused, and the least of them; (0, 0) of none or many."""
        used = np.unique(numbers)
        unused = int(used[-1]) - first + 1 - len(used) if len(used) else 0
        if not 0 < unused <= max(self.gaps, self.gap_share * len(used)):
            return 0, 0
        return unused, first + int(np.flatnonzero(used != first + np.arange(len(used)))[0])


DAMAGE = DamageLimits()


def shape_of(kind: str) -> str:
    """The shape of a cell type without its order: "tetra" of "tetra10"."""
    return LAGRANGE.get(kind, kind.rstrip("0123456789"))


def dimension_of(kind: str) -> int:
    """The dimension of a cell type, 0 to 3."""
    return DIMENSIONS.get(shape_of(kind), 3)


def node_indices(path: Path, ids: Indices, elements: Indices, nodes: Indices) -> Indices:
    """(m, k) indices of the nodes of elements, from node numbers as they stand in the file.

    Args:
        path: the file, for the message.
        ids: (n,) the number of each node of the file.
        elements: (m,) element numbers, for the message.
        nodes: (m, k) node numbers.

    Raises:
        MeshError: an element names a node that the file does not define.
    """
    indices = positions_of(ids, nodes)
    if (missing := (indices < 0).any(axis=1)).any():
        row = int(missing.argmax())
        node = int(nodes[row][indices[row] < 0][0])
        refuse_file(
            path, f"element {elements[row]} has the node {node}, which is not among the {len(ids)} nodes of the file"
        )
    return indices


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
        return shape_of(self.kind)

    @property
    def dim(self) -> int:
        """Dimension of the cells, 0 to 3."""
        return dimension_of(self.kind)

    @property
    def corners(self) -> Indices:
        """(m, c) the corner nodes alone."""
        return self.nodes[:, : CORNERS[self.shape]]

    def cut(self, points: Points | None, source: str) -> tuple[Block, Indices | None]:
        """The block cut into simplices, and the cell of each simplex; None if the block consists of simplices.

        Args:
            points: of the mesh if the cells have its dimension; None of facets, which need no orientation.
            source: begins the message of a MeshError.
        """
        if self.shape not in PLURALS or len(self.nodes) == 0:
            return self, None
        parts, owner = split_quads(self.corners) if self.dim == 2 else split_into_tetrahedra(self.shape, self.corners)
        if points is not None:
            parts = orient_simplices(self.shape, self.corners, parts, owner, points, source)
        return Block("triangle" if self.dim == 2 else "tetra", parts), owner


@dataclass(frozen=True)
class MeshFileContents:
    """The arrays of a mesh file.

    Attributes:
        points: (n, 2 or 3) [m].
        blocks: cells of all kinds and dimensions.
        sets: name -> for each block the numbers of its cells that belong to the set.
        point_sets: name -> node numbers.
        copies: whether a cell is listed once for each set that it is in, as in MSH 2.
        notes: messages to the user.
    """

    points: Points
    blocks: list[Block]
    sets: dict[str, list[Indices]]
    point_sets: dict[str, Indices] = field(default_factory=dict)
    copies: bool = False
    notes: tuple[str, ...] = ()

    def simplices(self, source: str) -> MeshData:
        """The mesh of tetrahedra, or of the triangles of a plane mesh, with sets as facet groups and regions.

        Hexahedra, wedges, pyramids and quadrilaterals are cut into simplices (see cell_cutting). Nodes in the middle of
        edges, faces and cells are removed; nodes without any cell are kept, and `check_mesh` reports them.

        Raises:
            MeshError: no cells, or cells of the highest dimension that cannot be cut into simplices, or a surface in
                space; `source` names the file in the message.
        """
        dim = max((block.dim for block in self.blocks if len(block.nodes)), default=0)
        if dim < 2:
            raise MeshError(f"{source} holds no triangles or tetrahedra ({self._census(range(4))}).")
        self._refuse_other_shapes(source, dim)
        self._refuse_lost_nodes(source)
        points, notes = self._in_plane(source) if dim == 2 else (self.points, ())
        cut, cut_notes = self._cut(points, dim, source)
        top = [i for i, block in enumerate(cut.blocks) if block.dim == dim and len(block.nodes)]
        below = [i for i, block in enumerate(cut.blocks) if block.shape == ("line" if dim == 2 else "triangle")]
        cells = np.concatenate([cut.blocks[i].corners for i in top])
        regions = cut._cell_sets(top)
        if self.copies:
            cells, regions = _without_copies(cells, regions)
        groups = cut._node_groups(cells, len(points)) | cut._facet_sets(below)
        notes = self.notes + notes + self._order_note(dim) + self._stray_note(dim) + cut_notes
        notes += self._unused_note({*groups, *regions}, dim)
        mesh = MeshData(points, cells, groups, regions, notes)
        return _without_nodes(mesh, self._midside_nodes())

    def _census(self, dims: range) -> str:
        """Number of cells of each kind, as text: "12 hexahedron, 4 tetra"."""
        counts: dict[str, int] = {}
        for block in self.blocks:
            if block.dim in dims:
                counts[block.kind] = counts.get(block.kind, 0) + len(block.nodes)
        return ", ".join(f"{count} {kind}" for kind, count in counts.items()) or "no cells at all"

    def _refuse_other_shapes(self, source: str, dim: int) -> None:
        """Raise MeshError if cells of the body, such as polyhedra, cannot be cut into simplices."""
        if any(block.dim == dim and block.shape not in CORNERS and len(block.nodes) for block in self.blocks):
            allowed = "triangles and quadrilaterals" if dim == 2 else "tetrahedra, hexahedra, wedges and pyramids"
            raise MeshError(
                f"{source} holds {self._census(range(dim, dim + 1))}; only {allowed} can be used. Cut the others into "
                f"simplices, or mesh the body with {'triangles' if dim == 2 else 'tetrahedra'} only."
            )

    def _refuse_lost_nodes(self, source: str) -> None:
        """MeshError where many nodes are in no cell of any kind: cells are missing."""
        lost = int(np.count_nonzero(~self._nodes_of([block.nodes for block in self.blocks])))
        if DAMAGE.too_many_lost(lost, len(self.points)):
            raise MeshError(
                f"{source} holds {len(self.points)} nodes, and {lost} of them belong to no cell: it has lost cells "
                "(damaged, or written in part only?). Export the mesh again, with all its cells and no other nodes."
            )

    def _midside_nodes(self) -> Mask:
        """(n,) whether each node belongs to cells, but is a corner of none of them."""
        if all(block.kind == block.shape for block in self.blocks):
            return np.zeros(len(self.points), bool)
        used = [block.nodes for block in self.blocks if block.shape in CORNERS]
        corners = [block.corners for block in self.blocks if block.shape in CORNERS]
        return self._nodes_of(used) & ~self._nodes_of(corners)

    def _nodes_of(self, rows: list[Indices]) -> Mask:
        """(n,) whether each node is in one of the rows; numbers out of range are passed over."""
        is_in = np.zeros(len(self.points), bool)
        for numbers in rows:
            is_in[numbers[(numbers >= 0) & (numbers < len(is_in))]] = True
        return is_in

    def _cut(self, points: Points, dim: int, source: str) -> tuple[MeshFileContents, tuple[str, ...]]:
        """The contents with every cell cut into simplices, its sets with them, and notes."""
        if not any(block.shape in PLURALS for block in self.blocks):
            return self, ()
        pairs = [block.cut(points if block.dim == dim else None, source) for block in self.blocks]
        sets = {
            name: [
                part if owner is None else np.flatnonzero(np.isin(owner, part)).astype(np.int64)
                for part, (_, owner) in zip(parts, pairs, strict=True)
            ]
            for name, parts in self.sets.items()
        }
        blocks = [block for block, _ in pairs]
        notes = []
        for level, simplices in ((dim, "tetrahedra" if dim == 3 else "triangles"), (dim - 1, "triangles")):
            cut = [i for i, block in enumerate(self.blocks) if block.shape in PLURALS and block.dim == level]
            if parts := sum(len(blocks[i].nodes) for i in cut):
                where = "" if level == dim else " of the surface"
                notes.append(f"{_counted([self.blocks[i] for i in cut])}{where} were cut into {parts} {simplices}.")
        return replace(self, blocks=blocks, sets=sets), tuple(notes)

    def _in_plane(self, source: str) -> tuple[Points, tuple[str, ...]]:
        """The points of a plane mesh without z, and a note where z is not 0."""
        if self.points.shape[1] == 2:
            return self.points, ()
        used = np.unique(np.concatenate([block.corners.ravel() for block in self.blocks if block.dim == 2]))
        used = used[(used >= 0) & (used < len(self.points))]
        body = self.points[used][np.isfinite(self.points[used]).all(axis=1)]
        size, height = np.ptp(body[:, :2], axis=0).max(), np.ptp(body[:, 2])
        if height > 1e-6 * size:  # what single precision leaves of a plane
            raise MeshError(
                f"{source} holds a surface of triangles in space, not a plane mesh (z varies by {height:.3g} m). To "
                "fill a closed surface with tetrahedra, give it as [mesh] surface = ... with a size h; a plane mesh "
                "must lie in a plane of constant z."
            )
        level = float(body[0, 2])
        note = f"The plane mesh lies at z = {level:.6g} m; z is left out." if abs(level) > 1e-6 * size else ""
        return np.ascontiguousarray(self.points[:, :2]), (note,) if note else ()

    def _order_note(self, dim: int) -> tuple[str, ...]:
        """A note if cells of the body are of higher order."""
        curved = sum(len(block.nodes) for block in self.blocks if block.dim == dim and block.kind != block.shape)
        if not curved:
            return ()
        return (f"{curved} cells are of second or higher order; only their corner nodes are kept (straight edges).",)

    def _stray_note(self, dim: int) -> tuple[str, ...]:
        """A note where cells of dimension d - 1 between nodes of the body are no facets of its cells."""
        # A damaged file may give a cell the type of another one with as many nodes: a quadrilateral in place of a
        # tetrahedron, a quadrilateral of second order in place of a hexahedron.
        body = [block for block in self.blocks if block.dim == dim and block.shape in FACETS]
        lower = [block for block in self.blocks if block.dim == dim - 1 and block.shape in CORNERS and len(block.nodes)]
        rows_of_body, rows_of_lower = ([block.nodes for block in blocks] for blocks in (body, lower))
        in_range = [
            rows.size == 0 or 0 <= rows.min() <= rows.max() < len(self.points) for rows in rows_of_body + rows_of_lower
        ]
        if not lower or not all(in_range):
            return ()
        of_lower, of_body = self._nodes_of(rows_of_lower), self._nodes_of(rows_of_body)
        curved = any(block.kind != block.shape for block in body)
        stray: dict[str, int] = {}
        # facets of the body's cells are compared with the cells of dimension d - 1 by their sorted corners
        for width in {CORNERS[block.shape] for block in lower}:
            facets: list[Indices] = [np.zeros((0, width), np.int64)]
            for block in body:
                for columns in (columns for columns in FACETS[block.shape] if len(columns) == width):
                    rows = block.nodes[:, columns]
                    facets.append(rows[of_lower[rows].all(axis=1)])
            of_cells = np.concatenate(facets)
            for block in (block for block in lower if CORNERS[block.shape] == width):
                _, _, inverse = distinct_rows(np.sort(np.concatenate([of_cells, block.corners]), axis=1))
                is_facet = np.isin(inverse[len(of_cells) :], inverse[: len(of_cells)]) & (
                    curved or block.kind == block.shape
                )
                if count := int(np.count_nonzero(~is_facet & of_body[block.corners].all(axis=1))):
                    stray[block.kind] = stray.get(block.kind, 0) + count
        if not stray:
            return ()
        listed = " and ".join(f"{count} {kind}" for kind, count in stray.items())
        return (
            f"{listed} on nodes of the body are no facets of its cells, and not part of it: if they are not meant to "
            "be there, the file is damaged and cells are missing.",
        )

    def _unused_note(self, used: set[str], dim: int) -> tuple[str, ...]:
        """A note with the sets that have become neither regions nor facet groups."""
        names = list(dict.fromkeys(name for name in (*self.sets, *self.point_sets) if name not in used))
        if not names:
            return ()
        facets = "edges" if dim == 2 else "triangles"
        return (
            f"Sets not used, for they hold neither cells nor all nodes of {facets} of the boundary: "
            f"{list_some(names, 8)}.",
        )

    def _facet_sets(self, blocks: list[int]) -> dict[str, Indices]:
        """Facet groups of the sets of cells in blocks of facets."""
        groups = {}
        for name, members in self.sets.items():
            facets = [self.blocks[i].corners[members[i]] for i in blocks if len(members[i])]
            if facets:
                groups[name] = np.concatenate(facets)
        return groups

    def _cell_sets(self, blocks: list[int]) -> dict[str, Indices]:
        """Regions of the sets of cells in blocks, cells numbered over all of these blocks."""
        starts = np.cumsum([0] + [len(self.blocks[i].nodes) for i in blocks])
        regions = {}
        for name, members in self.sets.items():
            cells = np.concatenate([start + members[i] for start, i in zip(starts, blocks, strict=False)])
            if len(cells):
                regions[name] = cells.astype(np.int64)
        return regions

    def _node_groups(self, cells: Indices, count: int) -> dict[str, Indices]:
        """Facet groups of node sets: the boundary facets all of whose nodes are in the set."""
        if not self.point_sets:
            return {}
        boundary = boundary_facets(cells)
        groups = {}
        for name, nodes in self.point_sets.items():
            marked = np.zeros(count, bool)
            marked[nodes] = True
            facets = facets_on_nodes(boundary, marked)
            if len(facets):
                groups[name] = facets
        return groups


def _counted(blocks: list[Block]) -> str:
    """Number of cells of each shape that is cut, as text: "12 hexahedra and 4 wedges"."""
    counts = {shape: sum(len(block.nodes) for block in blocks if block.shape == shape) for shape in PLURALS}
    words = [f"{count} {PLURALS[shape]}" for shape, count in counts.items() if count]
    return " and ".join([", ".join(words[:-1]), words[-1]] if words[1:] else words)


def _without_nodes(mesh: MeshData, nodes: Mask) -> MeshData:
    """The mesh without the marked nodes (n,), which are in none of its cells and groups."""
    if not nodes.any() or any(rows.max(initial=-1) >= len(nodes) for rows in (mesh.cells, *mesh.facet_groups.values())):
        return mesh  # numbers out of range: `check_mesh` refuses them
    number = np.cumsum(~nodes) - 1
    groups = {name: number[facets] for name, facets in mesh.facet_groups.items()}
    return replace(mesh, points=mesh.points[~nodes], cells=number[mesh.cells], facet_groups=groups)


def _without_copies(cells: Indices, regions: dict[str, Indices]) -> tuple[Indices, dict[str, Indices]]:
    """Cells without copies in the order of the file, and regions with the new cell numbers."""
    _, _, inverse = distinct_rows(np.sort(cells, axis=1))
    _, first, number = np.unique(inverse, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    return cells[first[order]], {name: np.unique(rank[number[members]]) for name, members in regions.items()}
