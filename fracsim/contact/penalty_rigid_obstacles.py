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
from .laws import ObstacleLaw
from .obstacle import FreeObstacle, RigidMotion, RigidObstacle
from .penalty_obstacles import PenaltyObstacleTerm
from .pose import PosedShape, rotation_derivative
from .rigid_body import contact_wrench
from .rigid_obstacle_state import FreeObstacleBase

Values = npt.NDArray[np.float64]
NEAR = 3.0  # widths of the penalty: gaps of points that may be in touch a step later


class VerletObstacle:
    """A free obstacle on its way.

    Attributes:
        body: what moves.    flight: how, at the start of a step until it is over.    weighed: J, what gravity has done.
    """

    gravity_work: float = 0.0

    def __init__(self, body: FreeObstacle) -> None:
        self.body, self.motion = body, body.start_motion()

    def reset_pose(self) -> PosedShape:
        """Where it is between two steps."""
        return PosedShape(self.body.shape, self.motion.pose)

    def begin_step(self, dt: float) -> PosedShape:
        """Where it is at the end of a step of dt s."""
        start, ways = self.motion.pose, self.body.motion_basis
        self._dt, self._half = dt, self.motion.momentum + dt / 2 * self.motion.force
        ahead = dt / 2 * _over(self.body.mass_matrix(start.rotation), self._half)
        mass = self.body.mass_matrix(start.incremented(ways @ ahead).rotation)
        self._way: Values = np.asarray(ways @ (dt * _over(mass, self._half)))
        return PosedShape(self.body.shape, start.incremented(self._way))

    def end_step(self, placed: PosedShape, pushed: Values) -> float:
        """The step is over, with force and moment (p,) of the body on it at its end, N and N m; the work that contact
        has done on it, J."""
        began, body, pose = self.motion, self.body, placed.pose
        force = body.motion_basis.T @ (pushed - body.gravity_potential(pose)[1])
        turned = pose.rotation_vector() if pose.dim == 3 else began.rotation + self._way[2:]
        self.motion = RigidMotion(pose, self._half + self._dt / 2 * force, force, turned)
        self.gravity_work = body.gravity_potential(began.pose)[0] - body.gravity_potential(pose)[0]
        return float(body.history_values(self.motion)[-1] - body.history_values(began)[-1]) - self.gravity_work

    def contact_point_motion(self, x: Values, placed: PosedShape) -> Values:
        """(n, d) way in the step of what was under places x (n, d) at its start, m."""
        return placed.pose.points_to_space(self.motion.pose.to_body(x)) - x

    def spring_stiffness(self, x: Values, k: Values, placed: PosedShape) -> Values:
        """(ways, ways) stiffness of springs k (n,), N/m, in any direction at places x (n, d)."""
        arm = x - placed.pose.centre
        still = np.broadcast_to(-np.eye(arm.shape[1]), (len(arm), arm.shape[1], arm.shape[1]))
        J = np.concatenate([still, rotation_derivative(arm)], axis=2) @ self.body.motion_basis
        return np.asarray(np.einsum("n,nip,niq->pq", k, J, J))

    def max_frequency(self, resistance: Values, placed: PosedShape) -> float:
        """The square of its highest frequency with the body held, 1/s^2."""
        mass = self.body.mass_matrix(placed.pose.rotation)
        return float(np.linalg.eigvals(_over(mass, resistance)).real.max(initial=0.0))


def _over(matrix: Values, values: Values) -> Values:
    """A^-1 b."""
    return np.asarray(np.linalg.solve(matrix, values), np.float64)


class PenaltyFreeObstacleTerm(FreeObstacleBase, PenaltyObstacleTerm):
    """Obstacles, at least one of them free, that explicit steps run into."""

    free: dict[int, VerletObstacle]

    def __init__(
        self,
        domain: Domain,
        u: fem.Function,
        obstacles: Sequence[RigidObstacle],
        law: ObstacleLaw,
        mass: Values,
        most: float,
    ) -> None:
        """As of ExplicitObstacles (collective)."""
        self.free = {
            number: VerletObstacle(each) for number, each in enumerate(obstacles) if isinstance(each, FreeObstacle)
        }
        super().__init__(domain, u, obstacles, law, mass, most)

    def frequency_bound(self) -> float:
        """With what the lightest obstacle adds on the springs that are near it: squares of a body and an obstacle on
        one spring add up, obstacles know nothing of each other (collective)."""
        self.obstacle_forces()
        return super().frequency_bound() + max(self._fastest_of(*each) for each in self.free.items())

    def _fastest_of(self, number: int, each: VerletObstacle) -> float:
        placed = self._kinematics.posed[number]
        near = np.flatnonzero(placed.distance(self.positions) < NEAR * self.law.barrier.width)
        resistance = each.spring_stiffness(self.positions[near], self.stiffness[near], placed)
        return each.max_frequency(sum_over_ranks(self.comm, resistance.reshape(-1)).reshape(resistance.shape), placed)

    # --- a step ---

    def _begin_new_step(self) -> None:
        super()._begin_new_step()
        for number, each in self.free.items():
            self._kinematics.posed[number] = each.begin_step(self._level.dt)

    def _obstacle_point_motion(self, number: int, placed: PosedShape) -> Values:
        if number in self.free and self._start_points is not None:
            return self.free[number].contact_point_motion(self._start_points, placed)
        return super()._obstacle_point_motion(number, placed)

    def accept_step(self) -> None:
        """The step is over: obstacles have the momentum that it gave them (collective)."""
        super().accept_step()
        for number, each in self.free.items():
            placed, found = self._kinematics.posed[number], self.obstacle_forces()[number]
            wrench = contact_wrench(found, self.positions, placed.pose)
            worked = each.end_step(placed, sum_over_ranks(self.comm, wrench))
            self._obstacle_work[number] = 0.0 if self.comm.rank else -worked

    def step_work(self) -> tuple[float, float]:
        """With the work of gravity on free obstacles (on rank 0)."""
        work, lost = super().step_work()
        return work + (0.0 if self.comm.rank else sum(each.gravity_work for each in self.free.values())), lost

    # --- its past ---

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Be again what `saved` gave."""
        super().from_checkpoint(saved)
        for number, each in self.free.items():
            self._kinematics.hold_at_start(number, each.reset_pose())
        self.update_displacement()
