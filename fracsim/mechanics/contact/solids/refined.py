"""Triangles cut until no side is longer than asked for: contact is felt, and weighed, at points of both sides."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ....meshes.topology import distinct_rows

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

MOST = 100_000  # triangles


def refined(points: Values, triangles: Ints, edge: float) -> tuple[Values, Ints]:
    """The surface of points (n, 3), m, and triangles (k, 3) with sides no longer than `edge`, m, or so long that
    there are about MOST triangles: sides are halved, in both triangles at once, so that it stays closed."""
    sides = points[triangles[:, 1:]] - points[triangles[:, :1]]
    area = float(np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).sum() / 2)
    edge = max(edge, 2.0 * float(np.sqrt(area / MOST)))
    while True:
        ends, _, side = distinct_rows(np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], 2).reshape(-1, 2)))
        far = np.linalg.norm(points[ends[:, 1]] - points[ends[:, 0]], axis=1) > edge
        if not far.any():
            return points, triangles
        middle = np.full(len(ends), -1)
        middle[far] = len(points) + np.arange(far.sum())
        points = np.concatenate([points, points[ends[far]].mean(axis=1)])
        triangles = _cut(triangles, middle[side.reshape(-1, 3)])


def _cut(triangles: Ints, middle: Ints) -> Ints:
    """Triangles (k, 3) cut at the points `middle` (k, 3) of the sides that begin at each corner; -1: not there."""
    parts = [triangles[(middle < 0).all(axis=1)]]
    for first in range(3):
        (a, b, c), (ab, bc, ca) = (np.roll(each, -first, axis=1).T for each in (triangles, middle))
        one, two = (ab >= 0) & (bc < 0) & (ca < 0), (ab < 0) & (bc >= 0) & (ca >= 0)
        parts += [np.column_stack(each)[one] for each in ((a, ab, c), (ab, b, c))]
        parts += [np.column_stack(each)[two] for each in ((c, ca, bc), (a, b, bc), (a, bc, ca))]
    (a, b, c), (ab, bc, ca), every = triangles.T, middle.T, (middle >= 0).all(axis=1)
    parts += [np.column_stack(each)[every] for each in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    return np.concatenate(parts)
