"""How long a blow lasts and on what it presses, after Hertz: two elastic spheres (K. L. Johnson, Contact Mechanics,
1985, eqs. 11.24 and 4.22).

    tau = 2.87 (m^2 / (R E*^2 v))^(1/5),   a = (3 F R / (4 E*))^(1/3),
    1/m = 1/m_1 + 1/m_2,   1/R = 1/R_1 + 1/R_2,   E* = E / (1 - nu^2) / 2

of two bodies of one stuff, that meet at a speed v; E* is twice that where one of them does not give way.

Equations: docs/theory.md#blows-and-loads.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Hertz:
    """Of bodies with Young's modulus `young` (Pa) and Poisson's ratio `poisson`."""

    young: float
    poisson: float

    def __call__(self, mass: Values, radius: Values, speed: Values, both_give: Flags) -> Values:
        """(k,) s, of reduced masses (k,) in kg, reduced radii (k,) in m and speeds (k,) in m/s."""
        stiff = self._stiff(both_give)
        return np.asarray(2.87 * (mass**2 / (radius * stiff**2 * speed)) ** 0.2)

    def spread(self, radius: Values, both_give: Flags) -> Values:
        """(k,) a^3 / F, m^3/N, of reduced radii (k,) in m."""
        return np.asarray(0.75 * radius / self._stiff(both_give))

    def _stiff(self, both_give: Flags) -> Values:
        """(k,) E*, Pa."""
        return np.asarray(self.young / (1 - self.poisson**2) / np.where(both_give, 2, 1))


def reduced(first: Values, second: Values) -> Values:
    """1 / (1 / a + 1 / b), either of which may be infinite."""
    return np.asarray(1.0 / (1.0 / first + 1.0 / second))
