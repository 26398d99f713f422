"""The penalty that pushes bodies apart in explicit steps: its force is bounded, and so is how fast it vibrates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...errors import InputError

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Penalty:
    """b(g) = kappa (d - g)^2 / (2 d) below the gap g = d, 0 above: energy per area, J/m^2.

    `stiffness` kappa in Pa, the pressure of a gap that is just closed; `width` d in m. Beyond, as the points of a body
    may be for a moment, the pressure goes on growing by kappa / d a metre: it knows no gap that cannot be.
    """

    stiffness: float
    width: float

    def __post_init__(self) -> None:
        """InputError where it pushes nothing apart."""
        for word, value in (("stiffness", self.stiffness), ("width", self.width)):
            if not 0 < value < np.inf:
                raise InputError(f"the {word} of a penalty is {value}: it must be a positive number")

    @property
    def rate(self) -> float:
        """b'' = kappa / d, Pa/m."""
        return self.stiffness / self.width

    def energy(self, g: Values) -> Values:
        """(n,) b, J/m^2."""
        return np.asarray(self.rate / 2 * self._into(g) ** 2)

    def slope(self, g: Values) -> Values:
        """(n,) b', Pa: minus the pressure."""
        return np.asarray(-self.rate * self._into(g)) + 0.0  # no -0.0

    def curvature(self, g: Values) -> Values:
        """(n,) b'', Pa/m."""
        return np.where(g < self.width, self.rate, 0.0)

    def _into(self, g: Values) -> Values:
        return np.maximum(self.width - g, 0.0)
