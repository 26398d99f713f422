"""The barrier that keeps gaps open, and how far points may move before a gap could close (IPC).

Equations: docs/theory.md#barrier, docs/theory.md#step-limits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..errors import InputError

Values = npt.NDArray[np.float64]

KEPT = 0.1  # share of a gap that a motion leaves
ITERATIONS = 50
HUGE = 1e200  # Pa, of a gap that is closed, and Pa/m: no infinity, of which there is no product with 0


@dataclass(frozen=True)
class Barrier:
    """b(g) = -kappa d (s - 1)^2 ln s, s = g / d: energy per area (J/m^2) of a gap g (m); 0 from s = 1 on, C2 there.

    `stiffness` kappa in Pa, `width` d in m: the pressure -b'(g) grows without bound as a gap closes.
    """

    stiffness: float
    width: float

    def __post_init__(self) -> None:
        """InputError where it keeps nothing apart."""
        for word, value in (("stiffness", self.stiffness), ("width", self.width)):
            if not 0 < value < np.inf:
                raise InputError(f"the {word} of a barrier is {value}: it must be a positive number")

    def energy(self, g: Values) -> Values:
        """(n,) b, J/m^2; infinite where a gap is closed."""
        s = self._share(g)
        return self._or(g, -self.stiffness * self.width * (s - 1) ** 2 * np.log(s), np.inf)

    def slope(self, g: Values) -> Values:
        """(n,) b', Pa: minus the pressure; never positive; where a gap is closed -HUGE, of which there is no norm."""
        s = self._share(g)
        return self._or(g, -self.stiffness * (s - 1) * (2 * np.log(s) + (s - 1) / s), -HUGE)

    def curvature(self, g: Values) -> Values:
        """(n,) b'', Pa/m; never negative."""
        s = self._share(g)
        # equal to 2 ln s + 3 - 2 / s - 1 / s^2, but without cancellation at s = 1
        bent = 2 * np.log1p(s - 1) + (s - 1) * (3 * s + 1) / s**2
        return self._or(g, -self.stiffness / self.width * bent, HUGE)

    def _share(self, g: Values) -> Values:
        """s within (0, 1]; 1, where all is zero, for gaps that are open or closed."""
        return np.where((g > 0) & (g < self.width), g, self.width) / self.width

    @staticmethod
    def _or(g: Values, inside: Values, closed: float) -> Values:
        return np.where(g > 0, inside, closed) + 0.0  # no -0.0


def safe_fractions(gap: Callable[[Values], Values], speed: Callable[[Values], Values], count: int) -> Values:
    """(count,) shares in (0, 1] of a motion that leave every gap at least KEPT of what it is now, all along the way.

    `gap`: shares (n,) of the motion -> distances (n,) of the points there, obstacles having moved by the same shares;
    `speed`: shares -> bounds (n,) of how fast the gaps close from there to the end, m per whole motion (see Motion).
    Conservative advancement: from a gap g a point may go on by (g - g_kept) / speed, then looks again. ITERATIONS
    bounds the looks, and every share on the way is safe, so that the least of all points (and ranks) is safe for all.
    """
    share = np.zeros(count)
    now = gap(share)
    if not (now > 0).all():
        raise ValueError(f"{int((~(now > 0)).sum())} gaps are closed before the motion: no share of it is safe")
    kept = KEPT * now
    for _ in range(ITERATIONS):
        # round-off may put a gap just below what is kept: no step back
        room = np.maximum(now - kept, 0)
        ahead = room / np.maximum(np.maximum(speed(share), room), np.finfo(float).tiny)
        share = np.minimum(share + ahead, 1.0)
        if ((share == 1) | (ahead < 1e-3 * share)).all():
            break
        now = gap(share)
    return share
