"""Points of the split surface that are the same before and after edges broke."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from .closed_surface import SplitSurface

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]

GRID = 7.31e-9  # no mesh has its points half-way between two of its steps


def point_identity(made: SplitSurface, which: Ints, number: Ints, size: float) -> Values:
    """(k, 2 d + 1) rows of the points `which` (k,): the place of each, and the `number` (nodes,) of its parents,
    descending, then -1.

    A copy at the same place whose group has lost nodes is another point. Places are in steps of GRID of the
    body's `size`, m: with numbers of the input mesh rows are the same on all ranks.
    """
    d, follow = made.points.shape[1], made.parents
    count = np.diff(follow.start)[which]
    rows = np.repeat(np.arange(len(which)), count)
    within = np.arange(len(rows)) - np.repeat(np.cumsum(count) - count, count)
    parents = np.full((len(which), d + 1), -1)
    parents[rows, within] = number[follow.parents[np.repeat(follow.start[:-1][which], count) + within]]
    return np.concatenate([np.rint(made.points[which] / (GRID * size)), -np.sort(-parents, axis=1)], axis=1)


def match_points(old: Values, new: Values) -> Ints:
    """(k,) which of the rows `new` (n, w) each of the rows `old` (k, w) is; -1: none."""
    if not len(old):
        return np.empty(0, np.int64)
    lead = new.shape[1] // 2  # of the first parent
    near = np.flatnonzero(np.isin(new[:, lead], old[:, lead]))
    both = np.concatenate([new[near], old])
    _, first, place = np.unique(both, axis=0, return_index=True, return_inverse=True)
    at = first[place.reshape(-1)[len(near) :]]
    result = np.full(len(old), -1)
    result[at < len(near)] = near[at[at < len(near)]]
    return result
