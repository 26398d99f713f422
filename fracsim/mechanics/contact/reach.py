"""Points on their way: how far they may go before an obstacle, and first guesses that have passed through nothing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ...errors import InputError
from .barrier import longest_step
from .facets import Facets
from .motion import Motion, Passing
from .obstacle import Obstacle
from .placed import Placed
from .skin import Skin

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
type Way = tuple[Placed, Values, Facets | None]  # where an obstacle begins, increment (p,) of its pose, what feels it

ROUNDS = 20  # in which points that follow several nodes are brought back


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
        weight = follow.handed_down(np.repeat(stopped[:, None], x.shape[1], axis=1).astype(float))
        change = follow.handed_down(back)
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
