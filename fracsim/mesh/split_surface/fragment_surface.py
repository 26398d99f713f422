"""The surface of what holds together: pieces apart, and of nodes alone that still have a whole cell.

Where a soft body tears, most of its walls are those of cracks within a piece, of crumbs without a cell, and of nodes
that hang by a few torn ones: on a loaf of 25,000 cells nine in ten. Contact may do without them. What is left is cut
flat (cut_patterns): a quarter of the elements, a third of what contact takes.

Walls between pieces, drawn where those lie that are cut flat: what contact keeps apart does not overlap in a
picture.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix, eye_array

from ..simplices import is_split, local_edges
from .closed_surface import SplitSurface, SurfacePoints, build_split_surface, build_surface_points
from .cut_patterns import EDGE, FACET, middles, planar_cut_table
from .entity_numbering import EntityNumbering
from .surface_map import SurfaceMap, whole

Flags = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Patterns = npt.NDArray[np.integer]
KEPT = 0.15  # of an edge


def build_fragment_surface(skeleton: EntityNumbering, pattern: Patterns, cut: Values | None = None) -> SplitSurface:
    """The split surface of damage patterns (C,) without the elements of loose nodes, which have no whole cell, and
    without walls between nodes of one piece: edges are open that join other pieces, or lead to loose nodes. `cut`: (E,)
    as for `split`, but no nearer to an end than KEPT: what is thinner has no room for contact."""
    apart, loose, _ = parted(skeleton, pattern)
    cut = None if cut is None else np.clip(cut, KEPT, 1 - KEPT)
    made = build_split_surface(skeleton, patterns_of(skeleton, apart), cut, planar_cut_table)
    kept = ~loose[made.parents.first_parent[made.elements[:, 0]]]  # all corners of an element follow the same side
    each = {name: getattr(made, name)[kept] for name in ("elements", "cell", "edge", "origin")}
    return replace(made, **each)


def has_same_fragments(skeleton: EntityNumbering, pattern: Patterns, before: Patterns) -> bool:
    """Whether damage patterns (C,) of now and of before have the same surface of pieces, and the same cells say how it
    moves with its nodes: cracks within a piece change neither."""
    apart, loose, _ = parted(skeleton, pattern)
    if not all(np.array_equal(now, then) for now, then in zip((apart, loose), parted(skeleton, before), strict=False)):
        return False
    ends = np.zeros(len(skeleton.points), bool)
    ends[skeleton.edges[apart]] = True
    at = ends[skeleton.cells].any(axis=1)
    gone = is_split(skeleton.dim)
    return np.array_equal(gone[pattern[at]], gone[before[at]])


def parted(skeleton: EntityNumbering, pattern: Patterns) -> tuple[Flags, Flags, Ints]:
    """(E,) open edges, (N,) loose nodes, and what (N,) holds together without edges that are broken or lead there."""
    loose = np.ones(len(skeleton.points), bool)
    loose[skeleton.cells[pattern == 0]] = False
    ends = skeleton.edges
    cut = skeleton.broken_edges(pattern) | loose[ends].any(axis=1)
    _, piece = skeleton.pieces(cut)
    return cut & (piece[ends[:, 0]] != piece[ends[:, 1]]), loose, piece


def patterns_of(skeleton: EntityNumbering, broken: Flags) -> Patterns:
    """(C,) patterns of the cells with `broken` (E,) edges."""
    bits = np.arange(skeleton.cell_edges.shape[1])
    return np.asarray((broken[skeleton.cell_edges] << bits).sum(axis=1), np.uint8)


def project_onto_fragments(
    at: SurfaceMap, skeleton: EntityNumbering, pattern: npt.NDArray[np.integer], flat: SurfaceMap
) -> SurfaceMap:
    """The points of `split` with those on walls between pieces where `flat` has those of `split_of_pieces`.

    Where a crack within the piece has come to one its sides are there at rest, and go with their own nodes from then
    on. Nodes without a whole cell keep their walls.
    """
    drawn = build_surface_points(skeleton, pattern)
    points, mean, cracked = _on_flat(skeleton, pattern, drawn)
    at = at.projected_onto(points[~cracked], mean[~cracked], flat)
    if not cracked.any():
        return at
    places, beside = drawn.positions.copy(), points[cracked]
    places[beside] = mean[cracked] @ flat.rest
    return at.projected_onto(
        beside, eye_array(len(places), format="csr")[beside], whole(drawn, skeleton, pattern, places)
    )


def _on_flat(
    skeleton: EntityNumbering, pattern: npt.NDArray[np.integer], drawn: SurfacePoints
) -> tuple[Ints, csr_matrix, Flags]:
    """Numbers (k,) of the points `drawn` on walls between pieces, rows (k, m) of which points of the flat surface each
    is the mean, and flags (k,) of those beside a crack within the piece."""
    apart, loose, piece = parted(skeleton, pattern)
    flat = build_surface_points(skeleton, patterns_of(skeleton, apart), planar_cut_table)
    node = skeleton.cells[drawn.cell]
    lead = node[np.arange(len(node)), drawn.group.argmax(axis=1)]
    own = np.where(loose[node], -1, piece[node]) == piece[lead][:, None]
    within = _within(drawn, skeleton.dim)
    mine, others = within & own, within & ~own
    at = np.flatnonzero(others.any(axis=1) & ~loose[lead])
    bits = 1 << np.arange(skeleton.dim + 1)
    share = middles(skeleton.dim)[mine[at] @ bits, others[at] @ bits]
    row, i, j = np.nonzero(share)
    ends = np.stack([node[at[row], i], node[at[row], j]], axis=1)
    column = flat.first + np.searchsorted(_keys(skeleton, flat), _key(skeleton, ends))
    shape = len(at), len(flat.positions)
    cracked = (drawn.group != mine)[at].any(axis=1)
    return drawn.first + at, csr_matrix((share[row, i, j], (row, column)), shape=shape), cracked


def _within(points: SurfacePoints, dim: int) -> Flags:
    """(copies, d + 1) nodes of the cell that the edge, facet or cell has of which a point is the middle."""
    result = np.ones(points.group.shape, bool)
    at = np.flatnonzero(points.kind == FACET)
    result[at, points.entity[at]] = False
    at = np.flatnonzero(points.kind == EDGE)
    result[at] = False
    result[at[:, None], local_edges(dim)[points.entity[at]]] = True
    return result


def _keys(skeleton: EntityNumbering, flat: SurfacePoints) -> Ints:
    """(copies,) that of each point, all on edges: ascending, as they are numbered."""
    edge = skeleton.cell_edges[flat.cell, flat.entity]
    end = skeleton.cells[flat.cell, flat.group.argmax(axis=1)]
    return np.asarray(2 * edge + (end == skeleton.edges[edge, 1]))


def _key(skeleton: EntityNumbering, ends: Ints) -> Ints:
    """(k,) of the points of the edges between nodes (k, 2) that follow the first of them."""
    edge = skeleton.find_edges(ends)
    return np.asarray(2 * edge + (ends[:, 0] == skeleton.edges[edge, 1]))
