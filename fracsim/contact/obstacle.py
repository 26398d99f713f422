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
from .pose import Placed, Pose, Values, second_order_turn, turning
from .shape_base import Shape


@dataclass(frozen=True, eq=False)
class Obstacle:
    """A rigid obstacle without a mass of its own.

    Attributes:
        name: of its columns in history.csv.    shape: about its reference point.    at: (d,) that point at t = 0, m.
        moved: (d,) displacement of the obstacle at a time, m; None: it is held.
        friction: Coulomb's coefficient against the body.
        spin: (3,) rad/s at which it is turned about its reference point (solids alone); None: it does not turn.
    """

    name: str
    shape: Shape
    at: Values
    moved: TimeFunction | None = None
    friction: float = 0.0
    spin: Values | None = None
    free: ClassVar[bool] = False  # whether it has a mass, and moves by itself

    def placed(self, t: float) -> Placed:
        """Where it is at time t, s."""
        pose = Pose.at(self.at + self.displacement(t))
        return Placed(self.shape, pose if self.spin is None else pose.moved(np.append(0 * self.at, t * self.spin)))

    def displacement(self, t: float) -> Values:
        """(d,) m."""
        return np.zeros(len(self.at)) if self.moved is None else self.moved(t)

    def way(self, start: float, end: float) -> Values:
        """(p,) increment q of its pose from one time to another."""
        shift = self.displacement(end) - self.displacement(start)
        return np.concatenate([shift, np.zeros(self._turns) if self.spin is None else (end - start) * self.spin])

    @cached_property
    def _turns(self) -> int:
        return 1 if len(self.at) == 2 else 3


@dataclass(frozen=True, eq=False, kw_only=True)
class FreeObstacle(Obstacle):
    """An obstacle with a mass. Its reference point is its centre, or the hinge that it hangs on.

    Attributes:
        mass: kg (2D: per metre of thickness).    inertia: (3, 3), in 2D (), about the reference point at the start.
        ways: (p, k) what it may do: its pose moves by ways @ z, z (k,). The identity: anything.
        centre: (d,) its centre of mass from the reference point, at the start, m.    gravity: (d,) m/s^2.
        rate: (k,) dz/dt at the start, m/s and rad/s.
    """

    mass: float
    inertia: Values
    ways: Values
    centre: Values
    gravity: Values
    rate: Values
    free: ClassVar[bool] = True

    @cached_property
    def count(self) -> int:
        """p."""
        return len(self.at) + self._turns

    def matrix(self, rotation: Values) -> Values:
        """(k, k) mass matrix of z with the body turned by `rotation`.

        Where the centre of mass is not the reference point that point is held: no motion couples the two.
        """
        d, full = len(self.at), np.zeros((self.count, self.count))
        full[:d, :d] = self.mass * np.eye(d)
        full[d:, d:] = rotation @ self.inertia @ rotation.T if d == 3 else self.inertia
        return np.asarray(self.ways.T @ full @ self.ways)

    def weight(self, pose: Pose) -> tuple[float, Values, Values]:
        """-m g . x of the centre of mass, J, with its derivatives (p,), (p, p) by an increment of the pose."""
        d, arm, force = len(self.at), pose.rotation @ self.centre, self.mass * self.gravity
        gradient, hessian = np.zeros(self.count), np.zeros((self.count, self.count))
        gradient[:d], gradient[d:] = -force, force @ turning(arm[None])[0]
        hessian[d:, d:] = -second_order_turn(force[None], arm[None])[0]
        return -float(force @ (pose.centre + arm)), gradient, hessian

    def told(self, flight: Flight) -> Values:
        """(2 d + 2 r + 1,) place and velocity of the centre of mass, turn and spin, energy of motion; m, m/s, rad,
        rad/s, J."""
        pose, d = flight.pose, len(self.at)
        rate = np.linalg.solve(self.matrix(pose.rotation), flight.momentum)
        arm, q = pose.rotation @ self.centre, self.ways @ rate
        velocity = q[:d] - turning(arm[None])[0] @ q[d:]
        energy = 0.5 * float(flight.momentum @ rate)
        return np.concatenate([pose.centre + arm, velocity, flight.turned, q[d:], [energy]])

    def at_first(self) -> Flight:
        """How it moves at t = 0, before anything touches it."""
        pose = Pose.at(self.at)
        momentum = self.matrix(pose.rotation) @ self.rate
        force = -self.ways.T @ self.weight(pose)[1]
        return Flight(pose, momentum, force, np.zeros(self._turns))


@dataclass(frozen=True, eq=False)
class Flight:
    """How an obstacle is moving.

    Attributes:
        pose: where it is.    momentum: (k,) of its ways, M dz/dt, kg m/s and kg m^2/s (about the reference point).
        force: (k,) the rate of the momentum that second-order schemes carry, N and N m.
        turned: (r,) in 2D the angle since the start, rad, whole turns counted; in 3D the rotation vector.
    """

    pose: Pose
    momentum: Values
    force: Values
    turned: Values = field(default_factory=lambda: np.zeros(1))

    def flat(self) -> Values:
        """All its numbers in a row."""
        return np.concatenate(
            [self.pose.centre, self.pose.rotation.reshape(-1), self.momentum, self.force, self.turned]
        )

    def like(self, numbers: Values) -> Flight:
        """The flight whose `flat` gave these numbers, of the same obstacle."""
        d, k, r = self.pose.dim, len(self.momentum), len(self.turned)
        centre, rotation, momentum, force, turned, _ = np.split(numbers, np.cumsum([d, d * d, k, k, r]))
        return Flight(Pose(centre, rotation.reshape(d, d)), momentum, force, turned)


def rows_of(flights: Iterable[Flight]) -> Values:
    """(n, m) the numbers of flights, a row each; shorter rows, as of what turns about a hinge, end with zeros."""
    rows = [flight.flat() for flight in flights]
    longest = max(map(len, rows), default=0)
    return np.array([np.pad(row, (0, longest - len(row))) for row in rows])
