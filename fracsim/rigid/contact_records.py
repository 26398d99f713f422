"""What touched what in a step, and what it gave."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Touches:
    """k contact points of a step that gave something.

    Attributes:
        first, second: (k,) the two things: bodies by their numbers, then what stands in their way.
        point: (k, 3) m.    normal: (k, 3) from the first to the second.
        impulse: (k, 3) that the second received from the first in the step, N s.
        closing: (k,) how fast the two met there, along the normal, m/s; 0 of what does not meet but rests.
    """

    first: Ints
    second: Ints
    point: Values
    normal: Values
    impulse: Values
    closing: Values

    @classmethod
    def none(cls) -> Touches:
        """Nothing touched."""
        none, nowhere = np.empty(0, np.int64), np.empty((0, 3))
        return cls(none, none, nowhere, nowhere, nowhere, np.empty(0))

    def __len__(self) -> int:
        return len(self.first)

    def energies(self, count: int, restitution: float) -> Values:
        """(count,) J that go into the first `count` things as they meet others, J_n c / (2 + 2 e): m c^2 / 2 of two of
        the reduced mass m. Where both are among these each has half of it; 0 of what meets nothing."""
        both = np.stack([self.first, self.second])
        each = np.einsum("ki,ki->k", self.impulse, self.normal) * self.closing / (2 + 2 * restitution)
        share = each / np.maximum((both < count).sum(axis=0), 1)
        return np.bincount(np.minimum(both, count).ravel(), np.tile(share, 2), count + 1)[:count].astype(float)

    def and_more(self, more: Touches) -> Touches:
        """And others after them."""
        return Touches(*(np.concatenate(both) for both in zip(vars(self).values(), vars(more).values(), strict=True)))

    def on(self, thing: int) -> tuple[Values, Values]:
        """(m, 3) points and (m, 3) impulses that one thing received."""
        first, second = self.first == thing, self.second == thing
        points = np.concatenate([self.point[first], self.point[second]])
        return points, np.concatenate([-self.impulse[first], self.impulse[second]])
