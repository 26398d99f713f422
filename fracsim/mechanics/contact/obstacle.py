"""An obstacle that is held or driven: a shape whose reference point goes the way that a function of time says."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from ..time_functions import TimeFunction
from .placed import Placed
from .pose import Pose, Values
from .shape import Shape


@dataclass(frozen=True, eq=False)
class Obstacle:
    """A rigid obstacle without a mass of its own.

    Attributes:
        name: of its columns in history.csv.    shape: about its reference point.    at: (d,) that point at t = 0, m.
        moved: (d,) displacement of the obstacle at a time, m; None: it is held.
        friction: Coulomb's coefficient against the body.
        spin: (3,) rad/s at which it is turned about its reference point (solids alone); None: it does not turn.
    """

    name: str
    shape: Shape
    at: Values
    moved: TimeFunction | None = None
    friction: float = 0.0
    spin: Values | None = None
    free: ClassVar[bool] = False  # whether it has a mass, and moves by itself

    def placed(self, t: float) -> Placed:
        """Where it is at time t, s."""
        pose = Pose.at(self.at + self.displacement(t))
        return Placed(self.shape, pose if self.spin is None else pose.moved(np.append(0 * self.at, t * self.spin)))

    def displacement(self, t: float) -> Values:
        """(d,) m."""
        return np.zeros(len(self.at)) if self.moved is None else self.moved(t)

    def way(self, start: float, end: float) -> Values:
        """(p,) increment q of its pose from one time to another."""
        shift = self.displacement(end) - self.displacement(start)
        return np.concatenate([shift, np.zeros(self._turns) if self.spin is None else (end - start) * self.spin])

    @cached_property
    def _turns(self) -> int:
        return 1 if len(self.at) == 2 else 3
