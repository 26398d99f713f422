"""Where obstacles are in a step, and how far on their way: those that are jammed wait and come on bit by bit."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from .facets import Facets
from .obstacle import Obstacle
from .placed import Placed
from .reach import Way, safe_shares

Values = npt.NDArray[np.float64]
type Going = tuple[Placed, Values]  # where an obstacle begins, and the increment (p,) of its pose


class Course:
    """Obstacles on their ways.

    Attributes:
        placed, at_start: where each is, and was as the step began.    ways: (p,) increment of its pose in the step.
        led: numbers of those whose way is known.
    """

    placed: list[Placed]
    at_start: list[Placed]
    ways: list[Values]

    def __init__(self, obstacles: Sequence[Obstacle], led: list[int]) -> None:
        self._obstacles, self.led = obstacles, led
        self._gone = 1.0  # share of their way

    def begin(self, start: float, end: float) -> None:
        """A step between these times, s, or a look at a state at `end`."""
        self.placed = [each.placed(end) for each in self._obstacles]
        self.at_start = [each.placed(start) for each in self._obstacles]
        self.ways = [each.way(start, end) for each in self._obstacles]
        self._gone = 1.0

    def put_at_start(self, number: int, placed: Placed) -> None:
        """One whose way is not known yet stays where it began."""
        self.placed[number] = self.at_start[number] = placed

    def known(self, facets: Callable[[int], Facets | None]) -> list[Way]:
        """Where each obstacle whose way is known is at the start of the step, its way (p,) to the end, and the facets
        that feel it, by its number."""
        return [(self.at_start[number], self.ways[number], facets(number)) for number in self.led]

    def back_to_start(self) -> None:
        """None has gone any of its way."""
        self._gone = 0.0

    @property
    def left(self) -> float:
        """The share of their way that is left; 0: all have gone all of it."""
        return 1 - self._gone

    def whole(self) -> dict[int, Going]:
        """Where each whose way is known was as the step began, and its way (p,), by numbers."""
        return {number: (self.at_start[number], self.ways[number]) for number in self.led}

    def rest(self) -> dict[int, Going]:
        """Where it is now, and what is left of its way."""
        return {number: (self._after(*way), (1 - self._gone) * way[1]) for number, way in self.whole().items()}

    def go_on(self, x: Values, ways: list[Way], least: Callable[[Values], float], most: float = 1.0) -> None:
        """A share of the rest of the `known` ways, `most` at most, that is safe with points at x (n, d); `least`: of
        shares (n,), on all ranks (collective)."""
        rest, still = 1 - self._gone, np.zeros_like(x)
        shares = [safe_shares(self._after(placed, q), x, still, rest * q, facets) for placed, q, facets in ways]
        share = min(least(np.min(shares, axis=0)) if shares else 1.0, most)
        self._gone = 1.0 if share == 1 else self._gone + share * rest
        for number, (placed, q, _) in zip(self.led, ways, strict=True):
            self.placed[number] = self._after(placed, q)

    def _after(self, placed: Placed, way: Values) -> Placed:
        """Where one that began at `placed` is now."""
        return Placed(placed.shape, placed.pose.moved(self._gone * way))
