"""What terms with free obstacles have in common: how these fly is their past, and told in history.csv."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Protocol, cast

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..meshes.text import AXES
from .obstacle import FreeObstacle, RigidMotion, motion_rows
from .obstacle_term import ObstacleTerm
from .pose import PosedShape

Values = npt.NDArray[np.float64]


class MovingObstacle(Protocol):
    """A free obstacle, and how it moves at the start of a step until that is over."""

    body: FreeObstacle
    motion: RigidMotion


class PlaceableObstacle(MovingObstacle, Protocol):
    """One that is placed by its flight."""

    def reset_pose(self) -> PosedShape:
        """Where it is between two steps."""


class FreeObstacleBase(ObstacleTerm):
    """Obstacles of which some are free.

    Attributes:
        free: those by their number.
    """

    free: Mapping[int, PlaceableObstacle]

    def _prescribed_numbers(self) -> list[int]:
        return [number for number in super()._prescribed_numbers() if number not in self.free]

    def free_motions(self) -> dict[int, RigidMotion]:
        """How each moves, by its number."""
        return {number: each.motion for number, each in self.free.items()}

    def set_free_motions(self, flights: Mapping[int, RigidMotion]) -> None:
        """Move again as `flights` gave it."""
        for number, each in self.free.items():
            each.motion = flights[number]

    def _place_obstacles(self, start: float, end: float) -> None:
        super()._place_obstacles(start, end)
        for number, each in self.free.items():
            self._kinematics.hold_at_start(number, each.reset_pose())

    def snapshot(self) -> object:
        """That of the points, and how obstacles move."""
        return super().snapshot(), self.free_motions()

    def restore(self, memory: object) -> None:
        """Be again what `memory` gave (not collective)."""
        points, flights = cast("tuple[object, dict[int, RigidMotion]]", memory)
        super().restore(points)
        self.set_free_motions(flights)

    def to_checkpoint(self) -> dict[str, Values]:
        """With rows of how obstacles move (collective)."""
        return super().to_checkpoint() | {"flights": motion_rows(each.motion for each in self.free.values())}

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Be again what `saved` gave."""
        super().from_checkpoint(saved)
        for k, each in enumerate(self.free.values()):
            each.motion = each.motion.from_array(saved["flights"][k])

    def posed_obstacles(self, t: float) -> list[PosedShape]:
        """Each obstacle at the time t of the state, s (not collective)."""
        here = super().posed_obstacles(t)
        for number, each in self.free.items():
            here[number] = PosedShape(here[number].shape, each.motion.pose)
        return here

    def kinetic_energy(self) -> float:
        """Energy of motion of the free obstacles, on rank 0, J."""
        if self.comm.rank:
            return 0.0
        return float(sum(each.body.history_values(each.motion)[-1] for each in self.free.values()))

    def summed_columns(self) -> dict[str, Callable[[], Values]]:
        """With position_NAME_x, velocity_NAME_x of the centre of mass, m and m/s, turn_NAME_z, spin_NAME_z in rad and
        rad/s, and kinetic_NAME in J of each that is free."""
        return super().summed_columns() | motion_columns(self.free.values(), self.comm)


def motion_columns(free: Iterable[MovingObstacle], comm: MPI.Intracomm) -> dict[str, Callable[[], Values]]:
    """Columns of history.csv that tell how obstacles fly, each with a function that gives this rank's share, (1,)."""
    tellers = [(_MotionReader(each, comm), column_names(each.body)) for each in free]
    return {name: partial(teller, place) for teller, names in tellers for place, name in enumerate(names)}


class _MotionReader:
    """What an obstacle tells of how it flies: asked for each column, found once for each flight."""

    def __init__(self, flying: MovingObstacle, comm: MPI.Intracomm) -> None:
        self._flying, self._root = flying, comm.rank == 0
        self._flight: RigidMotion | None = None
        self._told: Values = np.empty(0)

    def __call__(self, place: int) -> Values:
        """(1,) the column there; 0 where it is not this rank's to tell."""
        if not self._root:
            return np.zeros(1)
        if self._flight is not self._flying.motion:
            self._flight = self._flying.motion
            self._told = self._flying.body.history_values(self._flight)
        return self._told[place : place + 1]


def column_names(body: FreeObstacle) -> list[str]:
    """Names of what `told` gives."""
    d = len(body.start_point)
    axes, turns = AXES[:d], AXES[2:] if d == 2 else AXES
    kinds = [("position", axes), ("velocity", axes), ("turn", turns), ("spin", turns)]
    return [*[f"{kind}_{body.name}_{axis}" for kind, over in kinds for axis in over], f"kinetic_{body.name}"]
