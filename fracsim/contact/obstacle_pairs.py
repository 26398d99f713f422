"""Contact of a free obstacle with held or driven ones, by barriers at inset points; without friction.

    E = sum over points of both of  A b(gap),    gap: distance to the other shape minus the radius of the points

A is the share of a point in the surface of its shape, b the barrier of the contact with the body. A shape is all within
a radius of its inset points: for spheres and capsules a point or segment, for boxes and cylinders the edges without
their rounding. Where two convex bodies are nearest to each other one of these points is nearest to the other body:
exactly in 2D, and in 3D except for two edges that cross, of which points are sampled.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Protocol, cast

import numpy as np
import numpy.typing as npt

from .laws import BARRIER, GapPotential
from .node_contact import ContactForces, StepStart, evaluate_points
from .obstacle import RigidObstacle, free_pairs
from .pose import Pose, PosedShape, rotate_vectors
from .pose_derivatives import (
    MixedHessian,
    PoseDerivatives,
    carried_point_derivatives,
    mixed_pose_hessian,
    pose_derivatives,
)
from .shape_base import ConvexBody, Shape, frame_about, unit_vector
from .shapes import Capsule, RoundedBox, RoundedCylinder, Sphere, TranslatedShape
from .step_limit import PoseMotion, safe_fractions
from .triangle_mesh_shape import TriangleMeshShape

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class InsetPolicy:
    """Numbers of sampled points.

    Attributes:
        edge_points: points on an edge or a segment, and circles on a cylinder.
        circle_points: points on a circle.
    """

    edge_points: int = 9
    circle_points: int = 24


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
class OffsetShape:
    """All points within an offset of a shape: its distance minus the offset.

    Attributes:
        shape: original shape.
        offset: m.
    """

    shape: Shape
    offset: float

    @property
    def convex(self) -> bool:
        """Whether the shape is convex."""
        return self.shape.convex

    @property
    def rotation_invariant(self) -> bool:
        """Whether no rotation about the reference point changes the shape."""
        return self.shape.rotation_invariant

    def distance(self, x: Values) -> Values:
        """(n,) signed distances, m."""
        return self.shape.distance(x) - self.offset

    def normal(self, x: Values) -> Values:
        """(n, d) gradients of the distance."""
        return self.shape.normal(x)

    def curvature(self, x: Values) -> Values:
        """(n, d, d) Hessians of the distance, 1/m."""
        return self.shape.curvature(x)


@dataclass(frozen=True, eq=False)
class ObstaclePair:
    """A free obstacle, the first, and another one.

    Attributes:
        points: their inset points.
        areas: (n,) shares of these, m^2.
        targets: shapes that the points of each are in contact with: the other one, grown by their radius.
    """

    points: tuple[InsetPoints, InsetPoints]
    areas: tuple[Values, Values]
    targets: tuple[Shape, Shape]

    @classmethod
    def between(cls, body: RigidObstacle, obstacle: RigidObstacle) -> ObstaclePair:
        """Pair of two obstacles."""
        first, second = inset_points(body.shape), inset_points(obstacle.shape)
        # a triangle mesh has no distance function: it is in contact with others at its own points alone
        if isinstance(body.shape, TriangleMeshShape):
            none = InsetPoints(np.empty((0, 3)), 0.0)
            areas = np.full(len(first.points), first.area), np.empty(0)
            return cls((first, none), areas, (obstacle.shape,) * 2)
        areas = np.full(len(first.points), first.area), np.full(len(second.points), second.area)
        targets = OffsetShape(obstacle.shape, first.radius), OffsetShape(body.shape, second.radius)
        # an OffsetShape has all of a Shape that `evaluate_points` needs
        return cls((first, second), areas, cast("tuple[Shape, Shape]", targets))

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

    def contact_forces(
        self, body: Pose, obstacle: Pose, barrier: GapPotential, start: list[Values] | None
    ) -> list[tuple[ContactForces, Values]]:
        """Forces on the points of each, and their positions (n, d), m.

        Args:
            body: pose of the free obstacle.
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


class ObstaclePairs:
    """All pairs of free obstacles with others; `posed` are all obstacles at their poses, by their numbers.

    A pair of two triangle meshes has no distance function, and is left out.
    """

    def __init__(self, obstacles: Mapping[int, RigidObstacle], barrier: GapPotential) -> None:
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
        self._barrier = barrier
        self._start: dict[Numbers, list[Values]] = {}
        self._started_near: set[Numbers] = set()  # pairs in contact at the start of the step

    def begin_step(self, posed: PosedObstacles, *, time_averaged: bool) -> None:
        """Begin a step; `time_averaged`: barriers are averaged over it."""
        pairs = self._pairs.items() if time_averaged else []
        self._start = {(i, j): pair.gaps(posed[i].pose, posed[j].pose) for (i, j), pair in pairs}
        self._started_near = {
            numbers for numbers, gaps in self._start.items() if np.concatenate(gaps).min() < self._barrier.width
        }

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

    def derivatives(self, posed: PosedObstacles) -> tuple[dict[int, PoseDerivatives], dict[Numbers, MixedHessian]]:
        """Energies and derivatives of contact by the poses of free obstacles.

        Returns:
            Derivatives by the pose of each free obstacle in contact, where the energy of a pair counts once. And mixed
            second derivatives of pairs of free ones.
        """
        bodies: dict[int, PoseDerivatives] = {}
        mixed: dict[Numbers, MixedHessian] = {}
        for (i, j), ((of_i, x), (of_j, y)) in self._contact_forces(posed).items():
            first, second = posed[i].pose, posed[j].pose
            by_pose = {
                i: carried_point_derivatives(of_i, x, first) + pose_derivatives(of_j, y, first, None, first),
                j: pose_derivatives(of_i, x, second, None, second) + carried_point_derivatives(of_j, y, second),
            }
            free = [number for number in (i, j) if number in self._free]
            if len(free) == 2:  # the energy counts once
                by_pose[j] = replace(by_pose[j], energy=0.0)
                sides = mixed_pose_hessian(of_i, x, first, second), mixed_pose_hessian(of_j, y, second, first)
                mixed[i, j] = sides[0][0] + sides[1][0].T, sides[0][1] + sides[1][1].T
            for number in free:
                bodies[number] = bodies[number] + by_pose[number] if number in bodies else by_pose[number]
        return bodies, mixed

    def energies(self, posed: PosedObstacles) -> tuple[float, float]:
        """Energy of the barriers, and potential of their forces in the step, J."""
        contacts = [contact for sides in self._contact_forces(posed).values() for contact, _ in sides]
        return sum(contact.energy for contact in contacts), sum(contact.potential for contact in contacts)

    def work(self, posed: PosedObstacles, increments: Mapping[int, Values] | Sequence[Values]) -> float:
        """Work of prescribed obstacles on free ones by their own increments (p,) in the step, J."""
        total = 0.0
        for (i, j), ((of_i, _), (of_j, _)) in self._contact_forces(posed).items():
            on_first, d = of_i.normal.sum(axis=0) - of_j.normal.sum(axis=0), posed[i].pose.dim
            for number, force in ((j, on_first), (i, -on_first)):
                if number not in self._free:
                    total += float(force @ increments[number][:d])
        return total

    def _contact_forces(self, posed: PosedObstacles) -> dict[Numbers, list[tuple[ContactForces, Values]]]:
        """Forces on the points of both obstacles of each pair in contact."""
        contacts = {
            (i, j): pair.contact_forces(posed[i].pose, posed[j].pose, self._barrier, self._start.get((i, j)))
            for (i, j), pair in self._pairs.items()
            if (i, j) in self._started_near or pair.gap_bound(posed[i].pose, posed[j].pose) < self._barrier.width
        }
        return {numbers: sides for numbers, sides in contacts.items() if any(len(side.points) for side, _ in sides)}


class PairContact(Protocol):
    """Contact between obstacles of one kind."""

    def begin_step(self, posed: PosedObstacles, *, time_averaged: bool) -> None:
        """Begin a step; `time_averaged`: barriers are averaged over it."""

    def are_open(self, posed: PosedObstacles) -> bool:
        """Whether all gaps are open."""

    def safe_fraction(self, motions: Mapping[int, PoseMotion]) -> float:
        """Fraction of the motions of obstacles that leaves a tenth of each gap between them."""

    def derivatives(self, posed: PosedObstacles) -> tuple[dict[int, PoseDerivatives], dict[Numbers, MixedHessian]]:
        """Energies and derivatives by the poses of free obstacles in contact."""

    def energies(self, posed: PosedObstacles) -> tuple[float, float]:
        """Energy of the barriers, and potential of their forces in the step, J."""

    def work(self, posed: PosedObstacles, increments: Mapping[int, Values] | Sequence[Values]) -> float:
        """Work of prescribed obstacles on free ones by their own increments (p,) in the step, J."""


class AllPairs:
    """Contact between obstacles of all kinds; `posed` are all obstacles at their poses, by their numbers."""

    def __init__(self, kinds: Sequence[PairContact]) -> None:
        self.kinds = tuple(kinds)

    def begin_step(self, posed: PosedObstacles, *, time_averaged: bool) -> None:
        """Begin a step; `time_averaged`: barriers are averaged over it."""
        for pairs in self.kinds:
            pairs.begin_step(posed, time_averaged=time_averaged)

    def are_open(self, posed: PosedObstacles) -> bool:
        """Whether all gaps are open."""
        return all(pairs.are_open(posed) for pairs in self.kinds)

    def safe_fraction(self, motions: Mapping[int, PoseMotion]) -> float:
        """Fraction of the motions of obstacles that leaves a tenth of each gap between them."""
        return min((pairs.safe_fraction(motions) for pairs in self.kinds), default=1.0)

    def derivatives(self, posed: PosedObstacles) -> tuple[dict[int, PoseDerivatives], dict[Numbers, MixedHessian]]:
        """Energies and derivatives by the poses of free obstacles in contact."""
        bodies: dict[int, PoseDerivatives] = {}
        mixed: dict[Numbers, MixedHessian] = {}
        for pairs in self.kinds:
            of_bodies, of_pairs = pairs.derivatives(posed)
            mixed |= of_pairs
            for number, body in of_bodies.items():
                bodies[number] = bodies[number] + body if number in bodies else body
        return bodies, mixed

    def wrenches(self, posed: PosedObstacles) -> dict[int, Values]:
        """(p,) force and moment of the others on each free obstacle in contact, N and N m."""
        return {number: -body.gradient for number, body in self.derivatives(posed)[0].items()}

    def energies(self, posed: PosedObstacles) -> tuple[float, float]:
        """Energy of the barriers, and potential of their forces in the step, J."""
        energies = [pairs.energies(posed) for pairs in self.kinds]
        return sum(stored for stored, _ in energies), sum(potential for _, potential in energies)

    def work(self, posed: PosedObstacles, increments: Mapping[int, Values] | Sequence[Values]) -> float:
        """Work of prescribed obstacles on free ones by their own increments (p,) in the step, J."""
        return sum(pairs.work(posed, increments) for pairs in self.kinds)
