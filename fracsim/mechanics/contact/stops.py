"""All that a free obstacle meets beside the body: obstacles that are held or driven. No friction acts between them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from .course import Going
from .law import Repulsion
from .obstacle import Obstacle
from .placed import Placed
from .pose import Pose
from .push import Push, carried, push
from .stop import Stop
from .touch import Touch

Values = npt.NDArray[np.float64]
type Places = Mapping[int, Placed] | Sequence[Placed]  # by the numbers of obstacles


class Stops:
    """Of one free obstacle; `placed` is where all obstacles are, by their numbers."""

    def __init__(self, body: Obstacle, others: dict[int, Obstacle], barrier: Repulsion) -> None:
        """`others`: by their numbers."""
        self._each = {number: Stop.of(body, other) for number, other in others.items()}
        self._barrier, self._count = barrier, len(body.way(0.0, 0.0))
        self._start: dict[int, list[Values]] = {}

    def begin(self, pose: Pose, placed: Places, *, along: bool) -> None:
        """A step begins; `along`: barriers act along its way (along)."""
        each = self._each.items() if along else []
        self._start = {number: stop.gaps(pose, placed[number].pose) for number, stop in each}

    def are_open(self, pose: Pose, placed: Places) -> bool:
        """Whether it lies in none."""
        found = [stop.gaps(pose, placed[number].pose) for number, stop in self._each.items()]
        return all(gap.min(initial=np.inf) > 0 for both in found for gap in both)

    def safe_share(self, pose: Pose, q: Values, ways: dict[int, Going]) -> float:
        """Share of its way q (p,) that closes no gap, where others are and go by their numbers."""
        shares = [stop.safe_share(pose, q, ways[n][0].pose, ways[n][1]) for n, stop in self._each.items()]
        return min(shares, default=1.0)

    def push(self, pose: Pose, placed: Places) -> Push:
        """What they do to its pose."""
        p = self._count
        total = Push(0.0, np.zeros(p), np.zeros((p, p)), np.zeros((p, p)))
        for number in self._each:
            (own, x), (its, y) = self._touches(number, pose, placed)
            total = total + carried(own, x, pose) + push(its, y, pose, None, pose)
        return total

    def force(self, pose: Pose, placed: Places) -> Values:
        """(p,) force and moment of all of them on it, N and N m."""
        return -self.push(pose, placed).gradient

    def energies(self, pose: Pose, placed: Places) -> tuple[float, float]:
        """What their barriers store, and what their forces in the step are the derivative of, J."""
        found = [touch for number in self._each for touch, _ in self._touches(number, pose, placed)]
        return sum(touch.energy for touch in found), sum(touch.potential for touch in found)

    def work(self, pose: Pose, placed: Places, ways: Mapping[int, Values] | Sequence[Values]) -> float:
        """What they have done to it by their own ways (p,) in the step, J."""
        done = 0.0
        for number in self._each:
            (own, _), (its, _) = self._touches(number, pose, placed)
            done += float((own.normal.sum(axis=0) - its.normal.sum(axis=0)) @ ways[number][: pose.dim])
        return done

    def _touches(self, number: int, pose: Pose, placed: Places) -> list[tuple[Touch, Values]]:
        return self._each[number].touches(pose, placed[number].pose, self._barrier, self._start.get(number))
