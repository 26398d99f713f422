"""How contact with obstacles acts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[np.float64]


class Repulsion(Protocol):
    """An energy per area of gaps g (n,), m, that are less than a width: what pushes apart (barrier, penalty)."""

    @property
    def width(self) -> float:
        """m."""

    def energy(self, g: Values) -> Values:
        """(n,) b, J/m^2."""

    def slope(self, g: Values) -> Values:
        """(n,) b', Pa: minus the pressure."""

    def curvature(self, g: Values) -> Values:
        """(n,) b'', Pa/m."""


@dataclass(frozen=True)
class Law:
    """The barrier, and the speed of slip, m/s, below which friction passes for sticking."""

    barrier: Repulsion
    creep: float
