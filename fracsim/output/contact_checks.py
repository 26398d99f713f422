"""Monitors of contact: facets that intersect, missed or too fast contact with obstacles, and obstacles that overlap."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from ..contact.obstacle import find_overlaps, free_pairs
from ..mesh.domain import Domain
from ..meshes.data import format_point
from ..timestepping.state import State

if TYPE_CHECKING:
    from ..contact.rigid_obstacles import PoseContact, RigidObstacles

Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


class ObstacleContactMonitor:
    """Gaps and closing distances between the obstacles and the body.

    Attributes:
        least_gap: obstacle -> (least gap to the body in m, its time in s).
        largest_closing: obstacle -> (largest decrease of the gap in a step with contact in m, end of that step in s,
            size of that step in s), on this rank.
    """

    def __init__(self, domain: Domain, contacts: Sequence[PoseContact]) -> None:
        """Start without any step; `contacts`: of the body with obstacles (collective)."""
        self._contacts, self._comm, self._edge = contacts, domain.comm, domain.mean_edge_length
        groups = [contact.group for contact in contacts]
        self._width = {obstacle.name: group.barrier_width for group in groups for obstacle in group.obstacles}
        self.least_gap = dict.fromkeys(self._width, (math.inf, 0.0))
        self.largest_closing = dict.fromkeys(self.least_gap, (0.0, 0.0, 0.0))

    def record_step(self, state: State, dt: float, figures: dict[str, float]) -> None:
        """Record a finished step (collective).

        Args:
            state: state at the end of the step.
            dt: size of the step, s.
            figures: columns of history.csv by name; gap_NAME is used.
        """
        closings = [closing for contact in self._contacts for closing in contact.closing_distances()]
        for (name, minimum), closing in zip(self.least_gap.items(), closings, strict=True):
            if figures[f"gap_{name}"] < minimum[0]:
                self.least_gap[name] = figures[f"gap_{name}"], state.t
            if closing > self.largest_closing[name][0]:
                self.largest_closing[name] = closing, state.t, dt

    def to_checkpoint(self) -> dict[str, Any]:
        """Values for `from_checkpoint` (collective)."""
        return {"least_gap": self.least_gap, "closed_in_a_step": self._closing_over_ranks()}

    def from_checkpoint(self, monitors: dict[str, Any]) -> None:
        """Restore the values of `to_checkpoint`."""
        self.least_gap |= {name: tuple(entry) for name, entry in monitors.get("least_gap", {}).items()}
        self.largest_closing |= {name: tuple(entry) for name, entry in monitors.get("closed_in_a_step", {}).items()}

    def summary(self) -> dict[str, Any]:
        """Part of summary.json: least gap of each obstacle, m."""
        return {"least_gap": {name: gap for name, (gap, _) in self.least_gap.items() if gap < math.inf}}

    def notes(self, *, done: bool) -> list[str]:
        """Sentences about obstacles; `done`: the run reached its end (collective)."""
        touched = [name for name, (gap, _) in self.least_gap.items() if gap < self._width[name]]
        closing = self._closing_over_ranks()
        missed = [self._missed_note(name) for name in self.least_gap if done and name not in touched]
        fast = [_speed_note(name, self._edge, *closing[name]) for name in touched if closing[name][0] > self._edge]
        # from a tenth of a mean edge on
        deep = [name for name in touched if self.least_gap[name][0] < -0.1 * self._edge]
        return [*missed, *fast, *(_overlap_note(name, self._edge, *self.least_gap[name]) for name in deep)]

    def _closing_over_ranks(self) -> dict[str, tuple[float, float, float]]:
        """`largest_closing` of the rank on which it is largest (collective)."""
        ranks: Sequence[dict[str, tuple[float, float, float]]] = self._comm.allgather(self.largest_closing)
        return {name: max(closing[name] for closing in ranks) for name in self.largest_closing}

    def _missed_note(self, name: str) -> str:
        gap, t = self.least_gap[name]
        return f"the obstacle {name} never met the body: it came no nearer than {gap:.3g} m, at t = {t:g} s"


def _speed_note(name: str, edge: float, closing: float, t: float, dt: float) -> str:
    """Sentence about a gap that closed by more than the mean edge (m) in the step of dt (s) that ended at t (s)."""
    return (
        f"{name} and the body met faster than the step can follow: at t = {t:g} s they closed in by {closing:.3g} m in "
        f"{dt:g} s, and an edge of the mesh is {edge:.3g} m; a time.step of {_round_down(dt * edge / closing):g} s "
        "would do"
    )


def _overlap_note(name: str, edge: float, gap: float, t: float) -> str:
    """Sentence about an obstacle within the body, with the least gap (m), its time (s) and the mean edge (m)."""
    return (
        f"{name} was inside the body by up to {-gap:.3g} m, {-gap / edge:.2g} of a mean edge, at t = {t:g} s: a higher "
        "contact.stiffness or a smaller mesh.h keeps them apart (docs/accuracy.md#contact)"
    )


def _round_down(value: float) -> float:
    """Value > 0 rounded down to one significant digit."""
    unit = 10.0 ** math.floor(math.log10(value))
    return math.floor(value / unit * (1 + 1e-9)) * unit


class ObstacleOverlapMonitor:
    """Deepest overlap of two obstacles in explicit steps, whose penalty fast ones may pass. The same on all ranks.

    Attributes:
        deepest_overlap: time in s, depth in m, and names of the two obstacles; empty if there was no overlap.
    """

    def __init__(self, motion: RigidObstacles) -> None:
        """Start without any frame; `motion` of the obstacles."""
        self._motion, self._pairs = motion, free_pairs([obstacle.free for obstacle in motion.obstacles])
        self.deepest_overlap: dict[str, Any] = {}

    def record_frame(self, t: float) -> None:
        """Record the poses of the obstacles at time t in s (not collective)."""
        if not self._pairs:
            return
        # An overlap from 0.1 of the size of a free obstacle on is told of.
        for first, second, depth in find_overlaps(self._motion.posed_at(t), self._pairs, 0.1):
            if depth > self.deepest_overlap.get("depth", 0.0):
                names = [self._motion.obstacles[number].name for number in (first, second)]
                self.deepest_overlap = {"time": t, "depth": depth, "both": names}

    def to_checkpoint(self) -> dict[str, Any]:
        """Values for `from_checkpoint`."""
        return {"obstacles_overlapped": self.deepest_overlap}

    def from_checkpoint(self, monitors: dict[str, Any]) -> None:
        """Restore the values of `to_checkpoint`."""
        self.deepest_overlap = monitors.get("obstacles_overlapped", {})

    def summary(self) -> dict[str, Any]:
        """Part of summary.json; empty if there was no overlap."""
        return self.to_checkpoint() if self.deepest_overlap else {}

    def notes(self) -> list[str]:
        """Sentence about an overlap, if there was one."""
        if not self.deepest_overlap:
            return []
        first, second = self.deepest_overlap["both"]
        return [
            f"{first} ran into {second}, by {self.deepest_overlap['depth']:.3g} m at "
            f"t = {self.deepest_overlap['time']:g} s: they met faster than explicit steps can follow"
        ]


class SelfContactTerm(Protocol):
    """Contact of a body with itself, as the monitor sees it."""

    def find_intersections(self) -> tuple[Values, Flags]:
        """(k, d) midpoints of pairs of facets that intersect, m, and (k,) flags of those without room (collective)."""


class IntersectionMonitor:
    """Facets of a body in contact with itself that intersect in a frame. The same on all ranks.

    Attributes:
        first_seen: of pairs "in_contact" and of crack faces "without_room", whose contact is off until there is room:
            time in s and place in m of the first one, and the largest number of pairs in a frame.
    """

    def __init__(self, term: SelfContactTerm) -> None:
        """Start without any frame; `term`: contact of the body with itself in implicit steps."""
        self._term = term
        self.first_seen: dict[str, dict[str, Any]] = {}

    def record_frame(self, t: float) -> None:
        """Record the current positions at time t in s (collective)."""
        positions, without_room = self._term.find_intersections()
        for kind, of_kind in (("in_contact", positions[~without_room]), ("without_room", positions[without_room])):
            if not len(of_kind):
                continue
            first = of_kind[np.lexsort(of_kind.T[::-1])[0]].tolist()
            entry = self.first_seen.setdefault(kind, {"time": t, "place": first, "pairs": 0})
            entry["pairs"] = max(entry["pairs"], len(of_kind))

    def to_checkpoint(self) -> dict[str, Any]:
        """Values for `from_checkpoint`."""
        return {"facets_intersect": self.first_seen}

    def from_checkpoint(self, monitors: dict[str, Any]) -> None:
        """Restore the values of `to_checkpoint`."""
        self.first_seen = monitors.get("facets_intersect", {})

    def summary(self) -> dict[str, Any]:
        """Part of summary.json; empty if nothing intersected."""
        return self.to_checkpoint() if self.first_seen else {}

    def notes(self) -> list[str]:
        """Sentences about facets that intersected."""
        remedies = {
            "in_contact": "contact has failed there, and the result is not to be trusted; a shorter time.step may help",
            "without_room": "crack faces that appeared without room have no contact until there is some; a smaller "
            "mesh.h leaves more",
        }
        return [_intersection_note(entry, remedies[kind]) for kind, entry in sorted(self.first_seen.items())]


def _intersection_note(entry: dict[str, Any], remedy: str) -> str:
    """Sentence about pairs of facets that were seen to intersect."""
    pairs = "1 pair" if entry["pairs"] == 1 else f"{entry['pairs']} pairs"
    return (
        f"{pairs} of facets of the body cut each other, first seen at t = {entry['time']:g} s near "
        f"{format_point(entry['place'])}: {remedy}"
    )
