"""Contact of free obstacles with others, by barriers at inset points, with lagged friction.

    E = sum over points of both of  A b(gap),    gap: distance to the other shape minus the radius of the points

A is the share of a point in the surface of its shape, b the barrier of the contact with the body. A shape is all within
a radius of its inset points: for spheres and capsules a point or segment, for boxes and cylinders the edges without
their rounding. Where two convex bodies are nearest to each other one of these points is nearest to the other body:
exactly in 2D, and in 3D except for two edges that cross, of which points are sampled.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product
from typing import Protocol, cast

import numpy as np
import numpy.typing as npt

from .laws import BARRIER, CoulombFriction, GapPotential, ObstacleLaw, tangential
from .node_contact import ContactForces, StepStart, evaluate_points, lag_contact
from .obstacle import RigidObstacle, free_pairs
from .pose import Pose, PosedShape, rotate_vectors, rotation_second_derivative
from .pose_derivatives import (
    PoseCoupling,
    PoseDerivatives,
    carried_point_derivatives,
    mixed_pose_hessian,
    point_jacobian,
)
from .shape_base import ConvexBody, Shape, frame_about, unit_vector
from .shapes import Capsule, OffsetShape, RoundedBox, RoundedCylinder, Sphere, TranslatedShape
from .step_limit import PoseMotion, safe_fractions
from .triangle_mesh_shape import TriangleMeshShape

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class InsetPolicy:
    """Numbers of sampled points.

    Attributes:
        edge_points: points on an edge or a segment, and circles on a cylinder.
        circle_points: points on a circle.
        touching_share: share of a surface that touches at once in a penalty, as one face of a box.
    """

    edge_points: int = 9
    circle_points: int = 24
    touching_share: float = 0.25


SAMPLES = InsetPolicy()


@dataclass(frozen=True, eq=False)
class InsetPoints:
    """Points such that a shape is all within a radius of them.

    Attributes:
        points: (n, d) in the frame of the shape, m.
        radius: m.
        area: share of each point in the surface of the shape, m^2 (2D: m).
    """

    points: Values
    radius: float
    area: float = 0.0


def inset_points(shape: Shape) -> InsetPoints:
    """Inset points of a shape; none of half spaces and hollow shapes."""
    if isinstance(shape, TranslatedShape):
        original = inset_points(shape.shape)
        return InsetPoints(original.points + shape.offset, original.radius, original.area)
    if isinstance(shape, TriangleMeshShape):
        return InsetPoints(shape.points, 0.0, surface_measure(shape) / len(shape.points))
    points, radius = _points_and_radius(shape)
    return InsetPoints(points, radius, surface_measure(shape) / max(len(points), 1))


def _points_and_radius(shape: Shape) -> tuple[Values, float]:
    if isinstance(shape, ConvexBody) and not shape.hollow:
        if isinstance(shape, Sphere):
            return np.zeros((1, shape.dim)), shape.radius
        if isinstance(shape, Capsule):
            along = np.linspace(-0.5, 0.5, SAMPLES.edge_points) * shape.length
            return along[:, None] * unit_vector(shape.axis), shape.radius
        if isinstance(shape, RoundedBox):
            return _edge_points(np.array(shape.size) / 2 - shape.fillet), shape.fillet
        if isinstance(shape, RoundedCylinder):
            return _circle_points(shape), shape.fillet
    return np.empty((0, shape.dim)), 0.0


def surface_measure(shape: Shape) -> float:
    """Area of the tessellation of a shape, m^2 (2D: length, m)."""
    points, elements = shape.tessellate()
    side = points[elements[:, 1:]] - points[elements[:, :1]]
    if shape.dim == 2:
        return float(np.linalg.norm(side[:, 0], axis=1).sum())
    return float(np.linalg.norm(np.cross(side[:, 0], side[:, 1]), axis=1).sum() / 2)


def _edge_points(half: Values) -> Values:
    """Points on the edges of a box of half sizes (d,), m; in 2D its corners."""
    d = len(half)
    if d == 2:
        return np.array(list(product((-1.0, 1.0), repeat=2))) * half
    along = np.linspace(-1.0, 1.0, SAMPLES.edge_points)
    lines = [np.insert(np.array(ends), axis, t) for axis in range(d) for ends in product((-1.0, 1.0), repeat=2)
             for t in along]  # fmt: skip
    return np.unique(np.array(lines), axis=0) * half


def _circle_points(shape: RoundedCylinder) -> Values:
    """Points on circles over the side of a cylinder."""
    angle = np.arange(SAMPLES.circle_points) * (2 * np.pi / SAMPLES.circle_points)
    radius, half = shape.radius - shape.fillet, shape.length / 2 - shape.fillet
    circle = radius * np.column_stack([np.cos(angle), np.sin(angle)])
    heights = np.linspace(-half, half, SAMPLES.edge_points)
    rings = [np.column_stack([circle, np.full(SAMPLES.circle_points, height)]) for height in heights]
    return np.concatenate(rings) @ frame_about(unit_vector(shape.axis)).T


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
        """Derivatives by the pose of each, with the energy in the first; (p, p) second derivatives by both."""
        gradient, slip, d = -self.on_first(poses), self.slip(poses), poses[0].dim
        H, energies, result, J = self.law.hessian(self.force, self.normal, slip), (self.energy(poses), 0.0), [], []
        for pose, x, energy, sign in zip(poses, self._carried(poses), energies, (1.0, -1.0), strict=True):
            arm = x - pose.centre
            J.append(sign * point_jacobian(arm))
            hessian = np.asarray(np.einsum("kip,kij,kjq->pq", J[-1], H, J[-1]))
            if exact:
                hessian[d:, d:] += rotation_second_derivative(sign * gradient, arm).sum(axis=0)
            result.append(PoseDerivatives(energy, np.einsum("kdp,kd->p", J[-1], gradient), hessian))
        return result[0], result[1], np.asarray(np.einsum("kip,kij,kjq->pq", J[0], H, J[1]))


@dataclass(frozen=True, eq=False)
class PairStart:
    """Pair of obstacles at the start of a step.

    Attributes:
        gaps: (n,) of the points of each, m.
        friction: in the step; None: without contact, or friction.
    """

    gaps: list[Values]
    friction: PairFriction | None


@dataclass(frozen=True, eq=False)
class ObstaclePair:
    """A free obstacle, the first, and another one.

    Attributes:
        points: their inset points.
        areas: (n,) shares of these, m^2.
        targets: shapes that the points of each are in contact with: the other one, grown by their radius.
        friction: coefficient of friction, the larger one of both.
    """

    points: tuple[InsetPoints, InsetPoints]
    areas: tuple[Values, Values]
    targets: tuple[Shape, Shape]
    friction: float

    @classmethod
    def between(cls, body: RigidObstacle, obstacle: RigidObstacle) -> ObstaclePair:
        """Pair of two obstacles."""
        first, second = inset_points(body.shape), inset_points(obstacle.shape)
        friction = max(body.friction, obstacle.friction)
        # a triangle mesh has no distance function: it is in contact with others at its own points alone
        if isinstance(body.shape, TriangleMeshShape):
            none = InsetPoints(np.empty((0, 3)), 0.0)
            areas = np.full(len(first.points), first.area), np.empty(0)
            return cls((first, none), areas, (obstacle.shape,) * 2, friction)
        areas = np.full(len(first.points), first.area), np.full(len(second.points), second.area)
        targets = OffsetShape(obstacle.shape, first.radius), OffsetShape(body.shape, second.radius)
        # an OffsetShape has all of a Shape that `evaluate_points` needs
        return cls((first, second), areas, cast("tuple[Shape, Shape]", targets), friction)

    def sides(self, body: Pose, obstacle: Pose) -> Iterator[tuple[Values, PosedShape]]:
        """(n, d) points of each obstacle in space, m, and the shape that they are in contact with."""
        yield body.points_to_space(self.points[0].points), PosedShape(self.targets[0], obstacle)
        yield obstacle.points_to_space(self.points[1].points), PosedShape(self.targets[1], body)

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

    def begin_step(
        self, body: Pose, obstacle: Pose, barrier: GapPotential, slip: Callable[[Values, Values], float]
    ) -> PairStart:
        """State of the pair at the start of a step, at the poses of both there.

        Args:
            body: pose of the first obstacle.
            obstacle: pose of the other one.
            barrier: b.
            slip: points and normals of contact (k, d) -> slip that counts as sticking, m.
        """
        gaps = self.gaps(body, obstacle)
        if not self.friction:
            return PairStart(gaps, None)
        sides = zip(self.sides(body, obstacle), gaps, self.areas, self.points, strict=True)
        lagged = [(lag_contact(x, gap, area, posed, barrier), inset) for (x, posed), gap, area, inset in sides]
        force = np.concatenate([contact.force for contact, _ in lagged])
        if not len(force):
            return PairStart(gaps, None)
        normal = np.concatenate([contact.normal for contact, _ in lagged])
        point = np.concatenate([contact.position - inset.radius * contact.normal for contact, inset in lagged])
        law = CoulombFriction(self.friction, slip(point, normal))
        return PairStart(gaps, PairFriction(law, force, normal, point, (body, obstacle)))

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
            starts = [StepStart.from_gaps(gap, body.dim) for gap in start]
        no_motion = np.zeros(body.dim)
        return [
            (evaluate_points(x, area, posed, barrier, None, None, no_motion, step_start), x)
            for (x, posed), area, step_start in zip(self.sides(body, obstacle), self.areas, starts, strict=True)
        ]

    def safe_fraction(self, body: Pose, q: Values, obstacle: Pose, other_q: Values) -> float:
        """Fraction of the increments q and `other_q` (p,) of both poses that leaves a tenth of each gap."""
        d, between = body.dim, float(np.linalg.norm(body.centre - obstacle.centre))
        straight = float(np.linalg.norm(q[:d] - other_q[:d]))
        angle, other_angle = float(np.linalg.norm(q[d:])), float(np.linalg.norm(other_q[d:]))
        reach = straight + angle * self._radius + other_angle * (between + straight + self._radius)
        if self.gap_bound(body, obstacle) * (1 - BARRIER.min_gap_ratio) > reach:
            return 1.0
        (x, target), (y, other_target) = self.sides(body, obstacle)
        motions = [
            _PairMotion(target, x - body.centre, body.centre, q, target.effective_increment(other_q)),
            _PairMotion(
                other_target, y - obstacle.centre, obstacle.centre, other_q, other_target.effective_increment(q)
            ),
        ]
        return min(motion.safe_fraction() for motion in motions)


@dataclass(frozen=True, eq=False)
class _PairMotion:
    """Motion of points with a rigid body, and of an obstacle before them.

    Attributes:
        obstacle: at the start.
        arm: (n, d) points relative to the centre of the body, m.
        centre: (d,) of the body, m.
        increment: (p,) of the body's pose.
        obstacle_increment: (p,) of the obstacle's pose.
    """

    obstacle: PosedShape
    arm: Values
    centre: Values
    increment: Values
    obstacle_increment: Values

    def safe_fraction(self) -> float:
        """Fraction of the motion that leaves a tenth of each gap; 0 where one is closed."""
        if not len(self.arm):
            return 1.0
        if not (self.gap(np.zeros(len(self.arm))) > 0).all():
            return 0.0
        return float(safe_fractions(self.gap, self.speed, len(self.arm)).min())

    def gap(self, fraction: Values) -> Values:
        """(n,) gaps after fractions (n,) of the motion, m."""
        return self.obstacle.shape.distance(self._obstacle_frame(fraction))

    def speed(self, fraction: Values) -> Values:
        """(n,) bounds of the closing speed, m per whole motion (step_limit.PointMotion).

        A rotation of the obstacle adds at most its angle times the distance of the points from its centre.
        """
        d, radius = len(self.centre), np.linalg.norm(self.arm, axis=1)
        straight = self.increment[:d] - self.obstacle_increment[:d]
        angle, obstacle_angle = np.linalg.norm(self.increment[d:]), np.linalg.norm(self.obstacle_increment[d:])
        closing: Values = np.full(len(self.arm), float(np.linalg.norm(straight)))
        if self.obstacle.shape.convex:
            v = self._rotated_back(np.tile(straight, (len(self.arm), 1)), fraction)
            normal = self.obstacle.shape.normal(self._obstacle_frame(fraction))
            closing = np.maximum(-np.einsum("ni,ni->n", normal, v), 0.0)
        distance = np.linalg.norm(self.centre - self.obstacle.pose.centre) + np.linalg.norm(straight) + radius
        return np.asarray(closing + angle * radius + obstacle_angle * distance)

    def _obstacle_frame(self, fraction: Values) -> Values:
        """(n, d) points in the frame of the obstacle, m."""
        d = len(self.centre)
        straight = fraction[:, None] * (self.increment[:d] - self.obstacle_increment[:d])
        motion = straight + rotate_vectors(self.arm, fraction[:, None] * self.increment[d:])
        return self._rotated_back(self.centre - self.obstacle.pose.centre + motion, fraction)

    def _rotated_back(self, vectors: Values, fraction: Values) -> Values:
        """(n, d) vectors in the frame that the obstacle has at each fraction."""
        w = -fraction[:, None] * self.obstacle_increment[len(self.centre) :]
        return np.asarray(rotate_vectors(vectors, w) @ self.obstacle.pose.rotation)


type PosedObstacles = Mapping[int, PosedShape] | Sequence[PosedShape]  # by the numbers of obstacles
type Numbers = tuple[int, int]  # of a free obstacle and another one


class StepMotion(Protocol):
    """Motion of obstacles in a step, as pairs need it at its start.

    Attributes:
        start_posed: obstacles at the start of the step, by their numbers.
    """

    start_posed: list[PosedShape]

    def velocity(self, number: int, x: Values) -> Values:
        """(d,) velocity of an obstacle at the start of the step, or (n, d) of its points at x (n, d), m/s."""


class ObstaclePairs:
    """All pairs of free obstacles with others; `posed` are all obstacles at their poses, by their numbers.

    A pair of two triangle meshes has no distance function, and is left out.
    """

    def __init__(self, obstacles: Mapping[int, RigidObstacle], law: ObstacleLaw) -> None:
        """`obstacles` by their numbers, free ones and others."""
        numbers = list(obstacles)
        named = [(numbers[i], numbers[j]) for i, j in free_pairs([obstacles[number] for number in numbers])]
        # a triangle mesh comes first, since it is in contact at its own points
        named = [(j, i) if isinstance(obstacles[j].shape, TriangleMeshShape) else (i, j) for i, j in named]
        self._pairs = {
            (i, j): ObstaclePair.between(obstacles[i], obstacles[j])
            for i, j in named
            if not all(isinstance(obstacles[number].shape, TriangleMeshShape) for number in (i, j))
        }
        self._free = {number for number, obstacle in obstacles.items() if obstacle.free}
        self._law, self._width, self._time_averaged = law, law.barrier.width, False
        self._start: dict[Numbers, PairStart] = {}
        self._started_near: set[Numbers] = set()  # pairs in contact at the start of the step

    def begin_step(self, motion: StepMotion, dt: float, *, time_averaged: bool) -> None:
        """Begin a step of dt, s; `time_averaged`: barriers are averaged over it."""
        self._start, self._started_near, self._time_averaged = {}, set(), time_averaged
        for (i, j), pair in self._pairs.items():
            first, second = (motion.start_posed[number].pose for number in (i, j))
            is_near = pair.gap_bound(first, second) < self._width
            if time_averaged or (is_near and pair.friction):
                slip = partial(self._sticking_slip, motion, dt, (i, j))
                self._start[i, j] = pair.begin_step(first, second, self._law.barrier, slip)
            if is_near:
                self._started_near.add((i, j))

    def _sticking_slip(self, motion: StepMotion, dt: float, numbers: Numbers, points: Values, normals: Values) -> float:
        """Slip in the step that counts as sticking, m."""
        first, second = (np.broadcast_to(motion.velocity(n, points), points.shape) for n in numbers)
        speed = float(np.linalg.norm(tangential(normals, first - second), axis=1).max())
        return dt * max(self._law.sticking_speed, self._law.sticking_ratio * speed)

    def are_open(self, posed: PosedObstacles) -> bool:
        """Whether all gaps are open."""
        gaps = [pair.gaps(posed[i].pose, posed[j].pose) for (i, j), pair in self._pairs.items()]
        return all(gap.min(initial=np.inf) > 0 for sides in gaps for gap in sides)

    def safe_fraction(self, motions: Mapping[int, PoseMotion]) -> float:
        """Fraction of the motions of obstacles that leaves a tenth of each gap between them."""
        fractions = [
            pair.safe_fraction(motions[i][0].pose, motions[i][1], motions[j][0].pose, motions[j][1])
            for (i, j), pair in self._pairs.items()
            if i in motions and j in motions
        ]
        return min(fractions, default=1.0)

    def derivatives(
        self, posed: PosedObstacles, *, exact: bool
    ) -> tuple[dict[int, PoseDerivatives], dict[Numbers, Values]]:
        """Energies and derivatives of contact by the poses of free obstacles.

        Returns:
            Derivatives by the pose of each free obstacle in contact, where the energy of a pair counts once. And mixed
            second derivatives of pairs of free ones.
        """
        bodies: dict[int, PoseDerivatives] = {}
        mixed: dict[Numbers, Values] = {}
        for (i, j), ((of_i, x), (of_j, y)) in self._contact_forces(posed).items():
            first, second = posed[i].pose, posed[j].pose
            by_pose = {
                i: carried_point_derivatives(of_i, x, first, exact=exact)
                + PoseCoupling(of_j, y, first, None, first, exact=exact).derivatives(),
                j: PoseCoupling(of_i, x, second, None, second, exact=exact).derivatives()
                + carried_point_derivatives(of_j, y, second, exact=exact),
            }
            block = mixed_pose_hessian(of_i, x, first, second, exact=exact)
            block = block + mixed_pose_hessian(of_j, y, second, first, exact=exact).T
            free = [number for number in (i, j) if number in self._free]
            if len(free) == 2:  # the energy counts once
                by_pose[j] = replace(by_pose[j], energy=0.0)
            if (friction := self._friction((i, j))) is not None:
                by_i, by_j, by_both = friction.derivatives((first, second), exact=exact)
                if i not in self._free:
                    by_j = replace(by_j, energy=by_i.energy)
                by_pose = {i: by_pose[i] + by_i, j: by_pose[j] + by_j}
                block = block + by_both
            if len(free) == 2:
                mixed[i, j] = block
            for number in free:
                bodies[number] = bodies[number] + by_pose[number] if number in bodies else by_pose[number]
        return bodies, mixed

    def _friction(self, numbers: Numbers) -> PairFriction | None:
        start = self._start.get(numbers)
        return None if start is None else start.friction

    def wrenches(self, posed: PosedObstacles) -> dict[int, Values]:
        """(p,) force and moment of the others on each free obstacle in contact, N and N m."""
        return {number: -body.gradient for number, body in self.derivatives(posed, exact=False)[0].items()}

    def energies(self, posed: PosedObstacles) -> tuple[float, float]:
        """Energy of the barriers, and potential of all forces in the step, J."""
        stored, potential = 0.0, 0.0
        for (i, j), sides in self._contact_forces(posed).items():
            stored += sum(contact.energy for contact, _ in sides)
            potential += sum(contact.potential for contact, _ in sides)
            if (friction := self._friction((i, j))) is not None:
                potential += friction.energy((posed[i].pose, posed[j].pose))
        return stored, potential

    def work(self, posed: PosedObstacles, increments: Mapping[int, Values] | Sequence[Values]) -> tuple[float, float]:
        """Work of prescribed obstacles on free ones by their own increments (p,) in the step; dissipation, J."""
        total, dissipated = 0.0, 0.0
        for (i, j), ((of_i, _), (of_j, _)) in self._contact_forces(posed).items():
            on_first, d = of_i.normal.sum(axis=0) - of_j.normal.sum(axis=0), posed[i].pose.dim
            if (friction := self._friction((i, j))) is not None:
                poses = posed[i].pose, posed[j].pose
                by_friction = friction.on_first(poses)
                on_first = on_first + by_friction.sum(axis=0)
                dissipated -= float(np.vdot(by_friction, friction.slip(poses)))
            for number, force in ((j, on_first), (i, -on_first)):
                if number not in self._free:
                    total += float(force @ increments[number][:d])
        return total, dissipated

    def _contact_forces(self, posed: PosedObstacles) -> dict[Numbers, list[tuple[ContactForces, Values]]]:
        """Normal forces on the points of both obstacles of each pair in contact, now or at the start of the step."""
        contacts = {}
        for (i, j), pair in self._pairs.items():
            if (i, j) in self._started_near or pair.gap_bound(posed[i].pose, posed[j].pose) < self._width:
                start = self._start[i, j].gaps if self._time_averaged else None
                contacts[i, j] = pair.contact_forces(posed[i].pose, posed[j].pose, self._law.barrier, start)
        return {
            numbers: sides
            for numbers, sides in contacts.items()
            if self._friction(numbers) is not None or any(len(contact.points) for contact, _ in sides)
        }


class PairContact(Protocol):
    """Contact between obstacles of one kind."""

    def begin_step(self, motion: StepMotion, dt: float, *, time_averaged: bool) -> None:
        """Begin a step of dt, s; `time_averaged`: barriers are averaged over it."""

    def are_open(self, posed: PosedObstacles) -> bool:
        """Whether all gaps are open."""

    def safe_fraction(self, motions: Mapping[int, PoseMotion]) -> float:
        """Fraction of the motions of obstacles that leaves a tenth of each gap between them."""

    def derivatives(
        self, posed: PosedObstacles, *, exact: bool
    ) -> tuple[dict[int, PoseDerivatives], dict[Numbers, Values]]:
        """Energies and derivatives by the poses of free obstacles in contact."""

    def energies(self, posed: PosedObstacles) -> tuple[float, float]:
        """Energy of the barriers, and potential of their forces in the step, J."""

    def work(self, posed: PosedObstacles, increments: Mapping[int, Values] | Sequence[Values]) -> tuple[float, float]:
        """Work of prescribed obstacles on free ones by their own increments (p,) in the step; dissipation, J."""


class AllPairs:
    """Contact between obstacles of all kinds; `posed` are all obstacles at their poses, by their numbers."""

    def __init__(self, kinds: Sequence[PairContact]) -> None:
        self.kinds = tuple(kinds)

    def begin_step(self, motion: StepMotion, dt: float, *, time_averaged: bool) -> None:
        """Begin a step of dt, s; `time_averaged`: barriers are averaged over it."""
        for pairs in self.kinds:
            pairs.begin_step(motion, dt, time_averaged=time_averaged)

    def are_open(self, posed: PosedObstacles) -> bool:
        """Whether all gaps are open."""
        return all(pairs.are_open(posed) for pairs in self.kinds)

    def safe_fraction(self, motions: Mapping[int, PoseMotion]) -> float:
        """Fraction of the motions of obstacles that leaves a tenth of each gap between them."""
        return min((pairs.safe_fraction(motions) for pairs in self.kinds), default=1.0)

    def derivatives(
        self, posed: PosedObstacles, *, exact: bool
    ) -> tuple[dict[int, PoseDerivatives], dict[Numbers, Values]]:
        """Energies and derivatives by the poses of free obstacles in contact."""
        bodies: dict[int, PoseDerivatives] = {}
        mixed: dict[Numbers, Values] = {}
        for pairs in self.kinds:
            of_bodies, of_pairs = pairs.derivatives(posed, exact=exact)
            mixed |= of_pairs
            for number, body in of_bodies.items():
                bodies[number] = bodies[number] + body if number in bodies else body
        return bodies, mixed

    def wrenches(self, posed: PosedObstacles) -> dict[int, Values]:
        """(p,) force and moment of the others on each free obstacle in contact, N and N m."""
        return {number: -body.gradient for number, body in self.derivatives(posed, exact=False)[0].items()}

    def energies(self, posed: PosedObstacles) -> tuple[float, float]:
        """Energy of the barriers, and potential of their forces in the step, J."""
        energies = [pairs.energies(posed) for pairs in self.kinds]
        return sum(stored for stored, _ in energies), sum(potential for _, potential in energies)

    def work(self, posed: PosedObstacles, increments: Mapping[int, Values] | Sequence[Values]) -> tuple[float, float]:
        """Work of prescribed obstacles on free ones by their own increments (p,) in the step; dissipation, J."""
        works = [pairs.work(posed, increments) for pairs in self.kinds]
        return sum(work for work, _ in works), sum(dissipated for _, dissipated in works)
