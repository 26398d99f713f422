"""The closed split surface of a damaged mesh: points, elements, and the nodes that each point follows.

Points are nodes of the mesh, and copies of points of edges, facets and cells (cut_patterns).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt

from ...meshes.topology import facets_of, row_keys
from ..simplices import local_edges
from .cut_patterns import CutEntity, CutTable, PatternElements, cut_table, intact_cell_table
from .entity_numbering import CRACK, EntityNumbering
from .surface_motion import PointParents

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


class SurfacePoints:
    """The numbered points of the split surface: nodes first, then copies of edge, facet and cell points.

    Attributes:
        positions: (n, d) reference coordinates, m.
        parents: the nodes that each point follows.
        first: number of the first copy.
        cell, kind, entity: (copies,) a cell that contains each copy; kind (a CutEntity) and local number of its
            entity.
        group: (copies, d + 1) flags of the nodes of the cell that each copy follows.
    """

    def __init__(
        self, topology: EntityNumbering, damaged: Ints, pattern: Ints, cut: Values | None, table: CutTable
    ) -> None:
        """`pattern`: of the `damaged` cells; `cut`: see build_split_surface."""
        self._topology, self._copies = topology, table.copies
        self._cut = cut if cut is not None and np.isfinite(cut).any() else None
        nodes = np.arange(len(topology.points)) if topology.dim == 2 else topology.boundary_nodes
        self._of_node = np.full(len(topology.points), -1)
        self._of_node[nodes] = np.arange(len(nodes))
        row, owner = self._copies.expand(pattern)
        # first copy of each damaged cell
        self._first = np.searchsorted(owner, np.arange(len(damaged)))
        number, first_position = _number_keys(self._keys(row, damaged[owner], owner))
        # the last entry is read where there is no copy
        self._of_copy = np.append(number + len(nodes), -1)
        row, cell = row[first_position], damaged[owner[first_position]]
        self.cell, self.kind, self.entity = cell, self._copies.kind[row], self._copies.entity[row]
        self.first, self.group = len(nodes), (group := self._copies.group[row])
        parents = np.concatenate([nodes, topology.cells[cell][group]])
        count = np.concatenate([np.ones(len(nodes), np.int64), group.sum(axis=1)])
        self.positions: Values = np.concatenate([topology.points[nodes], self._reference_positions(row, cell)])
        self.parents = PointParents.from_positions(parents, count, self.positions, topology.points)

    def of_nodes(self, nodes: Ints) -> Ints:
        """Points of boundary nodes (2D: of any nodes); -1 for other nodes."""
        return self._of_node[nodes]

    def of_corners(self, corners: Ints, place: Ints, cell: Ints) -> Ints:
        """(n, w) points of PatternElements.corners (n, w); `place` (n,) is the index of `cell` (n,) in `damaged`."""
        result = self._of_copy[np.clip(self._first[place][:, None] + corners, 0, len(self._of_copy) - 1)]
        # crack faces have no corners at nodes
        element, corner = np.nonzero(corners < 0)
        node = self._topology.cells[cell[element], -1 - corners[element, corner]]
        result[element, corner] = self._of_node[node]
        return result

    def entity_nodes(self) -> npt.NDArray[np.bool_]:
        """(copies, d + 1) flags of the nodes of the edge, facet or cell that each copy is the centre of."""
        result = np.ones(self.group.shape, bool)
        selected = np.flatnonzero(self.kind == CutEntity.FACET)
        result[selected, self.entity[selected]] = False
        selected = np.flatnonzero(self.kind == CutEntity.EDGE)
        result[selected] = False
        result[selected[:, None], local_edges(self._topology.dim)[self.entity[selected]]] = True
        return result

    def keys(self, number: Ints) -> Ints:
        """(n,) keys of the points, equal on all ranks and as edges break; `number` (nodes,): of the input mesh.

        A key stands for the nodes of the entity of a point and those that the point follows: a copy whose group has
        lost nodes is another point.
        """
        nodes, corners = number[self.parents.parents[: self.first]], number[self._topology.cells[self.cell]]
        of_entity, followed = (
            np.sort(np.where(flags, corners, -1), axis=1) for flags in (self.entity_nodes(), self.group)
        )
        of_copies = row_keys(np.concatenate([of_entity, followed], axis=1))
        return np.concatenate([node_keys(nodes, self._topology.dim), of_copies])

    def order_keys(self, node_numbers: Ints, cell_numbers: Ints) -> tuple[Ints, Ints]:
        """(n, 3) keys that order the points of several parts of a mesh as those of the whole mesh.

        Also returns (n,) the lowest cell of each copy, 0 for nodes. `node_numbers` and `cell_numbers`: of the input
        mesh.
        """
        topology, nodes, copies = self._topology, self.parents.parents[: self.first], slice(self.first, None)
        kind = np.concatenate([np.zeros(self.first, np.int64), 1 + self.kind])
        entity = np.zeros((len(kind), topology.dim + 1), np.int64)
        entity[: self.first, 0] = node_numbers[nodes]
        entity[copies, 0], entity[copies, -1] = cell_numbers[self.cell], self.group.argmax(axis=1)
        selected = np.flatnonzero(self.kind == CutEntity.EDGE)
        edge = topology.cell_edges[self.cell[selected], self.entity[selected]]
        end = topology.cells[self.cell[selected], self.group[selected].argmax(axis=1)]
        entity[self.first + selected, :2] = node_numbers[topology.edges[edge]]
        entity[self.first + selected, 2:] = 0
        entity[self.first + selected, -1] = end == topology.edges[edge, 1]
        selected = np.flatnonzero(self.kind == CutEntity.FACET)
        facet = topology.facets[topology.cell_facets[self.cell[selected], self.entity[selected]]]
        group = np.where(self.group[selected], topology.cells[self.cell[selected]], len(topology.points))
        entity[self.first + selected, :-1] = node_numbers[facet]
        entity[self.first + selected, -1] = np.count_nonzero(facet < group.min(axis=1)[:, None], axis=1)
        # numbers of entities have 31 bits
        lead = (kind << 40) + entity[:, 0]
        middle = entity[:, 1] if topology.dim == 2 else (entity[:, 1] << 32) + entity[:, 2]
        lowest_cell = np.concatenate([np.zeros(self.first, np.int64), cell_numbers[self.cell]])
        return np.stack([lead, middle, entity[:, -1]], axis=1), lowest_cell

    def _keys(self, row: Ints, cell: Ints, owner: Ints) -> Ints:
        """(copies,) keys that are equal in all cells of a copy: (edge, end), (facet, group) or (cell, group)."""
        topology, copies, d = self._topology, self._copies, self._topology.dim
        kind, entity, lead = copies.kind[row], copies.entity[row], copies.lead[row]
        keys = np.empty(len(row), np.int64)
        selected = np.flatnonzero(kind == CutEntity.EDGE)
        edge = topology.cell_edges[cell[selected], entity[selected]]
        keys[selected] = 2 * edge + (topology.cells[cell[selected], lead[selected]] == topology.edges[edge, 1])
        selected = np.flatnonzero(kind == CutEntity.FACET)
        facet = topology.cell_facets[cell[selected], entity[selected]]
        group = np.where(copies.group[row[selected]], topology.cells[cell[selected]], len(topology.points))
        rank = np.count_nonzero(topology.facets[facet] < group.min(axis=1)[:, None], axis=1)
        base = 2 * len(topology.edges)
        keys[selected] = base + d * facet + rank
        selected = np.flatnonzero(kind == CutEntity.CELL)
        keys[selected] = base + d * len(topology.facets) + (d + 1) * owner[selected] + lead[selected]
        return keys

    # --- reference positions ---

    def _reference_positions(self, row: Ints, cell: Ints) -> Values:
        topology, kind, entity = self._topology, self._copies.kind[row], self._copies.entity[row]
        result = np.empty((len(row), topology.dim))
        selected = kind == CutEntity.EDGE
        result[selected] = self._edge_points(topology.cell_edges[cell[selected], entity[selected]])
        selected = kind == CutEntity.FACET
        if selected.any():
            nodes = topology.facets[topology.cell_facets[cell[selected], entity[selected]]]
            # ascending, so that all copies of a point have the same position to the last bit
            edges = np.sort(topology.cell_edges[cell[selected][:, None], _facet_edges()[entity[selected]]], axis=1)
            result[selected] = self._centres(nodes, edges)
        selected = kind == CutEntity.CELL
        result[selected] = self._centres(topology.cells[cell[selected]], topology.cell_edges[cell[selected]])
        return result

    def _edge_points(self, edges: Ints) -> Values:
        ends = self._topology.points[self._topology.edges[edges]]
        share = 0.5 if self._cut is None else np.where(np.isnan(self._cut[edges]), 0.5, self._cut[edges])[:, None]
        cut: Values = ends[:, 0] + share * (ends[:, 1] - ends[:, 0])
        return cut

    def _centres(self, nodes: Ints, edges: Ints) -> Values:
        """Centroids, or the mean of the given cuts if there are two or more, so that a planar crack stays planar."""
        centre: Values = self._topology.points[nodes].mean(axis=1)
        if self._cut is not None:
            has_cut = ~np.isnan(self._cut[edges])
            selected = np.flatnonzero(has_cut.sum(axis=1) >= 2)
            weight = has_cut[selected] / has_cut[selected].sum(axis=1, keepdims=True)
            cuts = self._edge_points(edges[selected].ravel()).reshape(*edges[selected].shape, self._topology.dim)
            centre[selected] = np.einsum("ne,nei->ni", weight, cuts)
        return centre


def node_keys(numbers: Ints, dim: int) -> Ints:
    """(n,) keys, as of SurfacePoints.keys, of points at nodes with `numbers` (n,) in the input mesh."""
    alone = np.full((len(numbers), dim + 1), -1)
    alone[:, -1] = numbers
    return row_keys(np.concatenate([alone, alone], axis=1))


@cache
def _facet_edges() -> Ints:
    """(4, 3) local edges of each facet of a tetrahedron."""
    return np.array([np.flatnonzero(np.all(local_edges(3) != facet, axis=1)) for facet in range(4)])


def _number_keys(keys: Ints) -> tuple[Ints, Ints]:
    """The number of each key among the distinct keys, ascending, and the first position of each distinct key.

    By a table, since the keys are dense.
    """
    used = np.zeros(int(keys.max(initial=-1)) + 1, bool)
    used[keys] = True
    distinct = np.flatnonzero(used)
    number_of_key = np.empty(len(used), np.int64)  # of the used keys alone
    number_of_key[distinct] = np.arange(len(distinct))
    number = number_of_key[keys]
    first_position = np.empty(len(distinct), np.int64)
    first_position[number[::-1]] = np.arange(len(keys))[::-1]
    return number, first_position


@dataclass(frozen=True)
class SplitSurface:
    """The split surface in the reference configuration.

    Attributes:
        points: (n, d) reference coordinates, m: nodes of the mesh first (3D: of its boundary), then the copies.
        parents: the nodes that each point follows.
        elements: (m, d) triangles with normals outwards (3D) or segments with the body to their left (2D): closed.
        cell: (m,) cell of each element.
        edge: (m,) edge whose breaking opened each element, -1 on the boundary.
        origin: (m,) index into EntityNumbering.origins.
        fill: (k, 3) triangles that cover the body in 2D; none in 3D.
        fill_cell: (k,) cell of each of these triangles.
        broken: (E,) flags of broken edges.
        fragment_count: number of fragments.
        node_fragment: (N,) fragment of each node; fragments are numbered by their lowest node.
        numbering: the points by their entities; None: of several bodies.
    """

    points: Values
    parents: PointParents
    elements: Ints
    cell: Ints
    edge: Ints
    origin: Ints
    fill: Ints
    fill_cell: Ints
    broken: npt.NDArray[np.bool_]
    fragment_count: int
    node_fragment: Ints
    numbering: SurfacePoints | None = None

    @property
    def point_fragment(self) -> Ints:
        """(n,) fragment of each point: that of all its parents."""
        return self.node_fragment[self.parents.first_parent]


def build_split_surface(
    topology: EntityNumbering,
    pattern: npt.NDArray[np.integer],
    cut: Values | None = None,
    table: Callable[[int], CutTable] = cut_table,
    fragments: Callable[[npt.NDArray[np.bool_]], tuple[int, Ints]] | None = None,
) -> SplitSurface:
    """The split surface of damage patterns (C,), see EdgeGraph.pattern.

    `cut`: (E,) position of the cut of each edge, from the lower node (0) to the higher (1); NaN: 1/2.
    `table`: the table of patterns for a dimension.    `fragments`: find_fragments of a MeshPart; None: of the topology.
    """
    rows = table if pattern.any() else intact_cell_table
    return _SurfaceBuilder(topology, pattern, cut, rows(topology.dim))(fragments or topology.find_fragments)


def build_surface_points(
    topology: EntityNumbering, pattern: npt.NDArray[np.integer], table: Callable[[int], CutTable] = cut_table
) -> SurfacePoints:
    """The points of the split surface with edges cut at 1/2."""
    damaged = np.flatnonzero(pattern)
    return SurfacePoints(topology, damaged, pattern[damaged].astype(np.int64), None, table(topology.dim))


class _SurfaceBuilder:
    """Builds the split surface; boundary facets of undamaged cells are elements as they are."""

    def __init__(
        self, topology: EntityNumbering, pattern: npt.NDArray[np.integer], cut: Values | None, table: CutTable
    ) -> None:
        self.topology, self.table = topology, table
        self.damaged = np.flatnonzero(pattern)
        self.pattern = pattern[self.damaged].astype(np.int64)
        # index of each cell among the damaged ones
        self.place = np.full(len(pattern), -1)
        self.place[self.damaged] = np.arange(len(self.damaged))
        self.broken = topology.broken_edges(pattern)
        self.points = SurfacePoints(topology, self.damaged, self.pattern, cut, table)

    def __call__(self, fragments: Callable[[npt.NDArray[np.bool_]], tuple[int, Ints]]) -> SplitSurface:
        parts = self._undamaged_cell_facets(), self._damaged_cell_facets(), self._crack_faces()
        elements, cell, edge, origin = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        count, node_fragment = fragments(self.broken)
        points = self.points
        return SplitSurface(
            points.positions,
            points.parents,
            elements,
            cell,
            edge,
            origin,
            *self._fill(),
            self.broken,
            count,
            node_fragment,
            points,
        )

    def _undamaged_cell_facets(self) -> tuple[Ints, ...]:
        """(corners, cell, edge, origin) of boundary facets of undamaged cells."""
        boundary = self.topology.boundary
        selected = np.flatnonzero(self.place[boundary[:, 0]] < 0)
        cell = boundary[selected, 0]
        corners = self.points.of_nodes(boundary_corners(self.topology, selected))
        return corners, cell, np.full(len(selected), -1), self.topology.origin[selected]

    def _damaged_cell_facets(self) -> tuple[Ints, ...]:
        """(corners, cell, edge, origin) of boundary facets of damaged cells."""
        cell, facet = self.topology.boundary.T
        selected = np.flatnonzero(self.place[cell] >= 0)
        damaged_index = self.place[cell[selected]]
        key = (self.topology.dim + 1) * self.pattern[damaged_index] + facet[selected]
        corners, owner, edge = self._expand(self.table.facets, key, damaged_index)
        return corners, cell[selected[owner]], edge, self.topology.origin[selected[owner]]

    def _crack_faces(self) -> tuple[Ints, ...]:
        """(corners, cell, edge, origin) of crack faces, both sides."""
        corners, owner, edge = self._expand(self.table.crack_faces, self.pattern, np.arange(len(self.damaged)))
        cell = self.damaged[owner]
        return corners, cell, self.topology.cell_edges[cell, edge].astype(np.int64), np.full(len(cell), CRACK)

    def _fill(self) -> tuple[Ints, Ints]:
        """Triangles that cover the body in 2D, and the cell of each; none in 3D."""
        if self.topology.dim == 3:
            return np.empty((0, 3), np.int64), np.empty(0, np.int64)
        whole = np.flatnonzero(self.place < 0)
        corners, owner, _ = self._expand(self.table.fill, self.pattern, np.arange(len(self.damaged)))
        triangles = np.concatenate([self.topology.cells[whole], corners])
        return triangles, np.concatenate([whole, self.damaged[owner]])

    def _expand(self, elements: PatternElements, key: Ints, place: Ints) -> tuple[Ints, Ints, Ints]:
        """(corners, owner, local edge) of the elements of each key, in the damaged cell number `place` (keys,)."""
        row, owner = elements.expand(key)
        damaged = place[owner]
        corners = self.points.of_corners(elements.corners[row], damaged, self.damaged[damaged])
        return corners, owner, elements.edge[row]


def boundary_corners(topology: EntityNumbering, which: Ints) -> Ints:
    """(n, d) nodes of boundary facets `which` (n,), oriented with normals outwards."""
    outward = facets_of(np.arange(topology.dim + 1)[None])[0]
    cell, facet = topology.boundary[which].T
    return topology.cells[cell[:, None], outward[facet]]
