"""Obstacles in explicit steps of which some move freely.

A free obstacle in explicit steps: velocity Verlet of its momentum, as of that of every node.

    p_{n+1/2} = p_n + dt/2 f_n,    z = dt M^-1 p_{n+1/2},    p_{n+1} = p_{n+1/2} + dt/2 f_{n+1}

p the momentum of what it may do (its ways), M its mass where it will be half-way; forces and moments are those of the
points themselves, so that body and obstacle exchange momentum to round-off, in a step of any size.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from ..mesh.domain import Domain
from ..mesh.parallel import sum_over_ranks
from .laws import Law
from .obstacle import Flight, FreeObstacle, Obstacle
from .penalty_obstacles import ExplicitObstacles
from .pose import Placed, turning
from .rigid_body import on_obstacle
from .rigid_obstacle_state import Flights

Values = npt.NDArray[np.float64]
NEAR = 3.0  # widths of the penalty: gaps of points that may be in touch a step later


class Drift:
    """A free obstacle on its way.

    Attributes:
        body: what moves.    flight: how, at the start of a step until it is over.    weighed: J, what gravity has done.
    """

    weighed: float = 0.0

    def __init__(self, body: FreeObstacle) -> None:
        self.body, self.flight = body, body.at_first()

    def look(self) -> Placed:
        """Where it is between two steps."""
        return Placed(self.body.shape, self.flight.pose)

    def begin(self, dt: float) -> Placed:
        """Where it is at the end of a step of dt s."""
        start, ways = self.flight.pose, self.body.ways
        self._dt, self._half = dt, self.flight.momentum + dt / 2 * self.flight.force
        ahead = dt / 2 * _over(self.body.matrix(start.rotation), self._half)
        mass = self.body.matrix(start.moved(ways @ ahead).rotation)
        self._way: Values = np.asarray(ways @ (dt * _over(mass, self._half)))
        return Placed(self.body.shape, start.moved(self._way))

    def arrive(self, placed: Placed, pushed: Values) -> float:
        """The step is over, with force and moment (p,) of the body on it at its end, N and N m; the work that contact
        has done on it, J."""
        began, body, pose = self.flight, self.body, placed.pose
        force = body.ways.T @ (pushed - body.weight(pose)[1])
        turned = pose.turned() if pose.dim == 3 else began.turned + self._way[2:]
        self.flight = Flight(pose, self._half + self._dt / 2 * force, force, turned)
        self.weighed = body.weight(began.pose)[0] - body.weight(pose)[0]
        return float(body.told(self.flight)[-1] - body.told(began)[-1]) - self.weighed

    def under(self, x: Values, placed: Placed) -> Values:
        """(n, d) way in the step of what was under places x (n, d) at its start, m."""
        return placed.pose.points_to_space(self.flight.pose.to_body(x)) - x

    def resistance(self, x: Values, k: Values, placed: Placed) -> Values:
        """(ways, ways) stiffness of springs k (n,), N/m, in any direction at places x (n, d)."""
        arm = x - placed.pose.centre
        still = np.broadcast_to(-np.eye(arm.shape[1]), (len(arm), arm.shape[1], arm.shape[1]))
        J = np.concatenate([still, turning(arm)], axis=2) @ self.body.ways
        return np.asarray(np.einsum("n,nip,niq->pq", k, J, J))

    def fastest(self, resistance: Values, placed: Placed) -> float:
        """The square of its highest frequency with the body held, 1/s^2."""
        mass = self.body.matrix(placed.pose.rotation)
        return float(np.linalg.eigvals(_over(mass, resistance)).real.max(initial=0.0))


def _over(matrix: Values, values: Values) -> Values:
    """A^-1 b."""
    return np.asarray(np.linalg.solve(matrix, values), np.float64)


class ExplicitFreeObstacles(Flights, ExplicitObstacles):
    """Obstacles, at least one of them free, that explicit steps run into."""

    free: dict[int, Drift]

    def __init__(
        self, domain: Domain, u: fem.Function, obstacles: Sequence[Obstacle], law: Law, mass: Values, most: float
    ) -> None:
        """As of ExplicitObstacles (collective)."""
        self.free = {number: Drift(each) for number, each in enumerate(obstacles) if isinstance(each, FreeObstacle)}
        super().__init__(domain, u, obstacles, law, mass, most)

    def frequency_bound(self) -> float:
        """With what the lightest obstacle adds on the springs that are near it: squares of a body and an obstacle on
        one spring add up, obstacles know nothing of each other (collective)."""
        self.touching()
        return super().frequency_bound() + max(self._fastest_of(*each) for each in self.free.items())

    def _fastest_of(self, number: int, each: Drift) -> float:
        placed = self._course.placed[number]
        near = np.flatnonzero(placed.distance(self.x) < NEAR * self.law.barrier.width)
        resistance = each.resistance(self.x[near], self.stiffness[near], placed)
        return each.fastest(sum_over_ranks(self.comm, resistance.reshape(-1)).reshape(resistance.shape), placed)

    # --- a step ---

    def _start_of_step(self) -> None:
        super()._start_of_step()
        for number, each in self.free.items():
            self._course.placed[number] = each.begin(self._level.dt)

    def _way_under(self, number: int, placed: Placed) -> Values:
        if number in self.free and self._from is not None:
            return self.free[number].under(self._from, placed)
        return super()._way_under(number, placed)

    def accept_step(self) -> None:
        """The step is over: obstacles have the momentum that it gave them (collective)."""
        super().accept_step()
        for number, each in self.free.items():
            placed, found = self._course.placed[number], self.touching()[number]
            worked = each.arrive(placed, sum_over_ranks(self.comm, on_obstacle(found, self.x, placed.pose)))
            self._worked[number] = 0.0 if self.comm.rank else -worked

    def step_work(self) -> tuple[float, float]:
        """With the work of gravity on free obstacles (on rank 0)."""
        work, lost = super().step_work()
        return work + (0.0 if self.comm.rank else sum(each.weighed for each in self.free.values())), lost

    # --- its past ---

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Be again what `saved` gave."""
        super().from_checkpoint(saved)
        for number, each in self.free.items():
            self._course.put_at_start(number, each.look())
        self.update_displacement()
