"""What comes together in the events of a step, first and after one another: where bodies are then, and what is near.

Mostly a step has one event; see rigid.impact_sequence for those that are taken apart.

What rests sinks into the floor while it flies to where something strikes it: it is set back onto it.

A body flies as if there were nothing for the share s of the step (rigid.contact_law), through what it comes to more
slowly than c_0 as well: it lies deeper by up to c_0 dt then, at every blow. It is moved by that along the normal of
what stands there, its velocity as it was: no work but that of its weight, which it had lost too much of.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from .bodies import Bodies
from .collision_detection import Finder
from .contact_law import Meetings, flown_together, later, meetings, meetings_apart
from .contact_law import flown as flown_before
from .contact_points import Contacts
from .contact_solver import crowded
from .fragment_overlap import Parting
from .free_flight import flown, of_things
from .impact_sequence import Event, Kin, Stage, behind, so_far
from .mujoco_model import Looked, Model, Rules
from .swept_bounds import Course, course_of

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
EVENTS, OF_CROWD = 6, 3  # of a step that is taken apart, at most: of few contacts, and of a crowd


def lifts(before: Contacts, after: Contacts, flew: Flags) -> Values:
    """(n, 3) m by which bodies that flew (n,) are set back: by what the deepest of their contacts with what stands is
    deeper in than any was before."""
    count = len(flew)
    deep: Values = np.zeros(count)
    rows, body, _ = _standing(before, flew)
    np.maximum.at(deep, body, -before.gap[rows])
    rows, body, sign = _standing(after, flew)
    sunk = -after.gap[rows] - deep[body]
    order = np.argsort(sunk, kind="stable")
    order = order[sunk[order] > 0]
    lift: Values = np.zeros((count, 3))
    lift[body[order]] = (sunk * sign)[order, None] * after.axes[rows[order], 0]
    return lift


def _standing(contacts: Contacts, flew: Flags) -> tuple[Ints, Ints, Values]:
    """Contacts (k,) of bodies that flew (n,) with what stands, these bodies (k,), and 1 where the normal is towards
    them, -1 where it is away."""
    count, (first, second) = len(flew), contacts.things.T
    body = np.minimum(first, second)
    rows = np.flatnonzero((np.maximum(first, second) >= count) & np.append(flew, False)[np.minimum(body, count)])
    return rows, body[rows], np.where(second[rows] < count, 1.0, -1.0)


def raised(contacts: Contacts, lift: Values) -> Values:
    """(k,) distances where bodies (n,) are moved by (n, 3), m."""
    if not np.any(lift):
        return contacts.gap
    things = np.minimum(contacts.things, len(lift))
    moved = np.append(lift, np.zeros((1, 3)), axis=0)[things]
    return np.asarray(contacts.gap + np.einsum("ki,ki->k", moved[:, 1] - moved[:, 0], contacts.axes[:, 0]))


@dataclass(frozen=True)
class Again:
    """An `event` as the round before had it, without what comes `far`ther (n,) than was thought: of what was near as it
    began contacts `kept` are still known, the first ones."""

    event: Event
    far: Flags
    kept: Ints


class Striking:
    """In one step of the bodies of a model."""

    def __init__(
        self, model: Model, rules: Rules, finder: Finder, ways: Values, looked: Looked, parting: Parting,
        kin: Kin | None,
    ) -> None:  # fmt: skip
        """`ways`: (stands, 3) where what stands is as the step begins, m; `looked`: at corners over planes, in this
        step; `parting`: how overlaps stand as it begins; `kin`: of what may break (None: nothing does)."""
        self._model, self._rules, self._finder, self._kin = model, rules, finder, kin
        self._ways, self._looked, self._parting, self._count = ways, looked, parting, len(model.mass)

    def first(self, start: Bodies, course: Course, known: Event | None, far: Flags) -> Event:
        """What comes together first in the step; `known` so far, without what comes `far`ther (n,) than was thought."""
        before, same = self._renewed(start, course, known.before if known else None, far)
        again = Again(known, far, same) if known else None
        stage = Stage(self._rules.gravity, self._parting) if known is None or known.last else known.stage
        event, kept = self._event(start, before, stage, course, again)
        if event.last and self._goes_on(event):
            events = OF_CROWD if crowded(event) else EVENTS
            event, kept = self._event(start, before, event.taken_apart(events), course, again)
        if known:
            event.near[: len(kept)] |= known.near[kept]
            event.near &= ~event.waits
            event.impulse[: len(kept)] = known.impulse[kept]
        return event

    def after(self, met: Event, bodies: Bodies) -> Event | None:
        """The event after one that left bodies with these velocities; None where they meet nothing else."""
        model, rules, rates = self._model, self._rules, met.course.rates
        far = met.course.farther(course_of(model, rules, bodies, rates, met.course.common))
        course = course_of(model, rules, bodies, rates)
        contacts, kept = self._renewed(bodies, course, met.contacts, far)
        stage = met.stage.after_it(met.share, met.parting)
        struck = _rows(met.near & met.strikes, kept, len(contacts))
        if not np.any(self._meeting(contacts, bodies, rates, stage, met.share, struck)[0].closing):
            return None
        return self._event(bodies, contacts, stage, course, struck=struck)[0]

    def _goes_on(self, met: Event) -> bool:
        """Whether the step is to be taken apart: in a crowd only for what may break."""
        many = crowded(met)
        if many and self._kin is None:
            return False
        rules, meeting = self._rules, met.meeting
        waits = later(meeting.gap, meeting.closing, rules.step, rules.fast)
        return behind(met, waits, rules.fast * rules.step, self._count, self._kin if many else None)

    def _event(
        self, start: Bodies, before: Contacts, stage: Stage, course: Course, again: Again | None = None,
        struck: Flags | None = None,
    ) -> tuple[Event, Ints]:  # fmt: skip
        """An event of bodies near to which is `before`, of which some have `struck` (k,) where they are; and which
        contacts that were known are kept, the first ones."""
        meeting, parting = self._meeting(before, start, course.rates, stage, stage.begun, struck)
        share = self._flights(meeting, before, stage)
        flies = share > stage.since
        time = self._rules.step * (share - stage.since)
        fallen = time[:, None] * stage.gravity
        bodies = self._flown(start, time, fallen) if np.any(flies) else start
        contacts, kept = self._near(bodies, before, course, share, flies, again)
        if np.any(flies):
            lift = lifts(before, contacts, flies & stage.first)
            bodies = replace(bodies, place=bodies.place + lift)
            falling, lifted = replace(bodies, velocity=bodies.velocity + fallen), raised(contacts, lift)
            struck = None if struck is None else _rows(struck, kept, len(contacts))
            past, landed = share if stage.apart else None, replace(contacts, gap=lifted)
            meeting, parting = self._meeting(landed, falling, course.rates, stage, past, struck)
        return Event(stage, course, before, bodies, share, contacts, meeting, parting), kept

    def _flights(self, meeting: Meetings, contacts: Contacts, stage: Stage) -> Values:
        """(n,) share of the step at which bodies are struck in an event."""
        if stage.begun is None:
            return flown_before(meeting, contacts.things, self._count)
        return flown_together(meeting, contacts.things, stage.begun, self._rules.fast * self._rules.step)

    def _flown(self, start: Bodies, time: Values, fallen: Values) -> Bodies:
        """The bodies after times (n,) s in which they gain velocities (n, 3) m/s, which they are left without."""
        flying = replace(start, velocity=start.velocity + fallen / 2)
        return replace(flown(self._model, flying, time), velocity=start.velocity)

    def _near(
        self, bodies: Bodies, before: Contacts, course: Course, share: Values, flies: Flags, again: Again | None
    ) -> tuple[Contacts, Ints]:
        """What is near bodies that are struck after shares (n,) of the step, and which contacts known are kept."""
        if again is None:
            return self._renewed(bodies, course, before, flies)
        event = again.event
        if event.contacts is event.before and not np.any(flies):
            return before, again.kept
        return self._renewed(bodies, course, event.contacts, again.far | (share != event.share))

    def _renewed(self, bodies: Bodies, course: Course, known: Contacts | None, others: Flags) -> tuple[Contacts, Ints]:
        """Contacts `known`, those of bodies (n,) that are `others` now found again; and which are kept, which are the
        first. What of a crowd flies or goes farther is little of it."""
        if known is None:
            return self._find(bodies, course), np.empty(0, np.int64)
        stays = np.append(~others, np.ones(len(course.rates), bool))
        kept = np.flatnonzero(known.of_both(stays))
        if not np.any(others):
            return known, kept
        return known.chosen(kept).and_more(self._find(bodies, course, others)), kept

    def _find(self, bodies: Bodies, course: Course, only: Flags | None = None) -> Contacts:
        """Contacts of what comes together within the step, of all bodies or `only` some (n,)."""
        return self._finder(bodies, self._ways, course, self._rules.step, self._looked, only, self._parting)

    def _meeting(
        self, contacts: Contacts, bodies: Bodies, rates: Values, stage: Stage, past: Values | None,
        struck: Flags | None,
    ) -> tuple[Meetings, Parting]:  # fmt: skip
        """How contacts act in a step, or at shares `past` (n,) of one that is taken apart, those but that have `struck`
        (k,), and how overlaps stand."""
        rules, motion = self._rules, of_things(bodies, rates)
        gap, parting = stage.parting(contacts.geoms, contacts.things, contacts.gap)
        closing = contacts.closing(*motion)
        if past is None:
            return meetings(gap, closing, rules.step, rules.fast, rules.restitution), parting
        gap, come, rest = so_far(contacts, gap, motion, rates, past, rules.step)
        strikes = closing > max(rules.fast, stage.quick)
        if struck is not None:
            strikes &= ~struck
        return meetings_apart(gap, closing, rules.step, rules.fast, rules.restitution, come, rest, strikes), parting


def _rows(flags: Flags, kept: Ints, count: int) -> Flags:
    """(count,) the flags of those that were kept, which are the first."""
    found = np.zeros(count, bool)
    found[: len(kept)] = flags[kept]
    return found
