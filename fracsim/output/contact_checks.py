"""Obstacles that never met the body, met it faster than the steps could follow, or are too small: told at the end."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Protocol

from mpi4py import MPI

from ..contact.drawing import min_extent
from ..contact.obstacle import RigidObstacle
from ..timestepping.state import State


class Met(Protocol):
    """A term of obstacles.

    Attributes:
        obstacles: with their names.    edge: of the body's mesh in the mean, m.    width: of the barrier, m.
    """

    obstacles: tuple[RigidObstacle, ...]
    comm: MPI.Intracomm

    @property
    def mean_edge_length(self) -> float: ...

    @property
    def barrier_width(self) -> float: ...

    def closing_distances(self) -> list[float]:
        """How far each and what it touches would have come closer in the last step, m, on this rank (collective)."""

    def points_only_flags(self) -> list[tuple[RigidObstacle, bool]]:
        """Each, and whether only points of the body feel it."""


class Meetings:
    """What has come of each obstacle so far.

    Attributes:
        gap: name -> (least distance to the body, m, and when, s).
        closed: name -> (farthest that it and the body would have come closer in a step in which they met, m; when that
            step ended, s; its size, s); of this rank.
    """

    def __init__(self, contacts: Sequence[Met]) -> None:
        """`contacts`: terms of obstacles (collective)."""
        self._contacts, self._edge = contacts, contacts[0].mean_edge_length
        self._width = {each.name: contact.barrier_width for contact in contacts for each in contact.obstacles}
        self.gap = dict.fromkeys(self._width, (math.inf, 0.0))
        self.closed = dict.fromkeys(self.gap, (0.0, 0.0, 0.0))

    def look(self, state: State, dt: float, figures: dict[str, float]) -> None:
        """Note a step of dt s that was taken; `figures`: the columns gap_NAME of history.csv (collective)."""
        closings = [closing for contact in self._contacts for closing in contact.closing_distances()]
        for (name, gap), closing in zip(self.gap.items(), closings, strict=True):
            if figures[f"gap_{name}"] < gap[0]:
                self.gap[name] = figures[f"gap_{name}"], state.t
            if closing > self.closed[name][0]:
                self.closed[name] = closing, state.t, dt

    def monitors(self) -> dict[str, Any]:
        """What a restart goes on from, for `restore` (collective)."""
        return {"least_gap": self.gap, "closed_in_a_step": self._over_ranks()}

    def restore(self, monitors: dict[str, Any]) -> None:
        """Go on from `monitors`."""
        self.gap |= {name: tuple(found) for name, found in monitors.get("least_gap", {}).items()}
        self.closed |= {name: tuple(found) for name, found in monitors.get("closed_in_a_step", {}).items()}

    def summary(self) -> dict[str, Any]:
        """For summary.json: the least gap to each, m."""
        return {"least_gap": {name: gap for name, (gap, _) in self.gap.items() if gap < math.inf}}

    def notes(self, *, done: bool) -> list[str]:
        """A sentence of each obstacle that has one; `done`: the run came to its end (collective)."""
        met = [name for name, (gap, _) in self.gap.items() if gap < self._width[name]]
        closed, sizes = self._over_ranks(), zip(self.gap, self._sizes(), strict=True)
        missed = [self._missed(name) for name in self.gap if done and name not in met]
        small = [_too_small(name, size, self._edge) for name, size in sizes if size < self._edge]
        fast = [_too_fast(name, self._edge, *closed[name]) for name in met if closed[name][0] > self._edge]
        return [*missed, *small, *fast]

    def _sizes(self) -> list[float]:
        """The least extent of each obstacle that points alone feel, m; infinite of a plane and of one that the body is
        in."""
        alone = [each for contact in self._contacts for each in contact.points_only_flags()]
        return [min_extent(each.shape) if only else math.inf for each, only in alone]

    def _over_ranks(self) -> dict[str, tuple[float, float, float]]:
        """`closed` of the rank where it is largest (collective)."""
        every: Sequence[dict[str, tuple[float, float, float]]] = self._contacts[0].comm.allgather(self.closed)
        return {name: max(each[name] for each in every) for name in self.closed}

    def _missed(self, name: str) -> str:
        gap, t = self.gap[name]
        return f"the obstacle {name} never met the body: it came no nearer than {gap:.3g} m, at t = {t:g} s"


def _too_small(name: str, size: float, edge: float) -> str:
    return (
        f"{name} is {size:.3g} m across, and an edge of the mesh {edge:.3g} m: it may pass between the points of the "
        "surface, which alone feel obstacles; a smaller mesh.h would do"
    )


def _too_fast(name: str, edge: float, closed: float, t: float, dt: float) -> str:
    return (
        f"{name} and the body met faster than the step can follow: at t = {t:g} s they closed in by {closed:.3g} m in "
        f"{dt:g} s, and an edge of the mesh is {edge:.3g} m; a time.step of {_rounded_down(dt * edge / closed):g} s "
        "would do"
    )


def _rounded_down(value: float) -> float:
    """To one digit."""
    unit = 10.0 ** math.floor(math.log10(value))
    return math.floor(value / unit * (1 + 1e-9)) * unit
