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

from .barrier import longest_step
from .inset_points import Grown, Skeleton, skeleton
from .laws import Repulsion
from .node_contact import Start, Touch, touch
from .obstacle import Obstacle
from .pose import Placed, Pose, turned
from .rigid_body import Push, carried, push
from .shape_base import Shape
from .step_limit import Going
from .triangle_mesh_shape import Solid

Values = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Stop:
    """Of a free obstacle, the first, and another one.

    Attributes:
        bones: their skeletons.    areas: (n,) shares of their points, m^2.    seen: what the points of each see of the
            other, grown by their radius.
    """

    bones: tuple[Skeleton, Skeleton]
    areas: tuple[Values, Values]
    seen: tuple[Shape, Shape]

    @classmethod
    def of(cls, body: Obstacle, other: Obstacle) -> Stop:
        """Between two obstacles."""
        mine, its = skeleton(body.shape), skeleton(other.shape)
        if isinstance(body.shape, Solid):  # which has no distance: it feels others at its points
            nobody = Skeleton(np.empty((0, 3)), 0.0)
            return cls((mine, nobody), (np.full(len(mine.points), mine.share), np.empty(0)), (other.shape,) * 2)
        areas = np.full(len(mine.points), mine.share), np.full(len(its.points), its.share)
        seen = Grown(other.shape, mine.radius), Grown(body.shape, its.radius)
        return cls((mine, its), areas, cast("tuple[Shape, Shape]", seen))  # what `touch` asks of a shape they have

    def sides(self, body: Pose, other: Pose) -> Iterator[tuple[Values, Placed]]:
        """(n, d) points of each in space, m, and what they see of the other one."""
        yield body.points_to_space(self.bones[0].points), Placed(self.seen[0], other)
        yield other.points_to_space(self.bones[1].points), Placed(self.seen[1], body)

    def gaps(self, body: Pose, other: Pose) -> list[Values]:
        """(n,) of the points of each, m."""
        return [placed.distance(x) for x, placed in self.sides(body, other)]

    def touches(
        self, body: Pose, other: Pose, barrier: Repulsion, start: list[Values] | None
    ) -> list[tuple[Touch, Values]]:
        """What acts on the points of each, and where these are; `start`: gaps as the step began (laws)."""
        begun: list[Start | None] = [None, None] if start is None else [Start.straight(gap, body.dim) for gap in start]
        still = np.zeros(body.dim)
        return [
            (touch(x, area, placed, barrier, None, None, still, gap), x)
            for (x, placed), area, gap in zip(self.sides(body, other), self.areas, begun, strict=True)
        ]

    def safe_share(self, body: Pose, q: Values, other: Pose, its: Values) -> float:
        """Share of the ways q and `its` (p,) of the body and the other one that leaves a tenth of each gap."""
        (x, there), (y, here) = self.sides(body, other)
        ways = [
            _Way(there, x - body.centre, body.centre, q, there.felt(its)),
            _Way(here, y - other.centre, other.centre, its, here.felt(q)),
        ]
        return min(way.safe_share() for way in ways)


@dataclass(frozen=True, eq=False)
class _Way:
    """Points go with a body, arms (n, d) about its centre, by q (p,), and an obstacle before them by `its` (p,)."""

    obstacle: Placed
    arm: Values
    centre: Values
    q: Values
    its: Values

    def safe_share(self) -> float:
        """Of the way, that leaves a tenth of each gap; 0 where one is closed."""
        if not len(self.arm):
            return 1.0
        if not (self.gap(np.zeros(len(self.arm))) > 0).all():
            return 0.0
        return float(longest_step(self.gap, self.speed, len(self.arm)).min())

    def gap(self, share: Values) -> Values:
        """(n,) after shares (n,) of the way, m."""
        return self.obstacle.shape.distance(self._seen(share))

    def speed(self, share: Values) -> Values:
        """(n,) bounds of how fast gaps close, m per whole way (motion.Motion); a turn of the obstacle closes them by no
        more than its size times the points' distance from its centre."""
        d, arm = len(self.centre), np.linalg.norm(self.arm, axis=1)
        straight, turn, turned_ = self.q[:d] - self.its[:d], np.linalg.norm(self.q[d:]), np.linalg.norm(self.its[d:])
        closing: Values = np.full(len(self.arm), float(np.linalg.norm(straight)))
        if self.obstacle.shape.convex:
            v = self._turned(np.tile(straight, (len(self.arm), 1)), share)
            closing = np.maximum(-np.einsum("ni,ni->n", self.obstacle.shape.normal(self._seen(share)), v), 0.0)
        away = np.linalg.norm(self.centre - self.obstacle.pose.centre) + np.linalg.norm(straight) + arm
        return np.asarray(closing + turn * arm + turned_ * away)

    def _seen(self, share: Values) -> Values:
        """(n, d) the points in the frame of the obstacle."""
        d = len(self.centre)
        along = share[:, None] * (self.q[:d] - self.its[:d]) + turned(self.arm, share[:, None] * self.q[d:])
        return self._turned(self.centre - self.obstacle.pose.centre + along, share)

    def _turned(self, vectors: Values, share: Values) -> Values:
        return np.asarray(turned(vectors, -share[:, None] * self.its[len(self.centre) :]) @ self.obstacle.pose.rotation)


type Places = Mapping[int, Placed] | Sequence[Placed]  # by the numbers of obstacles


class Stops:
    """Of one free obstacle; `placed` is where all obstacles are, by their numbers."""

    def __init__(self, body: Obstacle, others: dict[int, Obstacle], barrier: Repulsion) -> None:
        """`others`: by their numbers."""
        self._each = {number: Stop.of(body, other) for number, other in others.items()}
        self._barrier, self._count = barrier, len(body.way(0.0, 0.0))
        self._start: dict[int, list[Values]] = {}

    def begin(self, pose: Pose, placed: Places, *, along: bool) -> None:
        """A step begins; `along`: barriers act along its way (laws)."""
        each = self._each.items() if along else []
        self._start = {number: stop.gaps(pose, placed[number].pose) for number, stop in each}

    def are_open(self, pose: Pose, placed: Places) -> bool:
        """Whether it lies in none."""
        found = [stop.gaps(pose, placed[number].pose) for number, stop in self._each.items()]
        return all(gap.min(initial=np.inf) > 0 for both in found for gap in both)

    def safe_share(self, pose: Pose, q: Values, ways: dict[int, Going]) -> float:
        """Share of its way q (p,) that closes no gap, where others are and go by their numbers."""
        shares = [stop.safe_share(pose, q, ways[n][0].pose, ways[n][1]) for n, stop in self._each.items()]
        return min(shares, default=1.0)

    def push(self, pose: Pose, placed: Places) -> Push:
        """What they do to its pose."""
        p = self._count
        total = Push(0.0, np.zeros(p), np.zeros((p, p)), np.zeros((p, p)))
        for number in self._each:
            (own, x), (its, y) = self._touches(number, pose, placed)
            total = total + carried(own, x, pose) + push(its, y, pose, None, pose)
        return total

    def force(self, pose: Pose, placed: Places) -> Values:
        """(p,) force and moment of all of them on it, N and N m."""
        return -self.push(pose, placed).gradient

    def energies(self, pose: Pose, placed: Places) -> tuple[float, float]:
        """What their barriers store, and what their forces in the step are the derivative of, J."""
        found = [touch for number in self._each for touch, _ in self._touches(number, pose, placed)]
        return sum(touch.energy for touch in found), sum(touch.potential for touch in found)

    def work(self, pose: Pose, placed: Places, ways: Mapping[int, Values] | Sequence[Values]) -> float:
        """What they have done to it by their own ways (p,) in the step, J."""
        done = 0.0
        for number in self._each:
            (own, _), (its, _) = self._touches(number, pose, placed)
            done += float((own.normal.sum(axis=0) - its.normal.sum(axis=0)) @ ways[number][: pose.dim])
        return done

    def _touches(self, number: int, pose: Pose, placed: Places) -> list[tuple[Touch, Values]]:
        return self._each[number].touches(pose, placed[number].pose, self._barrier, self._start.get(number))
