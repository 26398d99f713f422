"""Coulomb friction in explicit steps: each point in touch hangs on a spring that slips once it pulls harder than mu N.

P. A. Cundall, O. D. L. Strack: A discrete numerical model for granular assemblies. Geotechnique 29 (1979) 47-65. A
body at rest on a slope stays there: friction that is a function of the velocity alone would let it creep.

Equations: docs/theory.md#explicit-contact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .friction import tangential

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Springs:
    """The springs of one obstacle.

    Attributes:
        points: (k,) of the surface, ascending.    slip: (k, d) by which they are stretched, m.
        stiffness: (k,) N/m.
    """

    points: Ints
    slip: Values
    stiffness: Values

    @classmethod
    def none(cls, dim: int) -> Springs:
        """Nothing is in touch."""
        return cls(np.empty(0, np.int64), np.empty((0, dim)), np.empty(0))

    @property
    def force(self) -> Values:
        """(k, d) on the points, N."""
        return -self.stiffness[:, None] * self.slip

    @property
    def energy(self) -> float:
        """J."""
        return 0.5 * float(self.stiffness @ np.sum(self.slip**2, axis=1))

    def pulled(self, points: Ints, moved: Values, normal: Values, stiffness: Values, most: Values) -> Springs:
        """After points (k,) in touch have moved by `moved` (k, d) over the obstacle: stretched across the `normal`
        (k, d), by forces of at most `most` (k,), N. Points that let go lose their springs, new ones begin with none."""
        slip = moved.copy()
        if len(points) and len(self.points):
            place = np.minimum(np.searchsorted(points, self.points), len(points) - 1)
            known = points[place] == self.points
            slip[place[known]] += self.slip[known]
        slip = tangential(normal, slip)
        pull = stiffness * np.linalg.norm(slip, axis=1)
        share = np.divide(most, pull, out=np.ones(len(pull)), where=pull > most)
        return Springs(points, share[:, None] * slip, stiffness)

    def lost(self, before: Springs, moved: Values) -> float:
        """What friction has taken, J, as points (n, d) moved by `moved`: its work by the trapezoidal rule, less what
        the springs store."""
        work = sum(float(np.vdot(each.force, moved[each.points])) for each in (before, self)) / 2
        return before.energy - self.energy - work
