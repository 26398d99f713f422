"""Contacts that an engine finds: where, between what, and how fast it comes together there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .touches import Touches

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Contacts:
    """k places where things touch or are near one another.

    Attributes:
        geoms: (k, 2) of the engine.    things: (k, 2) bodies by their numbers, then what stands in their way.
        point: (k, 3) m.    axes: (k, 3, 3), the first from the first thing to the second.
        gap: (k,) m, below 0 of what is in one another.    friction: (k,) Coulomb's coefficient.
        arms: (2, k, 3) r from what the two things turn about, m.    levers: (2, k, 3) r x n, m.
    """

    geoms: Ints
    things: Ints
    point: Values
    axes: Values
    gap: Values
    friction: Values
    arms: Values
    levers: Values

    @classmethod
    def found(
        cls, geoms: Ints, things: Ints, point: Values, axes: Values, gap: Values, friction: Values, places: Values
    ) -> Contacts:
        """With the places (things, 3) that things turn about, m."""
        arms = np.stack([point - places[each] for each in things.T])
        return cls(geoms, things, point, axes, gap, friction, arms, np.cross(arms, axes[:, 0]))

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

    def slipping(self, velocity: Values, spin: Values, chosen: Flags) -> Values:
        """(k,) how fast things slip along one another in chosen (k,) contacts, m/s; 0 in all others."""
        slip = np.zeros(len(self))
        slip[chosen] = np.linalg.norm(self.chosen(np.flatnonzero(chosen)).parting(velocity, spin)[:, 1:], axis=1)
        return slip

    def parting(self, velocity: Values, spin: Values) -> Values:
        """(k, 3) velocities of the second things beside the first, along the axes, m/s."""
        first, second = self.things.T
        v = velocity[second] - velocity[first]
        v += np.cross(spin[second], self.arms[1]) - np.cross(spin[first], self.arms[0])
        return np.asarray(np.einsum("kij,kj->ki", self.axes, v))

    def chosen(self, rows: Ints) -> Contacts:
        """Some (m,) of them."""
        return Contacts(self.geoms[rows], self.things[rows], self.point[rows], self.axes[rows], self.gap[rows],
                        self.friction[rows], self.arms[:, rows], self.levers[:, rows])  # fmt: skip

    def and_more(self, more: Contacts) -> Contacts:
        """And others after them."""
        return Contacts(*(
            np.concatenate([mine, others], axis=int(name in ("arms", "levers")))
            for (name, mine), others in zip(vars(self).items(), vars(more).values(), strict=True)
        ))  # fmt: skip

    def touches(self, rows: Ints, impulse: Values, closing: Values) -> Touches:
        """Of contacts (m,) that gave impulses (m, 3) along their axes, N s; all met at speeds (k,), m/s."""
        axes, (first, second) = self.axes[rows], self.things[rows].T
        given = np.einsum("ki,kij->kj", impulse, axes)
        return Touches(first, second, self.point[rows], axes[:, 0], given, closing[rows])
