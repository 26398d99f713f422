"""Cuts of cells by cracks: a line through a triangle, a plane through a tetrahedron.

A cut passes through the point at which the crack came in, or through the centroid where a crack starts.
Equations: docs/theory.md#cell-cutting.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...mesh.simplices import local_edges
from ..initial_cracks import MIN_CUT_SHARE
from .branching import rotate
from .cut_cells import corner_partitions
from .tip_parameters import TIP

Flags = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class EdgeCuts:
    """Edges that cracks cut.

    Attributes:
        row: (n,) number of the cell in the arrays that were passed.
        edge: (n,) its local edge.
        share: (n,) position of the cut, 0 at the edge's first local node to 1 at its second.
    """

    row: Ints
    edge: Ints
    share: Values

    def points(self, corners: Values) -> Values:
        """Return the points (n, 2) of the cuts, m, from the corners (cells, 3, 2) of the triangles that were passed."""
        first, second = local_edges(2)[self.edge].T
        a, b = corners[self.row, first], corners[self.row, second]
        return np.asarray(a + self.share[:, None] * (b - a))


def plane_crossings(corners: Values, through: Values, normal: Values) -> tuple[Flags, Values]:
    """Return whether lines (planes) cross local edges of cells (n, k), and the nearest position on each edge (n, k).

    An edge that is not crossed has the position of its nearer end. Positions are within MIN_CUT_SHARE of the ends.

    Args:
        corners: (n, d + 1, d) corners of cells, m.
        through: (n, d) points of the lines, m.
        normal: (n, d) their normals.
    """
    first, second = local_edges(corners.shape[2]).T
    # Signed distances of the corners from the line or plane.
    height = np.einsum("nci,ni->nc", corners - through[:, None], normal)
    a, b = height[:, first], height[:, second]
    crossed = (a >= 0) != (b >= 0)
    share = np.where(crossed, a / np.where(crossed, a - b, 1.0), np.abs(a) > np.abs(b))
    return crossed, np.clip(share, MIN_CUT_SHARE, 1 - MIN_CUT_SHARE)


def points_on_edges(corners: Values, share: Values) -> Values:
    """Return the points (n, 3, 2) at positions (n, 3) of the local edges of triangles (n, 3, 2)."""
    first, second = local_edges(2).T
    return np.asarray(corners[:, first] + share[..., None] * (corners[:, second] - corners[:, first]))


def exit_cuts(
    corners: Values, entry: Ints, point: Values, normal: Values, ahead: Values, split_beyond: Flags
) -> EdgeCuts:
    """Return the edge by which each crack leaves its triangle.

    It leaves along the line of its normal. If that leads back, against `ahead`, or into a split cell, and the other
    exit does not, the crack takes the other edge, at the point nearest to the line. A crack that turns so far that it
    would leave by its entry passes the corner that lies farthest ahead.

    Args:
        corners: (n, 3, 2) corners of triangles, m.
        entry: (n,) local edges by which the cracks came in.
        point: (n, 2) points at which they came in, m.
        normal: (n, 2) normals of the cracks.
        ahead: (n, 2) directions of the cracks, of any length.
        split_beyond: (n, 3) local edges with a split cell on the other side.
    """
    rows = np.arange(len(entry))[:, None]
    crossed, share = plane_crossings(corners, point, normal)
    # The two other edges of the triangle.
    exits = np.stack([(entry + 1) % 3, (entry + 2) % 3], axis=1)
    progress = _progress(points_on_edges(corners, share)[rows, exits], point, ahead)
    end_shares = np.stack([np.full_like(share, end) for end in (MIN_CUT_SHARE, 1 - MIN_CUT_SHARE)])
    end_progress = np.stack([_progress(points_on_edges(corners, end)[rows, exits], point, ahead) for end in end_shares])
    # The point on the line lies behind: the end of the edge that is farther ahead is better.
    turned = (progress < 0) & (end_progress.max(axis=0) > progress)
    farther_end = np.where(end_progress[1] > end_progress[0], 1 - MIN_CUT_SHARE, MIN_CUT_SHARE)
    share[rows, exits] = np.where(turned, farther_end, share[rows, exits])
    progress = np.where(turned, end_progress.max(axis=0), progress)
    # Penalties of the two exits: going back, past a corner, into a split cell.
    penalty = (progress < 0) + turned + 0.5 * split_beyond[rows, exits]
    first = np.argmax(crossed[rows, exits], axis=1)[:, None]
    excess = np.take_along_axis(penalty, first, 1) - np.take_along_axis(penalty, 1 - first, 1)
    is_less_ahead = np.take_along_axis(progress, first, 1) < np.take_along_axis(progress, 1 - first, 1)
    passes_corner = np.take_along_axis(turned, first, 1) & is_less_ahead & (excess == 0)
    chosen = np.where((excess > 0) | passes_corner, 1 - first, first)
    edge = np.take_along_axis(exits, chosen, 1)[:, 0]
    return EdgeCuts(rows[:, 0], edge, share[rows[:, 0], edge])


def branching_cuts(
    corners: Values, entry: Ints, point: Values, normal: Values, ahead: Values, split_beyond: Flags, branches: Flags
) -> EdgeCuts:
    """Return the edges by which cracks leave their triangles, two of them for those that branch (n,).

    Branches are at the branching angle to `ahead`. In a triangle that both would leave by one edge the crack stays
    single, and branches in the next. The other arguments are those of `exit_cuts`.
    """
    single_cuts = exit_cuts(corners, entry, point, normal, ahead, split_beyond)
    rows = np.flatnonzero(branches)
    if not len(rows):
        return single_cuts
    branch_cuts = []
    for angle in (TIP.branching_angle, -TIP.branching_angle):
        direction = rotate(ahead[rows], angle)
        across = rotate(direction, np.pi / 2)
        branch_cuts.append(exit_cuts(corners[rows], entry[rows], point[rows], across, direction, split_beyond[rows]))
    # Branches that leave by one edge would coincide.
    two = branch_cuts[0].edge != branch_cuts[1].edge
    is_single = np.ones(len(entry), bool)
    is_single[rows[two]] = False
    parts = [EdgeCuts(single_cuts.row[is_single], single_cuts.edge[is_single], single_cuts.share[is_single])]
    parts += [EdgeCuts(rows[two], cuts.edge[two], cuts.share[two]) for cuts in branch_cuts]
    return EdgeCuts(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("row", "edge", "share")))


def _progress(exits: Values, point: Values, ahead: Values) -> Values:
    """Return |ahead| times the cosine (n, k) of `ahead` (n, 2) and the paths from points (n, 2) to exits (n, k, 2)."""
    apart = exits - point[:, None]
    length = np.linalg.norm(apart, axis=2)
    return np.divide(np.einsum("nwi,ni->nw", apart, ahead), length, out=np.zeros(length.shape), where=length > 0)


def plane_cuts(corners: Values, broken: Flags, point: Values, normal: Values) -> EdgeCuts:
    """Return the edges that planes cut of tetrahedra with some edges broken already.

    The corners are parted as the plane parts them, or else so that all broken edges are cut, with the least total
    distance of corners on the wrong side.

    Args:
        corners: (n, 4, 3) corners, m.
        broken: (n, 6) edges that are broken already.
        point: (n, 3) points of the planes, m.
        normal: (n, 3) normals of the planes.
    """
    sides, cut = corner_partitions()
    height = np.einsum("nci,ni->nc", corners - point[:, None], normal)
    # Total distance of corners on the wrong side, for both orientations of the plane.
    misfit = [
        np.where(sides, np.maximum(sign * height, 0)[:, None], np.maximum(-sign * height, 0)[:, None]).sum(2)
        for sign in (1, -1)
    ]
    missed_edges = (broken[:, None] & ~cut).sum(axis=2)
    size = np.abs(height).sum(axis=1, keepdims=True)
    # Ten times the size of the cell: a partition that misses a broken edge comes after all others.
    chosen = np.argmin(np.minimum(*misfit) + 10 * missed_edges * size, axis=1)
    _, share = plane_crossings(corners, point, normal)
    row, edge = np.nonzero(cut[chosen] & ~broken)
    return EdgeCuts(row, edge, share[row, edge])


def centroid_cuts(corners: Values, normal: Values) -> EdgeCuts:
    """Return the edges that lines (planes) through the centroids of cells cross."""
    crossed, share = plane_crossings(corners, corners.mean(axis=1), normal)
    row, edge = np.nonzero(crossed)
    return EdgeCuts(row, edge, share[row, edge])
