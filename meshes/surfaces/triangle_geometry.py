"""Geometry of triangles in space: areas, edges, enclosed volumes, winding numbers, and polygons cut into triangles."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..data import Indices, Points
from ..topology import Floats, Mask

Triangulation = tuple[Points, Indices]  # points (n, 3), triangles (k, 3)
BATCH_SIZE = 1_000_000  # pairs of a point and a triangle that are computed at once


def without_unused_points(points: Points, triangles: Indices) -> Triangulation:
    """The surface without points that belong to no triangle."""
    used = np.zeros(len(points), bool)
    used[triangles] = True
    if used.all():
        return points, triangles
    return points[used], (np.cumsum(used) - 1)[triangles]


def concatenate(surfaces: list[Triangulation]) -> Triangulation:
    """Several surfaces as one."""
    starts = np.cumsum([0] + [len(points) for points, _ in surfaces])
    triangles = [triangles + start for (_, triangles), start in zip(surfaces, starts, strict=False)]
    return np.concatenate([points for points, _ in surfaces]), np.concatenate(triangles)


def directed_edges(triangles: Indices) -> Indices:
    """(3 k, 2) edges in the direction of their triangle, three rows for each triangle."""
    return np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2)


def areas(points: Points, triangles: Indices) -> Floats:
    """(k,) areas of triangles [m^2]."""
    a, b, c = (points[column] for column in triangles.T)
    normals = np.cross(b - a, c - a)
    return np.asarray(np.sqrt(np.einsum("ki,ki->k", normals, normals)) / 2)


def has_no_area(points: Points, triangles: Indices) -> Mask:
    """(k,) whether each triangle is lower than 1e-7 of the size of the surface."""
    a, b, c = (points[column] for column in triangles.T)
    squares = [np.einsum("ki,ki->k", side, side) for side in (b - a, c - b, a - c)]
    longest = np.sqrt(np.maximum(np.maximum(squares[0], squares[1]), squares[2]))
    # coordinates in single precision move a corner by up to 6e-8 of the size
    return areas(points, triangles) <= 1e-7 * float(np.ptp(points, axis=0).max()) * longest / 2


def enclosed_volumes(points: Floats, triangles: npt.NDArray[np.integer]) -> Floats:
    """(k,) share x_0 . (x_1 x x_2) / 6 of each triangle in the enclosed volume [m^3], by the divergence theorem."""
    a, b, c = (points - points.mean(axis=0))[triangles].transpose(1, 0, 2)
    return np.asarray(np.einsum("ki,ki->k", a, np.cross(b, c)) / 6)


def winding_numbers(x: Floats, corners: Floats) -> Floats:
    """(n,) winding number of triangles (k, 3, 3) around points x (n, 3): the sum of their solid angles over 4 pi.

    tan(omega / 2) = a . (b x c) / (|a||b||c| + (a . b)|c| + (b . c)|a| + (c . a)|b|)   (Van Oosterom, Strackee 1983)
    """
    return np.concatenate([_windings(part, corners) for part in batches(x, len(corners))])


def _windings(x: Floats, corners: Floats) -> Floats:
    a, b, c = (corners[None] - x[:, None, None]).transpose(2, 0, 1, 3)
    la, lb, lc = (np.linalg.norm(corner, axis=2) for corner in (a, b, c))
    ab, bc, ca = (np.einsum("nki,nki->nk", *pair) for pair in ((a, b), (b, c), (c, a)))
    triple = np.einsum("nki,nki->nk", a, np.cross(b, c))
    return np.asarray(np.arctan2(triple, la * lb * lc + ab * lc + bc * la + ca * lb).sum(axis=1) / (2 * np.pi))


def batches(x: Floats, count: int) -> list[Floats]:
    """Points (n, 3) in batches of about BATCH_SIZE pairs with `count` triangles."""
    return np.array_split(x, 1 + len(x) * count // BATCH_SIZE)


def probes_inside(points: Points, corners: Floats) -> Mask:
    """Whether points (n, 3), about 300 of them at most, lie within a closed surface of triangles (k, 3, 3)."""
    probes = points[:: 1 + len(points) // 300]
    return np.asarray(abs(winding_numbers(probes, corners)) > 0.5)


def triangles_of_faces(points: Points, faces: Indices) -> Indices:
    """(m (k - 2), 3) triangles of faces (m, k) with the same orientation: fans of convex faces, else by ears.

    Ears: G. H. Meisters (1975), Polygons have ears, American Mathematical Monthly 82.
    """
    corners = points[faces]
    normals = np.cross(corners - corners[:, :1], np.roll(corners, -1, axis=1) - corners[:, :1]).sum(axis=1)
    ahead, behind = np.roll(corners, -1, axis=1) - corners, corners - np.roll(corners, 1, axis=1)
    convex = (np.einsum("mki,mi->mk", np.cross(behind, ahead), normals) >= 0).all(axis=1)
    fan = [[0, i, i + 1] for i in range(1, faces.shape[1] - 1)]
    columns = np.tile(np.array(fan, np.int64), (len(faces), 1, 1))
    for face in np.flatnonzero(~convex):
        columns[face] = _ears(corners[face], normals[face])
    return np.take_along_axis(faces, columns.reshape(len(faces), -1), axis=1).reshape(-1, 3)


def _ears(corners: Floats, normal: Floats) -> list[list[int]]:
    """Triangles of a polygon (k, 3) with a normal, cut off one by one at its ears."""
    left, triangles = list(range(len(corners))), []
    while len(left) > 3:
        ears = (i for i in range(len(left)) if _is_ear(corners, normal, left, i))
        i = next(ears, 0)  # without an ear the face cuts itself; the enclosed volume will tell
        triangles.append([left[i - 1], left[i], left[(i + 1) % len(left)]])
        del left[i]
    return [*triangles, left]


def _is_ear(corners: Floats, normal: Floats, left: list[int], i: int) -> bool:
    """Whether the triangle at corner i of those that are left is convex and holds no other corner."""
    ear = [left[i - 1], left[i], left[(i + 1) % len(left)]]
    a, b, c = corners[ear]
    if np.cross(b - a, c - b) @ normal <= 0:
        return False
    other_corners = corners[[node for node in left if node not in ear]]
    sides = [np.cross(end - start, other_corners - start) @ normal for start, end in ((a, b), (b, c), (c, a))]
    return not (np.array(sides) >= 0).all(axis=0).any()
