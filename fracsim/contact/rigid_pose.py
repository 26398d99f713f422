"""Pose of free obstacles for a given body: static condensation of the pose, and several obstacles together.

The pose minimises the incremental potential Phi (rigid_body), found on paths without a collision.

Equations: docs/theory.md#rigid-obstacles.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..mesh.parallel import sum_over_ranks
from .contact_surface import ContactSurface
from .facet_contact import ContactFacets
from .laws import GapPotential
from .node_contact import ContactForces, LaggedContact
from .obstacle import FreeObstacle, RigidMotion
from .obstacle_pairs import ObstaclePair, ObstaclePairs
from .pose import Pose, PosedShape
from .pose_derivatives import (
    PoseDerivatives,
    carried_point_derivatives,
    contact_wrench,
    mixed_pose_hessian,
    point_pose_hessian,
    pose_derivatives,
    resultant,
)
from .rigid_body import PosePredictor, RigidStep, RigidSystem, SystemDerivatives
from .step_limit import PoseMotion, safe_motion_fractions

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class BodySurroundings:
    """Body and obstacles around a free obstacle.

    Attributes:
        surface: points of the body.
        positions: (n, d) of these points, m.
        evaluate: obstacle at a pose -> its forces on the points.
        facets: facets on which the obstacle acts; None: on points alone.
        obstacles: all obstacles at their poses, by their numbers.
    """

    surface: ContactSurface
    positions: Values
    evaluate: Callable[[PosedShape], ContactForces]
    facets: ContactFacets | None
    obstacles: list[PosedShape]

    def is_open(self, posed: PosedShape) -> bool:
        """Whether the body does not overlap the obstacle at a pose (collective)."""
        if not self.surface.gaps_are_open(posed.distance(self.positions)):
            return False
        return self.facets is None or bool(
            self.surface.comm.allreduce(self.facets.are_open([posed], self.positions).all(), op=MPI.LAND)
        )


class CondensedPose:
    """Free obstacle whose pose is eliminated from the balance.

    Attributes:
        body: the obstacle.
        motion: its state of motion at the start of a step, until that is accepted.
        obstacle_pairs: its contact with held or driven obstacles.
        step: the last step that began.
        z: (k,) increment in the step.
        posed: the obstacle at its current pose.
    """

    step: RigidStep
    z: Values
    posed: PosedShape

    def __init__(self, body: FreeObstacle, obstacle_pairs: ObstaclePairs) -> None:
        self.body, self.motion, self.obstacle_pairs = body, body.start_motion(), obstacle_pairs
        self._step_motion: RigidMotion | None = None  # motion with which the step began
        self._solution: Values | None = None  # z of the last solution of this step
        self._derivatives: PoseDerivatives | None = None  # of contact at z
        self._predictor: PosePredictor | None = None

    # --- steps ---

    def reset_pose(self) -> PosedShape:
        """Return to the pose of the state of motion."""
        self.posed = PosedShape(self.body.shape, self.motion.pose)
        return self.posed

    def begin_step(self, step: RigidStep, lagged: LaggedContact | None) -> Values:
        """Begin a step, or begin it again; returns the increment (p,) of free flight."""
        if self._step_motion is not self.motion:
            self._solution = None
        self._step_motion, self.step, self._lagged, self._predictor = self.motion, step, lagged, None
        self.return_to_start()
        return step.increment(step.free_flight)

    @property
    def in_step(self) -> bool:
        """Whether the step that began is not accepted yet."""
        return self._step_motion is self.motion

    def end_step(
        self, contact: ContactForces, surroundings: BodySurroundings, free_wrench: Values | float = 0.0
    ) -> None:
        """Accept the step (collective).

        Args:
            contact: forces on the points of the body.
            surroundings: body and obstacles.
            free_wrench: (p,) force and moment of other free obstacles, N and N m.
        """
        pose = self.posed.pose
        of_body = sum_over_ranks(surroundings.surface.comm, contact_wrench(contact, surroundings.positions, pose))
        wrench = free_wrench + of_body + self.obstacle_pairs.wrench(pose, surroundings.obstacles)
        self.motion = self.step.end_motion(self.z, wrench)
        self._solution = self.z

    def contact_point_motion(self, lagged: LaggedContact, posed: PosedShape) -> Values:
        """(k, d) motion in the step of the obstacle's points in lagged contact, m, with the obstacle at `posed`."""
        start = self.step.start.pose
        return posed.pose.points_to_space(start.to_body(lagged.obstacle_point)) - lagged.obstacle_point

    # --- equilibrium ---

    def return_to_start(self) -> None:
        """Move to the start of the step."""
        self.move_to(np.zeros(self.body.motion_basis.shape[1]))

    def move_to(self, z: Values) -> None:
        """Move to the increment z (k,)."""
        self.z, self.posed = z, PosedShape(self.body.shape, self.step.pose(z))

    def equilibrate(self, surroundings: BodySurroundings) -> None:
        """Move to the pose of equilibrium with the points at their current positions (collective).

        Where the obstacle overlaps something at every start, it stays: Newton's method finds no finite force and
        fails.
        """
        self._derivatives = None
        for z in self.start_candidates(surroundings):
            self.move_to(z)
            if self.is_open(surroundings):
                break
        else:
            return
        z, self._derivatives = self.step.minimise(
            z, partial(self.pose_derivatives, surroundings), partial(self.free_fraction, surroundings)
        )
        self.move_to(z)

    def discard_derivatives(self) -> None:
        """Discard derivatives, as the obstacle is not at its equilibrium."""
        self._derivatives = None

    def is_open(self, surroundings: BodySurroundings) -> bool:
        """Whether the obstacle overlaps nothing (collective)."""
        pairs = self.obstacle_pairs
        return surroundings.is_open(self.posed) and pairs.are_open(self.posed.pose, surroundings.obstacles)

    def start_candidates(self, surroundings: BodySurroundings) -> Iterator[Values]:
        """Increments z to start from: predicted by Newton's method, current, last solution, and start of the step."""
        current = self.z
        if (predictor := self._predictor) is not None:
            yield predictor.way_at(predictor.fraction_at(surroundings.positions, surroundings.surface.comm))
        yield current
        if self._solution is not None:
            yield self._solution
        yield np.zeros_like(current)

    def pose_derivatives(self, surroundings: BodySurroundings, z: Values) -> PoseDerivatives:
        """Energy of contact at z, and its derivatives by the pose, of all ranks (collective)."""
        self.move_to(z)
        pose, contact = self.posed.pose, surroundings.evaluate(self.posed)
        local = pose_derivatives(contact, surroundings.positions, pose, self._lagged, self.step.start.pose)
        of_body = _sum_over_ranks(local, surroundings.surface.comm)
        return of_body + self.obstacle_pairs.pose_derivatives(pose, surroundings.obstacles)

    def free_fraction(self, surroundings: BodySurroundings, z: Values, dz: Values) -> float:
        """Fraction of the change dz from z that closes no gap, with the body at rest (collective)."""
        self.move_to(z)
        q, no_motion = self.step.pose_change(z, dz), 0 * surroundings.positions
        motions = {number: (posed, np.zeros_like(q)) for number, posed in enumerate(surroundings.obstacles)}
        fraction = self.obstacle_pairs.safe_fraction(self.posed.pose, q, motions)
        of_points = safe_motion_fractions(self.posed, surroundings.positions, no_motion, q, surroundings.facets)
        return min(fraction, surroundings.surface.min_fraction(of_points))

    # --- condensation ---

    def mixed_block(self, contact: ContactForces, x: Values, *, exact: bool) -> Values:
        """(k, d, z) derivatives of minus the forces on points by z, as they enter the tangent, N/m."""
        pose, start = self.posed.pose, self.step.start.pose
        by_pose = point_pose_hessian(contact, x, pose, self._lagged, start, exact=exact)
        return self.step.factor * by_pose @ self.step.pose_jacobian(self.z)

    def hessian(self, surroundings: BodySurroundings, *, exact: bool) -> Values:
        """(k, k) second derivative of Phi by z, `exact` or its positive definite part (collective)."""
        derivatives = self._derivatives or self.pose_derivatives(surroundings, self.z)
        return self.step.system(self.z, derivatives)[1 if exact else 2]

    def predict_increment(
        self, contact: ContactForces, surroundings: BodySurroundings, motion: Values, *, exact: bool
    ) -> Values:
        """(p,) increment of the pose for a motion (n, d) of the points, m, by the condensed system (collective)."""
        change = self.gradient_change(contact, surroundings, motion, exact=exact)
        dz = np.asarray(-np.linalg.solve(self.hessian(surroundings, exact=exact), change))
        return self.store_predictor(surroundings, motion, dz)

    def gradient_change(
        self, contact: ContactForces, surroundings: BodySurroundings, motion: Values, *, exact: bool
    ) -> Values:
        """(k,) change of the gradient of Phi by z for a motion (n, d) of the points, m (collective)."""
        mixed = self.mixed_block(contact, surroundings.positions, exact=exact)
        return sum_over_ranks(surroundings.surface.comm, np.einsum("kdz,kd->z", mixed, motion[contact.points]))

    def store_predictor(self, surroundings: BodySurroundings, motion: Values, dz: Values) -> Values:
        """Store the path of a step of Newton's method; returns the increment (p,) of the pose for dz (k,)."""
        self._predictor = PosePredictor(surroundings.positions, motion, self.z, dz)
        return self.step.pose_change(self.z, dz)

    def discard_predictor(self) -> None:
        """Discard the path of the last step of Newton's method."""
        self._predictor = None

    def safe_fraction(
        self, surroundings: BodySurroundings, motion: Values, z: Values, motions: dict[int, PoseMotion]
    ) -> float:
        """Fraction of the motions of points, obstacle and others from the start that closes no gap (collective)."""
        start, q = PosedShape(self.body.shape, self.step.start.pose), self.step.increment(z)
        fraction = self.obstacle_pairs.safe_fraction(start.pose, q, motions)
        of_points = safe_motion_fractions(start, surroundings.positions, motion, q, surroundings.facets)
        return min(fraction, surroundings.surface.min_fraction(of_points))

    def carried_by(self, increment: Values) -> Values:
        """(k,) z that moves it with another obstacle's increment (p,), as far as its motion basis allows."""
        d = self.step.start.pose.dim
        return np.asarray(np.linalg.lstsq(self.body.motion_basis[:d], increment[:d], rcond=None)[0])

    def normal_work(self, contact: ContactForces, x: Values) -> float:
        """Work of normal forces on the body by the motion of the obstacle in the step, this rank's share, J."""
        force = resultant(contact.normal, x[contact.points] - self.posed.pose.centre)
        return float(force @ self.step.increment(self.z))


def _sum_over_ranks(local: PoseDerivatives, comm: MPI.Intracomm) -> PoseDerivatives:
    """Sum of derivatives over all ranks (collective)."""
    parts = [np.atleast_1d(local.energy), local.gradient, local.hessian.reshape(-1), local.stiffness.reshape(-1)]
    p = len(local.gradient)
    energy, gradient, *matrices = np.split(sum_over_ranks(comm, np.concatenate(parts)), [1, 1 + p, 1 + p + p * p])
    return PoseDerivatives(float(energy[0]), gradient, *(matrix.reshape(p, p) for matrix in matrices))


class FreeObstacleSystem:
    """Two or more free obstacles in contact with one another; equal on all ranks, from sums over ranks."""

    def __init__(self, free: Mapping[int, CondensedPose], barrier: GapPotential) -> None:
        """`free`: free obstacles by their numbers."""
        self._free, self._bodies, self._barrier = free, list(free.values()), barrier
        numbers = combinations(range(len(self._bodies)), 2)
        self._pairs = {(i, j): ObstaclePair.between(self._bodies[i].body, self._bodies[j].body) for i, j in numbers}
        self._start: dict[tuple[int, int], list[Values]] = {}
        self._derivatives: SystemDerivatives | None = None

    # --- steps ---

    def begin_step(self, *, along: bool) -> None:
        """Begin a step; `along`: barriers are averaged over it."""
        poses, self._derivatives = self._poses(), None
        pairs = self._pairs.items() if along else []
        self._start = {(i, j): pair.gaps(poses[i], poses[j]) for (i, j), pair in pairs}

    def _poses(self) -> list[Pose]:
        return [body.posed.pose for body in self._bodies]

    @property
    def system(self) -> RigidSystem:
        """System of the steps of all obstacles."""
        return RigidSystem([body.step for body in self._bodies])

    def are_open(self) -> bool:
        """Whether no obstacle overlaps another one."""
        poses = self._poses()
        return all(
            gap.min(initial=1.0) > 0 for (i, j), pair in self._pairs.items() for gap in pair.gaps(poses[i], poses[j])
        )

    def safe_fraction(self, poses: Sequence[Pose], increments: Sequence[Values]) -> float:
        """Fraction of increments (p,) of all poses that closes no gap between obstacles."""
        pairs = self._pairs.items()
        return min(pair.safe_fraction(poses[i], increments[i], poses[j], increments[j]) for (i, j), pair in pairs)

    def safe_guess(self, z: Mapping[int, Values]) -> float:
        """Fraction of increments z (k,) from the step's start, by numbers, that closes no gap between obstacles."""
        increments = [body.step.increment(z[number]) for number, body in self._free.items()]
        return self.safe_fraction([body.step.start.pose for body in self._bodies], increments)

    # --- equilibrium ---

    def equilibrate(self, surroundings: Mapping[int, BodySurroundings]) -> None:
        """Move all to the poses of equilibrium with the points at their current positions (collective).

        As of CondensedPose, all stay where an obstacle overlaps something at every start.
        """
        around, self._derivatives = [surroundings[number] for number in self._free], None
        start_poses = self._poses()
        candidates = (body.start_candidates(near) for body, near in zip(self._bodies, around, strict=True))
        for z in zip(*candidates, strict=False):
            self._move_to(z)
            apart = all(body.is_open(near) for body, near in zip(self._bodies, around, strict=True))
            increments = [start.increment_to(pose) for start, pose in zip(start_poses, self._poses(), strict=True)]
            if apart and self.are_open() and self.safe_fraction(start_poses, increments) == 1:
                break
        else:
            return
        solution, self._derivatives = self.system.minimise(
            z, partial(self._system_derivatives, around), partial(self._free_fraction, around)
        )
        self._move_to(solution)

    def free_fraction(
        self, surroundings: Mapping[int, BodySurroundings], z: Mapping[int, Values], dz: Mapping[int, Values]
    ) -> float:
        """Fraction of the changes dz from z, by numbers, that closes no gap, with the body at rest (collective)."""
        numbers = list(self._free)
        return self._free_fraction(
            [surroundings[number] for number in numbers],
            [z[number] for number in numbers],
            [dz[number] for number in numbers],
        )

    def _move_to(self, z: Sequence[Values]) -> None:
        for body, z_i in zip(self._bodies, z, strict=True):
            body.move_to(z_i)

    def _system_derivatives(self, around: Sequence[BodySurroundings], z: Sequence[Values]) -> SystemDerivatives:
        """Derivatives of contact of all obstacles at z, of all ranks (collective)."""
        bodies = [body.pose_derivatives(near, z_i) for body, near, z_i in zip(self._bodies, around, z, strict=True)]
        mixed, poses = {}, self._poses()
        for (i, j), ((of_i, x), (of_j, y)) in self._contact_forces().items():
            bodies[i] = (
                bodies[i]
                + carried_point_derivatives(of_i, x, poses[i])
                + pose_derivatives(of_j, y, poses[i], None, poses[i])
            )
            by_j = pose_derivatives(of_i, x, poses[j], None, poses[j]) + carried_point_derivatives(of_j, y, poses[j])
            # the energy of the pair counts with the first obstacle
            bodies[j] = bodies[j] + PoseDerivatives(0.0, by_j.gradient, by_j.hessian, by_j.stiffness)
            first = mixed_pose_hessian(of_i, x, poses[i], poses[j])
            second = mixed_pose_hessian(of_j, y, poses[j], poses[i])
            mixed[i, j] = first[0] + second[0].T, first[1] + second[1].T
        return SystemDerivatives(bodies, mixed)

    def _contact_forces(self) -> dict[tuple[int, int], list[tuple[ContactForces, Values]]]:
        """Forces on the points of both obstacles of each pair in contact."""
        poses = self._poses()
        contacts = {
            (i, j): pair.contact_forces(poses[i], poses[j], self._barrier, self._start.get((i, j)))
            for (i, j), pair in self._pairs.items()
        }
        return {pair: sides for pair, sides in contacts.items() if any(len(side.points) for side, _ in sides)}

    def _free_fraction(self, around: Sequence[BodySurroundings], z: Sequence[Values], dz: Sequence[Values]) -> float:
        """Fraction of the changes dz from z that closes no gap, with the body at rest (collective)."""
        items = zip(self._bodies, around, z, dz, strict=True)
        fractions = [body.free_fraction(near, z_i, dz_i) for body, near, z_i, dz_i in items]
        increments = [body.step.pose_change(z_i, dz_i) for body, z_i, dz_i in zip(self._bodies, z, dz, strict=True)]
        self._move_to(z)
        return min(*fractions, self.safe_fraction(self._poses(), increments))

    # --- energy and condensation ---

    def energies(self) -> tuple[float, float]:
        """Energy of the barriers between obstacles, and potential of their forces in the step, J."""
        contacts = [contact for sides in self._contact_forces().values() for contact, _ in sides]
        return sum(contact.energy for contact in contacts), sum(contact.potential for contact in contacts)

    def wrenches(self) -> dict[int, Values]:
        """(p,) force and moment of the others on each obstacle, N and N m, by numbers."""
        poses, result = self._poses(), [np.zeros(body.body.pose_size) for body in self._bodies]
        for (i, j), ((of_i, x), (of_j, y)) in self._contact_forces().items():
            result[i] -= (
                carried_point_derivatives(of_i, x, poses[i]).gradient
                + pose_derivatives(of_j, y, poses[i], None, poses[i]).gradient
            )
            result[j] -= (
                pose_derivatives(of_i, x, poses[j], None, poses[j]).gradient
                + carried_point_derivatives(of_j, y, poses[j]).gradient
            )
        return dict(zip(self._free, result, strict=True))

    def hessian(self, surroundings: Mapping[int, BodySurroundings], *, exact: bool) -> Values:
        """(K, K) second derivative of Phi by z of all, `exact` or its positive definite part (collective)."""
        z, around = [body.z for body in self._bodies], [surroundings[number] for number in self._free]
        return self.system.system(z, self._derivatives or self._system_derivatives(around, z))[1 if exact else 2]

    def compliance(self, surroundings: Mapping[int, BodySurroundings], *, exact: bool) -> Values:
        """(K, K) inverse of the Hessian (collective)."""
        return np.asarray(np.linalg.inv(self.hessian(surroundings, exact=exact)))

    def predict_increments(
        self,
        contacts: Mapping[int, ContactForces],
        surroundings: Mapping[int, BodySurroundings],
        motion: Values,
        *,
        exact: bool,
    ) -> dict[int, Values]:
        """(p,) increments of the poses, by numbers, for a motion (n, d) of the points, m (collective)."""
        items = self._free.items()
        changes = [
            body.gradient_change(contacts[number], surroundings[number], motion, exact=exact) for number, body in items
        ]
        dz = self.system.split(-self.compliance(surroundings, exact=exact) @ np.concatenate(changes))
        return {
            number: body.store_predictor(surroundings[number], motion, dz_i)
            for (number, body), dz_i in zip(items, dz, strict=True)
        }
