"""The least of a quadratic over shares: a step of Newton's method to the deepest place of a facet."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[np.float64]


def least_over_shares(Q: Values, slope: Values, share: Values) -> Values:
    """(k, c) shares m where slope . (m - l) + (m - l) . Q (m - l) / 2 is least, m >= 0, sum m = 1, l = `share` (k, c);
    of segments (c = 2) or triangles (c = 3), Q (k, c, c) positive definite for changes that sum to 0.

    Inside, if the least of all changes is there; else on that side where it is lowest.
    """
    c = share.shape[1]
    b = slope - np.einsum("kce,ke->kc", Q, share)
    first = np.arange(c if c == 3 else 1)
    last = (first + 1) % c
    ends, across = np.einsum("kcc->kc", Q), Q[:, first, last]
    fall = across - ends[:, first] + b[:, last] - b[:, first]
    bent = ends[:, first] + ends[:, last] - 2 * across
    t = np.clip(np.divide(-fall, bent, out=np.zeros_like(fall), where=bent > 0), 0.0, 1.0)
    value = ends[:, first] / 2 + b[:, first] + t * (fall + t * bent / 2)
    best, every = value.argmin(axis=1), np.arange(len(value))
    least = np.zeros_like(share)
    least[every, first[best]], least[every, last[best]] = 1 - t[every, best], t[every, best]
    if c == 2:
        return least
    # from the first corner along the sides to the others
    mixed = ends[:, 0] - across[:, 0] - across[:, 2] + across[:, 1]
    back = across[:, 2] - ends[:, 0] + b[:, 2] - b[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        det = bent[:, 0] * bent[:, 2] - mixed**2
        m1 = (mixed * back - bent[:, 2] * fall[:, 0]) / det
        m2 = (mixed * fall[:, 0] - bent[:, 0] * back) / det
        inner = np.stack([1 - m1 - m2, m1, m2], axis=1)
    return np.where(np.all(inner > 0, axis=1, keepdims=True), inner, least)
