"""Interpenetration of fragments: a node of one fragment lies inside an intact cell of another.

Crack faces lie half an edge from the nodes beside them. Therefore crack faces that touch, or overlap slightly, are not
reported: a reported node lies about one edge length inside the other fragment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from scipy.spatial import cKDTree

from .parallel import allgather, alltoall, concatenate_over_ranks, max_over_ranks, sum_over_ranks

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


# Pairs of boxes that are compared at a time, which bounds memory.
PAIRS_AT_A_TIME = 1 << 22


@dataclass(frozen=True, order=True)
class Overlap:
    """A node of one fragment inside an intact cell of another.

    Attributes:
        depth: least barycentric coordinate of the node in the cell.
        node: number of the node in the input mesh.
        position: current position of the node, m.
        fragments: of the node, and of the cell.
    """

    depth: float
    node: int
    position: tuple[float, ...]
    fragments: tuple[int, int]


@dataclass(frozen=True)
class RankNodes:
    """Nodes of which ranks have parts.

    Attributes:
        comm: the ranks.
        numbers: (N,) numbers of the nodes of this rank in the input mesh.
        is_owned: (N,) flags; each node is owned by one rank.
    """

    comm: MPI.Intracomm
    numbers: Ints
    is_owned: Flags


def find_interpenetration(x: Values, cells: Ints, fragment: Ints, nodes: RankNodes | None = None) -> Overlap | None:
    """The node that lies deepest inside a cell of another fragment; None if there is none (collective).

    Of nodes that are equally deep, to 1e-9 of a cell, the one of the largest number counts, on any number of ranks.

    Args:
        x: (N, d) current positions, m.
        cells: (C, d + 1) intact cells of this rank.
        fragment: (N,) fragment of each node.
        nodes: the nodes of this rank; None: one rank has all.
    """
    shared = nodes or RankNodes(MPI.COMM_SELF, np.arange(len(x)), np.ones(len(x), bool))
    comm, cell_fragment = shared.comm, fragment[cells[:, 0]]
    owned = np.flatnonzero(shared.is_owned)
    by_fragment = owned[np.argsort(fragment[owned], kind="stable")]
    fragment_count = max_over_ranks(comm, int(fragment.max(initial=-1)) + 1)
    count = np.bincount(fragment[owned], minlength=fragment_count)
    lower, upper = _bounding_boxes(comm, x[by_fragment], count)
    small, large = _overlapping_boxes(lower, upper, sum_over_ranks(comm, count))
    if not len(small):
        return None
    near = by_fragment[
        _points_in_boxes(x[by_fragment], np.cumsum(count) - count, count, small, lower[large], upper[large])
    ]
    holds = np.zeros(fragment_count, bool)
    holds[large] = True
    searched = np.flatnonzero(holds[cell_fragment])
    box_of_near = _bounding_boxes(comm, x[near], np.array([len(near)]))
    searched = searched[_cells_at_box(x, box_of_near[0][0], box_of_near[1][0], cells[searched])]
    # 10,000 cells give the usual size of a cell
    sampled = cells[searched[:: len(searched) // 10_000 + 1]]
    radii = concatenate_over_ranks(comm, _balls(x, sampled)[1])
    if not len(radii):
        return None
    near_x, near_fragment, near_number = _nodes_at_cells(comm, x, cells[searched], near, fragment, shared.numbers)
    node, cell = _candidates(near_x, x, cells[searched], 4 * float(np.median(radii)))
    cell = searched[cell]
    foreign = near_fragment[node] != cell_fragment[cell]
    node, cell = node[foreign], cell[foreign]
    depth = np.round(_min_barycentric(near_x[node], x[cells[cell]]), 9)
    overlaps = []
    # least barycentric coordinate of a node that counts as inside: bodies that only touch do not interpenetrate
    if len(depth) and depth.max() > 0.05:
        deepest = np.lexsort((cell_fragment[cell], near_number[node], depth))[-1]
        inner, outer = node[deepest], cell[deepest]
        pair = int(near_fragment[inner]), int(cell_fragment[outer])
        overlaps = [Overlap(float(depth[deepest]), int(near_number[inner]), tuple(near_x[inner].tolist()), pair)]
    return max((overlap for of_rank in allgather(comm, overlaps) for overlap in of_rank), default=None)


def _bounding_boxes(comm: MPI.Intracomm, x: Values, count: Ints) -> tuple[Values, Values]:
    """(k, d) lower and (k, d) upper corners of the boxes about k groups of points of all ranks (collective).

    `x`: (n, d) points, group by group.    `count`: (k,) points of this rank in each group.
    """
    lower, upper = np.full((len(count), x.shape[1]), np.inf), np.full((len(count), x.shape[1]), -np.inf)
    used = np.flatnonzero(count)
    start = (np.cumsum(count) - count)[used]
    if len(used):
        lower[used], upper[used] = np.minimum.reduceat(x, start), np.maximum.reduceat(x, start)
    if comm.size > 1:
        comm.Allreduce(MPI.IN_PLACE, lower, MPI.MIN)
        comm.Allreduce(MPI.IN_PLACE, upper, MPI.MAX)
    return lower, upper


def _nodes_at_cells(
    comm: MPI.Intracomm, x: Values, cells: Ints, nodes: Ints, fragment: Ints, numbers: Ints
) -> tuple[Values, Ints, Ints]:
    """(n, d) positions, (n,) fragments and (n,) numbers of nodes of all ranks in the box about cells of this rank.

    Collective. `nodes`: (k,) that this rank has to offer.
    """
    if comm.size == 1:
        return x[nodes], fragment[nodes], numbers[nodes]
    corners = x[cells.reshape(-1)]
    boxes = allgather(comm, (corners.min(axis=0, initial=np.inf), corners.max(axis=0, initial=-np.inf)))
    inside = [nodes[((x[nodes] >= lower) & (x[nodes] <= upper)).all(axis=1)] for lower, upper in boxes]
    arrived = alltoall(comm, [(x[rows], fragment[rows], numbers[rows]) for rows in inside])
    near_x, near_fragment, near_number = (np.concatenate(parts) for parts in zip(*arrived, strict=True))
    return near_x, near_fragment, near_number


def _overlapping_boxes(lower: Values, upper: Values, count: Ints) -> tuple[Ints, Ints]:
    """(k,), (k,) pairs of fragments whose bounding boxes overlap, the one with fewer nodes first."""
    # along one axis a box may overlap those after it that begin before it ends
    orders = np.argsort(lower, axis=0)
    ends = [np.searchsorted(lower[order, k], upper[order, k]) for k, order in enumerate(orders.T)]
    axis = int(np.argmin([end.sum() for end in ends]))
    order, positions = orders[:, axis], np.arange(len(lower))
    after = np.maximum(ends[axis] - positions - 1, 0)
    last = np.cumsum(after)
    pairs, first = [np.empty((2, 0), np.int64)], 0
    while first < len(lower):
        stop = max(int(np.searchsorted(last, last[first] + PAIRS_AT_A_TIME)), first + 1)
        batch = slice(first, stop)
        i = np.repeat(positions[batch], after[batch])
        j = i + 1 + np.arange(len(i)) - np.repeat(np.cumsum(after[batch]) - after[batch], after[batch])
        i, j = order[i], order[j]
        for k in range(lower.shape[1]):
            overlap = (lower[i, k] < upper[j, k]) & (lower[j, k] < upper[i, k])
            i, j = i[overlap], j[overlap]
        pairs.append(np.sort([i, j], axis=0))
        first = stop
    i, j = np.concatenate(pairs, axis=1)
    fewer = count[i] <= count[j]
    return np.where(fewer, i, j), np.where(fewer, j, i)


def _points_in_boxes(x: Values, start: Ints, count: Ints, small: Ints, lower: Values, upper: Values) -> Ints:
    """Points of the fragments `small` (k,) that lie in the boxes `lower`, `upper` (k, d) of their pairs."""
    counts = count[small]
    pair = np.repeat(np.arange(len(small)), counts)
    point = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts) + np.repeat(start[small], counts)
    position = x[point]
    return np.unique(point[((position > lower[pair]) & (position < upper[pair])).all(axis=1)])


def _cells_at_box(x: Values, lower: Values, upper: Values, cells: Ints) -> Flags:
    """Flags (C,) of the cells that overlap a box."""
    bits = 1 << np.arange(x.shape[1], dtype=np.uint8)
    # A cell all of whose nodes are on one outer side of the box does not overlap it.
    sides = ((x < lower) @ bits, (x > upper) @ bits)
    return np.asarray(sum(np.bitwise_and.reduce(side[cells], axis=1) for side in sides) == 0)


def _balls(x: Values, cells: Ints) -> tuple[Values, Values]:
    """Centres (C, d) of cells, and radii (C,) of balls about them that have all corners, m."""
    corners = x[cells]
    centre = corners.mean(axis=1)
    return centre, np.sqrt(((corners - centre[:, None]) ** 2).sum(axis=2).max(axis=1))


def _candidates(points: Values, x: Values, cells: Ints, max_radius: float) -> tuple[Ints, Ints]:
    """Pairs (index in `points` (n, d), index in `cells`) of points in the smallest ball about the cell's centre."""
    centre, radius = _balls(x, cells)
    # larger cells are torn or crushed, and are left out
    usual = np.flatnonzero(radius < max_radius)
    if not len(usual) or not len(points):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    centres = cKDTree(centre[usual])
    pairs = cKDTree(points).sparse_distance_matrix(centres, radius[usual].max(), output_type="ndarray")
    cell = usual[pairs["j"]]
    close = pairs["v"] < radius[cell]
    return pairs["i"][close], cell[close]


def _min_barycentric(points: Values, corners: Values) -> Values:
    """(n,) minimum barycentric coordinate of points (n, d) in cells with corners (n, d + 1, d); -1 without volume."""
    edges = (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
    real = np.flatnonzero(np.linalg.det(edges) != 0)
    depth = np.full(len(points), -1.0)
    inner = np.linalg.solve(edges[real], (points[real] - corners[real, 0])[:, :, None])[:, :, 0]
    depth[real] = np.minimum(inner.min(axis=1), 1 - inner.sum(axis=1))
    return depth
