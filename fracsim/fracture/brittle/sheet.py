"""What a level set cuts of a body: the connected sheet around its start, up to the boundary and to older cracks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...mesh.simplices import local_edges
from ...meshes.components import components
from .body import Body, Cells, triangles
from .one_by_one import one_by_one

Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
Values = npt.NDArray[np.float64]

NEAREST = 1e-9  # of an edge: a cut is no nearer to its ends, or triangles of the split surface lose their corners
ROUNDS = 4


def sides_of(phi: Values, tolerance: float) -> Flags:
    """(N,) whether nodes are on the positive side; those on the surface are. NaN: on the other."""
    return np.asarray(phi >= -tolerance)


@dataclass(frozen=True)
class Crossing:
    """Cells that a surface crosses, and the edges that it may cut.

    Attributes:
        cells: (m,).    edges: (m, k) of these cells.
        open: (m, k) the edges that are crossed and not broken.
    """

    cells: Ints
    edges: Ints
    open: Flags

    @classmethod
    def of(cls, body: Body, sides: Flags, broken: Flags, usable: Flags | None = None) -> Crossing:
        """Of nodes on two `sides` (N,); `usable` (C,): cells in which the sides are known, None: all."""
        cells = body.crossed(sides)
        if usable is not None:
            cells = cells[usable[cells]]
        i, j = local_edges(body.dim).T
        side, edges = sides[body.cells[cells]], body.cell_edges[cells]
        return cls(cells, edges, (side[:, i] != side[:, j]) & ~broken[edges])

    def all(self) -> Ints:
        """Every open edge."""
        return np.unique(self.edges[self.open])

    def connected(self, dim: int, seeds: Ints) -> Ints:
        """The open edges that are linked to the seeds (edges) by triangles in which nothing crossed is broken.

        A level set crosses two edges of a triangle or none, and so did every older crack: of three edges they share
        one. So no chain of such triangles leads through an older crack, and each ends on it or on the boundary.
        """
        every, place = np.unique(self.edges[self.open], return_inverse=True)
        number = np.zeros(self.edges.shape, np.int64)
        number[self.open] = place
        corner = triangles(dim)
        inside = self.open[:, corner]
        through = np.count_nonzero(inside, axis=2) == 2
        links = number[:, corner][through][inside[through]].reshape(-1, 2)
        label = components(links, len(every))[1]
        return every[np.isin(label, label[np.isin(every, seeds)])]

    def touched(self, cut: Ints, edge_count: int) -> Ints:
        """Cells that have one of the edges."""
        flags = np.zeros(edge_count, bool)
        flags[cut] = True
        return self.cells[flags[self.edges].any(axis=1)]


def settled(body: Body, sides: Flags, usable: Flags, movable: Flags | None = None) -> Flags:
    """The sides (N,) with the nodes moved over that would be left without a cell on their own side.

    `usable` (C,): cells that have not come apart. `movable` (N,): nodes that may move; None: all. A node without such a
    cell would drift off as a crumb without stiffness. It goes over where all other nodes of one of its cells are, so
    that it has a whole cell there; or else it draws those of one of its cells over to its own side, which is tried for
    all such nodes of one side, then of the other, and kept where fewer are left. In a shell both faces go along.
    """
    if body.layer is None:
        return _settled(body, sides, usable, movable)
    half = len(sides) // 2
    free = None if movable is None else movable[:half]
    whole: Flags = np.asarray(usable.reshape(-1, 3).all(axis=1))
    return np.tile(_settled(body.layer, sides[:half], whole, free), 2)


def _settled(body: Cells, sides: Flags, usable: Flags, movable: Flags | None) -> Flags:
    """The same, of cells that are whole."""
    near = np.zeros(len(sides), bool)
    near[body.cells[body.crossed(sides)]] = True
    if movable is not None:
        near &= movable
    cells = body.cells[np.flatnonzero(body.touching(near) & usable)]
    best = _gone_over(cells, sides, near)
    fewest = np.count_nonzero(_loose(cells, best, near))
    for attempt in range(2 * ROUNDS):
        if not fewest:
            break
        trial = _gone_over(cells, _drawn(cells, best, near, bool(attempt % 2)), near)
        count = np.count_nonzero(_loose(cells, trial, near))
        if count < fewest:
            best, fewest = trial, count
    return one_by_one(cells, best, near) if fewest else best


def _loose(cells: Ints, sides: Flags, near: Flags) -> Flags:
    """(N,) nodes of cells (m, d + 1) that have none of them whole on their own side."""
    above = _count(sides[cells])
    loose = np.zeros(len(sides), bool)
    loose[cells] = True
    loose[cells[(above == 0) | (above == cells.shape[1])]] = False
    return np.asarray(loose & near)


def _gone_over(cells: Ints, sides: Flags, near: Flags) -> Flags:
    """The sides with loose nodes moved to where all other nodes of one of their cells are."""
    sides, most = sides.copy(), cells.shape[1] - 1
    for _ in range(ROUNDS):
        side = sides[cells]
        above = _count(side)
        lone = np.flatnonzero((above == 1) | (above == most))
        odd = cells[lone][side[lone] == (above[lone] == 1)[:, None]]
        over = odd[_loose(cells, sides, near)[odd]]
        if not len(over):
            break
        sides[over] = ~sides[over]
    return sides


def _drawn(cells: Ints, sides: Flags, near: Flags, to: bool) -> Flags:
    """The sides where each loose node of side `to` draws the others of one of its cells over to it.

    The cell with the fewest to draw, of these the first.
    """
    side = sides[cells]
    others = _count(side != to)
    wanting = (_loose(cells, sides, near) & (sides == to))[cells] & (near[cells] | (side == to)).all(axis=1)[:, None]
    row, corner = np.nonzero(wanting)
    order = np.lexsort((row, others[row]))
    chosen = row[order[np.unique(cells[row, corner][order], return_index=True)[1]]]
    sides = sides.copy()
    sides[cells[chosen]] = to
    return sides


def cut_places(phi: Values, sides: Flags, ends: Ints) -> Values:
    """(n,) where edges with `ends` (n, 2) on two sides are cut, from the first (0) to the second (1).

    The zero of phi on the edge; at the node where one has been moved to the other side.
    """
    phi, sides = phi[ends], sides[ends]
    distance = np.where(sides, np.maximum(phi, 0.0), np.maximum(-phi, 0.0))
    both = distance.sum(axis=1)
    place = np.divide(distance[:, 0], both, out=np.full(len(both), 0.5), where=both > 0)
    return np.clip(place, NEAREST, 1 - NEAREST)


def _count(flags: Flags) -> npt.NDArray[np.int8]:
    """(m,) how many of each row (m, d + 1) are set: column by column, a tenth of the time of NumPy's sum."""
    columns = flags.view(np.int8).T
    return np.asarray(sum(columns[1:], start=columns[0]))
