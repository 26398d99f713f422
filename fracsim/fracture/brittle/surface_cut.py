"""What a level set cuts of a body: the connected sheet around its start, up to the boundary and to older cracks.

The input mesh as a level set sees it: points, edges, the triangles of a cell.

Nodes that are left without a cell whose corners are all on their side, moved one after the other.

Where nodes are moved over all at once, each with its own cell in mind, neighbours undo one another's: where grains are
2.5 edges wide in a slab of two cells, one node in two hundred stays alone. Taken alone each finds a cell that leaves
fewer.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix

from ...mesh.input_topology import MeshTopology
from ...mesh.simplices import is_split, local_edges
from ...meshes.components import components
from ...meshes.data import MeshData
from ...meshes.topology import signed_measures

Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
Values = npt.NDArray[np.float64]
RELABEL_ROUNDS = 3
NEAREST = 1e-9  # of an edge: a cut is no nearer to its ends, or triangles of the split surface lose their corners
ROUNDS = 4


class Cells:
    """Cells by their nodes.

    Attributes:
        cells: (C, k) nodes.    corners: (k, C) the same.
    """

    cells: Ints
    corners: Ints

    def __init__(self, cells: Ints) -> None:
        self.cells, self.corners = cells, np.ascontiguousarray(cells.T)

    def crossed(self, sides: Flags) -> Ints:
        """Cells with nodes on both sides (N,)."""
        first = sides[self.corners[0]]
        differs = sides[self.corners[1]] != first
        for column in self.corners[2:]:  # five times as fast as any(axis=1)
            differs |= sides[column] != first
        return np.flatnonzero(differs)

    def touching(self, nodes: Flags) -> Flags:
        """(C,) whether cells have one of the nodes flagged (N,)."""
        result = nodes[self.corners[0]]
        for column in self.corners[1:]:
            result |= nodes[column]
        return result


class Body(MeshTopology, Cells):
    """A mesh as level sets cut it. A shell is cut where its middle surface is, across its whole thickness.

    Attributes:
        centroids: (C, d) m.    layer: triangles of a shell, whose nodes are there twice; None of a solid.
        tolerance: m; nodes as near as this to a surface lie on it.
    """

    def __init__(self, mesh: MeshData) -> None:
        MeshTopology.__init__(self, mesh)
        Cells.__init__(self, mesh.cells)
        self.volumes: Values = signed_measures(mesh.points, mesh.cells)
        self.layer = None if mesh.shell is None else Cells(mesh.shell.triangles)
        if mesh.shell is not None:
            self.points = mesh.shell.middle
        self.centroids: Values = self.points[mesh.cells].mean(axis=1)
        self.tolerance = 1e-7 * float(np.mean(self.volumes)) ** (1 / mesh.dim)

    @cached_property
    def around(self) -> csr_matrix:
        """(N, C) cells around each node."""
        cell = np.repeat(np.arange(len(self.cells)), self.cells.shape[1])
        return csr_matrix(
            (np.ones(len(cell), np.int8), (self.cells.ravel(), cell)), (len(self.points), len(self.cells))
        )

    def whole(self, cells: Ints, broken: Flags) -> Flags:
        """(n,) which of the cells have not come apart."""
        bits = 1 << np.arange(self.cell_edges.shape[1])
        return np.asarray(~is_split(self.dim)[broken[self.cell_edges[cells]] @ bits])


@cache
def triangles(dim: int) -> Ints:
    """(t, 3) local edges of the triangles of a cell: itself in 2D, its four facets in 3D."""
    edges = local_edges(dim)
    if dim == 2:
        return np.arange(3)[None]
    return np.array([np.flatnonzero(np.all(edges != facet, axis=1)) for facet in range(4)])


def one_by_one[Label: (Ints, Flags)](cells: Ints, label: Label, movable: Flags) -> Label:
    """Labels (N,) of nodes, grains or sides, with all corners of one cell of each lost node given one label of those
    around it, where that leaves fewer nodes lost; of several ways the one that moves fewest.

    `cells` (m, k): all those of the nodes that are `movable` (N,); others keep their labels, and do not count. The loop
    is over lost nodes, what each could do is looked at at once.
    """
    label = label.copy()
    around = _Around(cells, len(label))
    for _ in range(RELABEL_ROUNDS):
        held = np.bincount(cells[_whole(label[cells])].ravel(), minlength=len(label))
        lost = np.flatnonzero((held == 0) & movable & around.any)
        if not len(lost) or not any([_moved(cells, label, movable, held, around, int(node)) for node in lost]):
            break
    return label


class _Around:
    """Cells of nodes.

    Attributes:
        any: (N,) whether a node has any.
    """

    def __init__(self, cells: Ints, count: int) -> None:
        flat = cells.ravel()
        self._order = np.argsort(flat, kind="stable")
        self._start = np.searchsorted(flat[self._order], np.arange(count + 1))
        self._corners, self.any = cells.shape[1], np.diff(self._start) > 0

    def __call__(self, nodes: Ints) -> Ints:
        """Of any of some nodes, ascending."""
        parts = [self._order[self._start[node] : self._start[node + 1]] for node in nodes]
        return np.unique(np.concatenate(parts) // self._corners)


def _whole(label: npt.NDArray[Any]) -> Flags:
    """(..., m) whether all corners (..., m, k) have one label."""
    return np.asarray(np.all(label == label[..., :1], axis=-1))


def _moved(cells: Ints, label: Ints | Flags, movable: Flags, held: Ints, around: _Around, node: int) -> bool:
    """Whether a lost node has found a cell; labels and how many whole cells nodes have (N,) are brought up to date."""
    if held[node]:
        return False
    near = cells[around(np.array([node]))]
    corners = np.unique(near)
    local = cells[around(corners)]
    nodes, place = np.unique(local, return_inverse=True)
    place = place.reshape(local.shape)
    kinds = np.unique(label[corners])
    ways = np.repeat(near, len(kinds), axis=0)
    trial = np.tile(np.asarray(label[nodes]), (len(ways), 1))
    np.put_along_axis(trial, np.searchsorted(nodes, ways), np.tile(kinds, len(near))[:, None], axis=1)
    changed = trial != label[nodes]
    allowed = np.flatnonzero(~np.any(changed & ~movable[nodes], axis=1))
    trial, changed = trial[allowed], changed[allowed]
    incidence = np.zeros((len(local), len(nodes)), np.int64)
    incidence[np.arange(len(local))[:, None], place] = 1
    outside = held[nodes] - _whole(label[local]) @ incidence
    now = outside + _whole(trial[:, place]) @ incidence
    left = np.count_nonzero((now == 0) & movable[nodes], axis=1)
    before = np.count_nonzero((held[nodes] == 0) & movable[nodes])
    best = np.lexsort((np.arange(len(left)), changed.sum(axis=1), left))[:1]
    if not len(best) or left[best[0]] >= before:
        return False
    label[nodes], held[nodes] = trial[best[0]], now[best[0]]
    return True


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
