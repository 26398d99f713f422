"""Obstacles in explicit steps of which some move freely (drift)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from ...mesh.domain import Domain
from ...mesh.ranks import total
from .drift import Drift
from .explicit_obstacles import ExplicitObstacles
from .flights import Flights
from .free_obstacle import FreeObstacle
from .law import Law
from .obstacle import Obstacle
from .placed import Placed
from .push import on_obstacle

Values = npt.NDArray[np.float64]

NEAR = 3.0  # widths of the penalty: gaps of points that may be in touch a step later


class ExplicitFreeObstacles(Flights, ExplicitObstacles):
    """Obstacles, at least one of them free, that explicit steps run into."""

    free: dict[int, Drift]

    def __init__(
        self, domain: Domain, u: fem.Function, obstacles: Sequence[Obstacle], law: Law, mass: Values, most: float
    ) -> None:
        """As of ExplicitObstacles (collective)."""
        self.free = {number: Drift(each) for number, each in enumerate(obstacles) if isinstance(each, FreeObstacle)}
        super().__init__(domain, u, obstacles, law, mass, most)

    def frequency(self) -> float:
        """With what the lightest obstacle adds on the springs that are near it: squares of a body and an obstacle on
        one spring add up, obstacles know nothing of each other (collective)."""
        self.touching()
        return super().frequency() + max(self._fastest_of(*each) for each in self.free.items())

    def _fastest_of(self, number: int, each: Drift) -> float:
        placed = self._course.placed[number]
        near = np.flatnonzero(placed.distance(self.x) < NEAR * self.law.barrier.width)
        resistance = each.resistance(self.x[near], self.stiffness[near], placed)
        return each.fastest(total(self.comm, resistance.reshape(-1)).reshape(resistance.shape), placed)

    # --- a step ---

    def _start_of_step(self) -> None:
        super()._start_of_step()
        for number, each in self.free.items():
            self._course.placed[number] = each.begin(self._level.dt)

    def _way_under(self, number: int, placed: Placed) -> Values:
        if number in self.free and self._from is not None:
            return self.free[number].under(self._from, placed)
        return super()._way_under(number, placed)

    def arrive(self) -> None:
        """The step is over: obstacles have the momentum that it gave them (collective)."""
        super().arrive()
        for number, each in self.free.items():
            placed, found = self._course.placed[number], self.touching()[number]
            worked = each.arrive(placed, total(self.comm, on_obstacle(found, self.x, placed.pose)))
            self._worked[number] = 0.0 if self.comm.rank else -worked

    def driven(self) -> tuple[float, float]:
        """With the work of gravity on free obstacles (on rank 0)."""
        work, lost = super().driven()
        return work + (0.0 if self.comm.rank else sum(each.weighed for each in self.free.values())), lost

    # --- its past ---

    def restore(self, saved: dict[str, Values]) -> None:
        """Be again what `saved` gave."""
        super().restore(saved)
        for number, each in self.free.items():
            self._course.put_at_start(number, each.look())
        self.displaced()
