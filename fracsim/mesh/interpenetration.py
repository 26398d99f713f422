"""Whether pieces of a body overlap: whether a node of one lies inside a whole cell of another.

A crack runs half an edge from the nodes beside it, so the faces of one that closes, or presses on itself a little, are
not found: what is has gone an edge or so into the other.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]

INSIDE = 0.05  # least barycentric coordinate: bodies that touch are not inside each other
LONG = 4.0  # a cell of so many times the median radius is torn or crushed, and holds nothing
ROWS = 1 << 22  # of a table of boxes that are compared at a time


def find_interpenetration(x: Values, cells: Ints, piece: Ints) -> tuple[int, int] | None:
    """The node that is deepest inside a cell of another piece, and that cell; None where there is none.

    `x`: (N, d) places, m.    `cells`: (C, d + 1) the whole cells.    `piece`: (N,) of each node.
    """
    of_cell = piece[cells[:, 0]]
    nodes = np.argsort(piece, kind="stable")
    names, start, count = np.unique(piece[nodes], return_index=True, return_counts=True)
    if len(names) < 2:
        return None
    lower, upper = np.minimum.reduceat(x[nodes], start), np.maximum.reduceat(x[nodes], start)
    small, large = _meeting(lower, upper, count)
    if not len(small):
        return None
    near = _inside_boxes(x[nodes], start, count, small, lower[large], upper[large])
    holds = np.zeros(piece.max() + 1, bool)
    holds[names[large]] = True
    held = np.flatnonzero(holds[of_cell])
    node, cell = _candidates(x, nodes[near], cells[held])
    other = piece[node] != of_cell[held[cell]]
    node, cell = node[other], held[cell[other]]
    depth = _depth(x, node, cells[cell])
    if not len(depth) or depth.max() <= INSIDE:
        return None
    deepest = np.argmax(depth)
    return int(node[deepest]), int(cell[deepest])


def _meeting(lower: Values, upper: Values, count: Ints) -> tuple[Ints, Ints]:
    """Pairs of pieces whose boxes overlap, that of fewer nodes first."""
    pairs = []
    rows = max(1, ROWS // len(lower))
    for first in range(0, len(lower), rows):
        some = slice(first, first + rows)
        meets = ((lower[some, None] < upper) & (lower < upper[some, None])).all(axis=2)
        i, j = np.nonzero(meets)
        pairs.append(np.stack([i + first, j])[:, i + first < j])
    i, j = np.concatenate(pairs, axis=1)
    fewer = count[i] <= count[j]
    return np.where(fewer, i, j), np.where(fewer, j, i)


def _inside_boxes(x: Values, start: Ints, count: Ints, small: Ints, lower: Values, upper: Values) -> Ints:
    """Numbers of the points x of the pieces `small` that lie in the box of the pair."""
    many = count[small]
    pair = np.repeat(np.arange(len(small)), many)
    point = np.arange(many.sum()) - np.repeat(np.cumsum(many) - many, many) + np.repeat(start[small], many)
    at = x[point]
    return np.unique(point[((at > lower[pair]) & (at < upper[pair])).all(axis=1)])


def _candidates(x: Values, nodes: Ints, cells: Ints) -> tuple[Ints, Ints]:
    """Pairs (node, number of a cell) no farther apart than the cell's corners are from its centre."""
    if not len(cells):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    corners = x[cells]
    centre = corners.mean(axis=1)
    radius = np.sqrt(((corners - centre[:, None]) ** 2).sum(axis=2).max(axis=1))
    usual = np.flatnonzero(radius < LONG * np.median(radius))
    if not len(nodes) or not len(usual):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    found = cKDTree(x[nodes]).sparse_distance_matrix(cKDTree(centre[usual]), radius[usual].max(), output_type="ndarray")
    cell = usual[found["j"]]
    close = found["v"] < radius[cell]
    return nodes[found["i"][close]], cell[close]


def _depth(x: Values, node: Ints, cells: Ints) -> Values:
    """(n,) least barycentric coordinate of each node in its cell; -1 in a flat one."""
    corners = x[cells]
    edges = (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
    real = np.flatnonzero(np.linalg.det(edges) != 0)
    depth = np.full(len(node), -1.0)
    inner = np.linalg.solve(edges[real], (x[node[real]] - corners[real, 0])[:, :, None])[:, :, 0]
    depth[real] = np.minimum(inner.min(axis=1), 1 - inner.sum(axis=1))
    return depth
