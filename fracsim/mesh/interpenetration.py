"""Interpenetration of fragments: a node of one fragment lies inside an intact cell of another.

Crack faces lie half an edge from the nodes beside them. Therefore crack faces that touch, or overlap slightly, are not
reported: a reported node lies about one edge length inside the other fragment.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
# cells at most that give the usual size of a cell
SAMPLED_CELLS = 10_000


def find_interpenetration(x: Values, cells: Ints, fragment: Ints) -> tuple[int, int] | None:
    """The node that lies deepest inside a cell of another fragment, and that cell; None if there is none.

    `x`: (N, d) current positions, m.    `cells`: (C, d + 1) intact cells.    `fragment`: (N,) fragment of each node.
    """
    cell_fragment = fragment[cells[:, 0]]
    nodes = np.argsort(fragment, kind="stable")
    names, start, count = np.unique(fragment[nodes], return_index=True, return_counts=True)
    if len(names) < 2:
        return None
    lower, upper = np.minimum.reduceat(x[nodes], start), np.maximum.reduceat(x[nodes], start)
    small, large = _overlapping_boxes(lower, upper, count)
    if not len(small):
        return None
    near = _points_in_boxes(x[nodes], start, count, small, lower[large], upper[large])
    holds = np.zeros(fragment.max() + 1, bool)
    holds[names[large]] = True
    searched = np.flatnonzero(holds[cell_fragment])
    if not len(searched):
        return None
    usual_radius = float(np.median(_balls(x, cells[searched[:: len(searched) // SAMPLED_CELLS + 1]])[1]))
    searched = searched[_cells_at_points(x, nodes[near], cells[searched])]
    node, cell = _candidates(x, nodes[near], cells[searched], 4 * usual_radius)
    foreign = fragment[node] != cell_fragment[searched[cell]]
    node, cell = node[foreign], searched[cell[foreign]]
    depth = _min_barycentric(x, node, cells[cell])
    # least barycentric coordinate of a node that counts as inside: bodies that only touch do not interpenetrate
    if not len(depth) or depth.max() <= 0.05:
        return None
    deepest = np.argmax(depth)
    return int(node[deepest]), int(cell[deepest])


def _overlapping_boxes(lower: Values, upper: Values, count: Ints) -> tuple[Ints, Ints]:
    """(k,), (k,) pairs of fragments whose bounding boxes overlap, the one with fewer nodes first."""
    pairs = []
    # four million pairs of boxes are compared at a time, which bounds memory
    rows = max(1, (1 << 22) // len(lower))
    for first in range(0, len(lower), rows):
        batch = slice(first, first + rows)
        overlap = ((lower[batch, None] < upper) & (lower < upper[batch, None])).all(axis=2)
        i, j = np.nonzero(overlap)
        pairs.append(np.stack([i + first, j])[:, i + first < j])
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


def _cells_at_points(x: Values, nodes: Ints, cells: Ints) -> Flags:
    """Flags (C,) of the cells that overlap the box about some nodes."""
    if not len(nodes):
        return np.zeros(len(cells), bool)
    lower, upper = x[nodes].min(axis=0), x[nodes].max(axis=0)
    bits = 1 << np.arange(x.shape[1], dtype=np.uint8)
    # A cell all of whose nodes are on one outer side of the box does not overlap it.
    sides = ((x < lower) @ bits, (x > upper) @ bits)
    return np.asarray(sum(np.bitwise_and.reduce(side[cells], axis=1) for side in sides) == 0)


def _balls(x: Values, cells: Ints) -> tuple[Values, Values]:
    """Centres (C, d) of cells, and radii (C,) of balls about them that have all corners, m."""
    corners = x[cells]
    centre = corners.mean(axis=1)
    return centre, np.sqrt(((corners - centre[:, None]) ** 2).sum(axis=2).max(axis=1))


def _candidates(x: Values, nodes: Ints, cells: Ints, max_radius: float) -> tuple[Ints, Ints]:
    """Pairs (node, index in `cells`) in which the node lies in the smallest ball about the cell's centre."""
    centre, radius = _balls(x, cells)
    # larger cells are torn or crushed, and are left out
    usual = np.flatnonzero(radius < max_radius)
    if not len(usual):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    centres = cKDTree(centre[usual])
    pairs = cKDTree(x[nodes]).sparse_distance_matrix(centres, radius[usual].max(), output_type="ndarray")
    cell = usual[pairs["j"]]
    close = pairs["v"] < radius[cell]
    return nodes[pairs["i"][close]], cell[close]


def _min_barycentric(x: Values, node: Ints, cells: Ints) -> Values:
    """(n,) minimum barycentric coordinate of each node in its cell; -1 in a cell without volume."""
    corners = x[cells]
    edges = (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
    real = np.flatnonzero(np.linalg.det(edges) != 0)
    depth = np.full(len(node), -1.0)
    inner = np.linalg.solve(edges[real], (x[node[real]] - corners[real, 0])[:, :, None])[:, :, 0]
    depth[real] = np.minimum(inner.min(axis=1), 1 - inner.sum(axis=1))
    return depth
