"""Planar initial cracks, and which points of their planes lie on them. DOLFINx is not imported here."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..errors import InputError

Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class CrackPlane:
    """A planar crack.

    Attributes:
        name: name of the crack in messages.
        point, normal: (d,) a point (m) and the unit normal of the plane (2D: line).
        corners: (k, d) of the segment (2D: k = 2) or polygon (3D: k > 2), m; None: the crack covers the whole plane.
    """

    name: str
    point: Values
    normal: Values
    corners: Values | None = None

    def intersects_box(self, lower: Values, upper: Values) -> bool:
        """Whether no face of a bounding box, nor the plane of the crack, separates the crack from the box."""
        corners = np.array(np.meshgrid(*zip(lower, upper, strict=True))).reshape(len(lower), -1).T
        heights = (corners - self.point) @ self.normal
        if heights.min() > 0 or heights.max() < 0:
            return False
        return self.corners is None or bool(
            np.all(self.corners.min(axis=0) <= upper) and np.all(self.corners.max(axis=0) >= lower)
        )

    def contains(self, points: Values, slack: float) -> Flags:
        """(n,) whether points (n, d) of the plane lie within the corners, or at most `slack` (m) outside."""
        if self.corners is None:
            return np.ones(len(points), bool)
        if len(self.corners) == 2:
            along = self.corners[1] - self.corners[0]
            length = float(np.linalg.norm(along))
            coordinate = (points - self.corners[0]) @ along / length
            return np.asarray((coordinate >= -slack) & (coordinate <= length + slack))
        return _in_polygon(self.corners, self.normal, points, slack)


def plane_crack(name: str, point: Values, normal: Values) -> CrackPlane:
    """A crack over the whole section of the body with a plane (2D: a line). InputError if the normal is zero."""
    if not (length := float(np.linalg.norm(normal))):
        raise InputError(f"{name}.plane: the normal must not be zero")
    return CrackPlane(name, point, np.asarray(normal / length))


def segment_crack(name: str, corners: Values) -> CrackPlane:
    """A crack along the segment between two points (2, 2), m, of a 2D body. InputError if the points coincide."""
    along = corners[1] - corners[0]
    if not (length := float(np.linalg.norm(along))):
        raise InputError(f"{name}.segment: both ends are {corners[0].tolist()}; give two different points (m)")
    return CrackPlane(name, corners[0], np.array([-along[1], along[0]]) / length, corners)


def polygon_crack(name: str, corners: Values) -> CrackPlane:
    """A crack over a planar polygon (k, 3), m. InputError if the corners do not lie in one plane."""
    centre = corners.mean(axis=0)
    _, sizes, axes = np.linalg.svd(corners - centre)
    # distance of a corner from the plane, and of all corners from a line
    tolerance = 1e-6 * sizes[0]
    if sizes[1] <= tolerance or sizes[2] > tolerance:
        raise InputError(f"{name}.polygon: its {len(corners)} corners do not span a plane; give a flat polygon (m)")
    return CrackPlane(name, centre, axes[2], corners)


def _in_polygon(corners: Values, normal: Values, points: Values, slack: float) -> Flags:
    """(n,) whether points of the plane lie in the polygon (crossing number), or within `slack` (m) of a side."""
    first = corners[1] - corners[0]
    first = first / np.linalg.norm(first)
    axes = np.stack([first, np.cross(normal, first)], axis=1)
    x, start = points @ axes, corners @ axes
    along = np.roll(start, -1, axis=0) - start
    apart = x[:, None] - start
    rises = (start[:, 1] > x[:, 1:]) != ((start + along)[:, 1] > x[:, 1:])
    climb = np.where(along[:, 1] == 0, 1.0, along[:, 1])
    odd = (rises & (apart[..., 1] / climb * along[:, 0] > apart[..., 0])).sum(axis=1) % 2 == 1
    share = np.clip(np.einsum("nki,ki->nk", apart, along) / np.einsum("ki,ki->k", along, along), 0.0, 1.0)
    beside = np.linalg.norm(apart - share[..., None] * along, axis=2).min(axis=1) <= slack
    return np.asarray(odd | beside)
