"""The surface of what holds together: pieces apart, and of nodes alone that still have a whole cell.

Where a soft body tears, most of its walls are those of cracks within a piece, of crumbs without a cell, and of nodes
that hang by a few torn ones: on a loaf of 25,000 cells nine in ten. Contact may do without them. What is left is cut
flat (flat): a quarter of the elements, a third of what contact takes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from ..simplices import is_split
from .build import Split, split
from .flat import flat_table
from .skeleton import Skeleton

Flags = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Patterns = npt.NDArray[np.integer]
KEPT = 0.15  # of an edge


def split_of_pieces(skeleton: Skeleton, pattern: Patterns, cut: Values | None = None) -> Split:
    """The split surface of damage patterns (C,) without the elements of loose nodes, which have no whole cell, and
    without walls between nodes of one piece: edges are open that join other pieces, or lead to loose nodes. `cut`: (E,)
    as for `split`, but no nearer to an end than KEPT: what is thinner has no room for contact."""
    apart, loose, _ = parted(skeleton, pattern)
    cut = None if cut is None else np.clip(cut, KEPT, 1 - KEPT)
    made = split(skeleton, patterns_of(skeleton, apart), cut, flat_table)
    kept = ~loose[made.follow.first_parent[made.elements[:, 0]]]  # all corners of an element follow the same side
    each = {name: getattr(made, name)[kept] for name in ("elements", "cell", "edge", "origin")}
    return replace(made, **each)


def is_same_solid(skeleton: Skeleton, pattern: Patterns, before: Patterns) -> bool:
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


def parted(skeleton: Skeleton, pattern: Patterns) -> tuple[Flags, Flags, Ints]:
    """(E,) open edges, (N,) loose nodes, and what (N,) holds together without edges that are broken or lead there."""
    loose = np.ones(len(skeleton.points), bool)
    loose[skeleton.cells[pattern == 0]] = False
    ends = skeleton.edges
    cut = skeleton.broken_edges(pattern) | loose[ends].any(axis=1)
    _, piece = skeleton.pieces(cut)
    return cut & (piece[ends[:, 0]] != piece[ends[:, 1]]), loose, piece


def patterns_of(skeleton: Skeleton, broken: Flags) -> Patterns:
    """(C,) patterns of the cells with `broken` (E,) edges."""
    bits = np.arange(skeleton.cell_edges.shape[1])
    return np.asarray((broken[skeleton.cell_edges] << bits).sum(axis=1), np.uint8)
