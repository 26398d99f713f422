"""Unions of convex parts as the shapes that collide.

A solid body is divided by planes. The part whose hull has the largest excess volume is cut in two through its centre,
across the principal axis that leaves the least. This ends when the excess of all hulls is a small share of the body,
when the hulls are as close to it as cracks are smooth, or at the largest number of parts. Parts of one body do not
overlap.

Fragments of shells are unions of the hulls of clusters of surface triangles. A cluster is cut in two through its
centre, across its longest axis, while the distance of its triangles from a plane (root mean square, beyond the half
thickness of two flat faces) is above

    s > max(roughness h, shell_roughness L),

with the mean edge h of the mesh and the length L of the fragment. A spherical cap of height H has s = 0.29 H.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError

from ..forms.kinematics import SYMMETRIC_COMPONENTS
from ..mesh.split_surface.polyhedron_moments import PolyhedronMoments, cone_volumes, moments
from ..meshes.topology import components

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class DecompositionSettings:
    """Accuracy of the convex decomposition.

    Attributes:
        excess_volume: accepted excess volume of all hulls, as a share of the volume of the body.
        roughness: mean edges of the mesh; accepted mean distance of the hulls from the body.
        shell_roughness: lengths of the fragment; likewise for shells.
        max_parts: largest number of parts of a body.
        many_points: points above which only the longest axis is tried.
        axis_ratio: axes shorter than this share of the longest one are not cut across.
        min_thickness: least thickness of a part, as a share of its length; a thinner one would have no hull.
        directions: directions within the plane of a cluster along which extreme points are kept.
        tilts: slopes out of that plane, in scaled axes.
    """

    excess_volume: float = 0.02
    roughness: float = 0.1
    shell_roughness: float = 0.03
    max_parts: int = 32
    many_points: int = 1000
    axis_ratio: float = 0.7
    min_thickness: float = 0.01
    directions: int = 24
    tilts: tuple[float, ...] = (-0.7, 0.0, 0.7)


SETTINGS = DecompositionSettings()


@dataclass(frozen=True)
class ConvexHullPart:
    """Convex hull of a part of a body.

    Attributes:
        corners: (n, 3) m.
        area: m^2.
        excess_volume: volume of the hull beyond that of the part, m^3.
    """

    corners: Values
    area: float
    excess_volume: float


@dataclass(frozen=True)
class Polyhedron:
    """Solid within a closed surface.

    Attributes:
        points: (n, 3) m; all of them are corners of triangles.
        triangles: (m, 3) corners, with normals outwards.
    """

    points: Values
    triangles: Ints

    @classmethod
    def from_triangles(cls, points: Values, triangles: Ints) -> Polyhedron:
        """Return the solid within triangles (m, 3) between some of the points (n, 3)."""
        used, corners = np.unique(triangles, return_inverse=True)
        return cls(points[used], corners.reshape(-1, 3))

    @property
    def content_key(self) -> int:
        """Hash of all numbers, equal for equal solids within a process."""
        return hash((self.points.tobytes(), self.triangles.tobytes()))

    @property
    def without_cavities(self) -> Polyhedron:
        """The solid with its enclosed cavities filled."""
        # nothing can touch the inner surface of a cavity
        count, part = components(self.triangles[:, [0, 1, 1, 2]].reshape(-1, 2), len(self.points))
        if count == 1:
            return self
        surface = part[self.triangles[:, 0]]
        volume = np.bincount(surface, cone_volumes((self.points - self.points[0])[self.triangles]), count)
        # the surface of a cavity encloses a negative volume
        return Polyhedron.from_triangles(self.points, self.triangles[volume[surface] > 0])

    @property
    def moments(self) -> PolyhedronMoments:
        """Volume, centre and second moments."""
        return moments(self.points, self.triangles, np.zeros(len(self.triangles), np.int64), 1)

    @property
    def convex_hull(self) -> ConvexHullPart:
        """Convex hull of the points; of zero area if they lie in a plane."""
        try:
            hull = ConvexHull(self.points)
        except (QhullError, ValueError):
            return ConvexHullPart(self.points, 0.0, 0.0)
        volume = float(cone_volumes((self.points - self.points[0])[self.triangles]).sum())
        return ConvexHullPart(self.points[hull.vertices], float(hull.area), max(float(hull.volume) - volume, 0.0))

    def cut_by_plane(self, point: Values, normal: Values) -> tuple[Polyhedron, Polyhedron]:
        """Return the parts above and below the plane through a point (3,) with a normal (3,)."""
        # Each part is closed by a cone over the section from its centre. Where the section is not convex, triangles of
        # the cone overlap with opposite signs, so that volumes are exact.
        above = (self.points - point) @ normal >= 0
        count = above[self.triangles].sum(axis=1)
        is_cut = (count == 1) | (count == 2)
        cut = self.triangles[is_cut]
        # rotate the corners such that a is alone on its side
        alone = above[cut] == (count[is_cut] == 1)[:, None]
        order = (alone.argmax(axis=1)[:, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(cut, order, axis=1).T
        new = np.concatenate([self._intersections(a, b, point, normal), self._intersections(a, c, point, normal)])
        first = len(self.points)
        p, q = first + np.arange(2 * len(a)).reshape(2, -1)
        apex = np.full(len(a), first + len(new))
        centre = new.mean(axis=0, keepdims=True) if len(new) else new
        points = np.concatenate([self.points, new, centre])
        with_a = [_triangles(a, p, q), _triangles(q, p, apex)]
        without_a = [_triangles(p, b, c), _triangles(p, c, q), _triangles(p, q, apex)]
        a_above = above[a]
        parts = []
        for side, uncut in ((True, 3), (False, 0)):
            cut_triangles = [rows[a_above == side] for rows in with_a] + [rows[a_above != side] for rows in without_a]
            triangles = np.concatenate([self.triangles[count == uncut], *cut_triangles])
            parts.append(Polyhedron.from_triangles(points, triangles))
        return parts[0], parts[1]

    def _intersections(self, a: Ints, b: Ints, point: Values, normal: Values) -> Values:
        """Return where edges from a (k,) to b (k,) intersect the plane (k, 3), the same for both directions."""
        low, high = np.minimum(a, b), np.maximum(a, b)
        start, end = ((self.points[ends] - point) @ normal for ends in (low, high))
        share = (start / (start - end))[:, None]
        return np.asarray(self.points[low] + share * (self.points[high] - self.points[low]))


def _triangles(*corners: Ints) -> Ints:
    return np.stack(corners, axis=1)


# --- solid bodies ---


def convex_parts(body: Polyhedron, edge: float = 0.0) -> list[Values]:
    """Return the corners (n, 3), m, of the hulls of the parts of a body; `edge`: mean edge of the mesh, m."""
    hull = body.convex_hull
    heap: list[tuple[float, int, Polyhedron, ConvexHullPart]] = [(-hull.excess_volume, 0, body, hull)]
    number, excess = 1, hull.excess_volume
    accepted = max(SETTINGS.excess_volume * float(body.moments.volume[0]), SETTINGS.roughness * edge * hull.area)
    while excess > accepted and len(heap) < SETTINGS.max_parts:
        *_, part, part_hull = heap[0]
        halves = _best_halves(part)
        if not halves:
            break
        heapq.heappop(heap)
        excess += sum(half_hull.excess_volume for _, half_hull in halves) - part_hull.excess_volume
        for half, half_hull in halves:
            heapq.heappush(heap, (-half_hull.excess_volume, number, half, half_hull))
            number += 1
    return [thicken_flat_hull(part_hull.corners) for *_, part_hull in heap]


def hull_corners(points: Values) -> Values:
    """Return those of points (n, 3) that are corners of their hull: no other point touches a plane first."""
    try:
        return np.asarray(points[np.sort(ConvexHull(points).vertices)])
    except (QhullError, ValueError):
        return points


def _best_halves(part: Polyhedron) -> list[tuple[Polyhedron, ConvexHullPart]]:
    """Return the two halves with the least excess volume, cut through the centre; none of a part without volume."""
    part_moments = part.moments
    if not part_moments.volume[0] > 0:
        return []
    spread, axes = np.linalg.eigh(part_moments.second[0])
    axes = axes.T[spread > SETTINGS.axis_ratio**2 * spread[-1]][::-1]
    if len(part.points) > SETTINGS.many_points:
        axes = axes[:1]
    cuts = [part.cut_by_plane(part_moments.centre[0], axis) for axis in axes]
    candidates = [
        [(half, half.convex_hull) for half in halves] for halves in cuts if all(len(half.points) > 3 for half in halves)
    ]
    return min(candidates, key=lambda halves: sum(hull.excess_volume for _, hull in halves), default=[])


def thicken_flat_hull(corners: Values) -> Values:
    """Return corners (n, 3), doubled across principal axes along which they are thinner than the least thickness."""
    centre = corners.mean(axis=0)
    axes = np.linalg.svd(corners - centre)[2]
    widths = np.ptp((corners - centre) @ axes.T, axis=0)
    for axis in axes[widths < SETTINGS.min_thickness * widths.max()]:
        half = SETTINGS.min_thickness * float(widths.max()) / 2 * axis
        corners = np.concatenate([corners - half, corners + half])
    return corners


# --- shells ---


def shell_convex_parts(
    points: Values, triangles: Ints, fragment: Ints, count: int, thickness: float, edge: float
) -> list[list[Values]]:
    """Return the corners (n, 3), m, of the convex parts of each of `count` fragments of a shell.

    Args:
        points: (k, 3) of the closed surface of all fragments, m.
        triangles: (m, 3) corners.
        fragment: (m,) number of the fragment of each triangle.
        count: number of fragments.
        thickness: of the shell, m.
        edge: mean edge of the mesh, m.
    """
    cluster, owner = cluster_triangles(points[triangles], fragment, count, thickness, edge)
    # every point once for each of its clusters
    code = np.unique((cluster[:, None] * len(points) + triangles).ravel())
    point_cluster, x = code // len(points), points[code % len(points)]
    is_extreme = extreme_points(x, point_cluster)
    point_cluster, x = point_cluster[is_extreme], x[is_extreme]
    corners = np.split(x, np.searchsorted(point_cluster, np.arange(1, len(owner))))
    parts: list[list[Values]] = [[] for _ in range(count)]
    for number, hull in zip(owner, corners, strict=True):
        parts[number].append(thicken_flat_hull(hull))
    return parts


def cluster_triangles(corners: Values, fragment: Ints, count: int, thickness: float, edge: float) -> tuple[Ints, Ints]:
    """Return the cluster (m,) of each triangle and the fragment (c,) of each cluster.

    `corners`: (m, 3, 3) m; the other arguments are those of `shell_convex_parts`.
    """
    cluster, owner, divisible = fragment.copy(), np.arange(count), np.ones(count, bool)
    lengths = _fragment_lengths(corners, fragment, count)
    accepted = np.maximum(SETTINGS.roughness * edge, SETTINGS.shell_roughness * lengths)
    sums = _triangle_moments(corners, fragment, count)
    while divisible.any() and 2 * np.bincount(owner).max() <= SETTINGS.max_parts:
        rows = np.flatnonzero(divisible[cluster])
        number, group = np.unique(cluster[rows], return_inverse=True)
        centre, spread = _centres_and_spreads(sums[:, rows], group, len(number))
        squares, axes = np.linalg.eigh(spread)
        distance = np.sqrt(np.maximum(squares[:, 0] - (thickness / 2) ** 2, 0.0))
        is_bent = distance > accepted[owner[number]]
        arm = sums[1:4, rows].T / sums[0, rows, None] - centre[group]
        moves = (np.einsum("ni,ni->n", arm, axes[group, :, 2]) > 0) & is_bent[group]
        # a half is empty, and no cluster, where all triangles have the same centre
        half_number = np.full(len(number), -1)
        new = np.unique(group[moves])
        half_number[new] = len(owner) + np.arange(len(new))
        cluster[rows[moves]] = half_number[group[moves]]
        divisible = np.zeros(len(owner) + len(new), bool)
        divisible[number[new]] = divisible[len(owner) :] = True
        owner = np.concatenate([owner, owner[number[new]]])
    return cluster, owner


def _fragment_lengths(corners: Values, fragment: Ints, count: int) -> Values:
    """Return the diagonals (count,), m, of the bounding boxes of fragments."""
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, fragment, corners.min(axis=1))
    np.maximum.at(high, fragment, corners.max(axis=1))
    return np.asarray(np.linalg.norm(high - low, axis=1))


def _triangle_moments(corners: Values, fragment: Ints, count: int) -> Values:
    """Return areas, first and second moments (10, m) of triangles (m, 3, 3) about the middle of their fragment.

    int x x^T dA = A (sum_k x_k x_k^T + s s^T) / 12 with the sum s of the corners.
    """
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    area = np.maximum(area, 1e-30)
    sizes = np.bincount(fragment, minlength=count)
    middle = np.stack([np.bincount(fragment, x, count) for x in corners.mean(axis=1).T], axis=1) / sizes[:, None]
    x = corners - middle[fragment, None]
    s = x.sum(axis=1)
    second = [
        area * ((x[:, :, i] * x[:, :, j]).sum(axis=1) + s[:, i] * s[:, j]) / 12 for i, j in SYMMETRIC_COMPONENTS[3]
    ]
    return np.stack([area, *(area * s.T / 3), *second])


def _centres_and_spreads(sums: Values, group: Ints, count: int) -> tuple[Values, Values]:
    """Return centres (count, 3) and mean squares about them (count, 3, 3) of groups (m,) of triangles.

    `sums`: (10, m) moments of the triangles.
    """
    area, *higher = (np.bincount(group, values, count) for values in sums)
    centre, second = np.stack(higher[:3], axis=1) / area[:, None], np.empty((count, 3, 3))
    for (i, j), values in zip(SYMMETRIC_COMPONENTS[3], higher[3:], strict=True):
        second[:, i, j] = second[:, j, i] = values / area - centre[:, i] * centre[:, j]
    return centre, second


def extreme_points(points: Values, group: Ints) -> Flags:
    """Return (n,) flags of points (n, 3) that are the farthest of their group (n,) along one of some directions.

    Groups are ascending. Directions are spread around the flattest plane of a group, in it and tilted out of it, in
    axes that are scaled to the same length.
    """
    start = np.flatnonzero(np.diff(group, prepend=-1))
    number = np.cumsum(np.diff(group, prepend=-1) > 0) - 1
    sizes = np.diff(np.append(start, len(group)))[:, None]
    arm = points - (np.add.reduceat(points, start) / sizes)[number]
    square = np.einsum("ni,nj->nij", arm, arm).reshape(-1, 9)
    length2, axes = np.linalg.eigh(np.add.reduceat(square, start).reshape(-1, 3, 3) / sizes[:, None])
    axes = axes / np.sqrt(np.maximum(length2, 1e-8 * length2[:, -1:]))[:, None]
    height, *in_plane = np.einsum("ni,nij->jn", arm, axes[number])
    result = np.zeros(len(points), bool)
    for angle in 2 * np.pi * np.arange(SETTINGS.directions) / SETTINGS.directions:
        within = np.cos(angle) * in_plane[0] + np.sin(angle) * in_plane[1]
        for tilt in SETTINGS.tilts:
            along = within + tilt * height
            result |= along == np.maximum.reduceat(along, start)[number]
    return result
