"""Bodies as unions of convex parts: what a rigid-body engine collides.

A part is the hull of some cells. The part whose hull has most room to spare is cut in two, across the principal axis
that leaves the least, until what all hulls have to spare is a small share of the body, or there are enough of them.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]

SPARE = 0.02  # of the body's volume: what hulls may have beyond it
PARTS = 32  # of a body, at most
THIN = 0.01  # of its length: no part is flatter, or it would have no hull


@dataclass(frozen=True)
class Hull:
    """Of some cells: the corners (n, 3) of their convex hull, m, and the volume that it has beyond theirs, m^3."""

    corners: Values
    spare: float


@dataclass(frozen=True)
class Cells:
    """Of one body.

    Attributes:
        points: (N, 3) m.    cell, point: (k,) which of the c cells has which of the points, by cells.
        volume: (c,) m^3.
    """

    points: Values
    cell: Ints
    point: Ints
    volume: Values

    @property
    def middles(self) -> Values:
        """(c, 3) mean of the points of each, m."""
        at, count = self.points[self.point], np.bincount(self.cell, minlength=len(self.volume))
        sums = np.stack([np.bincount(self.cell, each, len(self.volume)) for each in at.T], axis=1)
        return np.asarray(sums / count[:, None])

    def hull(self, part: Ints) -> Hull:
        """Of some of the cells."""
        mine = np.zeros(len(self.volume), bool)
        mine[part] = True
        points = self.points[np.unique(self.point[mine[self.cell]])]
        try:
            made = ConvexHull(points)
        except QhullError:  # flat: a part without volume
            return Hull(points, 0.0)
        return Hull(points[made.vertices], max(float(made.volume - self.volume[part].sum()), 0.0))


def convex_parts(body: Cells, most: int = PARTS) -> list[Values]:
    """Corners (n, 3) of the hulls of the parts of a body, at most as many, m."""
    whole, middles = np.arange(len(body.volume)), body.middles
    first = body.hull(whole)
    heap: list[tuple[float, int, Ints, Hull]] = [(-first.spare, 0, whole, first)]
    made = 1
    spare, enough = first.spare, SPARE * float(body.volume.sum())
    while spare > enough and len(heap) < most:
        _, _, part, hull = heap[0]
        halves = _halves(body, middles, part)
        if not halves:
            break
        heapq.heappop(heap)
        spare += sum(half.spare for _, half in halves) - hull.spare
        for cut, half in halves:
            heapq.heappush(heap, (-half.spare, made, cut, half))
            made += 1
    return [thickened(hull.corners) for *_, hull in heap]


def thickened(corners: Values) -> Values:
    """Corners (n, 3), doubled across each principal axis along which they are flatter than THIN of their length."""
    middle = corners.mean(axis=0)
    axes = np.linalg.svd(corners - middle)[2]
    widths = np.ptp((corners - middle) @ axes.T, axis=0)
    for axis in axes[widths < THIN * widths.max()]:
        half = THIN * float(widths.max()) / 2 * axis
        corners = np.concatenate([corners - half, corners + half])
    return corners


def _halves(body: Cells, middles: Values, part: Ints) -> list[tuple[Ints, Hull]]:
    """The best of the three ways of cutting a part through its middle; none where it is a single cell."""
    weight = body.volume[part]
    arm = middles[part] - np.average(middles[part], axis=0, weights=weight)
    _, axes = np.linalg.eigh((weight[:, None] * arm).T @ arm)
    sides = [side for side in (arm @ axes > 0).T if side.any() and not side.all()]
    ways = [[(half, body.hull(half)) for half in (part[side], part[~side])] for side in sides]
    return min(ways, key=lambda way: sum(hull.spare for _, hull in way), default=[])
