"""Intersections of the elements of surfaces, from orientations alone: it shares no code with contact."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


def intersecting_elements(points: Values, elements: Ints) -> Ints:
    """(k, 2) pairs of segments (2D) or triangles (3D) that intersect and have no corner in common.

    Args:
        points: (n, d) m.
        elements: (m, d) numbers of their corners.
    """
    corners = points[elements]
    lower, upper = corners.min(axis=1), corners.max(axis=1)
    near = ((lower[:, None] <= upper[None]) & (lower[None] <= upper[:, None])).all(axis=2)
    first, second = np.nonzero(np.triu(near, 1))
    common = (elements[first][:, :, None] == elements[second][:, None]).any(axis=(1, 2))
    first, second = first[~common], second[~common]
    a, b = corners[first], corners[second]
    cut = _segments_cross(a, b) if points.shape[1] == 2 else _is_pierced(a, b) | _is_pierced(b, a)
    return np.stack([first[cut], second[cut]], axis=1)


def _segments_cross(a: Values, b: Values) -> Flags:
    """(k,) whether segments a (k, 2, 2) and b have their ends on different sides of each other."""
    sides = [np.sign(_area(p, q[:, 0]) * _area(p, q[:, 1])) for p, q in ((a, b), (b, a))]
    return np.asarray((sides[0] < 0) & (sides[1] < 0))


def _area(segment: Values, x: Values) -> Values:
    """(k,) twice the signed area of the triangle of a segment (k, 2, 2) and a point x (k, 2)."""
    return np.asarray(np.linalg.det(np.stack([segment[:, 1] - segment[:, 0], x - segment[:, 0]], axis=1)))


def _is_pierced(triangle: Values, other: Values) -> Flags:
    """(k,) whether an edge of the other triangle (k, 3, 3) goes through the triangle (k, 3, 3)."""

    def volume(i: Values, j: Values, k: Values, x: Values) -> Values:
        return np.asarray(np.sign(np.linalg.det(np.stack([j - i, k - i, x - i], axis=1))))

    corner, pierced = np.swapaxes(triangle, 0, 1), np.zeros(len(triangle), bool)
    for p, q in combinations(np.swapaxes(other, 0, 1), 2):
        around = [volume(p, q, corner[k], corner[(k + 1) % 3]) for k in range(3)]
        apart = volume(*corner, p) * volume(*corner, q) < 0
        pierced |= apart & (around[0] == around[1]) & (around[1] == around[2]) & (around[0] != 0)
    return pierced
