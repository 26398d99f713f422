"""A free solid in a step, with the body where it is: its pose is eliminated as that of other free obstacles is.

All of it is on rank 0 but how it flies, its way z and its pose.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix

from .ipc_friction import Friction
from .mesh_obstacles import Facing
from .obstacle import Flight, FreeObstacle
from .obstacle_pairs import Stops
from .pose import Placed, Pose
from .rigid_body import Push, RigidStep, Taken, of_points, resultant, ways_of_points
from .step_limit import Going

Values = npt.NDArray[np.float64]

ON_THE_WAY = 1e-9  # of the length of a step of Newton's method: places that are on it


@dataclass(frozen=True)
class Before:
    """What a solid is before in a step.

    Attributes:
        facing, friction: what the body does to it, unless that is far.    x: (n, 3) where that is; None: far.
        others: where other obstacles are, by their numbers.    start: (n, 3) where the body was as the step began.
    """

    facing: Facing | None
    friction: Friction | None
    x: Values | None
    others: Mapping[int, Placed]
    start: Values | None = None


class FreeSolid:
    """A free solid, and its pose.

    Attributes:
        flight: how it moves, at the start of a step until it is over.    step: the one that began last.
        z: (k,) its way in the step.    pose: where it is.    stops: what it meets beside the body, on rank 0.
    """

    step: RigidStep
    z: Values
    stops: Stops

    def __init__(self, body: FreeObstacle) -> None:
        self.body, self.flight = body, body.at_first()
        self.pose = self.flight.pose
        self._of: Flight | None = None  # that the step began with
        self._found: Values | None = None  # z of the last solution of this step
        self._way: Taken | None = None
        self._at: tuple[Values | None, Pose] | None = None  # where it was settled last in the step

    # --- a step ---

    def look(self) -> None:
        """Between two steps."""
        self.pose = self.flight.pose

    def begin(self, step: RigidStep) -> None:
        """A step begins, for the first time or once more."""
        if self._of is not self.flight:
            self._found = None
        self._of, self.step, self._at = self.flight, step, None
        self.forget_way()
        self.put(np.zeros(self.body.ways.shape[1]))

    @property
    def is_under_way(self) -> bool:
        """Whether the step that began is not over yet."""
        return self._of is self.flight

    def put(self, z: Values) -> None:
        """At z (k,)."""
        self.z, self.pose = z, self.step.pose(z)

    def forget_way(self) -> None:
        """Newton's method starts anew."""
        self._way = None

    def found(self) -> None:
        """The step is over: where it is first looked for if it is taken again."""
        self._found = self.z

    # --- where it is ---

    def settle(self, before: Before) -> Values:
        """The way z that belongs to the body where it is."""
        here = self.z
        for z in self._candidates(before):
            if self._may_be_at(before, z):
                z, _ = self.step.settle(z, lambda z: self.push(before, z), lambda z, dz: self.free(before, z, dz))
                self._at = before.x, self.step.pose(z)
                return z
        return here  # the body or a stop is in its way: Newton's method fails, and the step is halved

    def _candidates(self, before: Before) -> Iterator[Values]:
        if (way := self._way) is not None and before.x is not None:
            yield way.at(way.share(before.x))
        yield self.z
        if self._found is not None:
            yield self._found
        yield np.zeros_like(self.z)

    def _may_be_at(self, before: Before, z: Values) -> bool:
        """Whether it gets there, and the body where that is, with nothing between them on their ways."""
        pose = self.step.pose(z)
        if not self.stops.are_open(pose, before.others):
            return False
        if before.facing is None or before.x is None or before.start is None:
            return True
        if (way := self._way) is not None:
            off = before.x - way.x - (share := way.share(before.x)) * way.moved
            on_it = abs(off).max() <= ON_THE_WAY * abs(way.moved).max()
            if on_it and np.array_equal(z, way.at(share)):
                return True  # longest_step has looked
        x, then = before.start, self.step.start.pose
        if self._at is not None and self._at[0] is not None:
            x, then = self._at[0], self._at[1]
        before.facing.solid.put(pose)
        return before.facing.free_along(x, before.x, then) == 1

    def push(self, before: Before, z: Values) -> Push:
        """What the body and stops do to it at z."""
        self.put(z)
        found = self.stops.push(self.pose, before.others)
        parts = self._parts(before)
        return found if parts is None else found + of_points(*parts)

    def _met(self, before: Before) -> tuple[Facing, Values, int] | None:
        """The body's facets, with the solid where it is, the points (n + m, 3) of both and n; None: far."""
        facing = before.facing
        if facing is None or before.x is None:
            return None
        facing.solid.put(self.pose)
        return None if facing.is_far(before.x) else (facing, facing.with_solid(before.x), len(before.x))

    def _parts(self, before: Before) -> tuple[float, Values, csr_matrix, csr_matrix, Values] | None:
        """Energy, its derivative by the points of the solid, second ones, exact and positive, and arms; None: far."""
        if (met := self._met(before)) is None:
            return None
        facing, both, n = met
        energy, g = facing.energy(both), facing.gradient(both)
        exact, stiff = facing.hessian(both, exact=True), facing.hessian(both)
        if before.friction is not None:
            energy, g = energy + before.friction.energy(both), g + before.friction.gradient(both)
            exact = exact + before.friction.hessian(both, exact=True)
            stiff = stiff + before.friction.hessian(both)
        own = slice(3 * n, None)
        return energy, g[n:], exact[own, own], stiff[own, own], facing.solid.here - self.pose.centre

    def free(self, before: Before, z: Values, dz: Values) -> float:
        """Share of the way from z by dz that closes no gap, with the body where it is."""
        self.put(z)
        start, q = self.pose, self.step.onward(z, dz)
        still = {number: (placed, np.zeros_like(q)) for number, placed in before.others.items()}
        share = self.stops.safe_share(start, q, still)
        if before.facing is None or before.x is None:
            return share
        before.facing.solid.put(self.step.pose(z + dz))
        return min(share, before.facing.free_along(before.x, before.x, start))

    # --- how it gives way ---

    def given_way(self, before: Before) -> tuple[Values, Values] | None:
        """(3 n, k) Phi_xz by the body's points and (k, k) Phi_zz^-1, its positive definite part; None: nothing of the
        body is near."""
        if (met := self._met(before)) is None:
            return None
        facing, both, n = met
        H = facing.hessian(both)
        if before.friction is not None:
            H = H + before.friction.hessian(both)
        J = ways_of_points(facing.solid.here - self.pose.centre).reshape(-1, 6)
        mixed = self.step.factor * (H[: 3 * n, 3 * n :] @ J) @ self.step.by_way(self.z)
        if not mixed.any():
            return None
        resistance = self.step.system(self.z, self.push(before, self.z))[2]
        return mixed, np.asarray(np.linalg.inv(resistance))

    def taken_along(self, before: Before, moved: Values) -> Pose:
        """Where Newton's method takes it together with the points, which go by `moved` (n, 3), m."""
        given, dz = self.given_way(before), np.zeros_like(self.z)
        if given is not None:
            mixed, compliance = given
            dz = -compliance @ (mixed.T @ moved.reshape(-1))
        assert before.x is not None
        self._way = Taken(before.x, moved, self.z, dz)
        return self.step.pose(self.z + dz)

    def pushed(self, before: Before) -> Values:
        """(6,) force and moment of body and stops on it, N and N m."""
        force = self.stops.force(self.pose, before.others)
        parts = self._parts(before)
        return force if parts is None else force + resultant(-parts[1], parts[4])

    # --- first guesses ---

    def guess(self, before: Before, to: Values, led: list[Values]) -> tuple[Values, float]:
        """Where it goes by itself, stays or is taken along by another one on its way (6,), whichever is free first with
        the body on its way `to` (n, 3) from the start, and the share of that way which closes no gap."""
        d, first = 3, 0.0
        along = [np.asarray(np.linalg.lstsq(self.body.ways[:d], way[:d], rcond=None)[0]) for way in led if way.any()]
        ways: list[Values] = [self.step.ahead, 0 * self.step.ahead, *along]
        for z in ways:
            share = self._safe_share(before, to, z)
            if share == 1:
                return z, 1.0
            first = first or share
        return ways[0], first

    def _safe_share(self, before: Before, to: Values, z: Values) -> float:
        start = self.step.start.pose
        others: dict[int, Going] = {number: (placed, np.zeros(6)) for number, placed in before.others.items()}
        share = self.stops.safe_share(start, self.step.increment(z), others)
        if before.facing is None or before.start is None:
            return share
        before.facing.solid.put(self.step.pose(z))
        return min(share, before.facing.free_along(before.start, to, start))
