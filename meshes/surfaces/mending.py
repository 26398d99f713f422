"""Faults of triangle surfaces that are mended without a change of the shape: each with a note.

Points that are almost at the same place are joined; triangles that are given twice or have no area are left out; an
edge with nodes of other triangles on it (a T junction) is divided there. What is open then is refused by `closed`.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ..data import Indices, Points
from ..topology import Floats, Mask, components, distinct_rows

JOINED = 1e-6  # points nearer than this share of the surface's size are one
JOINED_OPEN = 2e-5  # the same where a surface is open otherwise, and no triangle collapses by it
FLAT = 1e-7  # share of the surface's size; triangles of a lesser height have no area
MAX_OPEN_EDGES = 20_000  # of a surface that is looked at for T junctions
HASH_FACTOR = np.uint64(0x9E3779B97F4A7C15)  # of multiplicative hashing: 2^64 over the golden ratio (D. E. Knuth)
MAX_ROUNDS = 50  # of dividing triangles at T junctions: one edge of a triangle a round


class Mended(NamedTuple):
    """A surface that has been mended.

    Attributes:
        points: (n, 3) [m].    triangles: (k, 3).    notes: one for each kind of fault.
        is_open: whether edges belong to one triangle only.
        may_be_flat: whether there may be triangles without an area.
    """

    points: Points
    triangles: Indices
    notes: tuple[str, ...]
    is_open: bool
    may_be_flat: bool


def mended(points: Points, triangles: Indices) -> Mended:
    """A surface that is to be closed, mended."""
    first = _mended(points, triangles, JOINED)
    if not first.is_open:
        return first
    wider, before = joined(points, triangles, JOINED_OPEN), joined(points, triangles, JOINED)
    if len(wider[0]) == len(before[0]) or len(wider[1]) < len(before[1]):
        return first
    second = _mended(points, triangles, JOINED_OPEN)
    if second.is_open:
        return first
    note = (
        f"{len(before[0]) - len(wider[0])} points of the surface within {JOINED_OPEN:g} of its size of another point "
        "were joined: it was open there."
    )
    return second._replace(notes=(note, *second.notes))


def mend_open_surface(points: Points, triangles: Indices) -> Mended:
    """The same of a surface that may be open: triangles given twice are taken once in any case."""
    return _mended(points, triangles, JOINED, sheet=True)


def _mended(points: Points, triangles: Indices, reach: float, copies: bool = False, sheet: bool = False) -> Mended:
    """The same with a given reach of points that are one, as a share of the size; `copies`: kept."""
    original = points, triangles
    points, triangles = joined(points, triangles, reach)
    notes = []
    once = _once(triangles) | copies
    if not once.all():
        notes.append(f"{int((~once).sum())} surface triangles were given more than once, and are taken once.")
    flat = has_no_area(points, triangles)
    if flat.all():  # for `closed` to refuse
        return Mended(points, triangles, (), False, True)
    if flat.any():
        notes.append(f"{int(flat.sum())} surface triangles without an area were left out.")
    retained = once & ~flat
    triangles, divided, is_open = _divided(points, triangles if retained.all() else triangles[retained], reach)
    if is_open and not once.all() and not sheet:
        return _mended(*original, reach, copies=True)  # open without them: sheets of no thickness
    if divided:
        notes.append(f"{divided} edges of the surface had corners of other triangles on them and were divided there.")
    return Mended(points, triangles, tuple(notes), is_open, divided > 0)


def joined(points: Points, triangles: Indices, reach: float = JOINED) -> tuple[Points, Indices]:
    """Points at the same place made one (STL repeats every corner); triangles that collapse thereby are left out."""
    points, triangles = _without_unused_points(points, triangles)
    points, number = _distinct_points(points)
    triangles = number[triangles]
    length = reach * float(np.ptp(points, axis=0).max())
    if _may_be_near(points, length):
        from scipy.spatial import cKDTree  # as in components: not needed to fill what has been read

        pairs = cKDTree(points).query_pairs(length, output_type="ndarray")
        _, cluster = components(pairs, len(points))
        points = points[np.unique(cluster, return_index=True)[1]]
        triangles = cluster[triangles]
    a, b, c = triangles.T
    whole = (a != b) & (b != c) & (c != a)
    return points, (triangles if whole.all() else triangles[whole]).astype(np.int64, copy=False)


def _without_unused_points(points: Points, triangles: Indices) -> tuple[Points, Indices]:
    """The points that triangles name, and the triangles with the numbers of these."""
    used = np.zeros(len(points), bool)
    used[triangles] = True
    if used.all():
        return points, triangles
    return points[used], (np.cumsum(used) - 1)[triangles]


def _distinct_points(points: Points) -> tuple[Points, Indices]:
    """Different points in rising order of their coordinates, and the place of each given one among them.

    Equal points have equal hashes: one sort of integers in place of a sort of rows of three numbers.
    """
    points = points + 0.0  # one zero, not two
    hashes = _hashes(points.view(np.int64))
    order = np.argsort(hashes)
    ranked = hashes[order]
    first = np.concatenate([[True], ranked[1:] != ranked[:-1]])
    representative = order[first]
    group = np.empty(len(points), np.int64)
    group[order] = np.cumsum(first) - 1
    distinct = points[representative]
    if not np.array_equal(distinct[group], points):  # different points of the same hash
        distinct, positions = np.unique(points, axis=0, return_inverse=True)
        return distinct, positions.ravel().astype(np.int64)
    rising = np.lexsort(distinct.T[::-1])
    position = np.empty(len(rising), np.int64)
    position[rising] = np.arange(len(rising))
    return distinct[rising], position[group]


def _hashes(rows: Indices) -> Indices:
    """An integer for each row (n, w) of integers: the same for equal rows, another one for almost all others."""
    hashes = np.zeros(len(rows), np.uint64)
    for column in rows.T:
        hashes = (hashes ^ column.view(np.uint64)) * HASH_FACTOR
        hashes ^= hashes >> np.uint64(29)
    return hashes.view(np.int64)


def _may_be_near(points: Points, length: float) -> bool:
    """Whether two points may be nearer than a length: False is certain.

    Two points that are have the same cell in one of four lattices of 8 lengths that are shifted by a quarter of a
    cell: a coordinate parts them in one of the four at most.
    """
    cells = (points - points.min(axis=0)) / (8 * length) if length > 0 else points
    for shift in range(4):
        numbers = np.sort(_hashes((cells + shift / 4).astype(np.int64)))
        if (numbers[1:] == numbers[:-1]).any():
            return True
    return False


def areas(points: Points, triangles: Indices) -> Floats:
    """(k,) areas [m^2]."""
    a, b, c = (points[column] for column in triangles.T)
    normals = np.cross(b - a, c - a)
    return np.asarray(np.sqrt(np.einsum("ki,ki->k", normals, normals)) / 2)


def has_no_area(points: Points, triangles: Indices) -> Mask:
    """(k,) whether each has no area: coordinates of single precision move a corner by up to 6e-8 of the size."""
    a, b, c = (points[column] for column in triangles.T)
    squares = [np.einsum("ki,ki->k", side, side) for side in (b - a, c - b, a - c)]
    longest = np.sqrt(np.maximum(np.maximum(squares[0], squares[1]), squares[2]))
    return areas(points, triangles) <= FLAT * float(np.ptp(points, axis=0).max()) * longest / 2


class EdgeTable:
    """The edges of triangles (k, 3), sorted once for all that asks for them.

    Attributes:
        directed: (3 k, 2) the edges of each triangle in its direction.
        edges: (m, 2) each edge once, the lower node first.    counts: (m,) the number of triangles at it.
        place: (3 k,) the edge of each of `directed`.
    """

    def __init__(self, triangles: Indices) -> None:
        self.directed = directed_edges(triangles)
        start, end = self.directed.T
        self.edges, self.counts, self.place = distinct_rows(
            np.stack([np.minimum(start, end), np.maximum(start, end)], axis=1)
        )


def directed_edges(triangles: Indices) -> Indices:
    """Edges in the direction of their triangle, three rows for each triangle: (3 k, 2)."""
    return np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2)


def find_open_edges(triangles: Indices) -> Indices:
    """Places in `directed_edges` of the edges of one triangle only."""
    table = EdgeTable(triangles)
    return np.flatnonzero(table.counts[table.place] == 1)


def _once(triangles: Indices) -> Mask:
    """(k,) whether each is the first with its three corners, whichever way it faces."""
    _, _, inverse = distinct_rows(np.sort(triangles, axis=1))
    first = np.zeros(len(triangles), bool)
    first[np.unique(inverse, return_index=True)[1]] = True
    return first


def _divided(points: Points, triangles: Indices, reach: float) -> tuple[Indices, int, bool]:
    """Triangles divided at the corners of others that lie on their open edges, how many edges were, and whether the
    surface is open then."""
    total = 0
    length = reach * float(np.ptp(points, axis=0).max())
    for _ in range(MAX_ROUNDS):
        positions = find_open_edges(triangles)
        if not 0 < len(positions) <= MAX_OPEN_EDGES:
            return triangles, total, len(positions) > 0
        splits = _nodes_on_edges(points, directed_edges(triangles)[positions], length)
        new, replaced = [], np.zeros(len(triangles), bool)
        for position, nodes in zip(positions, splits, strict=True):
            number, side = divmod(int(position), 3)
            if not nodes or replaced[number]:
                continue
            a, b, c = (int(node) for node in np.roll(triangles[number], -side))
            chain = [a, *nodes, b]
            if c not in nodes:
                new += [[first, second, c] for first, second in pairwise(chain)]
                replaced[number] = True
        if not new:
            return triangles, total, True
        total += int(replaced.sum())
        triangles = np.concatenate([triangles[~replaced], np.array(new, np.int64)])
        triangles = triangles[_once(triangles)]
    return triangles, total, len(find_open_edges(triangles)) > 0


def _nodes_on_edges(points: Points, edges: Indices, length: float) -> list[list[int]]:
    """For each open edge the ends of other open edges that lie on it, within a length, in its direction."""
    from scipy.spatial import cKDTree

    nodes = np.unique(edges)
    tree = cKDTree(points[nodes])
    result = []
    for a, b in edges:
        span = points[b] - points[a]
        size = float(np.linalg.norm(span))
        near = nodes[tree.query_ball_point((points[a] + points[b]) / 2, size / 2 + length)]
        along = (points[near] - points[a]) @ span / size
        off = np.linalg.norm(points[near] - points[a] - np.outer(along / size, span), axis=1)
        on = (off <= length) & (along > length) & (along < size - length)
        result.append(near[on][np.argsort(along[on])].tolist())
    return result
