"""Rotation vectors that are not small: how a turn by w (rad, axes of space) answers to a change of w.

    exp(w + dw) = exp(J(w) dw) exp(w) to first order,   J = 1 + a W + b W^2,  W y = w x y,
    a = (1 - cos s) / s^2,  b = (s - sin s) / s^3,  s = |w|

(the left Jacobian of SO(3); J. Sola et al., A micro Lie theory for state estimation in robotics, arXiv:1812.01537, eq.
145). In 2D J = 1.
"""

from __future__ import annotations

from math import factorial

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[np.float64]

# a, b, a'/s, b'/s as power series in s^2: exact to round-off up to a whole turn, and at s = 0 as well
_POWERS = range(24)
_A, _B = ([(-1.0) ** k / factorial(2 * k + extra) for k in _POWERS] for extra in (2, 3))
_A_SLOPE, _B_SLOPE = ([2 * (k + 1) * series[k + 1] for k in _POWERS[:-1]] for series in (_A, _B))


def jacobian(w: Values) -> Values:
    """(r, r) J(w), r = 1 or 3 numbers of a turn."""
    if len(w) == 1:
        return np.ones((1, 1))
    W = _cross(w)
    result: Values = np.eye(3) + _sum(_A, w) * W + _sum(_B, w) * W @ W
    return result


def bend(w: Values, moment: Values) -> Values:
    """(r, r) symmetric part of the derivative of J(w)^T m by w, the moment m (r,) held."""
    if len(w) == 1:
        return np.zeros((1, 1))
    across, along = np.cross(w, moment), float(w @ moment)
    steep = -_sum(_A_SLOPE, w) * across + _sum(_B_SLOPE, w) * np.cross(w, across)
    found = _sum(_B, w) * (along * np.eye(3) - np.outer(w, moment)) + np.outer(steep, w)
    return np.asarray(found + found.T) / 2


def _sum(series: list[float], w: Values) -> float:
    return float(np.polynomial.polynomial.polyval(float(w @ w), series))


def _cross(w: Values) -> Values:
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
