"""Functions of time: constants and tables of the study file as functions of t. No DOLFINx here."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import InputError
from ..meshes.words import AXES
from ..study import Boundary, TimeTable

Values = npt.NDArray[np.float64]
TimeFunction = Callable[[float], Values]


def in_time(value: Any, key: str, size: int) -> TimeFunction:
    """A constant or a table as a function of time that returns `size` numbers; "free" becomes nan."""
    table = value if isinstance(value, TimeTable) else TimeTable(time=[0.0], value=[value])
    times = np.asarray(table.time)
    rows = np.array([of_size(row if isinstance(row, list) else [row], size, key) for row in table.value])
    if np.any(np.isnan(rows) != np.isnan(rows[0])):
        raise InputError(f'{key}: a component that is "free" at one time must be free at all of them')
    return lambda t: np.array([np.interp(t, times, column) for column in rows.T])


def of_size(values: list[Any], size: int, key: str) -> Values:
    """A constant vector; InputError where it does not fit the dimension of the mesh. "free" becomes nan."""
    if len(values) != size:
        raise InputError(f"{key} = {values}: this mesh needs {size} number{'s'[: size != 1]}")
    return np.array([np.nan if value == "free" else float(value) for value in values])


def integral_in_time(value: Any, key: str, size: int) -> TimeFunction:
    """The integral from t = 0 of a constant or a table: exact, by trapezia between the corners of the table."""
    rate = in_time(value, key, size)
    corners = np.array(value.time) if isinstance(value, TimeTable) else np.empty(0)

    def integrated(t: float) -> Values:
        inner = corners[(corners > 0) & (corners < t)]
        knots = np.concatenate([[0.0], inner, [t]])
        rates = np.array([rate(knot) for knot in knots])
        return np.asarray(np.diff(knots) @ (rates[1:] + rates[:-1]) / 2)

    return integrated


def motion_function(boundary: Boundary, size: int, key: str) -> tuple[TimeFunction, npt.NDArray[np.bool_]]:
    """Displacement over time of a boundary entry, and which components it holds."""
    if boundary.fix is not None:
        held = np.array([axis in boundary.fix for axis in AXES[:size]])
        if beyond := set(boundary.fix) - set(AXES[:size]):
            raise InputError(f'{key}.fix = "{boundary.fix}": a {size}D mesh has no {min(beyond)}')
        return lambda t: np.zeros(size), held
    if boundary.displacement is not None:
        law = in_time(boundary.displacement, f"{key}.displacement", size)
    else:
        law = integral_in_time(boundary.velocity, f"{key}.velocity", size)
    return law, ~np.isnan(law(0.0))
