"""Directions that a user gives, and frames about them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ...errors import InputError

Values = npt.NDArray[np.float64]


def unit(direction: tuple[float, ...]) -> Values:
    """(d,) the direction, of length 1; InputError where it is none."""
    vector = np.array(direction, float)
    length = float(np.linalg.norm(vector))
    if len(vector) not in (2, 3) or not 0 < length < np.inf:
        raise InputError(f"{direction} is no direction: give 2 or 3 numbers that are not all zero")
    return np.asarray(vector / length)


def frame(axis: Values) -> Values:
    """(d, d) a rotation whose last column is the unit vector `axis` (d,)."""
    if len(axis) == 2:
        return np.array([[axis[1], axis[0]], [-axis[0], axis[1]]])
    across = np.cross(np.eye(3)[np.argmin(abs(axis))], axis)
    across /= np.linalg.norm(across)
    return np.column_stack([across, np.cross(axis, across), axis])
