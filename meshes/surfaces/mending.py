"""Faults of triangle surfaces that are mended without a change of the shape: each with a note.

Points that are almost at the same place are joined; triangles that are given twice or have no area are left out; an
edge with nodes of other triangles on it (a T junction) is divided there. What is open then is refused by `closed`.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from ..components import components
from ..data import Indices, Points
from ..topology import Floats, Mask, distinct_rows

JOINED = 1e-6  # points nearer than this share of the surface's size are one
JOINED_OPEN = 2e-5  # the same where a surface is open otherwise, and no triangle collapses by it
FLAT = 1e-7  # share of the surface's size; triangles of a lesser height have no area
MAX_OPEN_EDGES = 20_000  # of a surface that is looked at for T junctions
MAX_ROUNDS = 50  # of dividing triangles at T junctions: one edge of a triangle a round


def mended(points: Points, triangles: Indices) -> tuple[Points, Indices, tuple[str, ...]]:
    """Points and triangles of a surface, mended, and a note for each kind of fault."""
    first = _mended(points, triangles, JOINED)
    if not len(open_edges(first[1])):
        return first
    wider, before = joined(points, triangles, JOINED_OPEN), joined(points, triangles, JOINED)
    if len(wider[0]) == len(before[0]) or len(wider[1]) < len(before[1]):
        return first
    second = _mended(points, triangles, JOINED_OPEN)
    if len(open_edges(second[1])):
        return first
    note = (
        f"{len(before[0]) - len(wider[0])} points of the surface within {JOINED_OPEN:g} of its size of another point "
        "were joined: it was open there."
    )
    return second[0], second[1], (note, *second[2])


def mended_sheet(points: Points, triangles: Indices) -> tuple[Points, Indices, tuple[str, ...]]:
    """The same of a surface that may be open: triangles given twice are taken once in any case."""
    return _mended(points, triangles, JOINED, sheet=True)


def _mended(
    points: Points, triangles: Indices, reach: float, copies: bool = False, sheet: bool = False
) -> tuple[Points, Indices, tuple[str, ...]]:
    """The same with a given reach of points that are one, as a share of the size; `copies`: kept."""
    given = points, triangles
    points, triangles = joined(points, triangles, reach)
    notes = []
    once = _once(triangles) | copies
    if not once.all():
        notes.append(f"{int((~once).sum())} surface triangles were given more than once, and are taken once.")
    flat = flat_triangles(points, triangles)
    if flat.all():  # for `closed` to refuse
        return points, triangles, ()
    if flat.any():
        notes.append(f"{int(flat.sum())} surface triangles without an area were left out.")
    triangles, divided = _divided(points, triangles[once & ~flat], reach)
    if len(open_edges(triangles)) and not once.all() and not sheet:
        return _mended(*given, reach, copies=True)  # open without them: sheets of no thickness
    if divided:
        notes.append(f"{divided} edges of the surface had corners of other triangles on them and were divided there.")
    return points, triangles, tuple(notes)


def joined(points: Points, triangles: Indices, reach: float = JOINED) -> tuple[Points, Indices]:
    """Points at the same place made one (STL repeats every corner); triangles that collapse thereby are left out."""
    from scipy.spatial import cKDTree  # as in components: not needed to fill what has been read

    used, triangles = np.unique(triangles, return_inverse=True)
    points, triangles = points[used], triangles.reshape(-1, 3)
    points, number = np.unique(points, axis=0, return_inverse=True)
    length = reach * float(np.ptp(points, axis=0).max())
    pairs = cKDTree(points).query_pairs(length, output_type="ndarray")
    _, cluster = components(pairs, len(points))
    first = np.unique(cluster, return_index=True)[1]
    triangles = cluster[number.ravel()[triangles]]
    whole = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
    return points[first], triangles[whole].astype(np.int64)


def areas(points: Points, triangles: Indices) -> Floats:
    """(k,) areas [m^2]."""
    spans = points[triangles[:, 1:]] - points[triangles[:, :1]]
    return np.linalg.norm(np.cross(spans[:, 0], spans[:, 1]), axis=1) / 2


def flat_triangles(points: Points, triangles: Indices) -> Mask:
    """(k,) whether each has no area: coordinates of single precision move a corner by up to 6e-8 of the size."""
    longest = np.linalg.norm(points[triangles] - points[np.roll(triangles, 1, axis=1)], axis=2).max(axis=1, initial=0.0)
    return areas(points, triangles) <= FLAT * float(np.ptp(points, axis=0).max()) * longest / 2


def directed_edges(triangles: Indices) -> Indices:
    """Edges in the direction of their triangle, three rows for each triangle: (3 k, 2)."""
    return np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2)


def open_edges(triangles: Indices) -> Indices:
    """Places in `directed_edges` of the edges of one triangle only."""
    _, counts, place = distinct_rows(np.sort(directed_edges(triangles), axis=1))
    return np.flatnonzero(counts[place] == 1)


def _once(triangles: Indices) -> Mask:
    """(k,) whether each is the first with its three corners, whichever way it faces."""
    _, _, place = distinct_rows(np.sort(triangles, axis=1))
    first = np.zeros(len(triangles), bool)
    first[np.unique(place, return_index=True)[1]] = True
    return first


def _divided(points: Points, triangles: Indices, reach: float) -> tuple[Indices, int]:
    """Triangles divided at the corners of others that lie on their open edges, and how many edges were."""
    total = 0
    length = reach * float(np.ptp(points, axis=0).max())
    for _ in range(MAX_ROUNDS):
        places = open_edges(triangles)
        if not 0 < len(places) <= MAX_OPEN_EDGES:
            break
        splits = _nodes_on_edges(points, directed_edges(triangles)[places], length)
        new, replaced = [], np.zeros(len(triangles), bool)
        for place, nodes in zip(places, splits, strict=True):
            number, side = divmod(int(place), 3)
            if not nodes or replaced[number]:
                continue
            a, b, c = (int(node) for node in np.roll(triangles[number], -side))
            chain = [a, *nodes, b]
            if c not in nodes:
                new += [[one, other, c] for one, other in pairwise(chain)]
                replaced[number] = True
        if not new:
            break
        total += int(replaced.sum())
        triangles = np.concatenate([triangles[~replaced], np.array(new, np.int64)])
        triangles = triangles[_once(triangles)]
    return triangles, total


def _nodes_on_edges(points: Points, edges: Indices, length: float) -> list[list[int]]:
    """For each open edge the ends of other open edges that lie on it, within a length, in its direction."""
    from scipy.spatial import cKDTree

    nodes = np.unique(edges)
    tree = cKDTree(points[nodes])
    found = []
    for a, b in edges:
        span = points[b] - points[a]
        size = float(np.linalg.norm(span))
        near = nodes[tree.query_ball_point((points[a] + points[b]) / 2, size / 2 + length)]
        along = (points[near] - points[a]) @ span / size
        off = np.linalg.norm(points[near] - points[a] - np.outer(along / size, span), axis=1)
        on = (off <= length) & (along > length) & (along < size - length)
        found.append(near[on][np.argsort(along[on])].tolist())
    return found
