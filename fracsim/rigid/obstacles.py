"""Obstacles among rigid bodies: what stands, held or driven, and what moves freely, as bodies do that do not break.

Things are numbered: pieces first, then free obstacles, then the parts of what stands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, cast

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from ..contact.obstacle import RigidObstacle
from ..contact.pose import Pose, PosedShape
from .bodies import Bodies
from .convex_decomposition import outermost
from .mujoco_model import Part, Stand
from .obstacle_shapes import Primitive, primitives

if TYPE_CHECKING:
    from ..contact.obstacle import FreeObstacle

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


class Others:
    """Of a study, beside its bodies.

    Attributes:
        every: all of them.    free: numbers of those that move freely.
        owner: (things,) the obstacle that each free one, and then each part of what stands, is of.
        parts, outer: convex parts and outermost points of each that is free, as of bodies.
        extent: (things,) half sizes, m; infinite of planes.
    """

    def __init__(self, every: Sequence[RigidObstacle]) -> None:
        self.every = every
        self.free = [number for number, each in enumerate(every) if each.free]
        shapes = [primitives(each.shape, f"obstacle {each.name}") for each in every]
        self.parts: list[list[Part]] = [
            [replace(part, friction=every[number].friction) for part in shapes[number]] for number in self.free
        ]
        self.outer = [_outer(shapes[number]) for number in self.free]
        self._standing = [(k, part) for k, each in enumerate(every) if not each.free for part in shapes[k]]
        self.owner: Ints = np.array([*self.free, *(number for number, _ in self._standing)], np.int64)
        standing = [part.extent for _, part in self._standing]
        self.extent = np.array([*(shapes[number][0].extent for number in self.free), *standing])
        self.driven = any(each.prescribed_displacement is not None for each in every)

    def bodies(self) -> Bodies:
        """Those that are free, at the start."""
        free = [cast("FreeObstacle", self.every[number]) for number in self.free]
        at = np.array([each.start_point for each in free]).reshape(-1, 3)
        rate = np.array([each.start_rate for each in free]).reshape(-1, 6)
        inertia = np.array([each.inertia for each in free]).reshape(-1, 3, 3)
        mass, turn = np.array([each.mass for each in free]), np.tile(np.eye(3), (len(free), 1, 1))
        return Bodies(mass, at, inertia, at, turn, rate[:, :3], rate[:, 3:])

    def stands(self, t: float) -> list[Stand]:
        """What stands at a time, s."""
        every = self.every
        return [Stand(part, self.way(number, t), every[number].friction,
                      every[number].prescribed_displacement is not None)
                for number, part in self._standing]  # fmt: skip

    def ways(self, t: float) -> Values | None:
        """(stands, 3) reference points at a time, s; None where nothing is driven."""
        return np.array([self.way(number, t) for number, _ in self._standing]) if self.driven else None

    def way(self, number: int, t: float) -> Values:
        """(3,) where the reference point of what stands is at a time, s."""
        return np.asarray(self.every[number].start_point + self.every[number].displacement(t), float)

    def moved(self, t: float, dt: float) -> Values:
        """(obstacles, 3) how far each goes that is driven, in the step from a time on, m."""
        return np.array([self.way(k, t + dt) - self.way(k, t) for k in range(len(self.every))]).reshape(-1, 3)

    def placed(self, t: float, bodies: Bodies) -> list[PosedShape]:
        """Where they are at a time, s, with the free ones after all pieces among the `bodies`."""
        first = len(bodies) - len(self.free)
        result = [each.posed_at(t) for each in self.every]
        for place, number in enumerate(self.free, first):
            result[number] = PosedShape(self.every[number].shape, Pose(bodies.place[place], bodies.turn[place]))
        return result

    def readings(self, bodies: Bodies) -> Values:
        """What columns_of each free one tell: place, velocity, turn, spin and energy of motion."""
        mine = bodies.part(slice(len(bodies) - len(self.free), None))
        turn = Rotation.from_matrix(mine.turn).as_rotvec() if self.free else mine.spin
        return np.concatenate([mine.place, mine.velocity, turn, mine.spin, mine.kinetics[:, None]], axis=1).ravel()

    def columns(self) -> list[str]:
        """Names of the readings."""
        if not self.free:
            return []
        from ..contact.rigid_obstacle_state import column_names

        return [name for number in self.free for name in column_names(cast("FreeObstacle", self.every[number]))]


def _outer(parts: Sequence[Primitive]) -> Values:
    """(k, 3) corners that a plane may meet; none of round things, which the engine has itself."""
    hulls = [part.corners for part in parts if part.corners is not None]
    return outermost(np.concatenate(hulls)) if hulls else np.empty((0, 3))
