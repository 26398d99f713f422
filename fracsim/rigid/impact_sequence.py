"""Events of a step that is taken apart: what strikes bodies first, then what they meet with what that left them.

Else all that meets in a step acts at once. A step is taken apart where something strikes a body and would go on into
something else behind it, which would stop it in the air. In a crowd, where every event is dear, only where that would
be wrong most: the body may break (or is of pieces of one, and what strikes it breaks no more); pieces of one body are
no such thing for one another there, or heaps would be taken apart at every step.

What strikes at less than a hundredth of the greatest speed does not count (solutions are no more exact), nor what met
in the event before, where nothing has moved since.

Bodies that touch are at one time t dt in an event, all others at times of their own. So what two things have come
together by since the step began, with the velocities v that they have now, is dt (c(t_1 v_1) - c(t_2 v_2)), c the part
along the normal; what is driven is where it was as the step began.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .bodies import Bodies
from .contact_law import SOON, Meetings
from .contact_points import Contacts
from .fragment_overlap import Parting
from .swept_bounds import Course

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Kin = Callable[[Ints], Ints]  # of bodies (m,): the number c of what each is a piece of, -2 - c if it breaks no more; -1


@dataclass(frozen=True)
class Stage:
    """Which event of a step: the only one, where it is not taken apart.

    Attributes:
        gravity: (3,) m/s^2 that acts in it: in the first.    parting: how overlaps stand as it begins.
        begun: (n,) shares of the step that bodies have come through, None where it is not taken apart.
        after: so many events may follow.    quick: m/s, what is slower strikes nothing.
        first: whether it is the first one.
    """

    gravity: Values
    parting: Parting
    begun: Values | None = None
    after: int = 0
    quick: float = 0.0
    first: bool = True

    @property
    def apart(self) -> bool:
        """Whether the step is taken apart."""
        return self.begun is not None

    @property
    def since(self) -> Values | float:
        """(n,) shares of the step that bodies have come through."""
        return 0.0 if self.begun is None else self.begun

    def after_it(self, share: Values, parting: Parting) -> Stage:
        """The next one, of bodies that have come through shares (n,)."""
        return Stage(0 * self.gravity, parting, share, self.after - 1, self.quick, first=False)


class Event:
    """What comes together in an event of a step.

    Attributes:
        stage, course: which, and how far things come.    before: what was near bodies as it began.
        bodies: where they are struck, after the share (n,) of the step.    contacts, meeting: k of them.
        parting: how overlaps stand in it.    near: (k,) those that are looked at so far.
        impulse: (k, 3) of them so far, along their axes, N s.
    """

    def __init__(
        self, stage: Stage, course: Course, before: Contacts, bodies: Bodies, share: Values, contacts: Contacts,
        meeting: Meetings, parting: Parting,
    ) -> None:  # fmt: skip
        self.stage, self.course, self.before, self.bodies, self.share = stage, course, before, bodies, share
        self.contacts, self.meeting, self.parting = contacts, meeting, parting
        self.near: Flags = meeting.near & ~self.waits
        self.impulse: Values = np.zeros((len(contacts), 3))

    @property
    def last(self) -> bool:
        """Whether no other one follows."""
        return not self.stage.after

    @property
    def waits(self) -> Flags:
        """(k,) what is left to the events after it."""
        return self.meeting.waits & (self.stage.after > 0)

    @property
    def strikes(self) -> Flags:
        """(k,) what strikes in it."""
        return (self.meeting.closing > 0) & ~self.meeting.waits

    def taken_apart(self, events: int) -> Stage:
        """The first of at most so many, instead of it."""
        quick = SOON * float(self.meeting.closing.max())
        return Stage(self.stage.gravity, self.stage.parting, np.zeros(len(self.bodies)), events - 1, quick)


def behind(event: Event, waits: Flags, near: float, count: int, kin: Kin | None) -> bool:
    """Whether what moves (bodies below `count`) strikes a body, or is within `near` of it, m, and would go on into
    something behind it: a contact that `waits` (k,). `kin`: only where that body may break, and what is behind it is
    not of the same."""
    if not np.any(waits):
        return False
    closing, contacts = event.meeting.closing, event.contacts
    rows = np.flatnonzero((closing > 0) | (event.meeting.gap < near))
    things, axis = contacts.things[rows], contacts.axes[rows, 0]
    own, other = np.concatenate([things, things[:, ::-1]]).T
    way, late, speed = np.concatenate([axis, -axis]), np.tile(waits[rows], 2), np.tile(closing[rows], 2)
    strikes = np.flatnonzero(~late & (other < count) & (own < count))
    first = np.full(count + 1, -1)  # of what a body strikes or touches: what it strikes hardest
    order = strikes[np.argsort(speed[strikes], kind="stable")]
    first[own[order]] = order
    then = np.flatnonzero(late & (first[np.minimum(own, count)] >= 0))
    now = first[own[then]]
    on = (np.einsum("ki,ki->k", way[then], way[now]) > 0) & (other[then] != other[now])
    if kin is None or not np.any(on):
        return bool(np.any(on))
    mine, screen, beyond = (_kin(of[on], count, kin) for of in (own[now], other[now], other[then]))
    gives_way = (screen >= 0) | ((screen < -1) & (mine == -1))
    return bool(np.any(gives_way & (screen != mine) & (screen != beyond)))


def _kin(things: Ints, count: int, kin: Kin) -> Ints:
    """(k,) of things (k,), of which bodies are the first `count`; of what stands -1."""
    found = np.full(len(things), -1)
    bodies = things < count
    found[bodies] = kin(things[bodies])
    return found


def so_far(
    contacts: Contacts, gap: Values, motion: tuple[Values, Values], rates: Values, past: Values, dt: float
) -> tuple[Values, Values, Values]:
    """Of contacts at distances (k,) m of bodies that have come through shares `past` (n,) of the step: distances, m,
    what things came together by in these shares as they move now, m, and which share of the step is left, of the one
    that has more of it.    motion: (things, 3) velocities and spins.    rates: (stands, 3) m/s of what stands."""
    n = len(past)
    every, (velocity, spin) = np.append(past, np.zeros(len(rates))), motion
    least = np.minimum(*np.append(past, np.ones(len(rates)))[contacts.things.T])
    both = np.maximum(*every[contacts.things.T])
    among = contacts.closing(every[:, None] * velocity, every[:, None] * spin)
    come = np.where(np.maximum(*contacts.things.T) < n, among, both * contacts.closing(velocity, spin))
    if np.any(rates):
        moved: Values = np.zeros((len(every), 3))
        moved[n:] = rates
        gap = gap - dt * both * contacts.closing(moved, 0 * moved)
    return gap, dt * come, np.maximum(1 - least, SOON)
