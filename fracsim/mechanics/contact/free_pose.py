"""Where a free obstacle is in a step, with the body where it is: what is left of it once its pose is eliminated.

The pose is the least of the incremental potential Phi (rigid_step), found on ways that pass through nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ...mesh.ranks import total
from .course import Going
from .facets import Facets
from .free_obstacle import Flight, FreeObstacle
from .placed import Placed
from .push import Push, by_point_and_pose, on_obstacle, push, resultant
from .reach import safe_shares
from .rigid_step import RigidStep
from .skin import Skin
from .stops import Stops
from .taken import Taken
from .touch import Grip, Touch

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
            others + total(around.skin.comm, on_obstacle(found, around.x, pose)) + self.stops.force(pose, around.placed)
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
        return total(around.skin.comm, np.einsum("kdz,kd->z", mixed, moved[found.points]))

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
    energy, gradient, *both = np.split(total(comm, np.concatenate(parts)), [1, 1 + p, 1 + p + p * p])
    return Push(float(energy[0]), gradient, *(each.reshape(p, p) for each in both))
