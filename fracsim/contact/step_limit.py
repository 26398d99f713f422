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
from .barrier import longest_step
from .closest_point import Deepest, deepest
from .contact_surface import Skin
from .facet_contact import Facets
from .obstacle import Obstacle
from .pose import Placed, turned

Ints = npt.NDArray[np.int64]
ROUGH = 1e-6  # of the size of a facet: what is left of derivatives where its deepest place is found roughly
Values = npt.NDArray[np.float64]
ROUNDS = 20  # in which points that follow several nodes are brought back


@dataclass(frozen=True, eq=False)
class Motion:
    """Points x (n, d) go straight by `moved` (n, d), m, and the pose of an obstacle by q: at share s by s q."""

    obstacle: Placed
    x: Values
    moved: Values
    q: Values

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
        return self.moved - self.q[: self.obstacle.pose.dim]

    @cached_property
    def _turn(self) -> Values:
        return self.q[self.obstacle.pose.dim :]

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
        return np.asarray(turned(vectors, -share[:, None] * self._turn) @ self.obstacle.pose.rotation)


class Passing:
    """Facets whose deepest places are `at`, and whose corners go straight by `relative` (k, c, d), m, past a convex
    obstacle that turns by `turn` (r,), rad, meanwhile.

    On the way these are found roughly: L (closest_point) lies above its tangent at any place, which is what counts. The
    obstacle stays where it was, and corners go as they are seen from it.
    """

    def __init__(self, at: Deepest, relative: Values, turn: Values) -> None:
        self._start, self._relative, self._turn = at.x, relative, turn
        self._share: Values = np.zeros(len(at.x))
        self._at = at
        self._centre, self._turns = at.placed.pose.centre, float(np.linalg.norm(turn))

    @property
    def count(self) -> int:
        """k."""
        return len(self._start)

    def of(self, which: Ints) -> Passing:
        """Some of them, at the start."""
        at = self._at
        some = Deepest(at.placed, at.x[which], at.soften, at.share[which])
        return Passing(some, self._relative[which], self._turn)

    def _there(self, share: Values) -> Deepest:
        if not np.array_equal(share, self._share):
            x, at = self._start + share[:, None, None] * self._relative, self._at
            if self._turns:
                x = self._centre + self._seen(x - self._centre, share)
            self._share, self._at = share.copy(), deepest(at.placed, x, at.soften, at.share, ROUGH)
        return self._at

    def _seen(self, vectors: Values, share: Values) -> Values:
        """(k, c, d) vectors in the axes of the obstacle at each share, turned back to those that it had."""
        (k, c, d), w = vectors.shape, -share[:, None] * self._turn
        return turned(vectors.reshape(-1, d), np.repeat(w, c, axis=0)).reshape(k, c, d)

    def gap(self, share: Values) -> Values:
        """(k,) no less is left after shares (k,) of the motion, m."""
        at = self._there(share)
        return at.gap + np.minimum(at.slack.min(axis=1), 0.0)

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
        over = np.maximum(at.gap[:, None] + at.slack, gap)
        return np.asarray((closing * gap / over).max(axis=1))

    def _reach(self) -> Values:
        """(k, c) the largest distance of corners from the centre on the way, which is at one of its ends."""
        ends = self._start - self._centre, self._start - self._centre + self._relative
        return np.maximum(*(np.linalg.norm(each, axis=2) for each in ends))


type Way = tuple[Placed, Values, Facets | None]  # where an obstacle begins, increment (p,) of its pose, what feels it


def safe_shares(placed: Placed, x: Values, moved: Values, q: Values, facets: Facets | None = None) -> Values:
    """(n,) shares in [0, 1] of the ways `moved` (n, d) of points x that leave a tenth of each gap to an obstacle which
    moves by q meanwhile, and of those of their `facets`; 0 where the gap is closed already."""
    turn = (q := placed.felt(q))[placed.pose.dim :]
    relative = moved - q[: placed.pose.dim]
    reach, swept = np.linalg.norm(relative, axis=1), None
    if turn.any():
        swept = np.linalg.norm(turn) * (np.linalg.norm(x - placed.pose.centre, axis=1) + reach)
        reach = reach + swept
    if placed.beyond(x) > 1.2 * reach.max(initial=0.0):
        return np.ones(len(x))
    gap = placed.distance(x)
    share = np.where(gap > 0, 1.0, 0.0)
    near = np.flatnonzero((gap > 0) & (gap < 1.2 * reach))
    if len(near):
        motion = Motion(placed, x[near], moved[near], q)
        share[near] = longest_step(motion.gap, motion.speed, len(near))
    if facets is not None:
        near = facets.closing(placed, x, relative, swept, 1.2 * reach)
        free = _facet_shares(Passing(facets.look(placed, x, near), relative[facets.corners[near]], turn))
        np.minimum.at(share, facets.corners[near], free[:, None])
    return share


def _facet_shares(passing: Passing) -> Values:
    """(k,) shares of the ways of facets to an obstacle that leave a tenth of their gaps."""
    gap = passing.gap(np.zeros(passing.count))
    share, open_ = np.zeros(len(gap)), np.flatnonzero(gap > 0)
    if len(open_):
        passing = passing.of(open_)
        share[open_] = longest_step(passing.gap, passing.speed, len(open_))
    return share


def within_reach(skin: Skin, ways: Sequence[Way], start: Values, end: Values) -> Values:
    """(owned dofs,) of displacements at the start and a guess of the end of a step, the end with every point stopped
    where it would pass into an obstacle; from there on the obstacle takes it along (collective).

    Each point on its own: to shorten the step of the whole body would leave a driven obstacle inside it. A point of a
    crack follows several nodes, which it brings back with it.
    """
    x, follow = skin.places(start), skin.follow
    for _ in range(ROUNDS):
        back, stopped = _brought_back(skin.area, ways, x, follow(end - start))
        if not skin.comm.allreduce(int(stopped.any())):
            return end
        weight = follow.assemble_to_nodes(np.repeat(stopped[:, None], x.shape[1], axis=1).astype(float))
        change = follow.assemble_to_nodes(back)
        end = end + np.where(np.abs(weight) > 1e-3, change / np.where(np.abs(weight) > 1e-3, weight, 1.0), 0.0)
    return end


def _brought_back(area: Values, ways: Sequence[Way], x: Values, moved: Values) -> tuple[Values, npt.NDArray[np.bool_]]:
    """(n, d) what is to be added to the ways of points, and which of them are stopped."""
    back, stopped = np.zeros_like(x), np.zeros(len(x), bool)
    for placed, q, facets in ways:
        share = np.where(area > 0, safe_shares(placed, x, moved, q, facets), 1.0)
        held = share < 1
        back[held] = ((share - 1)[:, None] * (moved - q[: x.shape[1]]))[held]
        stopped |= held
    return back, stopped


def check_apart(comm: MPI.Intracomm, x: Values, obstacles: tuple[Obstacle, ...]) -> None:
    """InputError where a point of the body lies in an obstacle before the first step (collective)."""
    for number, each in enumerate(obstacles):
        refuse_overlap(comm, each.placed(0.0).distance(x), number, each)


def refuse_overlap(comm: MPI.Intracomm, gaps: Values, number: int, each: Obstacle) -> None:
    """InputError where a distance to an obstacle at the start is not positive (collective)."""
    least = comm.allreduce(float(gaps.min(initial=np.inf)), op=MPI.MIN)
    if least <= 0:
        raise InputError(
            f"obstacle.{number}: {each.name} overlaps the body at the start, by {-least:.4g} m; "
            "move it away or make it smaller"
        )


type Going = tuple[Placed, Values]  # where an obstacle begins, and the increment (p,) of its pose


class Course:
    """Obstacles on their ways.

    Attributes:
        placed, at_start: where each is, and was as the step began.    ways: (p,) increment of its pose in the step.
        led: numbers of those whose way is known.
    """

    placed: list[Placed]
    at_start: list[Placed]
    ways: list[Values]

    def __init__(self, obstacles: Sequence[Obstacle], led: list[int]) -> None:
        self._obstacles, self.led = obstacles, led
        self._gone = 1.0  # share of their way

    def begin(self, start: float, end: float) -> None:
        """A step between these times, s, or a look at a state at `end`."""
        self.placed = [each.placed(end) for each in self._obstacles]
        self.at_start = [each.placed(start) for each in self._obstacles]
        self.ways = [each.way(start, end) for each in self._obstacles]
        self._gone = 1.0

    def put_at_start(self, number: int, placed: Placed) -> None:
        """One whose way is not known yet stays where it began."""
        self.placed[number] = self.at_start[number] = placed

    def known(self, facets: Callable[[int], Facets | None]) -> list[Way]:
        """Where each obstacle whose way is known is at the start of the step, its way (p,) to the end, and the facets
        that feel it, by its number."""
        return [(self.at_start[number], self.ways[number], facets(number)) for number in self.led]

    def back_to_start(self) -> None:
        """None has gone any of its way."""
        self._gone = 0.0

    @property
    def left(self) -> float:
        """The share of their way that is left; 0: all have gone all of it."""
        return 1 - self._gone

    def whole(self) -> dict[int, Going]:
        """Where each whose way is known was as the step began, and its way (p,), by numbers."""
        return {number: (self.at_start[number], self.ways[number]) for number in self.led}

    def rest(self) -> dict[int, Going]:
        """Where it is now, and what is left of its way."""
        return {number: (self._after(*way), (1 - self._gone) * way[1]) for number, way in self.whole().items()}

    def go_on(self, x: Values, ways: list[Way], least: Callable[[Values], float], most: float = 1.0) -> None:
        """A share of the rest of the `known` ways, `most` at most, that is safe with points at x (n, d); `least`: of
        shares (n,), on all ranks (collective)."""
        rest, still = 1 - self._gone, np.zeros_like(x)
        shares = [safe_shares(self._after(placed, q), x, still, rest * q, facets) for placed, q, facets in ways]
        share = min(least(np.min(shares, axis=0)) if shares else 1.0, most)
        self._gone = 1.0 if share == 1 else self._gone + share * rest
        for number, (placed, q, _) in zip(self.led, ways, strict=True):
            self.placed[number] = self._after(placed, q)

    def _after(self, placed: Placed, way: Values) -> Placed:
        """Where one that began at `placed` is now."""
        return Placed(placed.shape, placed.pose.moved(self._gone * way))
