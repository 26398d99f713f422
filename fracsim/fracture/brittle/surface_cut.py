"""Cuts of a mesh by a level set: the connected sheet through a start, up to the boundary and to older cracks.

Nodes that would be left without a cell on their own side are moved to the other side, together or one by one. One by
one is slower, and finds a cell for nodes whose neighbours undo each other's moves: in a slab of two cells with grains
2.5 edges wide that is one node in two hundred.

Equations: docs/theory.md#brittle-surfaces.
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
from ...meshes.data import MeshData
from ...meshes.topology import components, signed_measures

Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class SurfaceCutParameters:
    """Parameters of cuts by level sets.

    Attributes:
        min_share: least share of an edge between a cut and its ends: triangles of the split surface would lose their
            corners otherwise.
        on_surface: distance from the level set, over the mean cell size, up to which a node lies on it.
        reassign_rounds: attempts to move isolated nodes together.
        relabel_rounds: attempts to move isolated nodes one by one.
    """

    min_share: float = 1e-9
    on_surface: float = 1e-7
    reassign_rounds: int = 4
    relabel_rounds: int = 3


CUT = SurfaceCutParameters()


class CellNodes:
    """Cells as arrays of nodes, with queries that work corner by corner.

    Attributes:
        cells: (cells, k) nodes.
        corners: (k, cells) the transpose, contiguous: a query by columns takes a fifth of the time of any(axis=1).
    """

    cells: Ints
    corners: Ints

    def __init__(self, cells: Ints) -> None:
        self.cells, self.corners = cells, np.ascontiguousarray(cells.T)

    def find_crossed(self, sides: Flags) -> Ints:
        """Find the cells that have nodes on both sides (nodes,)."""
        first = sides[self.corners[0]]
        differs = sides[self.corners[1]] != first
        for column in self.corners[2:]:
            differs |= sides[column] != first
        return np.flatnonzero(differs)

    def flag_with_nodes(self, nodes: Flags) -> Flags:
        """Flag the cells (cells,) that have one of the flagged nodes (nodes,)."""
        result = nodes[self.corners[0]]
        for column in self.corners[1:]:
            result |= nodes[column]
        return result


class SurfaceCutMesh(MeshTopology, CellNodes):
    """Input mesh as level sets cut it; a shell is cut at its middle surface, through its whole thickness.

    Attributes:
        volumes: (cells,) m^d.
        centroids: (cells, d) m.
        layer: triangles of a shell, whose nodes are there twice; None for a solid.
        tolerance: distance up to which a node lies on a surface, m.
        size: diagonal of the bounding box, m.
    """

    def __init__(self, mesh: MeshData) -> None:
        MeshTopology.__init__(self, mesh)
        CellNodes.__init__(self, mesh.cells)
        self.volumes: Values = signed_measures(mesh.points, mesh.cells)
        self.layer = None if mesh.shell is None else CellNodes(mesh.shell.triangles)
        if mesh.shell is not None:
            self.points = mesh.shell.middle
        self.centroids: Values = self.points[mesh.cells].mean(axis=1)
        self.tolerance = CUT.on_surface * float(np.mean(self.volumes)) ** (1 / mesh.dim)
        self.size = float(np.linalg.norm(np.ptp(self.points, axis=0)))

    @cached_property
    def node_cells(self) -> csr_matrix:
        """(nodes, cells) incidence of cells around nodes."""
        cell = np.repeat(np.arange(len(self.cells)), self.cells.shape[1])
        return csr_matrix(
            (np.ones(len(cell), np.int8), (self.cells.ravel(), cell)), (len(self.points), len(self.cells))
        )

    def flag_unsplit(self, cells: Ints, broken: Flags) -> Flags:
        """Flag the cells (n,) that are not split, given the broken edges (edges,)."""
        bits = 1 << np.arange(self.cell_edges.shape[1])
        return np.asarray(~is_split(self.dim)[broken[self.cell_edges[cells]] @ bits])


@cache
def cell_triangles(dim: int) -> Ints:
    """Return the local edges (t, 3) of the triangles of a cell: the cell itself in 2D, its four facets in 3D."""
    edges = local_edges(dim)
    if dim == 2:
        return np.arange(3)[None]
    return np.array([np.flatnonzero(np.all(edges != facet, axis=1)) for facet in range(4)])


# --- nodes moved one by one ---


def relabel_isolated_nodes[Label: (Ints, Flags)](cells: Ints, label: Label, movable: Flags) -> Label:
    """Return labels (nodes,) with fewer isolated nodes, which have no cell with corners of one label.

    For each isolated node in turn all corners of one of its cells get one of the labels around it, if that leaves fewer
    nodes isolated; of several such moves that of fewest nodes is made.

    Args:
        cells: (m, k) all cells of the movable nodes.
        label: (nodes,) grain or side of each node.
        movable: (nodes,) nodes whose label may change; the others do not count as isolated.
    """
    label = label.copy()
    around = _NodeCellLists(cells, len(label))
    for _ in range(CUT.relabel_rounds):
        uniform_cells = np.bincount(cells[_is_uniform(label[cells])].ravel(), minlength=len(label))
        isolated = np.flatnonzero((uniform_cells == 0) & movable & around.any)
        if not len(isolated):
            break
        moved = [_relabel_cell(cells, label, movable, uniform_cells, around, int(node)) for node in isolated]
        if not any(moved):
            break
    return label


class _NodeCellLists:
    """Cells around nodes.

    Attributes:
        any: (nodes,) whether a node has any cell.
    """

    def __init__(self, cells: Ints, count: int) -> None:
        """Sort cells (m, k) by their nodes, of which there are `count`."""
        flat = cells.ravel()
        self._order = np.argsort(flat, kind="stable")
        self._start = np.searchsorted(flat[self._order], np.arange(count + 1))
        self._corners, self.any = cells.shape[1], np.diff(self._start) > 0

    def __call__(self, nodes: Ints) -> Ints:
        """Return the cells around any of the nodes, ascending."""
        parts = [self._order[self._start[node] : self._start[node + 1]] for node in nodes]
        return np.unique(np.concatenate(parts) // self._corners)


def _is_uniform(label: npt.NDArray[Any]) -> Flags:
    """Flag the cells (..., m) whose corners (..., m, k) have one label."""
    return np.asarray(np.all(label == label[..., :1], axis=-1))


def _relabel_cell(
    cells: Ints, label: Ints | Flags, movable: Flags, uniform_cells: Ints, around: _NodeCellLists, node: int
) -> bool:
    """Relabel one cell of an isolated node; return whether that was possible.

    `label` and `uniform_cells` (nodes,), the number of cells of one label around each node, are updated in place.
    """
    if uniform_cells[node]:
        return False
    near = cells[around(np.array([node]))]
    corners = np.unique(near)
    local = cells[around(corners)]
    nodes, column = np.unique(local, return_inverse=True)
    column = column.reshape(local.shape)
    # Trials: every cell around the node, with every label around it.
    candidates = np.unique(label[corners])
    targets = np.repeat(near, len(candidates), axis=0)
    trial = np.tile(np.asarray(label[nodes]), (len(targets), 1))
    np.put_along_axis(trial, np.searchsorted(nodes, targets), np.tile(candidates, len(near))[:, None], axis=1)
    changed = trial != label[nodes]
    allowed = np.flatnonzero(~np.any(changed & ~movable[nodes], axis=1))
    trial, changed = trial[allowed], changed[allowed]
    incidence = np.zeros((len(local), len(nodes)), np.int64)
    incidence[np.arange(len(local))[:, None], column] = 1
    # Cells around these nodes that are not among `local` keep their labels.
    unchanged = uniform_cells[nodes] - _is_uniform(label[local]) @ incidence
    count = unchanged + _is_uniform(trial[:, column]) @ incidence
    isolated = np.count_nonzero((count == 0) & movable[nodes], axis=1)
    before = np.count_nonzero((uniform_cells[nodes] == 0) & movable[nodes])
    best = np.lexsort((np.arange(len(isolated)), changed.sum(axis=1), isolated))[:1]
    if not len(best) or isolated[best[0]] >= before:
        return False
    label[nodes], uniform_cells[nodes] = trial[best[0]], count[best[0]]
    return True


# --- level sets ---


def sides_of_level_set(phi: Values, tolerance: float) -> Flags:
    """Flag the nodes on the positive side, to which those on the surface belong; NaN counts as negative."""
    return np.asarray(phi >= -tolerance)


@dataclass(frozen=True)
class CrossedCells:
    """Cells that a surface crosses, and the edges that it may cut.

    Attributes:
        cells: (m,) cells.
        edges: (m, k) their edges.
        open: (m, k) edges that are crossed and not broken.
    """

    cells: Ints
    edges: Ints
    open: Flags

    @classmethod
    def from_sides(cls, mesh: SurfaceCutMesh, sides: Flags, broken: Flags, usable: Flags | None = None) -> CrossedCells:
        """Find the cells with nodes on both sides (nodes,); `usable`: (cells,) where sides are defined, None: all."""
        cells = mesh.find_crossed(sides)
        if usable is not None:
            cells = cells[usable[cells]]
        i, j = local_edges(mesh.dim).T
        side, edges = sides[mesh.cells[cells]], mesh.cell_edges[cells].astype(np.int64)
        return cls(cells, edges, (side[:, i] != side[:, j]) & ~broken[edges])

    def all_open_edges(self) -> Ints:
        """Return all open edges."""
        return np.unique(self.edges[self.open])

    def connected_open_edges(self, dim: int, seeds: Ints) -> Ints:
        """Return the open edges that are linked to seed edges by triangles with two open edges."""
        edges, inverse = np.unique(self.edges[self.open], return_inverse=True)
        number = np.zeros(self.edges.shape, np.int64)
        number[self.open] = inverse
        triangles = cell_triangles(dim)
        is_open = self.open[:, triangles]
        # A level set crosses two edges of a triangle or none, and so did every older crack. Of three edges the two
        # sheets share one, so that no chain of triangles leads through an older crack: each ends on it or on the
        # boundary.
        linking = np.count_nonzero(is_open, axis=2) == 2
        links = number[:, triangles][linking][is_open[linking]].reshape(-1, 2)
        label = components(links, len(edges))[1]
        return edges[np.isin(label, label[np.isin(edges, seeds)])]

    def cells_with_edges(self, cut: Ints, edge_count: int) -> Ints:
        """Return the crossed cells that have one of the edges `cut`."""
        flags = np.zeros(edge_count, bool)
        flags[cut] = True
        return self.cells[flags[self.edges].any(axis=1)]


def level_set_cut_positions(phi: Values, sides: Flags, ends: npt.NDArray[np.integer]) -> Values:
    """Return the cut positions (n,) of edges whose ends (n, 2) are on different sides, from the first end.

    It is the zero of phi on the edge, or the node itself if that was moved to the other side.
    """
    phi, sides = phi[ends], sides[ends]
    distance = np.where(sides, np.maximum(phi, 0.0), np.maximum(-phi, 0.0))
    total = distance.sum(axis=1)
    position = np.divide(distance[:, 0], total, out=np.full(len(total), 0.5), where=total > 0)
    return np.clip(position, CUT.min_share, 1 - CUT.min_share)


# --- nodes moved to the other side together ---


def reassign_isolated_nodes(mesh: SurfaceCutMesh, sides: Flags, usable: Flags, movable: Flags | None = None) -> Flags:
    """Return the sides (nodes,) with isolated nodes moved, which have no usable cell on their own side.

    Such a node would be a fragment without stiffness. It moves to the side of all other nodes of one of its cells. Or
    it draws the other nodes of a cell to its own side, which is tried for all isolated nodes of one side, then of the
    other, and kept if fewer are left. In a shell both faces move together.

    Args:
        mesh: the input mesh.
        sides: (nodes,) side of the surface.
        usable: (cells,) cells that are not split.
        movable: (nodes,) nodes that may move; None: all.
    """
    if mesh.layer is None:
        return _reassign_in_cells(mesh, sides, usable, movable)
    half = len(sides) // 2
    layer_movable = None if movable is None else movable[:half]
    # A triangle of a shell stands for three tetrahedra.
    layer_usable: Flags = np.asarray(usable.reshape(-1, 3).all(axis=1))
    return np.tile(_reassign_in_cells(mesh.layer, sides[:half], layer_usable, layer_movable), 2)


def _reassign_in_cells(mesh: CellNodes, sides: Flags, usable: Flags, movable: Flags | None) -> Flags:
    """Return the sides as `reassign_isolated_nodes` does, for cells with any number of corners."""
    # Only nodes of crossed cells can be isolated by the surface.
    near = np.zeros(len(sides), bool)
    near[mesh.cells[mesh.find_crossed(sides)]] = True
    if movable is not None:
        near &= movable
    cells = mesh.cells[np.flatnonzero(mesh.flag_with_nodes(near) & usable)]
    best = _move_to_other_side(cells, sides, near)
    fewest = np.count_nonzero(_flag_isolated(cells, best, near))
    for attempt in range(2 * CUT.reassign_rounds):
        if not fewest:
            break
        trial = _move_to_other_side(cells, _draw_cells_over(cells, best, near, bool(attempt % 2)), near)
        count = np.count_nonzero(_flag_isolated(cells, trial, near))
        if count < fewest:
            best, fewest = trial, count
    return relabel_isolated_nodes(cells, best, near) if fewest else best


def _flag_isolated(cells: Ints, sides: Flags, near: Flags) -> Flags:
    """Flag the nodes (nodes,) of cells (m, d + 1), among `near`, that have no cell on their own side."""
    above = _count_flags(sides[cells])
    isolated = np.zeros(len(sides), bool)
    isolated[cells] = True
    isolated[cells[(above == 0) | (above == cells.shape[1])]] = False
    return np.asarray(isolated & near)


def _move_to_other_side(cells: Ints, sides: Flags, near: Flags) -> Flags:
    """Return the sides with isolated nodes moved to the side of all other nodes of one of their cells."""
    sides, all_but_one = sides.copy(), cells.shape[1] - 1
    for _ in range(CUT.reassign_rounds):
        side = sides[cells]
        above = _count_flags(side)
        with_odd_node = np.flatnonzero((above == 1) | (above == all_but_one))
        odd = cells[with_odd_node][side[with_odd_node] == (above[with_odd_node] == 1)[:, None]]
        moved = odd[_flag_isolated(cells, sides, near)[odd]]
        if not len(moved):
            break
        sides[moved] = ~sides[moved]
    return sides


def _draw_cells_over(cells: Ints, sides: Flags, near: Flags, target: bool) -> Flags:
    """Return the sides where each isolated node of side `target` draws one of its cells over to it.

    It is the cell with the fewest nodes to move, of equal ones the first.
    """
    side = sides[cells]
    to_move = _count_flags(side != target)
    possible = (near[cells] | (side == target)).all(axis=1)[:, None]
    is_isolated = (_flag_isolated(cells, sides, near) & (sides == target))[cells] & possible
    row, corner = np.nonzero(is_isolated)
    order = np.lexsort((row, to_move[row]))
    chosen = row[order[np.unique(cells[row, corner][order], return_index=True)[1]]]
    sides = sides.copy()
    sides[cells[chosen]] = target
    return sides


def _count_flags(flags: Flags) -> npt.NDArray[np.int8]:
    """Return the number (m,) of flags set in each row (m, d + 1), in a tenth of the time of NumPy's sum."""
    columns = flags.view(np.int8).T
    return np.asarray(sum(columns[1:], start=columns[0]))
