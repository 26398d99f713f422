"""Contacts that an engine finds: where, between what, and how fast it comes together there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Contacts:
    """k places where things touch or are near one another.

    Attributes:
        geoms: (k, 2) of the engine.    things: (k, 2) bodies by their numbers, then what stands in their way.
        point: (k, 3) m.    axes: (k, 3, 3), the first from the first thing to the second.
        gap: (k,) m, below 0 of what is in one another.    levers: (2, k, 3) of the two things, r x n, m.
    """

    geoms: Ints
    things: Ints
    point: Values
    axes: Values
    gap: Values
    levers: Values

    @classmethod
    def found(cls, geoms: Ints, things: Ints, point: Values, axes: Values, gap: Values, places: Values) -> Contacts:
        """With the places (things, 3) that things turn about, m."""
        arms = (point - places[each] for each in things.T)
        return cls(geoms, things, point, axes, gap, np.stack([np.cross(arm, axes[:, 0]) for arm in arms]))

    def __len__(self) -> int:
        return len(self.gap)

    def closing(self, velocity: Values, spin: Values) -> Values:
        """(k,) how fast things come together that move with velocities (things, 3) and spins (things, 3), m/s."""
        first, second = self.things.T
        along = np.einsum("ki,ki->k", velocity[first] - velocity[second], self.axes[:, 0])
        turning = np.einsum("ki,ki->k", spin[first], self.levers[0]) - np.einsum(
            "ki,ki->k", spin[second], self.levers[1]
        )
        return np.asarray(along + turning)
