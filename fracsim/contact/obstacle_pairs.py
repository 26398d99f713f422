"""Contact of free obstacles with others, by barriers at inset points, with lagged friction.

    E = sum over points of both of  A b(gap),    gap: distance to the other shape minus the radius of the points

A is the share of a point in the surface of its shape, b the barrier of the contact with the body.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np

from ..array_types import Values
from .inset_points import InsetPoints, inset_points
from .laws import BARRIER, CoulombFriction, GapPotential, ObstacleLaw, tangential
from .node_contact import (
    ContactForces,
    PoseCoupling,
    PoseDerivatives,
    StepStart,
    carried_derivatives,
    evaluate_points,
    lag_contact,
    mixed_pose_hessian,
)
from .obstacle import RigidObstacle
from .pose import Pose, PosedShape, point_jacobian
from .shape_base import Shape
from .shapes import TranslatedShape
from .step_limit import PointMotion, PoseMotion
from .triangle_mesh_shape import TriangleMeshShape

if TYPE_CHECKING:
    from .mesh_obstacle_term import MeshPair  # with ipctk
    from .rigid_obstacles import RigidObstacles


@dataclass(frozen=True, eq=False)
class PairFriction:
    """Lagged friction of a pair of obstacles in a step, at the points at which they touched at its start.

    The slip of a point is the motion of the first obstacle's material there minus that of the other's.

    Attributes:
        law: Coulomb's.
        force: (k,) normal forces, N.
        normal: (k, d) unit normals.
        point: (k, d) points at the start of the step, m.
        start: poses of both then.
    """

    law: CoulombFriction
    force: Values
    normal: Values
    point: Values
    start: tuple[Pose, Pose]

    def _carried(self, poses: tuple[Pose, Pose]) -> tuple[Values, Values]:
        """(k, d) points of both obstacles now, m."""
        first, second = (
            pose.points_to_space(start.to_body(self.point)) for pose, start in zip(poses, self.start, strict=True)
        )
        return first, second

    def slip(self, poses: tuple[Pose, Pose]) -> Values:
        """(k, d) motion of the first obstacle over the other in the step, m."""
        first, second = self._carried(poses)
        return np.asarray(first - second)

    def energy(self, poses: tuple[Pose, Pose]) -> float:
        """Potential of friction, J."""
        return float(self.law.energy(self.force, self.normal, self.slip(poses)).sum())

    def on_first(self, poses: tuple[Pose, Pose]) -> Values:
        """(k, d) forces on the first obstacle, N."""
        return -self.law.gradient(self.force, self.normal, self.slip(poses))

    def derivatives(self, poses: tuple[Pose, Pose], *, exact: bool) -> tuple[PoseDerivatives, PoseDerivatives, Values]:
        """Derivatives by the pose of each, with the whole energy; (p, p) second derivatives by both."""
        gradient, energy = -self.on_first(poses), self.energy(poses)
        H = self.law.hessian(self.force, self.normal, self.slip(poses))
        arms = [x - pose.centre for x, pose in zip(self._carried(poses), poses, strict=True)]
        first, second = (
            carried_derivatives(energy, sign * gradient, H, arm, exact=exact)
            for sign, arm in zip((1.0, -1.0), arms, strict=True)
        )
        mixed = -np.einsum("kip,kij,kjq->pq", point_jacobian(arms[0]), H, point_jacobian(arms[1]))
        return first, second, np.asarray(mixed)


@dataclass(frozen=True, eq=False)
class ObstaclePair:
    """A free obstacle, the first, and another one.

    Attributes:
        points: their inset points.
        targets: shapes that the points of each are in contact with: the other one, grown by their radius.
        friction: coefficient of friction, the larger one of both.
    """

    points: tuple[InsetPoints, InsetPoints]
    targets: tuple[Shape, Shape]
    friction: float

    @classmethod
    def between(cls, body: RigidObstacle, obstacle: RigidObstacle) -> ObstaclePair:
        """Pair of two obstacles."""
        first, second = inset_points(body.shape), inset_points(obstacle.shape)
        sides, centre = ((obstacle.shape, first.radius), (body.shape, second.radius)), np.zeros(body.shape.dim)
        targets = [TranslatedShape(shape, centre, radius) for shape, radius in sides]
        # a triangle mesh has no distance function: it is in contact with others at its own points alone
        if isinstance(body.shape, TriangleMeshShape):
            second, targets = InsetPoints(np.empty((0, 3)), 0.0), targets[:1] * 2
        return cls((first, second), (targets[0], targets[1]), max(body.friction, obstacle.friction))

    def sides(self, body: Pose, obstacle: Pose) -> Iterator[tuple[Values, PosedShape]]:
        """(n, d) points of each obstacle in space, m, and the shape that they are in contact with."""
        poses = body, obstacle
        sides = zip(self.points, poses, self.targets, poses[::-1], strict=True)
        for inset, pose, shape, target_pose in sides:
            target = PosedShape(shape, target_pose)
            yield inset.posed(pose, target), target

    def gap_bound(self, body: Pose, obstacle: Pose) -> float:
        """Lower bound of all gaps, m: that of the centre of the first minus its radius; distances are Lipschitz."""
        return float(PosedShape(self.targets[0], obstacle).distance(body.centre[None]).item()) - self._radius

    @cached_property
    def _radius(self) -> float:
        """Largest distance of the points of the first from its centre, m."""
        return float(np.linalg.norm(self.points[0].points, axis=1).max())

    def gaps(self, body: Pose, obstacle: Pose) -> list[Values]:
        """(n,) gaps of the points of each, m."""
        return [posed.distance(x) for x, posed in self.sides(body, obstacle)]

    def lag_friction(
        self, body: Pose, obstacle: Pose, barrier: GapPotential, slip: Callable[[Values, Values], float]
    ) -> PairFriction | None:
        """Friction of a step, at the poses of both at its start; None: nothing presses there.

        Args:
            body: pose of the first obstacle.
            obstacle: pose of the other one.
            barrier: b.
            slip: points and normals of contact (k, d) -> slip that counts as sticking, m.
        """
        lagged = [
            (lag_contact(x, posed.distance(x), inset.areas, posed, barrier), inset.radius)
            for (x, posed), inset in zip(self.sides(body, obstacle), self.points, strict=True)
        ]
        force = np.concatenate([contact.force for contact, _ in lagged])
        if not len(force):
            return None
        normal = np.concatenate([contact.normal for contact, _ in lagged])
        point = np.concatenate([contact.position - radius * contact.normal for contact, radius in lagged])
        return PairFriction(CoulombFriction(self.friction, slip(point, normal)), force, normal, point, (body, obstacle))

    def contact_forces(
        self, body: Pose, obstacle: Pose, barrier: GapPotential, start: list[Values] | None
    ) -> list[tuple[ContactForces, Values]]:
        """Normal forces on the points of each, and their positions (n, d), m.

        Args:
            body: pose of the first obstacle.
            obstacle: pose of the other one.
            barrier: b.
            start: gaps at the start of the step, where the barrier is averaged over it.
        """
        starts: list[StepStart | None] = [None, None]
        if start is not None:
            starts = [StepStart(gap) for gap in start]
        no_motion = np.zeros(body.dim)
        return [
            (evaluate_points(x, inset.areas, posed, barrier, None, None, no_motion, step_start), x)
            for (x, posed), inset, step_start in zip(self.sides(body, obstacle), self.points, starts, strict=True)
        ]

    def safe_fraction(self, body: Pose, q: Values, obstacle: Pose, other_q: Values) -> float:
        """Fraction of the increments q and `other_q` (p,) of both poses that leaves a tenth of each gap."""
        d, between = body.dim, float(np.linalg.norm(body.centre - obstacle.centre))
        straight = float(np.linalg.norm(q[:d] - other_q[:d]))
        angle, other_angle = float(np.linalg.norm(q[d:])), float(np.linalg.norm(other_q[d:]))
        reach = straight + angle * self._radius + other_angle * (between + straight + self._radius)
        if self.gap_bound(body, obstacle) * (1 - BARRIER.min_gap_ratio) > reach:
            return 1.0
        carriers, motions = ((body, q, other_q), (obstacle, other_q, q)), []
        sides = zip(self.sides(body, obstacle), carriers, self.points, strict=True)
        for (x, target), (carrier, motion, against), inset in sides:
            if (spin := inset.spin_direction(carrier)) is not None:
                motion = motion - (spin @ motion) * spin  # points of a cylinder do not spin with it
            shift, rotation = np.tile(motion[:d], (len(x), 1)), (carrier.centre, motion[d:])
            motions.append(PointMotion(target, x, shift, target.effective_increment(against), rotation))
        return min(points.safe_fraction() for points in motions)


type PosedObstacles = Mapping[int, PosedShape] | Sequence[PosedShape]  # by the numbers of obstacles
type Numbers = tuple[int, int]  # of a free obstacle and another one


# derivatives by the poses of both obstacles, each with the whole energy, and (p, p) second derivatives by both
type PairDerivatives = tuple[PoseDerivatives, PoseDerivatives, Values]


class BarrierPair:
    """Barrier and friction of a free obstacle and another one, of which one at least is analytic.

    `posed` are all obstacles at their poses, by their numbers.

    Attributes:
        numbers: of both.
        pair: their geometry.
    """

    def __init__(self, numbers: Numbers, obstacles: Mapping[int, RigidObstacle], law: ObstacleLaw) -> None:
        """`obstacles`: by their numbers."""
        if isinstance(obstacles[numbers[1]].shape, TriangleMeshShape):
            # a triangle mesh comes first, since it is in contact at its own points
            numbers = numbers[1], numbers[0]
        first, second = (obstacles[number] for number in numbers)
        self.numbers, self.pair, self._law = numbers, ObstaclePair.between(first, second), law
        # at the start of the step: whether they may be in contact, gaps (n,) of the points of each, m, and friction
        self._started_near = False
        self._start: list[Values] | None = None
        self._friction: PairFriction | None = None

    def _poses(self, posed: PosedObstacles) -> tuple[Pose, Pose]:
        return posed[self.numbers[0]].pose, posed[self.numbers[1]].pose

    def _is_near(self, poses: tuple[Pose, Pose]) -> bool:
        return self.pair.gap_bound(*poses) < self._law.barrier.width

    def begin_step(self, motion: RigidObstacles, dt: float, *, time_averaged: bool) -> None:
        """Begin a step of dt, s; `time_averaged`: the barrier is averaged over it."""
        poses = self._poses(motion.start_posed)
        self._started_near, self._friction = self._is_near(poses), None
        self._start = self.pair.gaps(*poses) if time_averaged else None
        if self._started_near and self.pair.friction:
            slip = partial(self._sticking_slip, motion, dt)
            self._friction = self.pair.lag_friction(*poses, self._law.barrier, slip)

    def _sticking_slip(self, motion: RigidObstacles, dt: float, points: Values, normals: Values) -> float:
        """Slip in the step that counts as sticking, m."""
        first, second = (np.broadcast_to(motion.velocity(n, points), points.shape) for n in self.numbers)
        speed = float(np.linalg.norm(tangential(normals, first - second), axis=1).max())
        return dt * max(self._law.sticking_speed, self._law.sticking_ratio * speed)

    def is_open(self, posed: PosedObstacles) -> bool:
        """Whether all gaps are open."""
        return all(gap.min(initial=np.inf) > 0 for gap in self.pair.gaps(*self._poses(posed)))

    def safe_fraction(self, first: PoseMotion, second: PoseMotion) -> float:
        """Fraction of the motions of both that leaves a tenth of each gap."""
        return self.pair.safe_fraction(first[0].pose, first[1], second[0].pose, second[1])

    def derivatives(self, posed: PosedObstacles, *, exact: bool) -> PairDerivatives | None:
        """Derivatives of the potential by both poses; None: out of contact."""
        poses = self._poses(posed)
        if (sides := self._contact_forces(poses)) is None:
            return None
        of_first, of_second = (
            self._of_side(*side, *ordered, inset, exact=exact)
            for side, ordered, inset in zip(sides, (poses, poses[::-1]), self.pair.points, strict=True)
        )
        by_first, by_second = of_first[0] + of_second[1], of_first[1] + of_second[0]
        by_both = of_first[2] + of_second[2].T
        if self._friction is None:
            return by_first, by_second, by_both
        of_friction = self._friction.derivatives(poses, exact=exact)
        return by_first + of_friction[0], by_second + of_friction[1], by_both + of_friction[2]

    @staticmethod
    def _of_side(
        contact: ContactForces, x: Values, carrier: Pose, other: Pose, inset: InsetPoints, *, exact: bool
    ) -> PairDerivatives:
        """Derivatives of contact of points x (n, d), m, by the poses of their carrier and of the other obstacle."""
        arm, stiffness = x[contact.points] - carrier.centre, contact.tangent(exact=exact)
        by_carrier = carried_derivatives(contact.potential, -contact.normal, stiffness, arm, exact=exact)
        by_other = PoseCoupling(contact, x, other, None, other, exact=exact).derivatives()
        by_both = mixed_pose_hessian(contact, x, carrier, other, exact=exact)
        if (spin := inset.spin_direction(carrier)) is None:
            return by_carrier, by_other, by_both
        return _without_spin(spin, by_carrier, by_other, by_both, exact=exact)

    def energies(self, posed: PosedObstacles) -> tuple[float, float]:
        """Energy of the barrier, and potential of all forces in the step, J."""
        poses = self._poses(posed)
        sides = self._contact_forces(poses) or []
        potential = 0.0 if self._friction is None else self._friction.energy(poses)
        stored = sum(contact.energy for contact, _ in sides)
        return stored, sum(contact.potential for contact, _ in sides) + potential

    def dissipated(self, posed: PosedObstacles) -> float:
        """Energy dissipated by friction in the step, J."""
        if self._friction is None:
            return 0.0
        poses = self._poses(posed)
        return -float(np.vdot(self._friction.on_first(poses), self._friction.slip(poses)))

    def _contact_forces(self, poses: tuple[Pose, Pose]) -> list[tuple[ContactForces, Values]] | None:
        """Normal forces on the points of both; None: out of contact, now and at the start of the step."""
        if not self._started_near and not self._is_near(poses):
            return None
        sides = self.pair.contact_forces(*poses, self._law.barrier, self._start)
        touches = self._friction is not None or any(len(contact.points) for contact, _ in sides)
        return sides if touches else None


def _without_spin(
    spin: Values, by_carrier: PoseDerivatives, by_other: PoseDerivatives, by_both: Values, *, exact: bool
) -> PairDerivatives:
    """Derivatives of contact whose points are turned about the axis of their carrier as both move.

    The energy is stationary in that turn phi. Its second derivatives are H - h h^T / (a . H a), where h = H a has the
    mixed ones by the poses and phi. a = `spin` (6,) is the increment of the carrier that turns the points with it. The
    turn comes before the rotation w of the carrier: exp(w) exp(phi a) = exp(w + phi a + phi w x a / 2 + ...).
    """
    of_carrier, of_other = by_carrier.hessian @ spin, by_both.T @ spin
    if abs(stiffness := float(spin @ of_carrier)) <= np.finfo(float).eps * np.linalg.norm(by_carrier.hessian):
        return by_carrier, by_other, by_both
    if exact:
        of_carrier[3:] += 0.5 * np.cross(spin[3:], by_carrier.gradient[3:])
    return (
        replace(by_carrier, hessian=by_carrier.hessian - np.outer(of_carrier, of_carrier) / stiffness),
        replace(by_other, hessian=by_other.hessian - np.outer(of_other, of_other) / stiffness),
        by_both - np.outer(of_carrier, of_other) / stiffness,
    )


class ObstaclePairs:
    """Contact between obstacles; `posed` are all obstacles at their poses, by their numbers.

    Attributes:
        pairs: of a free obstacle and another one each.
    """

    def __init__(self, pairs: Sequence[BarrierPair | MeshPair], free: Iterable[int]) -> None:
        """`free`: numbers of the free obstacles."""
        self.pairs, self._free = tuple(pairs), frozenset(free)

    def begin_step(self, motion: RigidObstacles, dt: float, *, time_averaged: bool) -> None:
        """Begin a step of dt, s; `time_averaged`: barriers are averaged over it."""
        for pair in self.pairs:
            pair.begin_step(motion, dt, time_averaged=time_averaged)

    def are_open(self, posed: PosedObstacles) -> bool:
        """Whether all gaps are open."""
        return all(pair.is_open(posed) for pair in self.pairs)

    def safe_fraction(self, motions: Mapping[int, PoseMotion]) -> float:
        """Fraction of the motions of obstacles that leaves a tenth of each gap between them."""
        moving = [pair for pair in self.pairs if all(number in motions for number in pair.numbers)]
        return min((pair.safe_fraction(*(motions[n] for n in pair.numbers)) for pair in moving), default=1.0)

    def derivatives(
        self, posed: PosedObstacles, *, exact: bool
    ) -> tuple[dict[int, PoseDerivatives], dict[Numbers, Values]]:
        """Potentials and derivatives of contact by the poses of free obstacles.

        Returns:
            Derivatives by the pose of each free obstacle in contact, where the energy of a pair counts once. And mixed
            second derivatives of pairs of free ones.
        """
        bodies: dict[int, PoseDerivatives] = {}
        mixed: dict[Numbers, Values] = {}
        for pair in self.pairs:
            if (parts := pair.derivatives(posed, exact=exact)) is None:
                continue
            *by_pose, by_both = parts
            if self._free.issuperset(pair.numbers):
                by_pose[1], mixed[pair.numbers] = replace(by_pose[1], energy=0.0), by_both
            for number, body in zip(pair.numbers, by_pose, strict=True):
                if number in self._free:
                    bodies[number] = bodies[number] + body if number in bodies else body
        return bodies, mixed

    def wrenches(self, posed: PosedObstacles) -> dict[int, Values]:
        """(p,) force and moment of the others on each free obstacle in contact, N and N m."""
        return {number: -body.gradient for number, body in self.derivatives(posed, exact=False)[0].items()}

    def energies(self, posed: PosedObstacles) -> tuple[float, float]:
        """Energy of the barriers, and potential of all forces in the step, J."""
        energies = [pair.energies(posed) for pair in self.pairs]
        return sum(stored for stored, _ in energies), sum(potential for _, potential in energies)

    def work(self, posed: PosedObstacles, increments: Sequence[Values]) -> tuple[float, float]:
        """Work of prescribed obstacles on free ones by their own increments (p,) in the step; dissipation, J."""
        total = 0.0
        for pair in self.pairs:
            if not self._free.issuperset(pair.numbers) and (parts := pair.derivatives(posed, exact=False)) is not None:
                by_pose = zip(pair.numbers, parts[:2], strict=True)
                total += sum(float(body.gradient @ increments[n]) for n, body in by_pose if n not in self._free)
        return total, sum(pair.dissipated(posed) for pair in self.pairs)
