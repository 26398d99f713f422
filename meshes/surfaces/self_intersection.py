"""Pairs of triangles of a surface that intersect.

A tree of bounding boxes finds the pairs that are near. Triangles with a common edge cannot pass through one another,
nor can those with one common node whose triangles lie around it like a graph over a plane: only the other pairs, a few
of a smooth surface, are tested exactly.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..data import Indices, MeshError, Points
from ..topology import Floats, Mask


@dataclass(frozen=True)
class CrossingLimits:
    """Tolerances of the test whether triangles intersect, and bounds of the search."""

    touching: float = 1e-6  # over the size of the surface: an edge that reaches less far beyond a triangle touches it
    margin: float = 1e-9  # of barycentric coordinates: an edge that passes nearer to the boundary counts if `closed`
    min_cosine: float = 0.1  # between the normals of a node and of its triangles, which are a graph over a plane then
    batch: int = 500_000  # pairs of boxes that are compared at once
    max_pairs: int = 100_000_000  # compared pairs of boxes and triangles: this many, or
    max_pairs_per_triangle: int = 1000  # so many for each triangle (a sphere of 1.3 million triangles takes 35)


CROSSING = CrossingLimits()
MAX_STEP = 2**20 - 4  # integer coordinate at the end of the longest side: three of 21 bits fit into one integer
GUARDS = 1 << 20 | 1 << 41 | 1 << 62  # the highest of the 21 bits of each axis, which is free
# shift and mask of each step that inserts two zeros between the bits of a number
_SPREADING = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def crossing_triangles(points: Points, triangles: Indices, *, closed: bool = False) -> Indices:
    """(k, 2) pairs of triangles, the lower number first, such that an edge of one passes through the other.

    Intersections within one plane are not found.

    Args:
        points: (n, 3) [m].
        triangles: (k, 3).
        closed: whether an edge through the boundary of a triangle counts.

    Raises:
        MeshError: so many triangles are near one another that the search would take too long.
    """
    if len(triangles) < 2:
        return np.zeros((0, 2), np.int64)
    order = _order_along_curve(sum(points[column] for column in triangles.T) / 3)
    triangles = triangles[order]  # neighbours in space are neighbours in memory
    corners = points[triangles]
    low = np.minimum(np.minimum(corners[:, 0], corners[:, 1]), corners[:, 2])
    high = np.maximum(np.maximum(corners[:, 0], corners[:, 1]), corners[:, 2])
    tolerance = CROSSING.touching * float((high.max(axis=0) - low.min(axis=0)).max())
    graph = _graph_nodes(corners, triangles, len(points))
    columns = np.ascontiguousarray(triangles.T)
    crossings: list[Indices] = [np.zeros((0, 2), np.int64)]
    for first, second in _near_pairs(low, high):
        pairs = np.stack(_without_neighbours(columns, first, second, graph), axis=1)
        crossed = _crossed(points, triangles, pairs, tolerance, -CROSSING.margin if closed else CROSSING.margin)
        crossings.append(np.sort(order[pairs[crossed]], axis=1))
    pairs = np.concatenate(crossings)
    return pairs[np.lexsort(pairs.T[::-1])]


# --- near pairs -----------------------------------------------------------------------------------------------------


def _near_pairs(low: Points, high: Points) -> Iterator[tuple[Indices, Indices]]:
    """Pairs of triangles whose bounding boxes overlap, each pair once, in batches.

    Args:
        low: (n, 3) lower corners of the boxes; boxes that are near in space should be near in the list.
        high: (n, 3) upper corners.

    Raises:
        MeshError: too many boxes overlap.
    """
    levels = _box_tree(low, high)
    # pairs of boxes at a level whose children are to be compared; None: each box with itself
    stack: list[tuple[int, Indices, Indices | None]] = [
        (depth, np.arange(len(lower) // 2), None) for depth, (lower, _) in enumerate(levels[1:])
    ]
    compared = 0
    while stack:
        if compared >= max(CROSSING.max_pairs, CROSSING.max_pairs_per_triangle * len(low)):
            raise MeshError(
                f"The surface of {len(low)} triangles was not searched to the end for triangles that pass "
                "through one another: too many are near each other. Remove doubled parts, or make the surface "
                "coarser, for example in MeshLab: Filters > Remeshing > Quadric Edge Collapse Decimation."
            )
        depth, first, partner = stack.pop()
        if len(first) > CROSSING.batch:
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
            # a guard bit stays if the upper bound is not below the lower one
            above = (high_second[:, j] - low_first[:, i]) & (high_first[:, i] - low_second[:, j])
            near = above & GUARDS == GUARDS
            children.append((2 * first[near] + i, 2 * second[near] + j))
        first, second = (np.concatenate(side) for side in zip(*children, strict=True))
        if depth + 2 == len(levels):
            yield first, second
        elif len(first):
            stack.append((depth + 1, first, second))


def _order_along_curve(middles: Points) -> Indices:
    """(n,) order of points (n, 3) along a Z curve through their bounding box (G. M. Morton 1966)."""
    low = middles.min(axis=0)
    steps = _steps(middles, low, float((middles.max(axis=0) - low).max()))
    code = np.zeros(len(middles), np.int64)
    for axis in range(3):
        spread: Indices = steps[:, axis]
        for shift, mask in _SPREADING:
            spread = (spread | spread << shift) & mask
        code |= spread << axis
    return np.argsort(code, kind="stable").astype(np.int64)


def _steps(points: Points, low: Floats, size: float) -> Indices:
    """(n, 3) coordinates from `low` on as integers, MAX_STEP for a length of `size` [m]."""
    return ((points - low) * (MAX_STEP / max(size, np.finfo(float).tiny))).astype(np.int64)


def _box_tree(low: Points, high: Points) -> list[tuple[Indices, Indices]]:
    """Lower and upper bounds (boxes,) of each level of a tree from the root on; box i holds boxes 2 i and 2 i + 1.

    The last level consists of the given boxes (n, 3) and of empty ones up to a power of two. The bounds of three axes,
    rounded outwards to integers, are packed into one integer, with guard bits in the upper one.
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
    """(n,) integers of three axes (3, n), packed into 21 bits each, the highest of which is free."""
    return np.asarray(steps[0] | steps[1] << 21 | steps[2] << 42)


# --- neighbours -----------------------------------------------------------------------------------------------------


def _without_neighbours(corners: Indices, first: Indices, second: Indices, graph: Mask) -> tuple[Indices, Indices]:
    """Pairs of triangles without those that have a common edge, or one common node of `graph`.

    Args:
        corners: (3, n) nodes of the triangles.
        first: of each pair.
        second: of each pair.
        graph: (nodes,) result of `_graph_nodes`.
    """
    # triangles with a common edge meet there and, if they lie in one plane, in an area: no edge passes through
    of_first, of_second = ([column[number] for column in corners] for number in (first, second))
    common = [(node == of_second[0]) | (node == of_second[1]) | (node == of_second[2]) for node in of_first]
    count = np.sum(common, axis=0, dtype=np.int8)
    node = np.where(common[0], of_first[0], np.where(common[1], of_first[1], of_first[2]))
    tested = (count == 0) | ((count == 1) & ~graph[node])
    return first[tested], second[tested]


def _graph_nodes(corners: Floats, triangles: Indices, count: int) -> Mask:
    """(count,) whether the triangles around each node are a graph over a plane.

    They go once around the node, and all their normals point to one side of the plane. The projection on the plane is
    one to one, so that the triangles meet in common edges and in the node only.

    Args:
        corners: (n, 3, 3) coordinates.
        triangles: (n, 3) nodes.
        count: number of nodes.
    """
    normals = _unit_normals(corners)
    normal = np.stack([sum(np.bincount(column, part, count) for column in triangles.T) for part in normals.T], axis=1)
    length = np.linalg.norm(normal, axis=1)
    # a direction in the plane, normal to the mean normal
    x, y, z = normal.T
    zero = np.zeros(count)
    across = np.where(np.abs(x) > 0.9 * length, [z, zero, -x], [zero, z, -y]).T
    # random numbers of the nodes, so small that sums of some thousand of them are exact
    code = np.random.default_rng(1).integers(2**40, size=count).astype(np.float64)[triangles]
    turns, open_ends, turned = np.zeros(count), np.zeros(count), np.zeros(count)
    for corner in range(3):
        node, after, before = (triangles[:, corner], (corner + 1) % 3, (corner + 2) % 3)
        aligned = np.einsum("ki,ki->k", normals, normal[node]) > CROSSING.min_cosine * length[node]
        turned += np.bincount(node, ~aligned, count)
        # once around: the direction is passed upwards once; the first and last node of an open fan do not cancel
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
    for first, second in ((0, 1), (1, 0)):  # few neighbours have nodes on both sides of the other's plane
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
    """(k, e) heights of points (k, e, 3) above the planes of triangles (k, 3, 3)."""
    return np.asarray(np.einsum("kei,ki->ke", x - faces[:, :1], _unit_normals(faces)))


def _unit_normals(faces: Floats) -> Floats:
    """(k, 3) unit normals of triangles (k, 3, 3); zero of those without area."""
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
