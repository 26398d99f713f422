"""Triangles of a surface that pass through one another: found by a tree of bounding boxes."""

from __future__ import annotations

import numpy as np

from ..data import Indices, MeshError, Points
from ..topology import Floats, Mask

TOUCHING = 1e-6  # share of the surface's size; an edge that reaches less far beyond a triangle touches it only
MARGIN = 1e-9  # of the coordinates within a triangle: what passes nearer to its boundary
AT_ONCE = 500_000  # pairs of boxes or triangles
# pairs of boxes and triangles that are compared, at least and for each triangle: a sphere of 1.3 million takes 35 each
MAX_PAIRS, MAX_PAIRS_EACH = 100_000_000, 1000
BITS = 20  # of a coordinate in the order of triangles along a curve


def crossing_triangles(points: Points, triangles: Indices, *, closed: bool = False) -> Indices:
    """Pairs of triangles, the lower number first, of which an edge of one passes through the other: (k, 2).

    An edge through the boundary of a triangle counts where `closed`. Triangles in one plane are not found.

    Raises:
        MeshError: so many triangles are near one another that the search would take too long.
    """
    if len(triangles) < 2:
        return np.zeros((0, 2), np.int64)
    order, levels = _tree(points[triangles])
    tolerance = TOUCHING * float(np.ptp(points[np.unique(triangles)], axis=0).max())
    found, compared = [np.zeros((0, 2), np.int64)], 0
    stack: list[tuple[int, Indices]] = [(0, np.zeros((1, 2), np.int64))]
    while stack:
        if compared >= max(MAX_PAIRS, MAX_PAIRS_EACH * len(triangles)):
            raise MeshError(
                f"The surface of {len(triangles)} triangles was not searched to the end for triangles that pass "
                "through one another: too many are near each other. Remove doubled parts, or make the surface "
                "coarser, for example in MeshLab: Filters > Remeshing > Quadric Edge Collapse Decimation."
            )
        level, pairs = stack.pop()
        if len(pairs) > AT_ONCE:
            stack += [(level, half) for half in np.array_split(pairs, 2)]
            continue
        low, high = levels[level]
        i, j = pairs.T
        near: Indices = pairs[((low[i] <= high[j]) & (low[j] <= high[i])).all(axis=1)]
        compared += len(i)
        if level + 1 < len(levels):
            stack.append((level + 1, _children(near)))
        else:
            apart = order[near[near[:, 0] != near[:, 1]]]
            crossed = _crossed(points, triangles, apart, tolerance, -MARGIN if closed else MARGIN)
            found.append(np.sort(apart[crossed], axis=1))
    return np.concatenate(found)


def _tree(corners: Floats) -> tuple[Indices, list[tuple[Floats, Floats]]]:
    """The triangle at each leaf, and the boxes of each level from the root: pairs of nodes 2 i, 2 i + 1 are in node i.

    Leaves follow a Z curve through the middles (G. M. Morton 1966); those beyond the last triangle are empty.
    """
    middles = corners.mean(axis=1)
    low = middles.min(axis=0)
    size = max(float(np.ptp(middles, axis=0).max()), np.finfo(float).tiny)
    steps = ((middles - low) / size * (2**BITS - 1)).astype(np.int64)
    code = np.zeros(len(middles), np.int64)
    for bit in range(BITS):
        for axis in range(3):
            code |= (steps[:, axis] >> bit & 1) << (3 * bit + axis)
    order: Indices = np.argsort(code, kind="stable").astype(np.int64)
    leaves = 1 << (len(order) - 1).bit_length()
    lower, upper = np.full((leaves, 3), np.inf), np.full((leaves, 3), -np.inf)
    lower[: len(order)], upper[: len(order)] = corners[order].min(axis=1), corners[order].max(axis=1)
    levels: list[tuple[Floats, Floats]] = [(lower, upper)]
    while len(lower) > 1:
        lower, upper = np.minimum(lower[0::2], lower[1::2]), np.maximum(upper[0::2], upper[1::2])
        levels.append((lower, upper))
    return order, levels[::-1]


def _children(pairs: Indices) -> Indices:
    """Pairs of the children of pairs of nodes, each unordered pair once."""
    both = (2 * pairs[:, None, :] + np.array([[0, 0], [0, 1], [1, 0], [1, 1]])).reshape(-1, 2)
    return both[both[:, 0] <= both[:, 1]]


def _crossed(points: Points, triangles: Indices, pairs: Indices, tolerance: float, margin: float) -> Mask:
    """(k,) whether an edge of one triangle of each pair passes through the other."""
    crossed = np.zeros(len(pairs), bool)
    reaching = np.zeros(len(pairs), bool)
    for one, other in ((0, 1), (1, 0)):  # to both sides of the other's plane: few neighbours do
        heights = _heights(points[triangles[pairs[:, one]]], points[triangles[pairs[:, other]]])
        reaching |= (heights.min(axis=1) < -tolerance) & (heights.max(axis=1) > tolerance)
    straddling = np.flatnonzero(reaching)
    for one, other in ((0, 1), (1, 0)):
        edges, faces = triangles[pairs[straddling, one]], triangles[pairs[straddling, other]]
        for side in range(3):
            edge = edges[:, [side, (side + 1) % 3]]
            free = ~(edge[:, :, None] == faces[:, None, :]).any(axis=(1, 2)) & ~crossed[straddling]
            crossed[straddling[free]] = _pierces(points[edge[free]], points[faces[free]], tolerance, margin)
    return crossed


def _heights(x: Floats, faces: Floats) -> Floats:
    """(k, e) of points (k, e, 3) over the planes of triangles (k, 3, 3)."""
    a, b, c = faces.transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1), np.finfo(float).tiny)[:, None]
    return np.asarray(np.einsum("kei,ki->ke", x - a[:, None], normal))


def _pierces(edges: Floats, faces: Floats, tolerance: float, margin: float) -> Mask:
    """(k,) whether segments (k, 2, 3) pass through triangles (k, 3, 3), by the signs of the volumes they span."""
    height = _heights(edges, faces)
    through = (height.min(axis=1) < -tolerance) & (height.max(axis=1) > tolerance)
    pierced = np.zeros(len(edges), bool)
    start, span = edges[through, 0], edges[through, 1] - edges[through, 0]
    corners = faces[through] - start[:, None]
    ahead = np.roll(corners, -1, axis=1)
    volumes = np.einsum("ki,ksi->ks", span, np.cross(corners, ahead))
    whole = volumes.sum(axis=1, keepdims=True)
    pierced[through] = (volumes * np.sign(whole) >= margin * np.abs(whole)).all(axis=1) & (whole[:, 0] != 0)
    return pierced
