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
    if not len(old) or not len(new):
        return np.full(len(old), -1)
    old_keys, new_keys = _row_keys(old), _row_keys(new)
    order = np.argsort(new_keys, kind="stable")
    insertion = np.minimum(np.searchsorted(new_keys[order], old_keys), len(new) - 1)
    match = order[insertion]
    same_key = new_keys[match] == old_keys
    is_equal = same_key & (new[match] == old).all(axis=1)
    if not np.array_equal(is_equal, same_key):  # two rows with one key
        return _match_sorted(old, new)
    return np.where(is_equal, match, -1)


def _row_keys(rows: Values) -> Ints:
    """(n,) integers that are equal for equal rows (n, w) of whole numbers, and hardly ever for others."""
    factors = np.random.default_rng(1).integers(-(2**62), 2**62, rows.shape[1]) | 1
    return np.asarray(rows.astype(np.int64) @ factors)  # modulo 2^64


def _match_sorted(old: Values, new: Values) -> Ints:
    """`match_points` by sorting whole rows."""
    rows = np.concatenate([new, old])
    _, first, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    match = first[inverse.reshape(-1)[len(new) :]]
    return np.where(match < len(new), match, -1)
