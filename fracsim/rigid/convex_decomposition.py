"""Bodies as unions of convex parts: what a rigid-body engine collides.

A part is the hull of what lies between planes. The part whose hull has most room to spare is cut in two through its
middle, across the principal axis that leaves the least, until what all hulls have to spare is a small share of the
body, or they lie nearer to it than cracks are smooth, a share of the mesh's edges, or there are enough of them. Parts
of one body do not lie in one another.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError

from ..mesh.split_surface.polyhedron_moments import PolyhedronMoments, cones, moments
from ..meshes.components import components

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]

SPARE = 0.02  # of the body's volume: what hulls may have beyond it
ROUGH = 0.1  # of the mean edge of the mesh: how far off they may be, in the mean
PARTS = 32  # of a body, at most
MANY = 1000  # points: what has more is cut across its longest axis, without a comparison
LONG = 0.7  # of its greatest length (as its second moments go): it is not cut across what is shorter
THIN = 0.01  # of its length: no part is flatter, or it would have no hull


@dataclass(frozen=True)
class Hull:
    """The corners (n, 3) of a convex hull, m, its area, m^2, and the volume that it has beyond what it is of, m^3."""

    corners: Values
    area: float
    spare: float


@dataclass(frozen=True)
class Solid:
    """What a closed surface encloses.

    Attributes:
        points: (n, 3) m, all of them corners of triangles.    triangles: (m, 3), their normals outwards.
    """

    points: Values
    triangles: Ints

    @classmethod
    def of(cls, points: Values, triangles: Ints) -> Solid:
        """Of triangles (m, 3) between some of the points."""
        used, corners = np.unique(triangles, return_inverse=True)
        return cls(points[used], corners.reshape(-1, 3))

    @property
    def key(self) -> int:
        """The same of what is the same to the last digit, within a process."""
        return hash((self.points.tobytes(), self.triangles.tobytes()))

    @property
    def filled(self) -> Solid:
        """Without its cavities: what is closed up within meets nothing."""
        count, part = components(self.triangles[:, [0, 1, 1, 2]].reshape(-1, 2), len(self.points))
        if count == 1:
            return self
        of = part[self.triangles[:, 0]]
        volume = np.bincount(of, cones((self.points - self.points[0])[self.triangles]), count)
        return Solid.of(self.points, self.triangles[volume[of] > 0])

    @property
    def moments(self) -> PolyhedronMoments:
        """Of volume."""
        return moments(self.points, self.triangles, np.zeros(len(self.triangles), np.int64), 1)

    @property
    def hull(self) -> Hull:
        """Of its points."""
        try:
            made = ConvexHull(self.points)
        except (QhullError, ValueError):  # flat, or hardly any points: a part without volume
            return Hull(self.points, 0.0, 0.0)
        volume = float(cones((self.points - self.points[0])[self.triangles]).sum())
        return Hull(self.points[made.vertices], float(made.area), max(float(made.volume) - volume, 0.0))

    def halves(self, at: Values, normal: Values) -> tuple[Solid, Solid]:
        """Above and below the plane through a point (3,) with a normal (3,).

        Each is closed by a cone over the section from its middle: where the section is not convex, triangles of that
        cone overlap with opposite signs, and volumes are exact even so.
        """
        above = (self.points - at) @ normal >= 0
        count = above[self.triangles].sum(axis=1)
        torn = self.triangles[(count == 1) | (count == 2)]
        lone = above[torn] == (count[(count == 1) | (count == 2)] == 1)[:, None]
        turned = (lone.argmax(axis=1)[:, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(torn, turned, axis=1).T  # a alone on its side
        new = np.concatenate([self._crossing(a, b, at, normal), self._crossing(a, c, at, normal)])
        first = len(self.points)
        p, q = first + np.arange(2 * len(a)).reshape(2, -1)
        apex = np.full(len(a), first + len(new))
        points = np.concatenate([self.points, new, new.mean(axis=0, keepdims=True) if len(new) else new])
        alone = [_rows(a, p, q), _rows(q, p, apex)]
        others = [_rows(p, b, c), _rows(p, c, q), _rows(p, q, apex)]
        up = above[a]
        parts = []
        for side, whole in ((True, 3), (False, 0)):
            kept = [rows[up == side] for rows in alone] + [rows[up != side] for rows in others]
            parts.append(Solid.of(points, np.concatenate([self.triangles[count == whole], *kept])))
        return parts[0], parts[1]

    def _crossing(self, a: Ints, b: Ints, at: Values, normal: Values) -> Values:
        """(k, 3) where edges meet the plane, the same from either end."""
        low, high = np.minimum(a, b), np.maximum(a, b)
        start, end = ((self.points[each] - at) @ normal for each in (low, high))
        share = (start / (start - end))[:, None]
        return np.asarray(self.points[low] + share * (self.points[high] - self.points[low]))


def _rows(*corners: Ints) -> Ints:
    return np.stack(corners, axis=1)


def convex_parts(body: Solid, edge: float = 0.0, most: int = PARTS) -> list[Values]:
    """Corners (n, 3) of the hulls of the parts of a body, at most as many, m; `edge`: the mean one of the mesh, m."""
    whole = body.hull
    heap: list[tuple[float, int, Solid, Hull]] = [(-whole.spare, 0, body, whole)]
    made, spare = 1, whole.spare
    enough = max(SPARE * float(body.moments.volume[0]), ROUGH * edge * whole.area)
    while spare > enough and len(heap) < most:
        *_, part, hull = heap[0]
        halves = _halved(part)
        if not halves:
            break
        heapq.heappop(heap)
        spare += sum(half.spare for _, half in halves) - hull.spare
        for cut, half in halves:
            heapq.heappush(heap, (-half.spare, made, cut, half))
            made += 1
    return [thickened(hull.corners) for *_, hull in heap]


def outermost(points: Values) -> Values:
    """(k, 3) those of points (n, 3) that are corners of their hull: no other is the first to touch a plane."""
    try:
        return np.asarray(points[np.sort(ConvexHull(points).vertices)])
    except (QhullError, ValueError):
        return points


def _halved(part: Solid) -> list[tuple[Solid, Hull]]:
    """The best way of cutting it through its middle, across a longer axis; none where it has no volume to cut."""
    of = part.moments
    if not of.volume[0] > 0:
        return []
    spread, axes = np.linalg.eigh(of.second[0])
    axes = axes.T[spread > LONG**2 * spread[-1]][::-1]
    ways = [part.halves(of.centre[0], axis) for axis in (axes[:1] if len(part.points) > MANY else axes)]
    made = [[(half, half.hull) for half in way] for way in ways if all(len(half.points) > 3 for half in way)]
    return min(made, key=lambda way: sum(half.spare for _, half in way), default=[])


def thickened(corners: Values) -> Values:
    """Corners (n, 3), doubled across each principal axis along which they are flatter than THIN of their length."""
    middle = corners.mean(axis=0)
    axes = np.linalg.svd(corners - middle)[2]
    widths = np.ptp((corners - middle) @ axes.T, axis=0)
    for axis in axes[widths < THIN * widths.max()]:
        half = THIN * float(widths.max()) / 2 * axis
        corners = np.concatenate([corners - half, corners + half])
    return corners
