"""Functions of time from tables, and their integrals. Without DOLFINx, since the study room uses them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[np.float64]
TimeFunction = Callable[[float], Values]


@dataclass(frozen=True)
class TabulatedFunction:
    """Piecewise linear function of time, constant outside its table.

    Attributes:
        times: (n,) times, increasing, s.
        rows: (n, k) values at these times.
    """

    times: Values
    rows: Values

    def __call__(self, t: float) -> Values:
        """(k,) values at time t (s)."""
        return np.array([np.interp(t, self.times, column) for column in self.rows.T])

    def integral(self, t: float) -> Values:
        """(k,) integrals from 0 to t (s): exact, by trapezoids between the times of the table."""
        if len(self.times) == 1:
            return t * self.rows[0]
        inner = self.times[(self.times > 0) & (self.times < t)]
        knots = np.concatenate([[0.0], inner, [t]])
        rates = np.array([self(knot) for knot in knots])
        return np.asarray(np.diff(knots) @ (rates[1:] + rates[:-1]) / 2)


@dataclass(frozen=True)
class PlaceFunction:
    """Function of time and place of the user.

    Attributes:
        function: returns values (n, k) at time t (s) and reference positions x (n, d), m.
    """

    function: Callable[[float, Values], Values]

    def at(self, x: Values) -> PlacedFunction:
        """Function of time alone at positions x (n, d), m."""
        return PlacedFunction(self.function, x)


@dataclass(frozen=True)
class PlacedFunction:
    """Function of time with values (n k,) at n positions, k for each of them.

    Attributes:
        function: of t (s) and x (n, d).
        x: (n, d) positions, m.
    """

    function: Callable[[float, Values], Values]
    x: Values

    def __call__(self, t: float) -> Values:
        """(n k,) values at time t (s)."""
        return np.asarray(self.function(t, self.x), float).reshape(-1)


def constant_function(values: Sequence[float] | Values) -> TabulatedFunction:
    """Function with the same k values at all times."""
    return TabulatedFunction(np.zeros(1), np.array([values], float))
