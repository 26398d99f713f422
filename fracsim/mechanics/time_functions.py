"""Functions of time: constants and tables, and their integrals. No DOLFINx here."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[np.float64]
TimeFunction = Callable[[float], Values]


@dataclass(frozen=True)
class TabulatedFunction:
    """Values (n, k) at times (n,) in s that increase: linear in between, constant outside."""

    times: Values
    rows: Values

    def __call__(self, t: float) -> Values:
        """(k,) the value at t."""
        return np.array([np.interp(t, self.times, column) for column in self.rows.T])

    def integral(self, t: float) -> Values:
        """(k,) the integral from 0 to t: exact, by trapezia between the corners of the table."""
        if len(self.times) == 1:
            return t * self.rows[0]
        inner = self.times[(self.times > 0) & (self.times < t)]
        knots = np.concatenate([[0.0], inner, [t]])
        rates = np.array([self(knot) for knot in knots])
        return np.asarray(np.diff(knots) @ (rates[1:] + rates[:-1]) / 2)


def constant_function(values: Sequence[float] | Values) -> TabulatedFunction:
    """The same k values at all times."""
    return TabulatedFunction(np.zeros(1), np.array([values], float))
