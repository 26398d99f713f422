"""Walls between pieces, drawn where those lie that are cut flat: what contact keeps apart does not overlap in a
picture."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix, eye_array

from ..simplices import local_edges
from .build import points_of
from .flat import flat_table, middles
from .places import Places, whole
from .points import SurfacePoints
from .skeleton import Skeleton
from .solid import parted, patterns_of
from .table import EDGE, FACET

Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


def laid(at: Places, skeleton: Skeleton, pattern: npt.NDArray[np.integer], flat: Places) -> Places:
    """The points of `split` with those on walls between pieces where `flat` has those of `split_of_pieces`.

    Where a crack within the piece has come to one its sides are there at rest, and go with their own nodes from then
    on. Nodes without a whole cell keep their walls.
    """
    drawn = points_of(skeleton, pattern)
    points, mean, cracked = _on_flat(skeleton, pattern, drawn)
    at = at.laid_on(points[~cracked], mean[~cracked], flat)
    if not cracked.any():
        return at
    places, beside = drawn.positions.copy(), points[cracked]
    places[beside] = mean[cracked] @ flat.rest
    return at.laid_on(beside, eye_array(len(places), format="csr")[beside], whole(drawn, skeleton, pattern, places))


def _on_flat(
    skeleton: Skeleton, pattern: npt.NDArray[np.integer], drawn: SurfacePoints
) -> tuple[Ints, csr_matrix, Flags]:
    """Numbers (k,) of the points `drawn` on walls between pieces, rows (k, m) of which points of the flat surface each
    is the mean, and flags (k,) of those beside a crack within the piece."""
    apart, loose, piece = parted(skeleton, pattern)
    flat = points_of(skeleton, patterns_of(skeleton, apart), flat_table)
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


def _keys(skeleton: Skeleton, flat: SurfacePoints) -> Ints:
    """(copies,) that of each point, all on edges: ascending, as they are numbered."""
    edge = skeleton.cell_edges[flat.cell, flat.entity]
    end = skeleton.cells[flat.cell, flat.group.argmax(axis=1)]
    return np.asarray(2 * edge + (end == skeleton.edges[edge, 1]))


def _key(skeleton: Skeleton, ends: Ints) -> Ints:
    """(k,) of the points of the edges between nodes (k, 2) that follow the first of them."""
    edge = skeleton.find_edges(ends)
    return np.asarray(2 * edge + (ends[:, 0] == skeleton.edges[edge, 1]))
