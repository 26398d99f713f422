"""Faces of surfaces with four or more corners, cut into triangles along diagonals inside the face."""

from __future__ import annotations

import numpy as np

from ..data import Indices, Points
from ..topology import Floats


def triangles_of_faces(points: Points, faces: Indices) -> Indices:
    """(m (k - 2), 3) triangles of faces (m, k), turned as these are: convex ones as fans, others ear by ear.

    Ears: G. H. Meisters (1975), Polygons have ears, American Mathematical Monthly 82.
    """
    corners = points[faces]
    normals = np.cross(corners - corners[:, :1], np.roll(corners, -1, axis=1) - corners[:, :1]).sum(axis=1)
    ahead, behind = np.roll(corners, -1, axis=1) - corners, corners - np.roll(corners, 1, axis=1)
    convex = (np.einsum("mki,mi->mk", np.cross(behind, ahead), normals) >= 0).all(axis=1)
    fan = [[0, i, i + 1] for i in range(1, faces.shape[1] - 1)]
    positions = np.tile(np.array(fan, np.int64), (len(faces), 1, 1))
    for face in np.flatnonzero(~convex):
        positions[face] = _ears(corners[face], normals[face])
    return np.take_along_axis(faces, positions.reshape(len(faces), -1), axis=1).reshape(-1, 3)


def _ears(corners: Floats, normal: Floats) -> list[list[int]]:
    """Triangles of a polygon: corners whose triangle turns with the polygon and holds no other corner, one by one."""
    left, triangles = list(range(len(corners))), []
    while len(left) > 3:
        ears = (i for i in range(len(left)) if _is_ear(corners, normal, left, i))
        i = next(ears, 0)  # none: the face cuts itself, and is refused later by what it encloses
        triangles.append([left[i - 1], left[i], left[(i + 1) % len(left)]])
        del left[i]
    return [*triangles, left]


def _is_ear(corners: Floats, normal: Floats, left: list[int], i: int) -> bool:
    ear = [left[i - 1], left[i], left[(i + 1) % len(left)]]
    a, b, c = corners[ear]
    if np.cross(b - a, c - b) @ normal <= 0:
        return False
    remaining = corners[[node for node in left if node not in ear]]
    sides = [np.cross(end - start, remaining - start) @ normal for start, end in ((a, b), (b, c), (c, a))]
    return not (np.array(sides) >= 0).all(axis=0).any()
