"""Tables of all patterns of broken edges of one cell: the points that a pattern adds and the elements between them.

Each node owns a part of its cell. One crack face per cell lies between the parts of nodes i and j, and is open if edge
ij is broken:

    3D: the quadrilateral (m, G_ijk, T, G_ijl)        2D: the segment (m, T)

with m the point of the edge, G of a facet, T of the cell. An open crack face exists twice, with opposite orientation:
with the copies of i and with those of j. Both are divided along the diagonal m-T. (The diagonal G-G would be an edge of
four triangles if both facets are intact.) A copy of m belongs to its end node. A copy of G or T belongs to a group of
nodes of the facet or cell that intact edges of *that facet or cell alone* connect. Hence neighbours have the same
copies, and each group lies in one fragment.

Planar cuts between fragments: if all edges between two groups of nodes are broken, the plane through the cut points of
the edges replaces the faces through T. It is one triangle around a node, or two between two pairs of nodes: a fifth of
the elements. Its points lie on edges alone, so that neighbours have the same points.

Equations: docs/theory.md#split-surface.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from itertools import permutations, product
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ..simplices import local_edges, node_groups

Ints = npt.NDArray[np.int64]


class CutEntity(IntEnum):
    """Entity of a cell whose point is copied for the sides of a crack."""

    EDGE = 0
    FACET = 1
    CELL = 2


class PatternPoint(NamedTuple):
    """A copy of the point of an edge, facet or cell, for one group of nodes; facet i lies opposite node i.

    `group`: local nodes that the copy follows, ascending.
    """

    kind: int
    entity: int
    group: tuple[int, ...]


# a node of the cell, or a copy
Corner = int | PatternPoint
# corners, and the local edge that opened the element when it broke (-1: none)
Element = tuple[tuple[Corner, ...], int]


@dataclass(frozen=True)
class PatternRows:
    """Rows of a table, grouped by key: the rows of key k are start[k] : start[k + 1]."""

    start: Ints

    def expand(self, keys: Ints) -> tuple[Ints, Ints]:
        """(n,) the rows of all `keys` in turn, and (n,) the index in `keys` that each row belongs to."""
        count = self.start[keys + 1] - self.start[keys]
        owner = np.repeat(np.arange(len(keys)), count)
        before = np.cumsum(count) - count
        return np.arange(len(owner)) + (self.start[keys] - before)[owner], owner


@dataclass(frozen=True)
class PatternPoints(PatternRows):
    """The copies of points of each pattern.

    `kind`, `entity`, `lead` (lowest local node of the group): (rows,).    `group`: (rows, d + 1) flags of local nodes.
    """

    kind: Ints
    entity: Ints
    lead: Ints
    group: npt.NDArray[np.bool_]


@dataclass(frozen=True)
class PatternElements(PatternRows):
    """The elements of each key.

    `corners`: (rows, w) index of a copy of the pattern, or -1 - i for node i.    `edge`: (rows,) local edge, or -1.
    """

    corners: Ints
    edge: Ints


@dataclass(frozen=True)
class CutTable:
    """Points and elements of all patterns of a simplex of dimension d.

    Attributes:
        copies, crack_faces: by pattern.
        facets: elements of a boundary facet, by pattern * (d + 1) + local facet.
        fill: triangles that cover a cell in 2D, by pattern; none in 3D.
    """

    copies: PatternPoints
    crack_faces: PatternElements
    facets: PatternElements
    fill: PatternElements


@cache
def cut_table(dim: int) -> CutTable:
    """The table of triangles (8 patterns) or tetrahedra (64 patterns), computed once."""
    return tabulate(CutCell, dim)


@cache
def intact_cell_table(dim: int) -> CutTable:
    """The table of the pattern without broken edges alone, for an undamaged body."""
    return tabulate(CutCell, dim, 1)


def tabulate(kind: type[CutCell], dim: int, patterns: int | None = None) -> CutTable:
    """The table of a kind of cell, for all patterns or the first `patterns`."""
    cells = [kind(dim, pattern) for pattern in range(patterns or 1 << len(local_edges(dim)))]
    nodes = range(dim + 1)
    return CutTable(
        _copy_rows(cells, dim),
        _element_rows([(cell, cell.crack_faces) for cell in cells], dim),
        _element_rows([(cell, cell.boundary(facet)) for cell in cells for facet in nodes], dim),
        _element_rows([(cell, cell.fan(cell.cell_copy, (0, 1, 2)) if dim == 2 else []) for cell in cells], 3),
    )


class CutCell:
    """Points and elements of one cell with one pattern of broken edges."""

    def __init__(self, dim: int, pattern: int) -> None:
        self.dim, self.pattern = dim, pattern
        self.edge = {frozenset((int(a), int(b))): k for k, (a, b) in enumerate(zip(*local_edges(dim).T, strict=True))}
        self.crack_faces = self._crack_faces()
        used = {corner for corners, _ in self.crack_faces for corner in corners if isinstance(corner, PatternPoint)}
        self.copies = sorted(used)

    def broken(self, i: int, j: int) -> bool:
        """Whether the edge between local nodes i and j is broken."""
        return bool(self.pattern >> self.edge[frozenset((i, j))] & 1)

    def group(self, nodes: Iterable[int], i: int) -> tuple[int, ...]:
        """The nodes, ascending, that intact edges between `nodes` connect to i."""
        nodes, connected = set(nodes), {i}
        while new := {k for j in connected for k in nodes - connected if not self.broken(j, k)}:
            connected |= new
        return tuple(sorted(connected))

    def edge_copy(self, i: int, j: int) -> PatternPoint:
        """The copy of the point of edge ij that follows i."""
        return PatternPoint(CutEntity.EDGE, self.edge[frozenset((i, j))], (i,))

    def facet_copy(self, facet: int, i: int) -> PatternPoint:
        """The copy of the point of a facet that follows the group of i."""
        return PatternPoint(CutEntity.FACET, facet, self.group(set(range(self.dim + 1)) - {facet}, i))

    def cell_copy(self, i: int) -> PatternPoint:
        """The copy of the point of the cell that follows the group of i."""
        return PatternPoint(CutEntity.CELL, 0, self.group(range(self.dim + 1), i))

    def _crack_faces(self) -> list[Element]:
        return [element for i, j, *remaining in _node_orders(self.dim) for element in self._crack_face(i, j, remaining)]

    def _crack_face(self, i: int, j: int, remaining: list[int]) -> list[Element]:
        """The crack face towards j on the side of i, with its normal out of the part of i."""
        if not self.broken(i, j):
            return []
        m, T, edge = self.edge_copy(i, j), self.cell_copy(i), self.edge[frozenset((i, j))]
        if self.dim == 2:
            # the part of i lies to the left
            return [((m, T) if permutation_sign((i, j, *remaining)) > 0 else (T, m), edge)]
        k, last = remaining
        return [((m, self.facet_copy(last, i), T), edge), ((m, T, self.facet_copy(k, i)), edge)]

    def boundary(self, facet: int) -> list[Element]:
        """The elements of a boundary facet: the facet itself if it has no broken edge, so that no T-junction arises."""
        loop = [node for node in range(self.dim + 1) if node != facet]
        loop = loop if facet % 2 == 0 else [loop[1], loop[0], *loop[2:]]
        if self.dim == 3:
            return self.fan(lambda i: self.facet_copy(facet, i), tuple(loop))
        a, b = loop
        if not self.broken(a, b):
            return [((a, b), -1)]
        return [((a, self.edge_copy(a, b)), -1), ((self.edge_copy(b, a), b), -1)]

    def fan(self, centre: Callable[[int], PatternPoint], loop: tuple[int, ...]) -> list[Element]:
        """The elements of a triangle: itself if its edges are intact, else a fan around the copies of its centre."""
        sides = list(zip(loop, loop[1:] + loop[:1], strict=True))
        if not any(self.broken(i, j) for i, j in sides):
            return [(loop, -1)]
        triangles: list[tuple[Corner, ...]] = []
        for i, j in sides:
            if self.broken(i, j):
                triangles += [(centre(i), i, self.edge_copy(i, j)), (centre(j), self.edge_copy(j, i), j)]
            else:
                triangles += [(centre(i), i, j)]
        return [(triangle, -1) for triangle in triangles]


@cache
def _node_orders(dim: int) -> list[tuple[int, ...]]:
    """Permutations (i, j, ...) of the nodes, one for each ordered pair: in 3D the even permutations."""
    return [order for order in permutations(range(dim + 1)) if dim == 2 or permutation_sign(order) > 0]


def permutation_sign(order: tuple[int, ...]) -> int:
    """Sign of a permutation, 1 or -1."""
    swaps = sum(order[a] > order[b] for a in range(len(order)) for b in range(a + 1, len(order)))
    return -1 if swaps % 2 else 1


def _copy_rows(cells: list[CutCell], dim: int) -> PatternPoints:
    rows = [copy for cell in cells for copy in cell.copies]
    group = np.zeros((len(rows), dim + 1), bool)
    for row, copy in zip(group, rows, strict=True):
        row[list(copy.group)] = True
    kind, entity = (np.array([copy[field] for copy in rows], np.int64) for field in (0, 1))
    return PatternPoints(_row_starts([cell.copies for cell in cells]), kind, entity, group.argmax(axis=1), group)


def _element_rows(lists: list[tuple[CutCell, list[Element]]], width: int) -> PatternElements:
    corners, edges = [], []
    for cell, elements in lists:
        index = {copy: number for number, copy in enumerate(cell.copies)}
        for element, edge in elements:
            corners.append([index[corner] if isinstance(corner, PatternPoint) else -1 - corner for corner in element])
            edges.append(edge)
    start = _row_starts([elements for _, elements in lists])
    return PatternElements(start, np.array(corners, np.int64).reshape(-1, width), np.array(edges, np.int64))


def _row_starts(lists: list[list[Element]] | list[list[PatternPoint]]) -> Ints:
    return np.concatenate([[0], np.cumsum([len(rows) for rows in lists])]).astype(np.int64)


@cache
def planar_cut_table(dim: int) -> CutTable:
    """The table of planar cuts, computed once."""
    return tabulate(PlanarCutCell, dim)


class PlanarCutCell(CutCell):
    """A cell with planar cuts between its groups of nodes; edges within a group count as intact."""

    def __init__(self, dim: int, pattern: int) -> None:
        group, ends = node_groups(dim)[pattern], local_edges(dim)
        apart = group[ends[:, 0]] != group[ends[:, 1]]
        super().__init__(dim, int(apart @ (1 << np.arange(len(ends)))))

    def _crack_faces(self) -> list[Element]:
        nodes = range(self.dim + 1)
        parts = sorted({self.group(nodes, i) for i in nodes})
        faces = [corners for part in parts if len(part) < len(nodes) for corners in self._faces_around(part)]
        return [(corners, min(corner.entity for corner in corners)) for corners in faces]

    def _faces_around(self, part: tuple[int, ...]) -> list[tuple[PatternPoint, ...]]:
        """The elements between `part` and the other nodes, with normals out of `part`."""
        part, complement = _in_even_order(part, tuple(node for node in range(self.dim + 1) if node not in part))
        if len(part) == 1:
            return [tuple(self.edge_copy(part[0], node) for node in complement)]
        if len(complement) == 1:
            return [tuple(self.edge_copy(node, complement[0]) for node in (part if self.dim == 3 else part[::-1]))]
        (i, j), (k, last) = part, complement
        a, b, c, d = self.edge_copy(i, k), self.edge_copy(i, last), self.edge_copy(j, last), self.edge_copy(j, k)
        # the same diagonal from both sides: see face_centre_weights
        return [(a, b, c), (a, c, d)]

    def fan(self, centre: Callable[[int], PatternPoint], loop: tuple[int, ...]) -> list[Element]:
        """The elements of a triangle, without a point at its centre."""
        corners: list[tuple[Corner, ...]] = []
        turns = [loop, (*loop[1:], loop[0]), (*loop[2:], *loop[:2])]
        for a, b, c in turns:
            if self.broken(a, b) and self.broken(a, c):
                corners.append((a, self.edge_copy(a, b), self.edge_copy(a, c)))
                if not self.broken(b, c):
                    corners += [(self.edge_copy(b, a), b, c), (self.edge_copy(b, a), c, self.edge_copy(c, a))]
        return [(element, -1) for element in corners or [loop]]


@cache
def face_centre_weights(dim: int) -> npt.NDArray[np.float64]:
    """(2^(d+1), 2^(d+1), d + 1, d + 1) weights of the edge points ij in the centre of the face between two groups.

    The first two indices are the groups of nodes of a cell or facet, as bits; i is in the first, j in the second group.
    """
    size = dim + 1
    result = np.zeros((1 << size, 1 << size, size, size))
    for first_bits, second_bits in product(range(1, 1 << size), repeat=2):
        if first_bits & second_bits:
            continue
        first, second = (tuple(node for node in range(size) if bits >> node & 1) for bits in (first_bits, second_bits))
        pairs = list(product(first, second))
        # a quadrilateral is two triangles: the centre is the middle of their common side
        if len(first) == len(second) == 2:
            pairs = list(zip(*_in_even_order(first, second), strict=True))
        for i, j in pairs:
            result[first_bits, second_bits, i, j] = 1 / len(pairs)
    return result


def _in_even_order(part: tuple[int, ...], complement: tuple[int, ...]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """The two groups, with two nodes exchanged if part + complement is an odd permutation."""
    if permutation_sign(part + complement) > 0:
        return part, complement
    return (part, _swap_first_two(complement)) if len(complement) > 1 else (_swap_first_two(part), complement)


def _swap_first_two(nodes: tuple[int, ...]) -> tuple[int, ...]:
    return nodes[1], nodes[0], *nodes[2:]
