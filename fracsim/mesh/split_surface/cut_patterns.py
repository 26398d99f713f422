"""What each damage pattern does to one cell: the points that it adds and the elements between them.

Every node owns a part of its cell. Between the parts of i and j stands one wall per cell, open where edge ij is broken:

    3D: the quad (m, G_ijk, T, G_ijl)        2D: the segment (m, T)

with m the point of the edge, G of a facet, T of the cell. An open wall is there twice, once with the copies of i and
once, turned round and cut along the same diagonal m-T, with those of j. (The other diagonal G-G would be an edge of
four triangles where both facets stay whole.) A copy of m belongs to its end node; a copy of G or T belongs to a
connected group of the nodes of the facet or cell, under the intact edges *of that facet or cell alone*. So neighbours
agree on a copy without asking, and every group lies in one piece of the body.

Equations: docs/theory.md#split-surface.

Cells cut flat between pieces: by one triangle around a node, or by two between two nodes and two.

What a node owns of its cell ends at six triangles that meet in the middle of the cell (cut_patterns). Between pieces,
where every edge from one group of nodes to another is broken, the plane through the places where these are cut does: a
fifth of the elements, and no corners that stick out. Its points are on edges alone, so that neighbours agree on them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from itertools import permutations, product
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ..simplices import local_edges, node_groups

Ints = npt.NDArray[np.int64]
EDGE, FACET, CELL = 0, 1, 2


class PatternPoint(NamedTuple):
    """A copy of the point of an edge, facet or cell: facet i lies opposite node i, as in DOLFINx."""

    kind: int
    entity: int
    group: tuple[int, ...]  # local nodes that it follows, ascending


Corner = int | PatternPoint  # a node of the cell, or a copy


Element = tuple[tuple[Corner, ...], int]  # corners, and the local edge whose breaking opened it (-1: none)


@dataclass(frozen=True)
class PatternRows:
    """Rows of a table by key: those of key k are start[k] : start[k + 1]."""

    start: Ints

    def expand(self, keys: Ints) -> tuple[Ints, Ints]:
        """(row, owner): the rows of every key in turn, and which of the keys each row came from."""
        count = self.start[keys + 1] - self.start[keys]
        owner = np.repeat(np.arange(len(keys)), count)
        before = np.cumsum(count) - count
        return np.arange(len(owner)) + (self.start[keys] - before)[owner], owner


@dataclass(frozen=True)
class PatternPoints(PatternRows):
    """Copies of each pattern: kind, entity, lead (lowest local node of the group): (rows,); group (rows, d + 1)."""

    kind: Ints
    entity: Ints
    lead: Ints
    group: npt.NDArray[np.bool_]


@dataclass(frozen=True)
class PatternElements(PatternRows):
    """Elements of each key. corners (rows, w): >= 0 a copy of the cell's pattern, -1 - i node i; edge (rows,) or -1."""

    corners: Ints
    edge: Ints


@dataclass(frozen=True)
class CutTable:
    """The patterns of a simplex of dimension d.

    Attributes:
        copies, walls: by pattern.
        facets: by pattern * (d + 1) + local facet: what becomes of the facet where it is on the boundary.
        fill: by pattern: triangles that cover a cell in 2D, none in 3D.
    """

    copies: PatternPoints
    crack_faces: PatternElements
    facets: PatternElements
    fill: PatternElements


@cache
def cut_table(dim: int) -> CutTable:
    """The table for triangles (8 patterns) or tetrahedra (64), worked out once."""
    return tabled(CutCell, dim)


@cache
def intact_cell_table(dim: int) -> CutTable:
    """The first row of it, which does for a body in which nothing has broken."""
    return tabled(CutCell, dim, 1)


def tabled(kind: type[CutCell], dim: int, patterns: int | None = None) -> CutTable:
    """What that kind of cell makes of every pattern, or of the first few."""
    cells = [kind(dim, pattern) for pattern in range(patterns or 1 << len(local_edges(dim)))]
    nodes = range(dim + 1)
    return CutTable(
        _copies(cells, dim),
        _elements([(cell, cell.walls) for cell in cells], dim),
        _elements([(cell, cell.boundary(facet)) for cell in cells for facet in nodes], dim),
        _elements([(cell, cell.fan(cell.T, (0, 1, 2)) if dim == 2 else []) for cell in cells], 3),
    )


class CutCell:
    """One cell with one pattern, in words."""

    def __init__(self, dim: int, pattern: int) -> None:
        self.dim, self.pattern = dim, pattern
        pairs: list[list[int]] = local_edges(dim).tolist()  # type: ignore[assignment]
        self.edge = {frozenset(pair): k for k, pair in enumerate(pairs)}
        self.walls = self._walls()
        used = {corner for corners, _ in self.walls for corner in corners if isinstance(corner, PatternPoint)}
        self.copies = sorted(used)

    def broken(self, i: int, j: int) -> bool:
        return bool(self.pattern >> self.edge[frozenset((i, j))] & 1)

    def group(self, nodes: Iterable[int], i: int) -> tuple[int, ...]:
        """The nodes that intact edges among `nodes` join to i."""
        nodes, found = set(nodes), {i}
        while more := {k for j in found for k in nodes - found if not self.broken(j, k)}:
            found |= more
        return tuple(sorted(found))

    def m(self, i: int, j: int) -> PatternPoint:
        return PatternPoint(EDGE, self.edge[frozenset((i, j))], (i,))

    def G(self, facet: int, i: int) -> PatternPoint:
        return PatternPoint(FACET, facet, self.group(set(range(self.dim + 1)) - {facet}, i))

    def T(self, i: int) -> PatternPoint:
        return PatternPoint(CELL, 0, self.group(range(self.dim + 1), i))

    def _walls(self) -> list[Element]:
        return [element for i, j, *rest in _turned(self.dim) for element in self._wall(i, j, rest)]

    def _wall(self, i: int, j: int, rest: list[int]) -> list[Element]:
        """The side of i of the wall towards j, positively ordered as seen from outside i's part."""
        if not self.broken(i, j):
            return []
        m, T, edge = self.m(i, j), self.T(i), self.edge[frozenset((i, j))]
        if self.dim == 2:  # the part of i lies to the left
            return [((m, T) if sign((i, j, *rest)) > 0 else (T, m), edge)]
        k, last = rest
        return [((m, self.G(last, i), T), edge), ((m, T, self.G(k, i)), edge)]

    def boundary(self, facet: int) -> list[Element]:
        """What covers a boundary facet: itself where it has no broken edge, so that no neighbour meets a T-junction."""
        loop = [node for node in range(self.dim + 1) if node != facet]
        loop = loop if facet % 2 == 0 else [loop[1], loop[0], *loop[2:]]
        if self.dim == 3:
            return self.fan(lambda i: self.G(facet, i), tuple(loop))
        a, b = loop
        if not self.broken(a, b):
            return [((a, b), -1)]
        return [((a, self.m(a, b)), -1), ((self.m(b, a), b), -1)]

    def fan(self, centre: Callable[[int], PatternPoint], loop: tuple[int, ...]) -> list[Element]:
        """A triangle as it is, or as a fan from the copies of its centre."""
        sides = list(zip(loop, loop[1:] + loop[:1], strict=True))
        if not any(self.broken(i, j) for i, j in sides):
            return [(loop, -1)]
        triangles: list[tuple[Corner, ...]] = []
        for i, j in sides:
            if self.broken(i, j):
                triangles += [(centre(i), i, self.m(i, j)), (centre(j), self.m(j, i), j)]
            else:
                triangles += [(centre(i), i, j)]
        return [(triangle, -1) for triangle in triangles]


@cache
def _turned(dim: int) -> list[tuple[int, ...]]:
    """Orderings (i, j, ...) of the nodes, one for each ordered pair: in 3D the even ones."""
    return [order for order in permutations(range(dim + 1)) if dim == 2 or sign(order) > 0]


def sign(order: tuple[int, ...]) -> int:
    swaps = sum(order[a] > order[b] for a in range(len(order)) for b in range(a + 1, len(order)))
    return -1 if swaps % 2 else 1


def _copies(cells: list[CutCell], dim: int) -> PatternPoints:
    rows = [copy for cell in cells for copy in cell.copies]
    group = np.zeros((len(rows), dim + 1), bool)
    for row, copy in zip(group, rows, strict=True):
        row[list(copy.group)] = True
    kind, entity = (np.array([copy[field] for copy in rows], np.int64) for field in (0, 1))
    return PatternPoints(_starts([cell.copies for cell in cells]), kind, entity, group.argmax(axis=1), group)


def _elements(lists: list[tuple[CutCell, list[Element]]], width: int) -> PatternElements:
    corners, edges = [], []
    for cell, elements in lists:
        place = {copy: index for index, copy in enumerate(cell.copies)}
        for element, edge in elements:
            corners.append([place[corner] if isinstance(corner, PatternPoint) else -1 - corner for corner in element])
            edges.append(edge)
    start = _starts([elements for _, elements in lists])
    return PatternElements(start, np.array(corners, np.int64).reshape(-1, width), np.array(edges, np.int64))


def _starts(lists: list[list[Element]] | list[list[PatternPoint]]) -> Ints:
    return np.concatenate([[0], np.cumsum([len(each) for each in lists])]).astype(np.int64)


@cache
def planar_cut_table(dim: int) -> CutTable:
    """The table of cells that are cut flat, worked out once."""
    return tabled(PlanarCutCell, dim)


class PlanarCutCell(CutCell):
    """A cell that is cut between its groups of nodes; edges within a group count as whole."""

    def __init__(self, dim: int, pattern: int) -> None:
        group, ends = node_groups(dim)[pattern], local_edges(dim)
        apart = group[ends[:, 0]] != group[ends[:, 1]]
        super().__init__(dim, int(apart @ (1 << np.arange(len(ends)))))

    def _walls(self) -> list[Element]:
        nodes = range(self.dim + 1)
        parts = sorted({self.group(nodes, i) for i in nodes})
        walls = [corners for part in parts if len(part) < len(nodes) for corners in self._around(part)]
        return [(corners, min(corner.entity for corner in corners)) for corners in walls]

    def _around(self, part: tuple[int, ...]) -> list[tuple[PatternPoint, ...]]:
        """Between these nodes and the others, positively ordered as seen from there."""
        part, rest = _ordered(part, tuple(node for node in range(self.dim + 1) if node not in part))
        if len(part) == 1:
            return [tuple(self.m(part[0], node) for node in rest)]
        if len(rest) == 1:
            return [tuple(self.m(node, rest[0]) for node in (part if self.dim == 3 else part[::-1]))]
        (i, j), (k, last) = part, rest
        a, b, c, d = self.m(i, k), self.m(i, last), self.m(j, last), self.m(j, k)
        return [(a, b, c), (a, c, d)]  # along the same diagonal from both sides: middles

    def fan(self, centre: Callable[[int], PatternPoint], loop: tuple[int, ...]) -> list[Element]:
        """A triangle, without a centre."""
        corners: list[tuple[Corner, ...]] = []
        turns = [loop, (*loop[1:], loop[0]), (*loop[2:], *loop[:2])]
        for a, b, c in turns:
            if self.broken(a, b) and self.broken(a, c):
                corners.append((a, self.m(a, b), self.m(a, c)))
                if not self.broken(b, c):
                    corners += [(self.m(b, a), b, c), (self.m(b, a), c, self.m(c, a))]
        return [(each, -1) for each in corners or [loop]]


@cache
def middles(dim: int) -> npt.NDArray[np.float64]:
    """(2^(d+1), 2^(d+1), d + 1, d + 1): of nodes `mine` and `others` of a cell or a facet, each by its bits, the shares
    with which points of edges from i to j make the middle of the wall between them."""
    size = dim + 1
    result = np.zeros((1 << size, 1 << size, size, size))
    for mine, other in product(range(1, 1 << size), repeat=2):
        if mine & other:
            continue
        part, rest = (tuple(node for node in range(size) if bits >> node & 1) for bits in (mine, other))
        pairs = list(product(part, rest))
        if len(part) == len(rest) == 2:  # a quad in two triangles: the middle of their common side
            pairs = list(zip(*_ordered(part, rest), strict=True))
        for i, j in pairs:
            result[mine, other, i, j] = 1 / len(pairs)
    return result


def _ordered(part: tuple[int, ...], rest: tuple[int, ...]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """The same with two nodes exchanged where all in turn are an odd permutation."""
    if sign(part + rest) > 0:
        return part, rest
    return (part, _swapped(rest)) if len(rest) > 1 else (_swapped(part), rest)


def _swapped(nodes: tuple[int, ...]) -> tuple[int, ...]:
    return nodes[1], nodes[0], *nodes[2:]
