"""Coulomb friction of a surface with itself in explicit steps: each point that is pushed hangs on a spring that slips.

    f_p = -k_p s,    s += (1 - n n^T) (dx_p - sum_c l_c dx_c) in a step, shortened to k_p |s| <= mu k_p (D - g)

with k_p, the gap g, its normal n and the shares l of the place on the facet as pushed (pushing); the facet's corners
take -l_c f_p. (Cundall and Strack's springs, as before obstacles: springs.) Forces sum to nothing; their moment is that
of f_p over the gap, as point and place are apart by it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .friction import tangential
from .pushing import Pushing

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Sticking:
    """Friction of `coefficient` between what is pushed and what pushes it.

    Attributes:
        start: (n, d) points where the step began, m; None: it is over.
    """

    pairs: Pushing
    coefficient: float
    start: Values | None

    def gradient(self, x: Values) -> Values:
        """(n, d) N: the force on the points is its negative."""
        met, found = self.pairs.met(x), np.zeros_like(x)
        pull = met.rate[:, None] * self.slips(x)
        np.add.at(found, met.at.points, pull)
        np.add.at(found, met.at.corners, -met.at.share[:, :, None] * pull[:, None])
        return found

    def energy(self, x: Values) -> float:
        """Of the springs, J."""
        return 0.5 * float(self.pairs.met(x).rate @ np.sum(self.slips(x) ** 2, axis=1))

    def slips(self, x: Values) -> Values:
        """(k, d) by which the springs of what is pushed are stretched, m. Those that are new are not."""
        met, before = self.pairs.met(x), self._before(x)
        slip = tangential(met.at.normal, before + self._moved(x))
        longest = self.coefficient * (self.pairs.width - met.at.gap)
        length = np.maximum(np.linalg.norm(slip, axis=1), np.finfo(float).tiny)
        return np.asarray(np.minimum(1.0, longest / length)[:, None] * slip)

    def lost(self, x: Values) -> float:
        """What friction has taken in the step, J: its work by the trapezoidal rule, less what the springs store."""
        rate = self.pairs.met(x).rate[:, None]
        work = -0.5 * float(np.vdot(rate * (self._before(x) + self.slips(x)), self._moved(x)))
        stored = 0.5 * float(self.pairs.held @ np.sum(self.pairs.slip**2, axis=1))
        return stored - self.energy(x) - work

    def _before(self, x: Values) -> Values:
        """(k, d) the slips that the step began with, m."""
        return np.asarray(self.pairs.slip[self.pairs.met(x).at.points])

    def _moved(self, x: Values) -> Values:
        """(k, d) way in the step of points that were pushed as it began, over what pushes them, m."""
        at = self.pairs.met(x).at
        if self.start is None:
            return np.zeros((len(at.points), x.shape[1]))
        way = x - self.start
        over = way[at.points] - np.einsum("kcd,kc->kd", way[at.corners], at.share)
        return np.where((self.pairs.held[at.points] > 0)[:, None], over, 0.0)
