"""How contacts act in a step: velocities after it, in one solve with all contacts (J. J. Moreau 1988, time stepping).

    0 <= force  _|_  speed after + r / dt >= 0

along the normal, speeds of parting; with r the distance g still between two things, so that they come no nearer than
touching. What meets fast, c > c_0, within the step, c dt > g, bounces or stops at once, r = -e c dt, and until it
meets, after the share g / (c dt) of the step, it flies as if there were nothing: it ends where it touches (to c_0 dt,
which is not waited for). So a blow gives its whole impulse in the step that it falls in. What lies in one another even
so (turns are not linear) comes apart no faster than c_0 / 4, which hardly any energy comes of.

Where a step is taken apart (rigid.impact_sequence) what else it would meet in it waits, for it may never come there: it
goes on with what the blow left it, and what it still meets then is the next event, of a few. Things that touch are at
one time in every event; what would meet after the last one comes to touch as the step ends, and meets in the next.

Equations: docs/theory.md#motion-and-contact-of-rigid-bodies.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

RECOVERED = 0.2  # of what things lie in one another by, in a step
SLOWLY = 0.25  # c_0: what is jammed is driven apart with the force that jams it, which is work
SOON = 0.01  # of a step: what meets within it meets now


@dataclass(frozen=True)
class Meetings:
    """Of k contacts.

    Attributes:
        gap: (k,) distances, m.    aim: (k,) r, m.    near: (k,) whether they may touch in the step.
        closing: (k,) m/s of what meets fast, 0 of all others.    when: (k,) share of the step, of these.
        waits: (k,) of these, what does not meet where things are now, where a step is taken apart.
        rest: (k,) share of the step that is left.
    """

    gap: Values
    aim: Values
    near: Flags
    closing: Values
    when: Values
    waits: Flags
    rest: Values | float = 1.0


def meetings(gap: Values, closing: Values, dt: float, fast: float, restitution: float) -> Meetings:
    """Of contacts at distances `gap` (k,) m whose things come together at `closing` (k,) m/s; `fast`: c_0, m/s."""
    hits = (closing > fast) & (gap < closing * dt)
    aim = np.where(hits, -restitution * closing * dt, _nearer(gap, gap, dt, fast))
    share = np.divide(gap, closing * dt, out=np.zeros_like(gap), where=hits & (gap > fast * dt))
    near, none = gap < (closing + fast) * dt, np.zeros(len(gap), bool)
    return Meetings(gap, aim, near, np.where(hits, closing, 0.0), np.clip(share, 0.0, 1.0), none)


def meetings_apart(
    gap: Values, closing: Values, dt: float, fast: float, restitution: float, come: Values, rest: Values, strikes: Flags
) -> Meetings:
    """Likewise in a step that is taken apart, of which a `rest` (k,) is left, and in which they have come together by
    `come` (k,) m so far, at that speed; of what `strikes` (k,) that waits which does not meet yet. In the last event it
    comes to touch as the step ends."""
    hits = strikes & (gap + come < closing * dt)
    waits = hits & later(gap, closing, dt, fast)
    aim = np.where(hits & ~waits, -restitution * closing * dt, _nearer(gap, gap / rest, dt, fast))
    share = np.divide(gap + come, closing * dt, out=np.zeros_like(gap), where=hits & (gap > fast * dt))
    near = gap < (closing * rest + fast) * dt
    return Meetings(gap, aim, near, np.where(hits, closing, 0.0), np.clip(share, 0.0, 1.0), waits, rest)


def _nearer(gap: Values, room: Values, dt: float, fast: float) -> Values:
    """(k,) r of what does not strike, at distances `gap` (k,) m with `room` (k,) m to come nearer by."""
    return np.where(gap < 0, np.maximum(RECOVERED * gap, -SLOWLY * fast * dt), room)


def later(gap: Values, closing: Values, dt: float, fast: float) -> Flags:
    """(k,) what comes together fast, and does not touch yet."""
    return np.asarray((closing > fast) & (gap > (fast + SOON * closing) * dt))


def flown(meeting: Meetings, things: Ints, count: int) -> Values:
    """(count,) share of the step that bodies fly for before something strikes them, 0 of what nothing does; `things`:
    (k, 2) of the contacts, bodies below `count`."""
    rows = np.flatnonzero(meeting.closing)
    share = _earliest(np.minimum(things[rows], count), meeting.when[rows], count)[:count]
    return np.where(np.isfinite(share), share, 0.0)


def flown_together(meeting: Meetings, things: Ints, begun: Values, near: float) -> Values:
    """(n,) likewise of bodies that have flown for `begun` (n,). What is within `near`, m, flies as long, or things
    would be held against one another where they are at different times; nothing flies to what something else strikes
    before."""
    count, rows = len(begun), np.flatnonzero(meeting.closing)
    links = things[meeting.gap < near]
    links = links[np.maximum(*links.T) < count]
    joined = csr_array((np.ones(len(links)), links.T), shape=(count, count))
    of = np.append(connected_components(joined, directed=False)[1], count)
    groups, when = of[np.minimum(things[rows], count)], meeting.when[rows]
    share = _earliest(groups, when, count)
    now = when <= share[groups].min(axis=1) + SOON
    first = _earliest(groups[now], when[now], count)[of[:-1]]
    return np.where(np.isfinite(first), np.maximum(first, begun), begun)


def _earliest(groups: Ints, when: Values, count: int) -> Values:
    """(count + 1,) when the first of pairs (k, 2) meet that things are in; infinite of none, and of the last."""
    first: Values = np.full(count + 1, np.inf)
    np.minimum.at(first, groups, np.repeat(when[:, None], 2, axis=1))
    first[count] = np.inf
    return first
