"""Identification of the points of a split surface before and after edges break."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from .closed_surface import SplitSurface

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


def point_identity(surface: SplitSurface, which: Ints, number: Ints, size: float) -> Values:
    """(k, 2 d + 1) rows that identify the points `which` (k,): position, and numbers of parents, descending, then -1.

    `number`: (nodes,) numbers of nodes; with those of the input mesh, rows are equal on all ranks. A copy at the same
    position whose group has lost nodes is another point. Positions are rounded relative to the `size` (m)
    of the body.
    """
    d, follow = surface.points.shape[1], surface.parents
    count = np.diff(follow.start)[which]
    rows = np.repeat(np.arange(len(which)), count)
    within = np.arange(len(rows)) - np.repeat(np.cumsum(count) - count, count)
    parents = np.full((len(which), d + 1), -1)
    parents[rows, within] = number[follow.parents[np.repeat(follow.start[:-1][which], count) + within]]
    # an irregular step, so that no point of a regular mesh lies half-way between two rounded positions
    position = np.rint(surface.points[which] / (7.31e-9 * size))
    return np.concatenate([position, -np.sort(-parents, axis=1)], axis=1)


def match_points(old: Values, new: Values) -> Ints:
    """(k,) the index in `new` (n, w) of each row of `old` (k, w); -1 if there is none."""
    if not len(old):
        return np.empty(0, np.int64)
    # column of the first parent
    lead = new.shape[1] // 2
    near = np.flatnonzero(np.isin(new[:, lead], old[:, lead]))
    rows = np.concatenate([new[near], old])
    _, first, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    match = first[inverse.reshape(-1)[len(near) :]]
    result = np.full(len(old), -1)
    result[match < len(near)] = near[match[match < len(near)]]
    return result
