"""Cells cut flat between pieces: by one triangle around a node, or by two between two nodes and two.

What a node owns of its cell ends at six triangles that meet in the middle of the cell (table). Between pieces, where
every edge from one group of nodes to another is broken, the plane through the places where these are cut does: a fifth
of the elements, and no corners that stick out. Its points are on edges alone, so that neighbours agree on them.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from itertools import product

import numpy as np
import numpy.typing as npt

from ..simplices import local_edges, node_groups
from .table import Cell, Copy, Corner, Element, Table, sign, tabled


@cache
def flat_table(dim: int) -> Table:
    """The table of cells that are cut flat, worked out once."""
    return tabled(FlatCell, dim)


class FlatCell(Cell):
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

    def _around(self, part: tuple[int, ...]) -> list[tuple[Copy, ...]]:
        """Between these nodes and the others, positively ordered as seen from there."""
        part, rest = _ordered(part, tuple(node for node in range(self.dim + 1) if node not in part))
        if len(part) == 1:
            return [tuple(self.m(part[0], node) for node in rest)]
        if len(rest) == 1:
            return [tuple(self.m(node, rest[0]) for node in (part if self.dim == 3 else part[::-1]))]
        (i, j), (k, last) = part, rest
        a, b, c, d = self.m(i, k), self.m(i, last), self.m(j, last), self.m(j, k)
        return [(a, b, c), (a, c, d)]  # along the same diagonal from both sides: middles

    def fan(self, centre: Callable[[int], Copy], loop: tuple[int, ...]) -> list[Element]:
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
