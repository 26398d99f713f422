"""Points on their way: how far they may go before an obstacle, and first guesses that have passed through nothing.

Points and an obstacle in motion: the gaps on the way, and bounds of how fast they close.

Where obstacles are in a step, and how far on their way: those that are jammed wait and come on bit by bit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..errors import InputError
from .barrier import safe_fractions
from .closest_point import FacetClosestPoints, find_closest_points
from .contact_surface import ContactSurface
from .facet_contact import ContactFacets
from .obstacle import RigidObstacle
from .pose import PosedShape, rotate_vectors

Ints = npt.NDArray[np.int64]
ROUGH = 1e-6  # of the size of a facet: what is left of derivatives where its deepest place is found roughly
Values = npt.NDArray[np.float64]
ROUNDS = 20  # in which points that follow several nodes are brought back


@dataclass(frozen=True, eq=False)
class PointMotion:
    """Points x (n, d) go straight by `moved` (n, d), m, and the pose of an obstacle by q: at share s by s q."""

    obstacle: PosedShape
    x: Values
    motion: Values
    increment: Values

    def gap(self, share: Values) -> Values:
        """(n,) distances after shares (n,) of the motion, m."""
        return self.obstacle.shape.distance(self._place(share))

    def speed(self, share: Values) -> Values:
        """(n,) no gap closes faster than this from `share` to the end, m per whole motion.

        Seen from the centre a point goes straight, by v. The distance to a convex body is a convex function, which lies
        above its tangent: a gap loses no more than -n . v, n its normal at `share`. So what slides along a floor may go
        on. To a hollow body the distance is 1-Lipschitz only: |v|. A turn by w adds |w| times the reach.
        """
        v = self._relative
        if self.obstacle.shape.convex:
            n = self.obstacle.shape.normal(self._place(share))
            closing = np.maximum(-np.einsum("ni,ni->n", n, self._seen(v, share)), 0)
        else:
            closing = np.linalg.norm(v, axis=1)
        return closing + self._turning

    @cached_property
    def _relative(self) -> Values:
        return self.motion - self.increment[: self.obstacle.pose.dim]

    @cached_property
    def _turn(self) -> Values:
        return self.increment[self.obstacle.pose.dim :]

    @cached_property
    def _turning(self) -> Values:
        """(n,) |w| times the largest distance from the centre on the way, which is at one of its ends."""
        ends = [np.linalg.norm(self._from_centre(np.full(len(self.x), share)), axis=1) for share in (0.0, 1.0)]
        return np.asarray(np.linalg.norm(self._turn) * np.maximum(*ends))

    def _place(self, share: Values) -> Values:
        """(n, d) the points in the frame of the body. Kept: gaps and speeds are asked for at the same shares."""
        kept = vars(self).get("kept")
        if kept is None or kept[0] is not share:
            kept = vars(self)["kept"] = share, self._seen(self._from_centre(share), share)
        return kept[1]

    def _from_centre(self, share: Values) -> Values:
        return np.asarray(self.x - self.obstacle.pose.centre + share[:, None] * self._relative)

    def _seen(self, vectors: Values, share: Values) -> Values:
        """(n, d) vectors in the frame that the body has at each share."""
        return np.asarray(rotate_vectors(vectors, -share[:, None] * self._turn) @ self.obstacle.pose.rotation)


class FacetMotion:
    """Facets whose deepest places are `at`, and whose corners go straight by `relative` (k, c, d), m, past a convex
    obstacle that turns by `turn` (r,), rad, meanwhile.

    On the way these are found roughly: L (closest_point) lies above its tangent at any place, which is what counts. The
    obstacle stays where it was, and corners go as they are seen from it.
    """

    def __init__(self, at: FacetClosestPoints, relative: Values, turn: Values) -> None:
        self._start, self._relative, self._turn = at.x, relative, turn
        self._share: Values = np.zeros(len(at.x))
        self._at = at
        self._centre, self._turns = at.posed.pose.centre, float(np.linalg.norm(turn))

    @property
    def count(self) -> int:
        """k."""
        return len(self._start)

    def select(self, which: Ints) -> FacetMotion:
        """Some of them, at the start."""
        at = self._at
        some = FacetClosestPoints(at.posed, at.x[which], at.smoothing, at.barycentric[which])
        return FacetMotion(some, self._relative[which], self._turn)

    def _there(self, share: Values) -> FacetClosestPoints:
        if not np.array_equal(share, self._share):
            x, at = self._start + share[:, None, None] * self._relative, self._at
            if self._turns:
                x = self._centre + self._seen(x - self._centre, share)
            self._share, self._at = share.copy(), find_closest_points(at.posed, x, at.smoothing, at.barycentric, ROUGH)
        return self._at

    def _seen(self, vectors: Values, share: Values) -> Values:
        """(k, c, d) vectors in the axes of the obstacle at each share, turned back to those that it had."""
        (k, c, d), w = vectors.shape, -share[:, None] * self._turn
        return rotate_vectors(vectors.reshape(-1, d), np.repeat(w, c, axis=0)).reshape(k, c, d)

    def gap(self, share: Values) -> Values:
        """(k,) no less is left after shares (k,) of the motion, m."""
        at = self._there(share)
        return at.gap + np.minimum(at.corner_rise.min(axis=1), 0.0)

    def speed(self, share: Values) -> Values:
        """(k,) no gap closes faster than this from `share` to the end, m per whole motion.

        Each corner is over the tangent by its slack, or more: one that comes closer by v may go on by the share
        (gap + slack) / v. A turn by w adds |w| times the reach.
        """
        at, gap = self._there(share), np.maximum(self.gap(share), np.finfo(float).tiny)[:, None]
        v = self._seen(self._relative, share) if self._turns else self._relative
        closing = np.maximum(-np.einsum("kcd,kd->kc", v, at.normal), 0.0)
        if self._turns:
            closing += self._turns * self._reach()
        over = np.maximum(at.gap[:, None] + at.corner_rise, gap)
        return np.asarray((closing * gap / over).max(axis=1))

    def _reach(self) -> Values:
        """(k, c) the largest distance of corners from the centre on the way, which is at one of its ends."""
        ends = self._start - self._centre, self._start - self._centre + self._relative
        return np.maximum(*(np.linalg.norm(each, axis=2) for each in ends))


type ObstacleMotion = tuple[
    PosedShape, Values, ContactFacets | None
]  # where an obstacle begins, increment (p,) of its pose, what feels it


def safe_motion_fractions(
    placed: PosedShape, x: Values, moved: Values, q: Values, facets: ContactFacets | None = None
) -> Values:
    """(n,) shares in [0, 1] of the ways `moved` (n, d) of points x that leave a tenth of each gap to an obstacle which
    moves by q meanwhile, and of those of their `facets`; 0 where the gap is closed already."""
    turn = (q := placed.effective_increment(q))[placed.pose.dim :]
    relative = moved - q[: placed.pose.dim]
    reach, swept = np.linalg.norm(relative, axis=1), None
    if turn.any():
        swept = np.linalg.norm(turn) * (np.linalg.norm(x - placed.pose.centre, axis=1) + reach)
        reach = reach + swept
    if placed.distance_bound(x) > 1.2 * reach.max(initial=0.0):
        return np.ones(len(x))
    gap = placed.distance(x)
    share = np.where(gap > 0, 1.0, 0.0)
    near = np.flatnonzero((gap > 0) & (gap < 1.2 * reach))
    if len(near):
        motion = PointMotion(placed, x[near], moved[near], q)
        share[near] = safe_fractions(motion.gap, motion.speed, len(near))
    if facets is not None:
        near = facets.closing_facets(placed, x, relative, swept, 1.2 * reach)
        free = _facet_shares(FacetMotion(facets.closest_points(placed, x, near), relative[facets.corners[near]], turn))
        np.minimum.at(share, facets.corners[near], free[:, None])
    return share


def _facet_shares(passing: FacetMotion) -> Values:
    """(k,) shares of the ways of facets to an obstacle that leave a tenth of their gaps."""
    gap = passing.gap(np.zeros(passing.count))
    share, open_ = np.zeros(len(gap)), np.flatnonzero(gap > 0)
    if len(open_):
        passing = passing.select(open_)
        share[open_] = safe_fractions(passing.gap, passing.speed, len(open_))
    return share


def stop_before_obstacles(skin: ContactSurface, ways: Sequence[ObstacleMotion], start: Values, end: Values) -> Values:
    """(owned dofs,) of displacements at the start and a guess of the end of a step, the end with every point stopped
    where it would pass into an obstacle; from there on the obstacle takes it along (collective).

    Each point on its own: to shorten the step of the whole body would leave a driven obstacle inside it. A point of a
    crack follows several nodes, which it brings back with it.
    """
    x, follow = skin.positions(start), skin.interpolation
    for _ in range(ROUNDS):
        back, stopped = _brought_back(skin.area, ways, x, follow(end - start))
        if not skin.comm.allreduce(int(stopped.any())):
            return end
        weight = follow.assemble_to_nodes(np.repeat(stopped[:, None], x.shape[1], axis=1).astype(float))
        change = follow.assemble_to_nodes(back)
        end = end + np.where(np.abs(weight) > 1e-3, change / np.where(np.abs(weight) > 1e-3, weight, 1.0), 0.0)
    return end


def _brought_back(
    area: Values, ways: Sequence[ObstacleMotion], x: Values, moved: Values
) -> tuple[Values, npt.NDArray[np.bool_]]:
    """(n, d) what is to be added to the ways of points, and which of them are stopped."""
    back, stopped = np.zeros_like(x), np.zeros(len(x), bool)
    for placed, q, facets in ways:
        share = np.where(area > 0, safe_motion_fractions(placed, x, moved, q, facets), 1.0)
        held = share < 1
        back[held] = ((share - 1)[:, None] * (moved - q[: x.shape[1]]))[held]
        stopped |= held
    return back, stopped


def check_obstacles_apart(comm: MPI.Intracomm, x: Values, obstacles: tuple[RigidObstacle, ...]) -> None:
    """InputError where a point of the body lies in an obstacle before the first step (collective)."""
    for number, each in enumerate(obstacles):
        refuse_overlap(comm, each.posed_at(0.0).distance(x), number, each)


def refuse_overlap(comm: MPI.Intracomm, gaps: Values, number: int, each: RigidObstacle) -> None:
    """InputError where a distance to an obstacle at the start is not positive (collective)."""
    least = comm.allreduce(float(gaps.min(initial=np.inf)), op=MPI.MIN)
    if least <= 0:
        raise InputError(
            f"obstacle.{number}: {each.name} overlaps the body at the start, by {-least:.4g} m; "
            "move it away or make it smaller"
        )


type PoseMotion = tuple[PosedShape, Values]  # where an obstacle begins, and the increment (p,) of its pose


class ObstacleKinematics:
    """Obstacles on their ways.

    Attributes:
        placed, at_start: where each is, and was as the step began.    ways: (p,) increment of its pose in the step.
        led: numbers of those whose way is known.
    """

    posed: list[PosedShape]
    start_posed: list[PosedShape]
    increments: list[Values]

    def __init__(self, obstacles: Sequence[RigidObstacle], led: list[int]) -> None:
        self._obstacles, self.prescribed = obstacles, led
        self._travelled = 1.0  # share of their way

    def begin_step(self, start: float, end: float) -> None:
        """A step between these times, s, or a look at a state at `end`."""
        self.posed = [each.posed_at(end) for each in self._obstacles]
        self.start_posed = [each.posed_at(start) for each in self._obstacles]
        self.increments = [each.pose_increment(start, end) for each in self._obstacles]
        self._travelled = 1.0

    def hold_at_start(self, number: int, placed: PosedShape) -> None:
        """One whose way is not known yet stays where it began."""
        self.posed[number] = self.start_posed[number] = placed

    def prescribed_motions(self, facets: Callable[[int], ContactFacets | None]) -> list[ObstacleMotion]:
        """Where each obstacle whose way is known is at the start of the step, its way (p,) to the end, and the facets
        that feel it, by its number."""
        return [(self.start_posed[number], self.increments[number], facets(number)) for number in self.prescribed]

    def return_to_start(self) -> None:
        """None has gone any of its way."""
        self._travelled = 0.0

    @property
    def remaining_fraction(self) -> float:
        """The share of their way that is left; 0: all have gone all of it."""
        return 1 - self._travelled

    def full_motions(self) -> dict[int, PoseMotion]:
        """Where each whose way is known was as the step began, and its way (p,), by numbers."""
        return {number: (self.start_posed[number], self.increments[number]) for number in self.prescribed}

    def remaining_motions(self) -> dict[int, PoseMotion]:
        """Where it is now, and what is left of its way."""
        return {
            number: (self._posed_after(*way), (1 - self._travelled) * way[1])
            for number, way in self.full_motions().items()
        }

    def advance(
        self, x: Values, ways: list[ObstacleMotion], least: Callable[[Values], float], most: float = 1.0
    ) -> None:
        """A share of the rest of the `known` ways, `most` at most, that is safe with points at x (n, d); `least`: of
        shares (n,), on all ranks (collective)."""
        rest, still = 1 - self._travelled, np.zeros_like(x)
        shares = [
            safe_motion_fractions(self._posed_after(placed, q), x, still, rest * q, facets)
            for placed, q, facets in ways
        ]
        share = min(least(np.min(shares, axis=0)) if shares else 1.0, most)
        self._travelled = 1.0 if share == 1 else self._travelled + share * rest
        for number, (placed, q, _) in zip(self.prescribed, ways, strict=True):
            self.posed[number] = self._posed_after(placed, q)

    def _posed_after(self, placed: PosedShape, way: Values) -> PosedShape:
        """Where one that began at `placed` is now."""
        return PosedShape(placed.shape, placed.pose.incremented(self._travelled * way))
