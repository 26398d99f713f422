"""Faults of triangle surfaces that are mended without a change of shape, each with a note.

Points that are almost at the same place are merged; triangles that are given twice or have no area are left out; an
edge with nodes of other triangles on it (a T junction) is divided there.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ..data import Indices, Points
from ..topology import Mask, components, distinct_rows
from .triangle_geometry import Triangulation, directed_edges, has_no_area, without_unused_points


@dataclass(frozen=True)
class MendingLimits:
    """Tolerances within which a surface is mended, and bounds of the work."""

    merge_distance: float = 1e-6  # of points, over the size of the surface
    merge_distance_open: float = 2e-5  # the same if the surface is open otherwise, and no triangle collapses
    max_open_edges: int = 20_000  # of a surface that is searched for T junctions
    max_rounds: int = 50  # of dividing triangles at T junctions, one edge of a triangle in a round


MENDING = MendingLimits()


class Mended(NamedTuple):
    """A surface that has been mended.

    Attributes:
        points: (n, 3) [m].
        triangles: (k, 3).
        notes: one for each kind of fault.
        is_open: whether edges belong to one triangle only.
        may_be_flat: whether there may be triangles without an area.
    """

    points: Points
    triangles: Indices
    notes: tuple[str, ...]
    is_open: bool
    may_be_flat: bool


def mend_closed_surface(points: Points, triangles: Indices) -> Mended:
    """Mend a surface that should be closed; one that is open otherwise has points merged over a larger distance."""
    near, far = MENDING.merge_distance, MENDING.merge_distance_open
    mended = _mend(points, triangles, near)
    if not mended.is_open:
        return mended
    merged, merged_far = merge_points(points, triangles, near), merge_points(points, triangles, far)
    if len(merged_far[0]) == len(merged[0]) or len(merged_far[1]) < len(merged[1]):
        return mended
    mended_far = _mend(points, triangles, far)
    if mended_far.is_open:
        return mended
    note = (
        f"{len(merged[0]) - len(merged_far[0])} points of the surface within {far:g} of its size of another point "
        "were joined: it was open there."
    )
    return mended_far._replace(notes=(note, *mended_far.notes))


def mend_open_surface(points: Points, triangles: Indices) -> Mended:
    """Mend a surface that may be open; triangles given twice are taken once in any case."""
    return _mend(points, triangles, MENDING.merge_distance, may_be_open=True)


def _mend(
    points: Points, triangles: Indices, distance: float, keep_copies: bool = False, may_be_open: bool = False
) -> Mended:
    """Mend a surface.

    Args:
        points: (n, 3) [m].
        triangles: (k, 3).
        distance: of points that are merged, over the size of the surface.
        keep_copies: whether triangles given twice are kept.
        may_be_open: whether copies are left out even if the surface is open without them.
    """
    original = points, triangles
    points, triangles = merge_points(points, triangles, distance)
    notes = []
    once = _is_first_copy(triangles) | keep_copies
    if not once.all():
        notes.append(f"{int((~once).sum())} surface triangles were given more than once, and are taken once.")
    flat = has_no_area(points, triangles)
    if flat.all():  # check_areas refuses it
        return Mended(points, triangles, (), False, True)
    if flat.any():
        notes.append(f"{int(flat.sum())} surface triangles without an area were left out.")
    retained = once & ~flat
    triangles, divided, is_open = _divide_t_junctions(
        points, triangles if retained.all() else triangles[retained], distance
    )
    if is_open and not once.all() and not may_be_open:
        return _mend(*original, distance, keep_copies=True)  # a wall without thickness has each triangle twice
    if divided:
        notes.append(f"{divided} edges of the surface had corners of other triangles on them and were divided there.")
    return Mended(points, triangles, tuple(notes), is_open, divided > 0)


def merge_points(points: Points, triangles: Indices, distance: float) -> Triangulation:
    """The surface with one point in place of several within a distance, without triangles that collapse.

    `distance`: over the size of the surface. STL repeats a point for every triangle.
    """
    points, triangles = without_unused_points(points, triangles)
    points, number = _distinct_points(points)
    triangles = number[triangles]
    length = distance * float(np.ptp(points, axis=0).max())
    if _may_be_near(points, length):
        from scipy.spatial import cKDTree  # slow to import, and most surfaces need no search

        pairs = cKDTree(points).query_pairs(length, output_type="ndarray")
        _, cluster = components(pairs, len(points))
        points = points[np.unique(cluster, return_index=True)[1]]
        triangles = cluster[triangles]
    a, b, c = triangles.T
    whole = (a != b) & (b != c) & (c != a)
    return points, (triangles if whole.all() else triangles[whole]).astype(np.int64, copy=False)


def _distinct_points(points: Points) -> tuple[Points, Indices]:
    """Distinct points in rising order of their coordinates, and the index of each given point among them."""
    points = points + 0.0  # -0.0 becomes 0.0
    # equal points have equal hashes: one sort of integers instead of one of rows of three numbers
    hashes = _hashes(points.view(np.int64))
    order = np.argsort(hashes)
    ranked = hashes[order]
    first = np.concatenate([[True], ranked[1:] != ranked[:-1]])
    representative = order[first]
    group = np.empty(len(points), np.int64)
    group[order] = np.cumsum(first) - 1
    distinct = points[representative]
    if not np.array_equal(distinct[group], points):  # different points with the same hash
        distinct, index = np.unique(points, axis=0, return_inverse=True)
        return distinct, index.ravel().astype(np.int64)
    rising = np.lexsort(distinct.T[::-1])
    rank = np.empty(len(rising), np.int64)
    rank[rising] = np.arange(len(rising))
    return distinct[rising], rank[group]


def _hashes(rows: Indices) -> Indices:
    """(n,) hash of each row (n, w) of integers, by multiplicative hashing (D. E. Knuth)."""
    factor = np.uint64(0x9E3779B97F4A7C15)  # 2^64 over the golden ratio
    hashes = np.zeros(len(rows), np.uint64)
    for column in rows.T:
        hashes = (hashes ^ column.view(np.uint64)) * factor
        hashes ^= hashes >> np.uint64(29)
    return hashes.view(np.int64)


def _may_be_near(points: Points, length: float) -> bool:
    """Whether two points may be nearer than a length; False is certain."""
    # Such points share a cell in one of four lattices of cells of 8 lengths, shifted by a quarter of a cell each: a
    # coordinate separates them in one of the four at most.
    cells = (points - points.min(axis=0)) / (8 * length) if length > 0 else points
    for shift in range(4):
        numbers = np.sort(_hashes((cells + shift / 4).astype(np.int64)))
        if (numbers[1:] == numbers[:-1]).any():
            return True
    return False


class EdgeTable:
    """The edges of triangles (k, 3).

    Attributes:
        directed: (3 k, 2) the edges of each triangle in its direction.
        edges: (m, 2) each edge once, the lower node first.
        counts: (m,) number of triangles at each edge.
        edge_of: (3 k,) index in `edges` of each of `directed`.
    """

    def __init__(self, triangles: Indices) -> None:
        self.directed = directed_edges(triangles)
        start, end = self.directed.T
        self.edges, self.counts, self.edge_of = distinct_rows(
            np.stack([np.minimum(start, end), np.maximum(start, end)], axis=1)
        )


def find_open_edges(triangles: Indices) -> Indices:
    """Indices in `directed_edges` of the edges that belong to one triangle only."""
    table = EdgeTable(triangles)
    return np.flatnonzero(table.counts[table.edge_of] == 1)


def _is_first_copy(triangles: Indices) -> Mask:
    """(k,) whether each triangle is the first with its three corners, whatever its orientation."""
    _, _, inverse = distinct_rows(np.sort(triangles, axis=1))
    first = np.zeros(len(triangles), bool)
    first[np.unique(inverse, return_index=True)[1]] = True
    return first


def _divide_t_junctions(points: Points, triangles: Indices, distance: float) -> tuple[Indices, int, bool]:
    """Triangles divided at nodes of others on their open edges; number of divided edges; whether edges are open yet.

    `distance`: of a node from the edge, over the size of the surface.
    """
    total = 0
    length = distance * float(np.ptp(points, axis=0).max())
    for _ in range(MENDING.max_rounds):
        open_ = find_open_edges(triangles)
        if not 0 < len(open_) <= MENDING.max_open_edges:
            return triangles, total, len(open_) > 0
        splits = _nodes_on_edges(points, directed_edges(triangles)[open_], length)
        new, replaced = [], np.zeros(len(triangles), bool)
        for edge, nodes in zip(open_, splits, strict=True):
            number, side = divmod(int(edge), 3)
            if not nodes or replaced[number]:
                continue
            # a fan from the opposite corner to the pieces of the edge
            a, b, c = (int(node) for node in np.roll(triangles[number], -side))
            chain = [a, *nodes, b]
            if c not in nodes:
                new += [[first, second, c] for first, second in pairwise(chain)]
                replaced[number] = True
        if not new:
            return triangles, total, True
        total += int(replaced.sum())
        triangles = np.concatenate([triangles[~replaced], np.array(new, np.int64)])
        triangles = triangles[_is_first_copy(triangles)]
    return triangles, total, len(find_open_edges(triangles)) > 0


def _nodes_on_edges(points: Points, edges: Indices, length: float) -> list[list[int]]:
    """For each open edge the nodes of other open edges that lie on it within a length [m], in its direction."""
    from scipy.spatial import cKDTree

    nodes = np.unique(edges)
    tree = cKDTree(points[nodes])
    on_edges = []
    for a, b in edges:
        span = points[b] - points[a]
        size = float(np.linalg.norm(span))
        near = nodes[tree.query_ball_point((points[a] + points[b]) / 2, size / 2 + length)]
        along = (points[near] - points[a]) @ span / size
        off = np.linalg.norm(points[near] - points[a] - np.outer(along / size, span), axis=1)
        on = (off <= length) & (along > length) & (along < size - length)
        on_edges.append(near[on][np.argsort(along[on])].tolist())
    return on_edges
