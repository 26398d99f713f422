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
from .contact_surface import Skin
from .facet_contact import Facets
from .laws import Repulsion
from .node_contact import Grip, Touch
from .obstacle import Flight, FreeObstacle
from .obstacle_pairs import Stop, Stops
from .pose import Placed, Pose
from .rigid_body import (
    Push,
    Pushes,
    RigidStep,
    Taken,
    Together,
    between_two,
    by_point_and_pose,
    carried,
    on_obstacle,
    push,
    resultant,
)
from .step_limit import Going, safe_shares

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Around:
    """The body around an obstacle.

    Attributes:
        skin: its points.    x: (n, d) where they are, m.    feel: what the obstacle does to them at a place.
        facets: that feel it between their points.    placed: where all obstacles are, by their numbers.
    """

    skin: Skin
    x: Values
    feel: Callable[[Placed], Touch]
    facets: Facets | None
    placed: list[Placed]

    def is_open(self, placed: Placed) -> bool:
        """Whether nothing of the body is in the obstacle there (collective)."""
        if not self.skin.are_apart(placed.distance(self.x)):
            return False
        return self.facets is None or bool(
            self.skin.comm.allreduce(self.facets.are_open([placed], self.x).all(), op=MPI.LAND)
        )


class FreePose:
    """A free obstacle, and its pose.

    Attributes:
        flight: how it moves, at the start of a step until it is over.    step: the one that began last.
        z: (k,) its way in the step.    placed: where it is.
    """

    step: RigidStep
    z: Values
    placed: Placed

    def __init__(self, body: FreeObstacle, stops: Stops) -> None:
        """`stops`: what it meets beside the body."""
        self.body, self.flight, self.stops = body, body.at_first(), stops
        self._of: Flight | None = None  # that the step began with
        self._found: Values | None = None  # z of the last solution of this step
        self._settled: Push | None = None  # what contact does to it at z
        self._way: Taken | None = None

    # --- a step ---

    def look(self) -> Placed:
        """Where it is between two steps."""
        self.placed = Placed(self.body.shape, self.flight.pose)
        return self.placed

    def begin(self, step: RigidStep, held: Grip | None) -> Values:
        """A step begins, for the first time or once more; `held`: what friction holds. (p,) its way in free flight."""
        if self._of is not self.flight:
            self._found = None
        self._of, self.step, self._held, self._way = self.flight, step, held, None
        self.stay()
        return step.increment(step.ahead)

    @property
    def is_under_way(self) -> bool:
        """Whether the step that began is not over yet."""
        return self._of is self.flight

    def arrive(self, found: Touch, around: Around, others: Values | float = 0.0) -> None:
        """The step is over: it has the momentum that points in touch, stops and `others` that are free, by a force and
        moment (p,), gave it (collective)."""
        pose = self.placed.pose
        pushed = (
            others
            + sum_over_ranks(around.skin.comm, on_obstacle(found, around.x, pose))
            + self.stops.force(pose, around.placed)
        )
        self.flight = self.step.arrived(self.z, pushed)
        self._found = self.z

    def under(self, held: Grip, placed: Placed) -> Values:
        """(k, d) way in the step of what is under the points that friction holds, m, with the obstacle at `placed`."""
        then = self.step.start.pose
        return placed.pose.points_to_space(then.to_body(held.under)) - held.under

    # --- where it is ---

    def stay(self) -> None:
        """Where the step began."""
        self.put(np.zeros(self.body.ways.shape[1]))

    def put(self, z: Values) -> None:
        """At z (k,)."""
        self.z, self.placed = z, Placed(self.body.shape, self.step.pose(z))

    def settle(self, around: Around) -> None:
        """The pose that belongs to the points where they are now (collective)."""
        self._settled = None
        for z in self.candidates(around):
            self.put(z)
            if self.is_open(around):
                break
        else:
            return  # the body or a stop is in the obstacle: Newton's method finds no finite force, and fails
        z, self._settled = self.step.settle(z, partial(self.push, around), partial(self.free, around))
        self.put(z)

    def forget_push(self) -> None:
        """It was put elsewhere than it was settled."""
        self._settled = None

    def is_open(self, around: Around) -> bool:
        """Whether it lies in nothing (collective)."""
        return around.is_open(self.placed) and self.stops.are_open(self.placed.pose, around.placed)

    def candidates(self, around: Around) -> Iterator[Values]:
        """Ways z to start from: where a step of Newton's method takes the obstacle along, where it is, where it was
        once this step was solved, and where the step began."""
        here = self.z
        if (way := self._way) is not None:
            yield way.at(way.share(around.x, around.skin.comm))
        yield here
        if self._found is not None:
            yield self._found
        yield np.zeros_like(here)

    def push(self, around: Around, z: Values) -> Push:
        """What contact does to the obstacle at z, of all ranks (collective)."""
        self.put(z)
        mine = push(around.feel(self.placed), around.x, self.placed.pose, self._held, self.step.start.pose)
        return _summed(mine, around.skin.comm) + self.stops.push(self.placed.pose, around.placed)

    def free(self, around: Around, z: Values, dz: Values) -> float:
        """Share of the way from z by dz that closes no gap, with the body where it is (collective)."""
        self.put(z)
        q, still = self.step.onward(z, dz), 0 * around.x
        others = {number: (placed, np.zeros_like(q)) for number, placed in enumerate(around.placed)}
        share = self.stops.safe_share(self.placed.pose, q, others)
        return min(share, around.skin.safe(safe_shares(self.placed, around.x, still, q, around.facets)))

    # --- how it gives way ---

    def by_z(self, found: Touch, x: Values, *, exact: bool) -> Values:
        """(k, d, ways) derivative of minus the forces on points in touch by z, as it enters the tangent."""
        pose, then = self.placed.pose, self.step.start.pose
        by_pose = by_point_and_pose(found, x, pose, self._held, then, exact=exact)
        return self.step.factor * by_pose @ self.step.by_way(self.z)

    def resistance(self, around: Around, *, exact: bool) -> Values:
        """(k, k) second derivative of Phi by z, its positive definite part or `exact` (collective)."""
        return self.step.system(self.z, self._settled or self.push(around, self.z))[1 if exact else 2]

    def taken_along(self, found: Touch, around: Around, moved: Values, *, exact: bool) -> Values:
        """(p,) increment of its pose as Newton's method moves it together with the points, by `moved` (n, d), m
        (collective)."""
        pulled = self.pulled(found, around, moved, exact=exact)
        return self.goes(around, moved, np.asarray(-np.linalg.solve(self.resistance(around, exact=exact), pulled)))

    def pulled(self, found: Touch, around: Around, moved: Values, *, exact: bool) -> Values:
        """(k,) change of the gradient of Phi by z with the points, which go by `moved` (n, d), m (collective)."""
        mixed = self.by_z(found, around.x, exact=exact)
        return sum_over_ranks(around.skin.comm, np.einsum("kdz,kd->z", mixed, moved[found.points]))

    def goes(self, around: Around, moved: Values, dz: Values) -> Values:
        """(p,) increment of its pose as Newton's method moves it by dz (k,) and the points by `moved` (n, d), m."""
        self._way = Taken(around.x, moved, self.z, dz)
        return self.step.onward(self.z, dz)

    def forget_way(self) -> None:
        """Newton's method starts anew."""
        self._way = None

    def safe_share(self, around: Around, moved: Values, z: Values, others: dict[int, Going]) -> float:
        """Share of the ways of points, obstacle and others, from the start of the step, that closes no gap
        (collective)."""
        start, q = Placed(self.body.shape, self.step.start.pose), self.step.increment(z)
        share = self.stops.safe_share(start.pose, q, others)
        return min(share, around.skin.safe(safe_shares(start, around.x, moved, q, around.facets)))

    def led_by(self, way: Values) -> Values:
        """(k,) z that takes it along with an obstacle on its way (p,), as far as it may go there."""
        d = self.step.start.pose.dim
        return np.asarray(np.linalg.lstsq(self.body.ways[:d], way[:d], rcond=None)[0])

    def pressed(self, found: Touch, x: Values) -> float:
        """Work of normal forces on the body in the step, by the way of the obstacle, this rank's share, J."""
        force = resultant(found.normal, x[found.points] - self.placed.pose.centre)
        return float(force @ self.step.increment(self.z))


def _summed(mine: Push, comm: MPI.Comm) -> Push:
    """Of the points of all ranks (collective)."""
    parts = [np.atleast_1d(mine.energy), mine.gradient, mine.hessian.reshape(-1), mine.stiffness.reshape(-1)]
    p = len(mine.gradient)
    energy, gradient, *both = np.split(sum_over_ranks(comm, np.concatenate(parts)), [1, 1 + p, 1 + p + p * p])
    return Push(float(energy[0]), gradient, *(each.reshape(p, p) for each in both))


class Mutual:
    """At least two free obstacles, by their numbers; all is done on every rank alike, from sums over all."""

    def __init__(self, free: Mapping[int, FreePose], barrier: Repulsion) -> None:
        self._free, self._each, self._barrier = free, list(free.values()), barrier
        pairs = combinations(range(len(self._each)), 2)
        self._stops = {(i, j): Stop.of(self._each[i].body, self._each[j].body) for i, j in pairs}
        self._start: dict[tuple[int, int], list[Values]] = {}
        self._settled: Pushes | None = None

    # --- a step ---

    def begin(self, *, along: bool) -> None:
        """A step begins; `along`: barriers act along its way (laws)."""
        poses, self._settled = self._poses(), None
        each = self._stops.items() if along else []
        self._start = {(i, j): stop.gaps(poses[i], poses[j]) for (i, j), stop in each}

    def _poses(self) -> list[Pose]:
        return [each.placed.pose for each in self._each]

    @property
    def together(self) -> Together:
        """Their steps."""
        return Together([each.step for each in self._each])

    def are_open(self) -> bool:
        """Whether none lies in another one."""
        at = self._poses()
        return all(gap.min(initial=1.0) > 0 for (i, j), stop in self._stops.items() for gap in stop.gaps(at[i], at[j]))

    def safe_share(self, poses: Sequence[Pose], ways: Sequence[Values]) -> float:
        """Share of the ways q (p,) of all from `poses` that closes no gap between them."""
        each = self._stops.items()
        return min(stop.safe_share(poses[i], ways[i], poses[j], ways[j]) for (i, j), stop in each)

    def safe_guess(self, taken: Mapping[int, Values]) -> float:
        """The same of ways z (k,) from the start of the step, by numbers."""
        ways = [each.step.increment(taken[number]) for number, each in self._free.items()]
        return self.safe_share([each.step.start.pose for each in self._each], ways)

    # --- where they are ---

    def settle(self, arounds: Mapping[int, Around]) -> None:
        """The poses that belong to the points of the body where they are now (collective)."""
        around, self._settled = [arounds[number] for number in self._free], None
        began = [each.placed.pose for each in self._each]
        for z in zip(*(each.candidates(near) for each, near in zip(self._each, around, strict=True)), strict=False):
            self._put(z)
            apart = all(each.is_open(near) for each, near in zip(self._each, around, strict=True))
            ways = [then.way_to(now) for then, now in zip(began, self._poses(), strict=True)]
            if apart and self.are_open() and self.safe_share(began, ways) == 1:
                break
        else:
            return  # as FreePose.settle
        found, self._settled = self.together.settle(z, partial(self._pushes, around), partial(self._safe, around))
        self._put(found)

    def free(self, arounds: Mapping[int, Around], z: Mapping[int, Values], dz: Mapping[int, Values]) -> float:
        """Share of the ways from z by dz, by numbers, that closes no gap, with the body where it is (collective)."""
        numbers = list(self._free)
        return self._safe([arounds[k] for k in numbers], [z[k] for k in numbers], [dz[k] for k in numbers])

    def _put(self, z: Sequence[Values]) -> None:
        for each, way in zip(self._each, z, strict=True):
            each.put(way)

    def _pushes(self, around: Sequence[Around], z: Sequence[Values]) -> Pushes:
        """What contact does to each at z, of all ranks (collective)."""
        each = [one.push(near, way) for one, near, way in zip(self._each, around, z, strict=True)]
        mixed, at = {}, self._poses()
        for (i, j), ((own, x), (its, y)) in self._touches().items():
            each[i] = each[i] + carried(own, x, at[i]) + push(its, y, at[i], None, at[i])
            seen = push(own, x, at[j], None, at[j]) + carried(its, y, at[j])
            each[j] = each[j] + Push(0.0, seen.gradient, seen.hessian, seen.stiffness)  # its energy is with the first
            one, other = between_two(own, x, at[i], at[j]), between_two(its, y, at[j], at[i])
            mixed[i, j] = one[0] + other[0].T, one[1] + other[1].T
        return Pushes(each, mixed)

    def _touches(self) -> dict[tuple[int, int], list[tuple[Touch, Values]]]:
        """What acts on the points of both of each pair that touches."""
        at = self._poses()
        found = {
            (i, j): stop.touches(at[i], at[j], self._barrier, self._start.get((i, j)))
            for (i, j), stop in self._stops.items()
        }
        return {pair: both for pair, both in found.items() if any(len(touch.points) for touch, _ in both)}

    def _safe(self, around: Sequence[Around], z: Sequence[Values], dz: Sequence[Values]) -> float:
        """Share of the way from z by dz that closes no gap, with the body where it is (collective)."""
        each = zip(self._each, around, z, dz, strict=True)
        own = [one.free(near, way, change) for one, near, way, change in each]
        ways = [one.step.onward(way, change) for one, way, change in zip(self._each, z, dz, strict=True)]
        self._put(z)
        return min(*own, self.safe_share(self._poses(), ways))

    # --- what they add, and how they give way ---

    def energies(self) -> tuple[float, float]:
        """What barriers between them store, and what their forces in the step are the derivative of, J."""
        found = [touch for both in self._touches().values() for touch, _ in both]
        return sum(touch.energy for touch in found), sum(touch.potential for touch in found)

    def forces(self) -> dict[int, Values]:
        """(p,) force and moment of the others on each, N and N m, by numbers."""
        at, total = self._poses(), [np.zeros(each.body.count) for each in self._each]
        for (i, j), ((own, x), (its, y)) in self._touches().items():
            total[i] -= carried(own, x, at[i]).gradient + push(its, y, at[i], None, at[i]).gradient
            total[j] -= push(own, x, at[j], None, at[j]).gradient + carried(its, y, at[j]).gradient
        return dict(zip(self._free, total, strict=True))

    def resistance(self, arounds: Mapping[int, Around], *, exact: bool) -> Values:
        """(K, K) Phi_zz of all, its positive definite part or `exact` (collective)."""
        z, around = [each.z for each in self._each], [arounds[number] for number in self._free]
        return self.together.system(z, self._settled or self._pushes(around, z))[1 if exact else 2]

    def compliance(self, arounds: Mapping[int, Around], *, exact: bool) -> Values:
        """(K, K) its inverse (collective)."""
        return np.asarray(np.linalg.inv(self.resistance(arounds, exact=exact)))

    def taken_along(
        self, found: Mapping[int, Touch], arounds: Mapping[int, Around], moved: Values, *, exact: bool
    ) -> dict[int, Values]:
        """(p,) increments of their poses as Newton's method moves them together with the points, by `moved` (n, d), m
        (collective)."""
        every = self._free.items()
        pushed = [each.pulled(found[number], arounds[number], moved, exact=exact) for number, each in every]
        dz = self.together.split(-self.compliance(arounds, exact=exact) @ np.concatenate(pushed))
        return {number: each.goes(arounds[number], moved, way) for (number, each), way in zip(every, dz, strict=True)}
