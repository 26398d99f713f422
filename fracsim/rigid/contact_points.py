"""Contacts that an engine finds: where, between what, and how fast it comes together there."""

from __future__ import annotations

from ctypes import c_int64
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ..mesh.c_library import load_library
from .contact_records import Touches

SOURCE = Path(__file__).with_suffix(".c")
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
        arms: (k, 2, 3) r from what the two things turn about, m.
    """

    geoms: Ints
    things: Ints
    point: Values
    axes: Values
    gap: Values
    friction: Values
    arms: Values

    @classmethod
    def found(
        cls, geoms: Ints, things: Ints, point: Values, axes: Values, gap: Values, friction: Values, places: Values
    ) -> Contacts:
        """With the places (things, 3) that things turn about, m."""
        return cls(geoms, things, point, axes, gap, friction, point[:, None] - places[things])

    def __len__(self) -> int:
        return len(self.gap)

    def closing(self, velocity: Values, spin: Values) -> Values:
        """(k,) how fast things come together that move with velocities (things, 3) and spins (things, 3), m/s."""
        return self._moving("closing", velocity, spin, np.empty(len(self)))

    def slipping(self, velocity: Values, spin: Values, chosen: Flags) -> Values:
        """(k,) how fast things slip along one another in chosen (k,) contacts, m/s; 0 in all others."""
        return np.where(chosen, np.hypot(*self.parting(velocity, spin).T[1:]), 0.0)

    def parting(self, velocity: Values, spin: Values) -> Values:
        """(k, 3) velocities of the second things beside the first, along the axes, m/s."""
        return self._moving("parting", velocity, spin, np.empty((len(self), 3)))

    def _moving(self, name: str, velocity: Values, spin: Values, speed: Values) -> Values:
        """A function of contact_points.c has written into `speed`."""
        arrays = [self.things, self.axes, self.arms, velocity, spin]
        given = [np.ascontiguousarray(each) for each in arrays]
        getattr(load_library(SOURCE), name)(c_int64(len(self)), *given, speed)
        return speed

    def of_both(self, flags: Flags) -> Flags:
        """(k,) where both things have a flag (things,)."""
        first, second = self.things.T
        return np.asarray(flags[first] & flags[second])

    def chosen(self, rows: Ints) -> Contacts:
        """Some (m,) of them."""
        return Contacts(*(np.take(values, rows, axis=0) for values in vars(self).values()))

    def and_more(self, more: Contacts) -> Contacts:
        """And others after them."""
        return Contacts(*(np.concatenate(both) for both in zip(vars(self).values(), vars(more).values(), strict=True)))

    def touches(self, rows: Ints, impulse: Values, closing: Values) -> Touches:
        """Of contacts (m,) that gave impulses (m, 3) along their axes, N s; all met at speeds (k,), m/s."""
        axes, (first, second) = self.axes[rows], self.things[rows].T
        given = np.einsum("ki,kij->kj", impulse, axes)
        return Touches(first, second, self.point[rows], axes[:, 0], given, closing[rows])
