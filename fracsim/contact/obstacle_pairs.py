"""All that a free obstacle meets beside the body: obstacles that are held or driven. No friction acts between them.

A free obstacle before one that is held or driven: points of the skeleton of each, and the distance to the other.

    E = sum over points of both of  A b(gap),    gap: distance to the other shape less the radius of the skeleton

A the share of a point in the surface of its shape, b the barrier of the contact with the body.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import numpy.typing as npt

from .barrier import safe_fractions
from .inset_points import InsetPoints, OffsetShape, inset_points
from .laws import GapPotential
from .node_contact import ContactForces, StepStart, evaluate_points
from .obstacle import RigidObstacle
from .pose import Pose, PosedShape, rotate_vectors
from .rigid_body import PoseDerivatives, carried_point_derivatives, pose_derivatives
from .shape_base import Shape
from .step_limit import PoseMotion
from .triangle_mesh_shape import TriangleMeshShape

Values = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ObstaclePair:
    """Of a free obstacle, the first, and another one.

    Attributes:
        bones: their skeletons.    areas: (n,) shares of their points, m^2.    seen: what the points of each see of the
            other, grown by their radius.
    """

    points: tuple[InsetPoints, InsetPoints]
    areas: tuple[Values, Values]
    targets: tuple[Shape, Shape]

    @classmethod
    def between(cls, body: RigidObstacle, other: RigidObstacle) -> ObstaclePair:
        """Between two obstacles."""
        mine, its = inset_points(body.shape), inset_points(other.shape)
        if isinstance(body.shape, TriangleMeshShape):  # which has no distance: it feels others at its points
            nobody = InsetPoints(np.empty((0, 3)), 0.0)
            return cls((mine, nobody), (np.full(len(mine.points), mine.area), np.empty(0)), (other.shape,) * 2)
        areas = np.full(len(mine.points), mine.area), np.full(len(its.points), its.area)
        seen = OffsetShape(other.shape, mine.radius), OffsetShape(body.shape, its.radius)
        return cls((mine, its), areas, cast("tuple[Shape, Shape]", seen))  # what `touch` asks of a shape they have

    def sides(self, body: Pose, other: Pose) -> Iterator[tuple[Values, PosedShape]]:
        """(n, d) points of each in space, m, and what they see of the other one."""
        yield body.points_to_space(self.points[0].points), PosedShape(self.targets[0], other)
        yield other.points_to_space(self.points[1].points), PosedShape(self.targets[1], body)

    def gaps(self, body: Pose, other: Pose) -> list[Values]:
        """(n,) of the points of each, m."""
        return [placed.distance(x) for x, placed in self.sides(body, other)]

    def contact_forces(
        self, body: Pose, other: Pose, barrier: GapPotential, start: list[Values] | None
    ) -> list[tuple[ContactForces, Values]]:
        """What acts on the points of each, and where these are; `start`: gaps as the step began (laws)."""
        begun: list[StepStart | None] = (
            [None, None] if start is None else [StepStart.from_gaps(gap, body.dim) for gap in start]
        )
        still = np.zeros(body.dim)
        return [
            (evaluate_points(x, area, placed, barrier, None, None, still, gap), x)
            for (x, placed), area, gap in zip(self.sides(body, other), self.areas, begun, strict=True)
        ]

    def safe_fraction(self, body: Pose, q: Values, other: Pose, its: Values) -> float:
        """Share of the ways q and `its` (p,) of the body and the other one that leaves a tenth of each gap."""
        (x, there), (y, here) = self.sides(body, other)
        ways = [
            _PairMotion(there, x - body.centre, body.centre, q, there.effective_increment(its)),
            _PairMotion(here, y - other.centre, other.centre, its, here.effective_increment(q)),
        ]
        return min(way.safe_fraction() for way in ways)


@dataclass(frozen=True, eq=False)
class _PairMotion:
    """Points go with a body, arms (n, d) about its centre, by q (p,), and an obstacle before them by `its` (p,)."""

    obstacle: PosedShape
    arm: Values
    centre: Values
    increment: Values
    obstacle_increment: Values

    def safe_fraction(self) -> float:
        """Of the way, that leaves a tenth of each gap; 0 where one is closed."""
        if not len(self.arm):
            return 1.0
        if not (self.gap(np.zeros(len(self.arm))) > 0).all():
            return 0.0
        return float(safe_fractions(self.gap, self.speed, len(self.arm)).min())

    def gap(self, share: Values) -> Values:
        """(n,) after shares (n,) of the way, m."""
        return self.obstacle.shape.distance(self._seen(share))

    def speed(self, share: Values) -> Values:
        """(n,) bounds of how fast gaps close, m per whole way (motion.Motion); a turn of the obstacle closes them by no
        more than its size times the points' distance from its centre."""
        d, arm = len(self.centre), np.linalg.norm(self.arm, axis=1)
        straight, turn, turned_ = (
            self.increment[:d] - self.obstacle_increment[:d],
            np.linalg.norm(self.increment[d:]),
            np.linalg.norm(self.obstacle_increment[d:]),
        )
        closing: Values = np.full(len(self.arm), float(np.linalg.norm(straight)))
        if self.obstacle.shape.convex:
            v = self._turned(np.tile(straight, (len(self.arm), 1)), share)
            closing = np.maximum(-np.einsum("ni,ni->n", self.obstacle.shape.normal(self._seen(share)), v), 0.0)
        away = np.linalg.norm(self.centre - self.obstacle.pose.centre) + np.linalg.norm(straight) + arm
        return np.asarray(closing + turn * arm + turned_ * away)

    def _seen(self, share: Values) -> Values:
        """(n, d) the points in the frame of the obstacle."""
        d = len(self.centre)
        along = share[:, None] * (self.increment[:d] - self.obstacle_increment[:d]) + rotate_vectors(
            self.arm, share[:, None] * self.increment[d:]
        )
        return self._turned(self.centre - self.obstacle.pose.centre + along, share)

    def _turned(self, vectors: Values, share: Values) -> Values:
        return np.asarray(
            rotate_vectors(vectors, -share[:, None] * self.obstacle_increment[len(self.centre) :])
            @ self.obstacle.pose.rotation
        )


type PosedObstacles = Mapping[int, PosedShape] | Sequence[PosedShape]  # by the numbers of obstacles


class ObstaclePairs:
    """Of one free obstacle; `placed` is where all obstacles are, by their numbers."""

    def __init__(self, body: RigidObstacle, others: dict[int, RigidObstacle], barrier: GapPotential) -> None:
        """`others`: by their numbers."""
        self._pairs = {number: ObstaclePair.between(body, other) for number, other in others.items()}
        self._barrier, self._count = barrier, len(body.pose_increment(0.0, 0.0))
        self._start: dict[int, list[Values]] = {}

    def begin_step(self, pose: Pose, placed: PosedObstacles, *, along: bool) -> None:
        """A step begins; `along`: barriers act along its way (laws)."""
        each = self._pairs.items() if along else []
        self._start = {number: stop.gaps(pose, placed[number].pose) for number, stop in each}

    def are_open(self, pose: Pose, placed: PosedObstacles) -> bool:
        """Whether it lies in none."""
        found = [stop.gaps(pose, placed[number].pose) for number, stop in self._pairs.items()]
        return all(gap.min(initial=np.inf) > 0 for both in found for gap in both)

    def safe_fraction(self, pose: Pose, q: Values, ways: dict[int, PoseMotion]) -> float:
        """Share of its way q (p,) that closes no gap, where others are and go by their numbers."""
        shares = [stop.safe_fraction(pose, q, ways[n][0].pose, ways[n][1]) for n, stop in self._pairs.items()]
        return min(shares, default=1.0)

    def pose_derivatives(self, pose: Pose, placed: PosedObstacles) -> PoseDerivatives:
        """What they do to its pose."""
        p = self._count
        total = PoseDerivatives(0.0, np.zeros(p), np.zeros((p, p)), np.zeros((p, p)))
        for number in self._pairs:
            (own, x), (its, y) = self._contact_forces(number, pose, placed)
            total = total + carried_point_derivatives(own, x, pose) + pose_derivatives(its, y, pose, None, pose)
        return total

    def wrench(self, pose: Pose, placed: PosedObstacles) -> Values:
        """(p,) force and moment of all of them on it, N and N m."""
        return -self.pose_derivatives(pose, placed).gradient

    def energies(self, pose: Pose, placed: PosedObstacles) -> tuple[float, float]:
        """What their barriers store, and what their forces in the step are the derivative of, J."""
        found = [touch for number in self._pairs for touch, _ in self._contact_forces(number, pose, placed)]
        return sum(touch.energy for touch in found), sum(touch.potential for touch in found)

    def work(self, pose: Pose, placed: PosedObstacles, ways: Mapping[int, Values] | Sequence[Values]) -> float:
        """What they have done to it by their own ways (p,) in the step, J."""
        done = 0.0
        for number in self._pairs:
            (own, _), (its, _) = self._contact_forces(number, pose, placed)
            done += float((own.normal.sum(axis=0) - its.normal.sum(axis=0)) @ ways[number][: pose.dim])
        return done

    def _contact_forces(self, number: int, pose: Pose, placed: PosedObstacles) -> list[tuple[ContactForces, Values]]:
        return self._pairs[number].contact_forces(pose, placed[number].pose, self._barrier, self._start.get(number))
