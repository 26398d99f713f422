"""An obstacle that is held or driven: a shape whose reference point goes the way that a function of time says.

A rigid obstacle that moves by itself: a dropped weight, a striker in flight, a pendulum; and how it is moving.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import numpy as np

from ..mechanics.time_functions import TimeFunction
from .pose import Pose, PosedShape, Values, rotation_derivative, rotation_second_derivative
from .shape_base import Shape


@dataclass(frozen=True, eq=False)
class RigidObstacle:
    """A rigid obstacle without a mass of its own.

    Attributes:
        name: of its columns in history.csv.    shape: about its reference point.    at: (d,) that point at t = 0, m.
        moved: (d,) displacement of the obstacle at a time, m; None: it is held.
        friction: Coulomb's coefficient against the body.
        spin: (3,) rad/s at which it is turned about its reference point (solids alone); None: it does not turn.
    """

    name: str
    shape: Shape
    start_point: Values
    prescribed_displacement: TimeFunction | None = None
    friction: float = 0.0
    spin: Values | None = None
    free: ClassVar[bool] = False  # whether it has a mass, and moves by itself

    def posed_at(self, t: float) -> PosedShape:
        """Where it is at time t, s."""
        pose = Pose.at_point(self.start_point + self.displacement(t))
        return PosedShape(
            self.shape, pose if self.spin is None else pose.incremented(np.append(0 * self.start_point, t * self.spin))
        )

    def displacement(self, t: float) -> Values:
        """(d,) m."""
        return (
            np.zeros(len(self.start_point)) if self.prescribed_displacement is None else self.prescribed_displacement(t)
        )

    def pose_increment(self, start: float, end: float) -> Values:
        """(p,) increment q of its pose from one time to another."""
        shift = self.displacement(end) - self.displacement(start)
        return np.concatenate([shift, np.zeros(self._turns) if self.spin is None else (end - start) * self.spin])

    @cached_property
    def _turns(self) -> int:
        return 1 if len(self.start_point) == 2 else 3


@dataclass(frozen=True, eq=False, kw_only=True)
class FreeObstacle(RigidObstacle):
    """An obstacle with a mass. Its reference point is its centre, or the hinge that it hangs on.

    Attributes:
        mass: kg (2D: per metre of thickness).    inertia: (3, 3), in 2D (), about the reference point at the start.
        ways: (p, k) what it may do: its pose moves by ways @ z, z (k,). The identity: anything.
        centre: (d,) its centre of mass from the reference point, at the start, m.    gravity: (d,) m/s^2.
        rate: (k,) dz/dt at the start, m/s and rad/s.
    """

    mass: float
    inertia: Values
    motion_basis: Values
    mass_centre: Values
    gravity: Values
    start_rate: Values
    free: ClassVar[bool] = True

    @cached_property
    def pose_size(self) -> int:
        """p."""
        return len(self.start_point) + self._turns

    def mass_matrix(self, rotation: Values) -> Values:
        """(k, k) mass matrix of z with the body turned by `rotation`.

        Where the centre of mass is not the reference point that point is held: no motion couples the two.
        """
        d, full = len(self.start_point), np.zeros((self.pose_size, self.pose_size))
        full[:d, :d] = self.mass * np.eye(d)
        full[d:, d:] = rotation @ self.inertia @ rotation.T if d == 3 else self.inertia
        return np.asarray(self.motion_basis.T @ full @ self.motion_basis)

    def gravity_potential(self, pose: Pose) -> tuple[float, Values, Values]:
        """-m g . x of the centre of mass, J, with its derivatives (p,), (p, p) by an increment of the pose."""
        d, arm, force = len(self.start_point), pose.rotation @ self.mass_centre, self.mass * self.gravity
        gradient, hessian = np.zeros(self.pose_size), np.zeros((self.pose_size, self.pose_size))
        gradient[:d], gradient[d:] = -force, force @ rotation_derivative(arm[None])[0]
        hessian[d:, d:] = -rotation_second_derivative(force[None], arm[None])[0]
        return -float(force @ (pose.centre + arm)), gradient, hessian

    def history_values(self, flight: RigidMotion) -> Values:
        """(2 d + 2 r + 1,) place and velocity of the centre of mass, turn and spin, energy of motion; m, m/s, rad,
        rad/s, J."""
        pose, d = flight.pose, len(self.start_point)
        rate = np.linalg.solve(self.mass_matrix(pose.rotation), flight.momentum)
        arm, q = pose.rotation @ self.mass_centre, self.motion_basis @ rate
        velocity = q[:d] - rotation_derivative(arm[None])[0] @ q[d:]
        energy = 0.5 * float(flight.momentum @ rate)
        return np.concatenate([pose.centre + arm, velocity, flight.rotation, q[d:], [energy]])

    def start_motion(self) -> RigidMotion:
        """How it moves at t = 0, before anything touches it."""
        pose = Pose.at_point(self.start_point)
        momentum = self.mass_matrix(pose.rotation) @ self.start_rate
        force = -self.motion_basis.T @ self.gravity_potential(pose)[1]
        return RigidMotion(pose, momentum, force, np.zeros(self._turns))


@dataclass(frozen=True, eq=False)
class RigidMotion:
    """How an obstacle is moving.

    Attributes:
        pose: where it is.    momentum: (k,) of its ways, M dz/dt, kg m/s and kg m^2/s (about the reference point).
        force: (k,) the rate of the momentum that second-order schemes carry, N and N m.
        turned: (r,) in 2D the angle since the start, rad, whole turns counted; in 3D the rotation vector.
    """

    pose: Pose
    momentum: Values
    force: Values
    rotation: Values = field(default_factory=lambda: np.zeros(1))

    def to_array(self) -> Values:
        """All its numbers in a row."""
        return np.concatenate(
            [self.pose.centre, self.pose.rotation.reshape(-1), self.momentum, self.force, self.rotation]
        )

    def from_array(self, numbers: Values) -> RigidMotion:
        """The flight whose `flat` gave these numbers, of the same obstacle."""
        d, k, r = self.pose.dim, len(self.momentum), len(self.rotation)
        centre, rotation, momentum, force, turned, _ = np.split(numbers, np.cumsum([d, d * d, k, k, r]))
        return RigidMotion(Pose(centre, rotation.reshape(d, d)), momentum, force, turned)


def motion_rows(flights: Iterable[RigidMotion]) -> Values:
    """(n, m) the numbers of flights, a row each; shorter rows, as of what turns about a hinge, end with zeros."""
    rows = [flight.to_array() for flight in flights]
    longest = max(map(len, rows), default=0)
    return np.array([np.pad(row, (0, longest - len(row))) for row in rows])
