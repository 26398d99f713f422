"""Pairs of triangles of a surface that pass through one another.

A tree of bounding boxes finds the pairs that are near. Triangles with a common edge cannot pass through one another,
nor can those with one common node whose triangles lie around it like a graph over a plane: only the other pairs, a few
of a smooth surface, are tested exactly.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..data import Indices, MeshError, Points
from ..topology import Floats, Mask

TOUCHING = 1e-6  # share of the surface's size; an edge that reaches less far beyond a triangle touches it only
MARGIN = 1e-9  # of the coordinates within a triangle: what passes nearer to its boundary
AT_ONCE = 500_000  # pairs of boxes or triangles
# pairs of boxes and triangles that are compared, at least and for each triangle: a sphere of 1.3 million takes 35 each
MAX_PAIRS, MAX_PAIRS_EACH = 100_000_000, 1000
MAX_STEP = 2**20 - 4  # steps of coordinates along the longest side, so that three of them fit into one integer
GUARDS = 1 << 20 | 1 << 41 | 1 << 62  # bits above the steps of three axes
_SPREADING = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
MIN_COSINE = 0.1  # of the angle between the normals of a node and of its triangles, that these form a graph
MAX_CODE = 2**40  # of random numbers of nodes, so that sums of some thousand of them are exact


def crossing_triangles(points: Points, triangles: Indices, *, closed: bool = False) -> Indices:
    """Pairs of triangles, the lower number first, of which an edge of one passes through the other: (k, 2).

    An edge through the boundary of a triangle counts where `closed`. Triangles in one plane are not found.

    Raises:
        MeshError: so many triangles are near one another that the search would take too long.
    """
    if len(triangles) < 2:
        return np.zeros((0, 2), np.int64)
    order = _along_curve(sum(points[column] for column in triangles.T) / 3)
    triangles = triangles[order]  # those that are near in space are near in memory
    corners = points[triangles]
    low = np.minimum(np.minimum(corners[:, 0], corners[:, 1]), corners[:, 2])
    high = np.maximum(np.maximum(corners[:, 0], corners[:, 1]), corners[:, 2])
    tolerance = TOUCHING * float((high.max(axis=0) - low.min(axis=0)).max())
    graph = _graph_nodes(corners, triangles, len(points))
    columns = np.ascontiguousarray(triangles.T)
    result: list[Indices] = [np.zeros((0, 2), np.int64)]
    for first, second in _near_pairs(low, high):
        pairs = np.stack(_without_neighbours(columns, first, second, graph), axis=1)
        crossed = _crossed(points, triangles, pairs, tolerance, -MARGIN if closed else MARGIN)
        result.append(np.sort(order[pairs[crossed]], axis=1))
    pairs = np.concatenate(result)
    return pairs[np.lexsort(pairs.T[::-1])]


# --- near pairs -----------------------------------------------------------------------------------------------------


def _near_pairs(low: Points, high: Points) -> Iterator[tuple[Indices, Indices]]:
    """Pairs of triangles whose bounding boxes (n, 3) overlap, each pair once, some at a time. MeshError: see above.

    Triangles that are near in space have to be near in the list.
    """
    levels = _box_tree(low, high)
    # pairs of boxes at a level whose children are to be compared; None: each box with itself
    stack: list[tuple[int, Indices, Indices | None]] = [
        (depth, np.arange(len(lower) // 2), None) for depth, (lower, _) in enumerate(levels[1:])
    ]
    compared = 0
    while stack:
        if compared >= max(MAX_PAIRS, MAX_PAIRS_EACH * len(low)):
            raise MeshError(
                f"The surface of {len(low)} triangles was not searched to the end for triangles that pass "
                "through one another: too many are near each other. Remove doubled parts, or make the surface "
                "coarser, for example in MeshLab: Filters > Remeshing > Quadric Edge Collapse Decimation."
            )
        depth, first, partner = stack.pop()
        if len(first) > AT_ONCE:
            half = len(first) // 2
            stack += [(depth, first[:half], None if partner is None else partner[:half])]
            stack += [(depth, first[half:], None if partner is None else partner[half:])]
            continue
        second = first if partner is None else partner
        lower, upper = (bounds.reshape(-1, 2) for bounds in levels[depth + 1])
        low_first, high_first, low_second, high_second = lower[first], upper[first], lower[second], upper[second]
        children: list[tuple[Indices, Indices]] = []
        for i, j in ((0, 1),) if partner is None else ((0, 0), (0, 1), (1, 0), (1, 1)):
            compared += len(first)
            # a guard bit is left where the upper bound is no less than the lower one
            above = (high_second[:, j] - low_first[:, i]) & (high_first[:, i] - low_second[:, j])
            near = above & GUARDS == GUARDS
            children.append((2 * first[near] + i, 2 * second[near] + j))
        first, second = (np.concatenate(side) for side in zip(*children, strict=True))
        if depth + 2 == len(levels):
            yield first, second
        elif len(first):
            stack.append((depth + 1, first, second))


def _along_curve(middles: Points) -> Indices:
    """The order of points (n, 3) along a Z curve through their bounding box (G. M. Morton 1966)."""
    low = middles.min(axis=0)
    steps = _steps(middles, low, float((middles.max(axis=0) - low).max()))
    code = np.zeros(len(middles), np.int64)
    for axis in range(3):
        # two bits of zero are put between each two bits
        spread: Indices = steps[:, axis]
        for shift, mask in _SPREADING:
            spread = (spread | spread << shift) & mask
        code |= spread << axis
    return np.argsort(code, kind="stable").astype(np.int64)


def _steps(points: Points, low: Floats, size: float) -> Indices:
    """Coordinates of points (n, 3) from `low` on as whole numbers, MAX_STEP for `size`."""
    return ((points - low) * (MAX_STEP / max(size, np.finfo(float).tiny))).astype(np.int64)


def _box_tree(low: Points, high: Points) -> list[tuple[Indices, Indices]]:
    """Lower and upper bounds (boxes,) of each level from the root: boxes 2 i and 2 i + 1 are in box i.

    The last level has the boxes given (n, 3), and empty ones that make it a power of two. The bounds of the three axes,
    rounded outwards to steps, stand in one integer, guard bits in the upper one.
    """
    origin = low.min(axis=0)
    size = float((high.max(axis=0) - origin).max())
    leaves = 1 << (len(low) - 1).bit_length()
    lower: Indices = np.full((3, leaves), MAX_STEP + 2)
    upper: Indices = np.zeros((3, leaves), np.int64)
    lower[:, : len(low)] = _steps(low, origin, size).T
    upper[:, : len(low)] = _steps(high, origin, size).T + 1
    levels = [(_packed(lower), _packed(upper) | GUARDS)]
    while lower.shape[1] > 1:
        lower = np.minimum(lower[:, 0::2], lower[:, 1::2])
        upper = np.maximum(upper[:, 0::2], upper[:, 1::2])
        levels.append((_packed(lower), _packed(upper) | GUARDS))
    return levels[::-1]


def _packed(steps: Indices) -> Indices:
    """(n,) the numbers of three axes (3, n), each in 21 bits, of which the highest is free."""
    return np.asarray(steps[0] | steps[1] << 21 | steps[2] << 42)


# --- neighbours -----------------------------------------------------------------------------------------------------


def _without_neighbours(corners: Indices, first: Indices, second: Indices, graph: Mask) -> tuple[Indices, Indices]:
    """Pairs of triangles but for those with a common edge, or with one common node that is a `graph` node.

    Two triangles with a common edge meet there and, if they lie in one plane, in an area: no edge of one passes
    through the other. `corners`: (3, n) nodes of the triangles.
    """
    of_first, of_second = ([column[number] for column in corners] for number in (first, second))
    common = [(node == of_second[0]) | (node == of_second[1]) | (node == of_second[2]) for node in of_first]
    count = np.sum(common, axis=0, dtype=np.int8)
    node = np.where(common[0], of_first[0], np.where(common[1], of_first[1], of_first[2]))
    tested = (count == 0) | ((count == 1) & ~graph[node])
    return first[tested], second[tested]


def _graph_nodes(corners: Floats, triangles: Indices, count: int) -> Mask:
    """(count,) the nodes around which the triangles (n, 3), with corners (n, 3, 3), lie like a graph over a plane.

    The triangles of a node go once around it, and all their normals point to one side of the plane: the projection on
    the plane is one to one, so that the triangles meet in common edges and in the node only.
    """
    normals = _unit_normals(corners)
    normal = np.stack([sum(np.bincount(column, part, count) for column in triangles.T) for part in normals.T], axis=1)
    length = np.linalg.norm(normal, axis=1)
    # a direction in the plane: across the normal
    x, y, z = normal.T
    zero = np.zeros(count)
    across = np.where(np.abs(x) > 0.9 * length, [z, zero, -x], [zero, z, -y]).T
    code = np.random.default_rng(1).integers(MAX_CODE, size=count).astype(np.float64)[triangles]
    turns, open_ends, turned = np.zeros(count), np.zeros(count), np.zeros(count)
    for corner in range(3):
        node, after, before = (triangles[:, corner], (corner + 1) % 3, (corner + 2) % 3)
        aligned = np.einsum("ki,ki->k", normals, normal[node]) > MIN_COSINE * length[node]
        turned += np.bincount(node, ~aligned, count)
        # once around: the direction is passed upwards once; of an open fan the first and last node do not cancel out
        direction = across[node]
        height = np.einsum("kci,ki->kc", corners[:, [after, before]] - corners[:, [corner]], direction)
        turns += np.bincount(node, (height[:, 0] < 0) & (height[:, 1] >= 0), count)
        open_ends += np.bincount(node, code[:, after] - code[:, before], count)
    return np.asarray((turned == 0) & (turns == 1) & (open_ends == 0))


# --- exact test -----------------------------------------------------------------------------------------------------


def _crossed(points: Points, triangles: Indices, pairs: Indices, tolerance: float, margin: float) -> Mask:
    """(k,) whether an edge of one triangle of each pair passes through the other."""
    crossed = np.zeros(len(pairs), bool)
    reaching = np.zeros(len(pairs), bool)
    for first, second in ((0, 1), (1, 0)):  # to both sides of the other's plane: few neighbours do
        heights = _heights(points[triangles[pairs[:, first]]], points[triangles[pairs[:, second]]])
        reaching |= (heights.min(axis=1) < -tolerance) & (heights.max(axis=1) > tolerance)
    straddling = np.flatnonzero(reaching)
    for first, second in ((0, 1), (1, 0)):
        edges, faces = triangles[pairs[straddling, first]], triangles[pairs[straddling, second]]
        for side in range(3):
            edge = edges[:, [side, (side + 1) % 3]]
            free = ~(edge[:, :, None] == faces[:, None, :]).any(axis=(1, 2)) & ~crossed[straddling]
            crossed[straddling[free]] = _pierces(points[edge[free]], points[faces[free]], tolerance, margin)
    return crossed


def _heights(x: Floats, faces: Floats) -> Floats:
    """(k, e) of points (k, e, 3) over the planes of triangles (k, 3, 3)."""
    return np.asarray(np.einsum("kei,ki->ke", x - faces[:, :1], _unit_normals(faces)))


def _unit_normals(faces: Floats) -> Floats:
    """(k, 3) of triangles (k, 3, 3); zero where they have no area."""
    a, b, c = faces.transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    return np.asarray(normal / np.maximum(np.linalg.norm(normal, axis=1), np.finfo(float).tiny)[:, None])


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
