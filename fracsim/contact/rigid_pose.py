"""Where a free obstacle is in a step, with the body where it is: what is left of it once its pose is eliminated.

The pose is the least of the incremental potential Phi (rigid_body), found on ways that pass through nothing.

Free obstacles with one another: barriers between each two, and their poses found together.
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
from .rigid_body import (
    PoseDerivatives,
    PosePredictor,
    RigidStep,
    RigidSystem,
    SystemDerivatives,
    carried_point_derivatives,
    contact_wrench,
    mixed_pose_hessian,
    point_pose_hessian,
    pose_derivatives,
    resultant,
)
from .step_limit import PoseMotion, safe_motion_fractions

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class BodySurroundings:
    """The body around an obstacle.

    Attributes:
        skin: its points.    x: (n, d) where they are, m.    feel: what the obstacle does to them at a place.
        facets: that feel it between their points.    placed: where all obstacles are, by their numbers.
    """

    surface: ContactSurface
    positions: Values
    evaluate: Callable[[PosedShape], ContactForces]
    facets: ContactFacets | None
    obstacles: list[PosedShape]

    def is_open(self, placed: PosedShape) -> bool:
        """Whether nothing of the body is in the obstacle there (collective)."""
        if not self.surface.gaps_are_open(placed.distance(self.positions)):
            return False
        return self.facets is None or bool(
            self.surface.comm.allreduce(self.facets.are_open([placed], self.positions).all(), op=MPI.LAND)
        )


class CondensedPose:
    """A free obstacle, and its pose.

    Attributes:
        flight: how it moves, at the start of a step until it is over.    step: the one that began last.
        z: (k,) its way in the step.    placed: where it is.
    """

    step: RigidStep
    z: Values
    posed: PosedShape

    def __init__(self, body: FreeObstacle, stops: ObstaclePairs) -> None:
        """`stops`: what it meets beside the body."""
        self.body, self.motion, self.obstacle_pairs = body, body.start_motion(), stops
        self._step_motion: RigidMotion | None = None  # that the step began with
        self._solution: Values | None = None  # z of the last solution of this step
        self._derivatives: PoseDerivatives | None = None  # what contact does to it at z
        self._predictor: PosePredictor | None = None

    # --- a step ---

    def reset_pose(self) -> PosedShape:
        """Where it is between two steps."""
        self.posed = PosedShape(self.body.shape, self.motion.pose)
        return self.posed

    def begin_step(self, step: RigidStep, held: LaggedContact | None) -> Values:
        """A step begins, for the first time or once more; `held`: what friction holds. (p,) its way in free flight."""
        if self._step_motion is not self.motion:
            self._solution = None
        self._step_motion, self.step, self._lagged, self._predictor = self.motion, step, held, None
        self.return_to_start()
        return step.increment(step.free_flight)

    @property
    def in_step(self) -> bool:
        """Whether the step that began is not over yet."""
        return self._step_motion is self.motion

    def end_step(self, found: ContactForces, around: BodySurroundings, others: Values | float = 0.0) -> None:
        """The step is over: it has the momentum that points in touch, stops and `others` that are free, by a force and
        moment (p,), gave it (collective)."""
        pose = self.posed.pose
        pushed = (
            others
            + sum_over_ranks(around.surface.comm, contact_wrench(found, around.positions, pose))
            + self.obstacle_pairs.wrench(pose, around.obstacles)
        )
        self.motion = self.step.end_motion(self.z, pushed)
        self._solution = self.z

    def contact_point_motion(self, held: LaggedContact, placed: PosedShape) -> Values:
        """(k, d) way in the step of what is under the points that friction holds, m, with the obstacle at `placed`."""
        then = self.step.start.pose
        return placed.pose.points_to_space(then.to_body(held.obstacle_point)) - held.obstacle_point

    # --- where it is ---

    def return_to_start(self) -> None:
        """Where the step began."""
        self.move_to(np.zeros(self.body.motion_basis.shape[1]))

    def move_to(self, z: Values) -> None:
        """At z (k,)."""
        self.z, self.posed = z, PosedShape(self.body.shape, self.step.pose(z))

    def equilibrate(self, around: BodySurroundings) -> None:
        """The pose that belongs to the points where they are now (collective)."""
        self._derivatives = None
        for z in self.candidates(around):
            self.move_to(z)
            if self.is_open(around):
                break
        else:
            return  # the body or a stop is in the obstacle: Newton's method finds no finite force, and fails
        z, self._derivatives = self.step.minimise(
            z, partial(self.pose_derivatives, around), partial(self.free_fraction, around)
        )
        self.move_to(z)

    def discard_derivatives(self) -> None:
        """It was put elsewhere than it was settled."""
        self._derivatives = None

    def is_open(self, around: BodySurroundings) -> bool:
        """Whether it lies in nothing (collective)."""
        return around.is_open(self.posed) and self.obstacle_pairs.are_open(self.posed.pose, around.obstacles)

    def candidates(self, around: BodySurroundings) -> Iterator[Values]:
        """Ways z to start from: where a step of Newton's method takes the obstacle along, where it is, where it was
        once this step was solved, and where the step began."""
        here = self.z
        if (way := self._predictor) is not None:
            yield way.way_at(way.fraction_at(around.positions, around.surface.comm))
        yield here
        if self._solution is not None:
            yield self._solution
        yield np.zeros_like(here)

    def pose_derivatives(self, around: BodySurroundings, z: Values) -> PoseDerivatives:
        """What contact does to the obstacle at z, of all ranks (collective)."""
        self.move_to(z)
        mine = pose_derivatives(
            around.evaluate(self.posed), around.positions, self.posed.pose, self._lagged, self.step.start.pose
        )
        return _summed(mine, around.surface.comm) + self.obstacle_pairs.pose_derivatives(
            self.posed.pose, around.obstacles
        )

    def free_fraction(self, around: BodySurroundings, z: Values, dz: Values) -> float:
        """Share of the way from z by dz that closes no gap, with the body where it is (collective)."""
        self.move_to(z)
        q, still = self.step.pose_change(z, dz), 0 * around.positions
        others = {number: (placed, np.zeros_like(q)) for number, placed in enumerate(around.obstacles)}
        share = self.obstacle_pairs.safe_fraction(self.posed.pose, q, others)
        return min(
            share,
            around.surface.min_fraction(safe_motion_fractions(self.posed, around.positions, still, q, around.facets)),
        )

    # --- how it gives way ---

    def mixed_block(self, found: ContactForces, x: Values, *, exact: bool) -> Values:
        """(k, d, ways) derivative of minus the forces on points in touch by z, as it enters the tangent."""
        pose, then = self.posed.pose, self.step.start.pose
        by_pose = point_pose_hessian(found, x, pose, self._lagged, then, exact=exact)
        return self.step.factor * by_pose @ self.step.pose_jacobian(self.z)

    def hessian(self, around: BodySurroundings, *, exact: bool) -> Values:
        """(k, k) second derivative of Phi by z, its positive definite part or `exact` (collective)."""
        return self.step.system(self.z, self._derivatives or self.pose_derivatives(around, self.z))[1 if exact else 2]

    def predict_increment(
        self, found: ContactForces, around: BodySurroundings, moved: Values, *, exact: bool
    ) -> Values:
        """(p,) increment of its pose as Newton's method moves it together with the points, by `moved` (n, d), m
        (collective)."""
        pulled = self.gradient_change(found, around, moved, exact=exact)
        return self.store_predictor(
            around, moved, np.asarray(-np.linalg.solve(self.hessian(around, exact=exact), pulled))
        )

    def gradient_change(self, found: ContactForces, around: BodySurroundings, moved: Values, *, exact: bool) -> Values:
        """(k,) change of the gradient of Phi by z with the points, which go by `moved` (n, d), m (collective)."""
        mixed = self.mixed_block(found, around.positions, exact=exact)
        return sum_over_ranks(around.surface.comm, np.einsum("kdz,kd->z", mixed, moved[found.points]))

    def store_predictor(self, around: BodySurroundings, moved: Values, dz: Values) -> Values:
        """(p,) increment of its pose as Newton's method moves it by dz (k,) and the points by `moved` (n, d), m."""
        self._predictor = PosePredictor(around.positions, moved, self.z, dz)
        return self.step.pose_change(self.z, dz)

    def discard_predictor(self) -> None:
        """Newton's method starts anew."""
        self._predictor = None

    def safe_fraction(self, around: BodySurroundings, moved: Values, z: Values, others: dict[int, PoseMotion]) -> float:
        """Share of the ways of points, obstacle and others, from the start of the step, that closes no gap
        (collective)."""
        start, q = PosedShape(self.body.shape, self.step.start.pose), self.step.increment(z)
        share = self.obstacle_pairs.safe_fraction(start.pose, q, others)
        return min(
            share, around.surface.min_fraction(safe_motion_fractions(start, around.positions, moved, q, around.facets))
        )

    def carried_by(self, way: Values) -> Values:
        """(k,) z that takes it along with an obstacle on its way (p,), as far as it may go there."""
        d = self.step.start.pose.dim
        return np.asarray(np.linalg.lstsq(self.body.motion_basis[:d], way[:d], rcond=None)[0])

    def normal_work(self, found: ContactForces, x: Values) -> float:
        """Work of normal forces on the body in the step, by the way of the obstacle, this rank's share, J."""
        force = resultant(found.normal, x[found.points] - self.posed.pose.centre)
        return float(force @ self.step.increment(self.z))


def _summed(mine: PoseDerivatives, comm: MPI.Comm) -> PoseDerivatives:
    """Of the points of all ranks (collective)."""
    parts = [np.atleast_1d(mine.energy), mine.gradient, mine.hessian.reshape(-1), mine.stiffness.reshape(-1)]
    p = len(mine.gradient)
    energy, gradient, *both = np.split(sum_over_ranks(comm, np.concatenate(parts)), [1, 1 + p, 1 + p + p * p])
    return PoseDerivatives(float(energy[0]), gradient, *(each.reshape(p, p) for each in both))


class FreeObstacleSystem:
    """At least two free obstacles, by their numbers; all is done on every rank alike, from sums over all."""

    def __init__(self, free: Mapping[int, CondensedPose], barrier: GapPotential) -> None:
        self._free, self._poses_of, self._barrier = free, list(free.values()), barrier
        pairs = combinations(range(len(self._poses_of)), 2)
        self._pairs = {(i, j): ObstaclePair.between(self._poses_of[i].body, self._poses_of[j].body) for i, j in pairs}
        self._start: dict[tuple[int, int], list[Values]] = {}
        self._derivatives: SystemDerivatives | None = None

    # --- a step ---

    def begin_step(self, *, along: bool) -> None:
        """A step begins; `along`: barriers act along its way (laws)."""
        poses, self._derivatives = self._poses(), None
        each = self._pairs.items() if along else []
        self._start = {(i, j): stop.gaps(poses[i], poses[j]) for (i, j), stop in each}

    def _poses(self) -> list[Pose]:
        return [each.posed.pose for each in self._poses_of]

    @property
    def system(self) -> RigidSystem:
        """Their steps."""
        return RigidSystem([each.step for each in self._poses_of])

    def are_open(self) -> bool:
        """Whether none lies in another one."""
        at = self._poses()
        return all(gap.min(initial=1.0) > 0 for (i, j), stop in self._pairs.items() for gap in stop.gaps(at[i], at[j]))

    def safe_fraction(self, poses: Sequence[Pose], ways: Sequence[Values]) -> float:
        """Share of the ways q (p,) of all from `poses` that closes no gap between them."""
        each = self._pairs.items()
        return min(stop.safe_fraction(poses[i], ways[i], poses[j], ways[j]) for (i, j), stop in each)

    def safe_guess(self, taken: Mapping[int, Values]) -> float:
        """The same of ways z (k,) from the start of the step, by numbers."""
        ways = [each.step.increment(taken[number]) for number, each in self._free.items()]
        return self.safe_fraction([each.step.start.pose for each in self._poses_of], ways)

    # --- where they are ---

    def equilibrate(self, arounds: Mapping[int, BodySurroundings]) -> None:
        """The poses that belong to the points of the body where they are now (collective)."""
        around, self._derivatives = [arounds[number] for number in self._free], None
        began = [each.posed.pose for each in self._poses_of]
        for z in zip(*(each.candidates(near) for each, near in zip(self._poses_of, around, strict=True)), strict=False):
            self._move_to(z)
            apart = all(each.is_open(near) for each, near in zip(self._poses_of, around, strict=True))
            ways = [then.increment_to(now) for then, now in zip(began, self._poses(), strict=True)]
            if apart and self.are_open() and self.safe_fraction(began, ways) == 1:
                break
        else:
            return  # as FreePose.settle
        found, self._derivatives = self.system.minimise(
            z, partial(self._system_derivatives, around), partial(self._free_fraction, around)
        )
        self._move_to(found)

    def free_fraction(
        self, arounds: Mapping[int, BodySurroundings], z: Mapping[int, Values], dz: Mapping[int, Values]
    ) -> float:
        """Share of the ways from z by dz, by numbers, that closes no gap, with the body where it is (collective)."""
        numbers = list(self._free)
        return self._free_fraction([arounds[k] for k in numbers], [z[k] for k in numbers], [dz[k] for k in numbers])

    def _move_to(self, z: Sequence[Values]) -> None:
        for each, way in zip(self._poses_of, z, strict=True):
            each.move_to(way)

    def _system_derivatives(self, around: Sequence[BodySurroundings], z: Sequence[Values]) -> SystemDerivatives:
        """What contact does to each at z, of all ranks (collective)."""
        each = [one.pose_derivatives(near, way) for one, near, way in zip(self._poses_of, around, z, strict=True)]
        mixed, at = {}, self._poses()
        for (i, j), ((own, x), (its, y)) in self._contact_forces().items():
            each[i] = each[i] + carried_point_derivatives(own, x, at[i]) + pose_derivatives(its, y, at[i], None, at[i])
            seen = pose_derivatives(own, x, at[j], None, at[j]) + carried_point_derivatives(its, y, at[j])
            each[j] = each[j] + PoseDerivatives(
                0.0, seen.gradient, seen.hessian, seen.stiffness
            )  # its energy is with the first
            one, other = mixed_pose_hessian(own, x, at[i], at[j]), mixed_pose_hessian(its, y, at[j], at[i])
            mixed[i, j] = one[0] + other[0].T, one[1] + other[1].T
        return SystemDerivatives(each, mixed)

    def _contact_forces(self) -> dict[tuple[int, int], list[tuple[ContactForces, Values]]]:
        """What acts on the points of both of each pair that touches."""
        at = self._poses()
        found = {
            (i, j): stop.contact_forces(at[i], at[j], self._barrier, self._start.get((i, j)))
            for (i, j), stop in self._pairs.items()
        }
        return {pair: both for pair, both in found.items() if any(len(touch.points) for touch, _ in both)}

    def _free_fraction(self, around: Sequence[BodySurroundings], z: Sequence[Values], dz: Sequence[Values]) -> float:
        """Share of the way from z by dz that closes no gap, with the body where it is (collective)."""
        each = zip(self._poses_of, around, z, dz, strict=True)
        own = [one.free_fraction(near, way, change) for one, near, way, change in each]
        ways = [one.step.pose_change(way, change) for one, way, change in zip(self._poses_of, z, dz, strict=True)]
        self._move_to(z)
        return min(*own, self.safe_fraction(self._poses(), ways))

    # --- what they add, and how they give way ---

    def energies(self) -> tuple[float, float]:
        """What barriers between them store, and what their forces in the step are the derivative of, J."""
        found = [touch for both in self._contact_forces().values() for touch, _ in both]
        return sum(touch.energy for touch in found), sum(touch.potential for touch in found)

    def wrenches(self) -> dict[int, Values]:
        """(p,) force and moment of the others on each, N and N m, by numbers."""
        at, total = self._poses(), [np.zeros(each.body.pose_size) for each in self._poses_of]
        for (i, j), ((own, x), (its, y)) in self._contact_forces().items():
            total[i] -= (
                carried_point_derivatives(own, x, at[i]).gradient
                + pose_derivatives(its, y, at[i], None, at[i]).gradient
            )
            total[j] -= (
                pose_derivatives(own, x, at[j], None, at[j]).gradient
                + carried_point_derivatives(its, y, at[j]).gradient
            )
        return dict(zip(self._free, total, strict=True))

    def hessian(self, arounds: Mapping[int, BodySurroundings], *, exact: bool) -> Values:
        """(K, K) Phi_zz of all, its positive definite part or `exact` (collective)."""
        z, around = [each.z for each in self._poses_of], [arounds[number] for number in self._free]
        return self.system.system(z, self._derivatives or self._system_derivatives(around, z))[1 if exact else 2]

    def compliance(self, arounds: Mapping[int, BodySurroundings], *, exact: bool) -> Values:
        """(K, K) its inverse (collective)."""
        return np.asarray(np.linalg.inv(self.hessian(arounds, exact=exact)))

    def predict_increments(
        self, found: Mapping[int, ContactForces], arounds: Mapping[int, BodySurroundings], moved: Values, *, exact: bool
    ) -> dict[int, Values]:
        """(p,) increments of their poses as Newton's method moves them together with the points, by `moved` (n, d), m
        (collective)."""
        every = self._free.items()
        pushed = [each.gradient_change(found[number], arounds[number], moved, exact=exact) for number, each in every]
        dz = self.system.split(-self.compliance(arounds, exact=exact) @ np.concatenate(pushed))
        return {
            number: each.store_predictor(arounds[number], moved, way)
            for (number, each), way in zip(every, dz, strict=True)
        }
