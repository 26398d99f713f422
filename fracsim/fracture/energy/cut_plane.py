"""How cracks cut cells: a line a triangle, a plane a tetrahedron, from where they came in, or through the centre.

Equations: docs/theory.md#cell-cutting.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...mesh.simplices import local_edges
from ..initial_cracks import CLOSEST
from .branching import ANGLE, rotated
from .crack_front import partitions

Flags = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Cuts:
    """Edges that are cut.

    Attributes:
        row: (n,) the cell's place in what was given.    edge: (n,) its local edge.
        share: (n,) where, from the edge's first local node (0) to its second (1).
    """

    row: Ints
    edge: Ints
    share: Values


def line_cuts(corners: Values, through: Values, normal: Values) -> tuple[Flags, Values]:
    """(n, k) whether lines (planes) cross the local edges of cells, and (n, k) the share of each edge nearest to them.

    `corners`: (n, d + 1, d) m. `through`, `normal`: (n, d). An edge that is not crossed is met at the end that is
    nearer. Shares are held within 0.02 to 0.98.
    """
    first, second = local_edges(corners.shape[2]).T
    height = np.einsum("nci,ni->nc", corners - through[:, None], normal)
    a, b = height[:, first], height[:, second]
    crossed = (a >= 0) != (b >= 0)
    share = np.where(crossed, a / np.where(crossed, a - b, 1.0), np.abs(a) > np.abs(b))
    return crossed, np.clip(share, CLOSEST, 1 - CLOSEST)


def points_at(corners: Values, share: Values) -> Values:
    """(n, 3, 2) the points at shares (n, 3) of the local edges of triangles (n, 3, 2)."""
    first, second = local_edges(2).T
    return np.asarray(corners[:, first] + share[..., None] * (corners[:, second] - corners[:, first]))


def leave(corners: Values, entry: Ints, point: Values, normal: Values, ahead: Values, torn: Flags) -> Cuts:
    """Where cracks that came in at local edges `entry` (n,) and points (n, 2) leave their cells: one edge each.

    Along the line of the normal (n, 2), unless that goes back, against `ahead` (n, 2), or into a split cell, `torn`
    (n, 3), where the other way out does not: then by the other edge, as near to the line as it comes. A crack that
    turns so far that it would leave by where it came in goes by the end that lies most ahead.
    """
    rows = np.arange(len(entry))[:, None]
    crossed, share = line_cuts(corners, point, normal)
    ways = np.stack([(entry + 1) % 3, (entry + 2) % 3], axis=1)
    along = _along(points_at(corners, share)[rows, ways], point, ahead)
    ends = np.stack([np.full_like(share, each) for each in (CLOSEST, 1 - CLOSEST)])
    far = np.stack([_along(points_at(corners, each)[rows, ways], point, ahead) for each in ends])
    turned = (along < 0) & (far.max(axis=0) > along)
    share[rows, ways] = np.where(turned, np.where(far[1] > far[0], 1 - CLOSEST, CLOSEST), share[rows, ways])
    along = np.where(turned, far.max(axis=0), along)
    bad = (along < 0) + turned + 0.5 * torn[rows, ways]
    first = np.argmax(crossed[rows, ways], axis=1)[:, None]
    worse = np.take_along_axis(bad, first, 1) - np.take_along_axis(bad, 1 - first, 1)
    less = np.take_along_axis(along, first, 1) < np.take_along_axis(along, 1 - first, 1)
    aside = np.take_along_axis(turned, first, 1) & less & (worse == 0)
    edge = np.take_along_axis(ways, np.where((worse > 0) | aside, 1 - first, first), 1)[:, 0]
    return Cuts(rows[:, 0], edge, share[rows[:, 0], edge])


def fork(
    corners: Values, entry: Ints, point: Values, normal: Values, ahead: Values, torn: Flags, branches: Flags
) -> Cuts:
    """Where cracks leave their cells: as `leave` has it, and those that branch (n,) by both other edges where lines at
    ANGLE to `ahead` do; in a cell where they do not they go on as one, to branch in the next."""
    one = leave(corners, entry, point, normal, ahead, torn)
    rows = np.flatnonzero(branches)
    if not len(rows):
        return one
    ways = []
    for angle in (ANGLE, -ANGLE):
        way = rotated(ahead[rows], angle)
        ways.append(leave(corners[rows], entry[rows], point[rows], rotated(way, np.pi / 2), way, torn[rows]))
    two = ways[0].edge != ways[1].edge
    single = np.ones(len(entry), bool)
    single[rows[two]] = False
    parts = [Cuts(one.row[single], one.edge[single], one.share[single])]
    parts += [Cuts(rows[two], each.edge[two], each.share[two]) for each in ways]
    return Cuts(*(np.concatenate([getattr(each, name) for each in parts]) for name in ("row", "edge", "share")))


def _along(exits: Values, point: Values, ahead: Values) -> Values:
    """(n, ways) cosines, times |ahead|, of `ahead` (n, 2) and the ways from points (n, 2) to (n, ways, 2)."""
    apart = exits - point[:, None]
    length = np.linalg.norm(apart, axis=2)
    return np.divide(np.einsum("nwi,ni->nw", apart, ahead), length, out=np.zeros(length.shape), where=length > 0)


def cleave(corners: Values, broken: Flags, point: Values, normal: Values) -> Cuts:
    """The edges that planes through points (n, 3) cut of tetrahedra whose edges `broken` (n, 6) are cut already.

    The corners are parted as the plane does it, or else so that all broken edges are cut and corners are least far on
    the wrong side.
    """
    sides, cut = partitions()
    height = np.einsum("nci,ni->nc", corners - point[:, None], normal)
    wrong = [np.where(sides, np.maximum(sign * height, 0)[:, None], np.maximum(-sign * height, 0)[:, None]).sum(2)
             for sign in (1, -1)]  # fmt: skip
    left = (broken[:, None] & ~cut).sum(axis=2)
    size = np.abs(height).sum(axis=1, keepdims=True)
    chosen = np.argmin(np.minimum(*wrong) + 10 * left * size, axis=1)
    _, share = line_cuts(corners, point, normal)
    row, edge = np.nonzero(cut[chosen] & ~broken)
    return Cuts(row, edge, share[row, edge])


def through_centre(corners: Values, normal: Values) -> Cuts:
    """The edges of each cell that a line (a plane) through its centre crosses."""
    crossed, share = line_cuts(corners, corners.mean(axis=1), normal)
    row, edge = np.nonzero(crossed)
    return Cuts(row, edge, share[row, edge])
