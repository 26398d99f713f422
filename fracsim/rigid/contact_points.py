"""Contact points between rigid bodies, and the impulses that they transmitted in a step."""

from __future__ import annotations

from ctypes import c_int64
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ..mesh.c_library import load_library

SOURCE = Path(__file__).with_suffix(".c")
Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Contacts:
    """Contact points (k) of pairs of bodies that touch or are close to one another.

    Bodies are numbered first, prescribed obstacles after them.

    Attributes:
        geoms: (k, 2) numbers of the convex parts in the engine; -1 for contacts with the core of a fragment.
        pairs: (k, 2) numbers of the two bodies.
        point: (k, 3) m.
        axes: (k, 3, 3) rows: the normal, from the first body to the second, and two tangents.
        gap: (k,) m; negative where the bodies overlap.
        friction: (k,) coefficients of Coulomb's friction.
        arms: (k, 2, 3) from the centres of the two bodies to the point, m.
    """

    geoms: Ints
    pairs: Ints
    point: Values
    axes: Values
    gap: Values
    friction: Values
    arms: Values

    @classmethod
    def with_arms(
        cls, geoms: Ints, pairs: Ints, point: Values, axes: Values, gap: Values, friction: Values, centres: Values
    ) -> Contacts:
        """Return contacts with arms from the `centres` (n, 3), m, of all bodies and obstacles."""
        return cls(geoms, pairs, point, axes, gap, friction, point[:, None] - centres[pairs])

    def __len__(self) -> int:
        return len(self.gap)

    # --- velocities at the contacts ---

    def approach_speeds(self, velocity: Values, spin: Values) -> Values:
        """Return normal speeds of approach (k,), m/s, for velocities and spins (n, 3) of all bodies and obstacles."""
        return self._evaluate("approach_speeds", velocity, spin, np.empty(len(self)))

    def relative_velocities(self, velocity: Values, spin: Values) -> Values:
        """Return velocities (k, 3), m/s, of the second body relative to the first, along the axes of the contacts."""
        return self._evaluate("relative_velocities", velocity, spin, np.empty((len(self), 3)))

    def slip_speeds(self, velocity: Values, spin: Values, chosen: Flags) -> Values:
        """Return tangential speeds (k,), m/s, in the contacts `chosen` (k,); 0 in the others."""
        return np.where(chosen, np.hypot(*self.relative_velocities(velocity, spin).T[1:]), 0.0)

    def _evaluate(self, name: str, velocity: Values, spin: Values, result: Values) -> Values:
        """Call the function `name` of contact_points.c, which writes into `result`."""
        values = [self.pairs, self.axes, self.arms, velocity, spin]
        arrays = [np.ascontiguousarray(array) for array in values]
        getattr(load_library(SOURCE), name)(c_int64(len(self)), *arrays, result)
        return result

    # --- subsets ---

    def both_flagged(self, flags: Flags) -> Flags:
        """Return (k,) flags of contacts of which both bodies have a flag, `flags` (n,)."""
        first, second = self.pairs.T
        return np.asarray(flags[first] & flags[second])

    def select(self, rows: Ints) -> Contacts:
        """Return the contacts with the numbers `rows` (m,)."""
        return Contacts(*(np.take(values, rows, axis=0) for values in vars(self).values()))

    def concatenate(self, following: Contacts) -> Contacts:
        """Return these contacts and the `following` ones after them."""
        pairs = zip(vars(self).values(), vars(following).values(), strict=True)
        return Contacts(*(np.concatenate(pair) for pair in pairs))

    def impulse_record(self, rows: Ints, impulse: Values, approach_speed: Values) -> ContactImpulses:
        """Return the record of contacts `rows` (m,) that transmitted `impulse` (m, 3), N s, along their axes.

        `approach_speed`: (k,) of all contacts, m/s.
        """
        axes, (first, second) = self.axes[rows], self.pairs[rows].T
        in_space = np.einsum("ki,kij->kj", impulse, axes)
        return ContactImpulses(first, second, self.point[rows], axes[:, 0], in_space, approach_speed[rows])


@dataclass(frozen=True)
class ContactImpulses:
    """Impulses of the contact points (k) that transmitted one in a step.

    Attributes:
        first: (k,) numbers of the first bodies; prescribed obstacles follow after all bodies.
        second: (k,) numbers of the second bodies.
        point: (k, 3) m.
        normal: (k, 3) unit vectors from the first body to the second.
        impulse: (k, 3) received by the second body from the first, N s.
        approach_speed: (k,) normal speed of an impact, m/s; 0 for resting contact.
    """

    first: Ints
    second: Ints
    point: Values
    normal: Values
    impulse: Values
    approach_speed: Values

    @classmethod
    def empty(cls) -> ContactImpulses:
        """Return a record without contacts."""
        numbers, vectors = np.empty(0, np.int64), np.empty((0, 3))
        return cls(numbers, numbers, vectors, vectors, vectors, np.empty(0))

    def __len__(self) -> int:
        return len(self.first)

    def impact_energies(self, count: int, restitution: float) -> Values:
        """Return the energies (count,), J, that the first `count` bodies receive in impacts.

        The energy of an impact is J_n c / (2 + 2 e): m c^2 / 2 with the reduced mass m. Two bodies below `count` share
        it equally.
        """
        pairs = np.stack([self.first, self.second])
        energy = np.einsum("ki,ki->k", self.impulse, self.normal) * self.approach_speed / (2 + 2 * restitution)
        share = energy / np.maximum((pairs < count).sum(axis=0), 1)
        # one more bin takes what obstacles receive
        return np.bincount(np.minimum(pairs, count).ravel(), np.tile(share, 2), count + 1)[:count].astype(float)

    def concatenate(self, following: ContactImpulses) -> ContactImpulses:
        """Return these impulses and the `following` ones after them."""
        pairs = zip(vars(self).values(), vars(following).values(), strict=True)
        return ContactImpulses(*(np.concatenate(pair) for pair in pairs))

    def received_by(self, body: int) -> tuple[Values, Values]:
        """Return points (m, 3), m, and impulses (m, 3), N s, that one body or obstacle received."""
        first, second = self.first == body, self.second == body
        points = np.concatenate([self.point[first], self.point[second]])
        return points, np.concatenate([-self.impulse[first], self.impulse[second]])
