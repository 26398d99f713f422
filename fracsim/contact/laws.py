"""How contact with obstacles acts.

A barrier's force as a mean over the way of a step, for schemes of second order.

Forces at the end of a step (blow) lose b(g_n) - b(g) + b'(g) (g - g_n) >= 0 in each, of first order in dt: a fifth of a
bounce of fifty steps. The mean of b' over gaps from g_n to g would lose nothing. By Radau's two points it is

    3/4 b'((2 g_n + g) / 3) + 1/4 b'(g),

exact for b' of second degree and, as (-1)^k b^(k) >= 0 up to k = 4, no less than the mean on the way in and no more on
the way out: it gives no energy at any step. (Gauss's points give some on the way in, Simpson's on the way out.) But a
gap that steps do not resolve swings about its rest without end. So a share of the force stays that at the end,

    p = 3 c / 4 b'((2 g_n + g) / 3) + (1 - 3 c / 4) b'(g),    c = 0.8:

it still gives none, a bounce of fifty steps loses 4 %, and of the swing of a stiff gap c / (2 - c) = 2/3 is left after
a step. p is the slope of 9 c / 4 b((2 g_n + g) / 3) + (1 - 3 c / 4) b(g).

Equations: docs/theory.md#contact-in-a-time-step.

How much stiffer a barrier has to be where what presses on it has all but closed a gap.

A barrier holds any pressure, a small stiffness at a small gap: kappa b'(g) = p. But at a gap of TIGHT its stiffness
b'' = p / g is so much more than that of the body around it that Newton's method creeps: with a ten-thousandth of the
stiffness that contact has by itself steps were halved without end. From there on kappa is what bears the pressure at
EASY. (To double it each time, as Li et al. 2020 do, takes ten steps for the same.) It never goes back: a barrier that
is stiffer than need be costs little.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from .barrier import Barrier

Values = npt.NDArray[np.float64]
EARLIER = 0.75 * 0.8  # 3 c / 4: weight of the force after a third of the way
TIGHT, EASY = 3e-3, 0.1  # of the barrier's width. By itself contact came down to 0.016 in a torn loaf that recoils


class GapPotential(Protocol):
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
class ObstacleLaw:
    """The barrier, and the speed of slip, m/s, below which friction passes for sticking."""

    barrier: GapPotential
    sticking_speed: float


@dataclass(frozen=True)
class TimeAveragedPotential:
    """A barrier over steps that begin with gaps `start` (n,), m: a function of the gaps g (n,) at their ends."""

    barrier: GapPotential
    start_gap: Values

    def energy(self, g: Values) -> Values:
        """(n,) its potential, J/m^2; infinite where a gap is closed."""
        earlier, end = self._both(self.barrier.energy, g)
        return np.asarray(3 * EARLIER * earlier + (1 - EARLIER) * end)

    def slope(self, g: Values) -> Values:
        """(n,) p, Pa: minus the pressure; never positive."""
        earlier, end = self._both(self.barrier.slope, g)
        return np.asarray(EARLIER * earlier + (1 - EARLIER) * end)

    def curvature(self, g: Values) -> Values:
        """(n,) dp/dg, Pa/m; never negative."""
        earlier, end = self._both(self.barrier.curvature, g)
        return np.asarray(EARLIER / 3 * earlier + (1 - EARLIER) * end)

    def _both(self, law: Callable[[Values], Values], g: Values) -> tuple[Values, Values]:
        """(n,) after a third of the way, where gaps are open if they are at its end, and there."""
        return law(np.where(g > 0, (2 * self.start_gap + g) / 3, g)), law(g)


def stiffness_factor(share: float) -> float:
    """Factor of kappa with which the pressure at a gap of `share` of the width stands at EASY; 1 where it is not
    TIGHT."""
    if not 0 < share < TIGHT:
        return 1.0
    tight, easy = Barrier(1.0, 1.0).slope(np.array([share, EASY]))
    return float(tight / easy)
