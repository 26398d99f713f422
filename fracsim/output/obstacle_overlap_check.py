"""Obstacles that lie in each other, where they do not feel each other: looked for at frames, told at the end."""

from __future__ import annotations

from typing import Any

from ..contact.initial_overlap import find_overlaps, free_pairs
from ..contact.obstacle_term import ObstacleTerm


class Overlapping:
    """The deepest overlap that was seen, the same on all ranks.

    Attributes:
        seen: time (s), depth (m) and the two names; empty: never.
    """

    def __init__(self, contact: ObstacleTerm) -> None:
        """`contact`: the term of the obstacles."""
        self._contact, self._pairs = contact, free_pairs(contact.obstacles)
        self.seen: dict[str, Any] = {}

    def look(self, t: float) -> None:
        """Note where obstacles are at the time t of the state, s (not collective)."""
        if not self._pairs:
            return
        for a, b, deep in find_overlaps(self._contact.posed_obstacles(t), self._pairs):
            if deep > self.seen.get("depth", 0.0):
                names = [self._contact.obstacles[each].name for each in (a, b)]
                self.seen = {"time": t, "depth": deep, "both": names}

    def monitors(self) -> dict[str, Any]:
        """What a restart goes on from, for `restore`."""
        return {"obstacles_overlapped": self.seen}

    def restore(self, monitors: dict[str, Any]) -> None:
        """Go on from `monitors`."""
        self.seen = monitors.get("obstacles_overlapped", {})

    def summary(self) -> dict[str, Any]:
        """For summary.json, where there was anything."""
        return self.monitors() if self.seen else {}

    def notes(self) -> list[str]:
        """A sentence where there is one."""
        if not self.seen:
            return []
        first, second = self.seen["both"]
        return [
            f"{first} ran into {second}, by {self.seen['depth']:.3g} m at t = {self.seen['time']:g} s: in explicit "
            "steps obstacles do not feel each other"
        ]
