"""The rigid-body engine: MuJoCo finds contacts and their forces, with friction; bodies fly and turn by their momentum.

    v' = v + dt g + J / m,   x' = x + s dt (v + s dt g / 2) + (1 - s) dt v',   l' = l + r x J,   turns: rigid.tumbling

with impulses J for the law of rigid.meeting, of few contacts by rigid.newton, of many by rigid.crowd, where bodies are
after the share s of the step that they fly for before they are struck; some steps are taken apart (rigid.events).
MuJoCo's own contacts are springs and dashpots that let things in, and its own way of turning bodies loses angular
momentum: neither is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from .bodies import Bodies
from .contacts import Contacts
from .crowd import Crowd
from .events import Course, Event, Kin, Stage, behind, so_far
from .finding import Finder
from .lifting import lifts, raised
from .meeting import SOON, Meetings, flown, flown_together, later, meetings, meetings_apart
from .model import Part, Rules, Stand, model_of
from .newton import Newton
from .siblings import Overlaps, Parting
from .touches import Touches
from .tumbling import rotated, tumbled

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

TURN = 1.0  # rad a step that contacts set a body spinning by, at most: they are of one place, and a crumb would whirl
EVENTS, OF_CROWD = 6, 3  # of a step that is taken apart, at most: of few contacts, and of a crowd
ROUNDS = 3  # of looking for contacts, at most, where what is struck goes farther than was thought,
FARTHER = 1.5  # by as many times
MISSED = 0.25  # c_0 dt, that what nobody looked at may be in a floor by
SLIPS = 10  # rounds of slip, at most,
CLOSE = 0.02  # c_0: what slips otherwise than was thought by less, times mu, is not looked at again
CROWD = 300  # contacts: more are not given to Newton's method
NEARLY = 0.01  # c_0: what velocities of a crowd may be off by,
MOST, WORK = 150, 3_000_000  # after so many iterations, at most, of few contacts so many in all
LOOKS, ROUGH = 3, 30  # looks for what meets what, at most, and iterations of all but the first whole one


class Engine:
    """Bodies of fixed shapes, and what stands in their way. Another one is made where bodies break."""

    def __init__(
        self,
        bodies: Bodies,
        parts: Sequence[Sequence[Part]],
        stands: Sequence[Stand],
        rules: Rules,
        overlaps: Overlaps | None = None,
        names: Ints | None = None,
        outer: Sequence[Values] | None = None,
        turn: Values | None = None,
    ) -> None:
        """`parts`: convex parts of each body, `outer`: its outermost points (None: all corners), both turned by `turn`
        (n, 3, 3) (None: not at all); `overlaps`: of bodies by their names (n,), ascending, or numbers."""
        self._rules, self._count = rules, len(bodies)
        self._model = model_of(bodies, parts, stands, rules, outer, turn)
        self._finder = Finder(self._model)
        self._newton: Newton | None = None
        self._way: Values = np.array([stand.at for stand in stands]).reshape(-1, 3)  # where each was last, m
        known = np.arange(len(bodies)) if names is None else names
        self._parting = Parting.of(overlaps or Overlaps.none(), known, self._model.first, len(self._model.thing))

    @property
    def overlaps(self) -> Overlaps:
        """Of pieces that lie in one another from birth, as they are now."""
        return self._parting.overlaps

    # --- a step ---

    def advance(self, bodies: Bodies, ways: Values | None = None, kin: Kin | None = None) -> tuple[Bodies, Touches]:
        """The bodies a step later, and what touched; `ways`: (stands, 3) where the reference points of what stands are
        at the end of the step, m (None: where they were); `kin`: of what may break, see rigid.events (None: nothing
        does)."""
        rates: Values = np.zeros_like(self._way) if ways is None else np.asarray((ways - self._way) / self._rules.step)
        course, end = self._course(bodies, rates), self._way if ways is None else ways
        known: Event | None = None
        far: Flags = np.ones(self._count, bool)
        planes = self._model.planes
        planes.begin()
        for _ in range(ROUNDS):
            met = known = self._met(bodies, course, known, far, kin)
            moved, touches, last, done = self._moved(bodies, met, rates, rough=True)
            far = last.last & self._farther(moved, last.course)[0]  # what else goes farther has been looked for
            far |= planes.missed(moved, end, MISSED * self._rules.fast * self._rules.step)
            if not np.any(far):
                break
            now = self._course(moved, rates, course.common)
            most = [np.where(far, np.maximum(*both), both[0]) for both in zip(course.reach, now.reach, strict=True)]
            course = replace(course, reach=most)
        if not done:
            moved, touches, *_ = self._moved(bodies, met, rates, rough=False)
        if ways is not None:
            self._way = ways.copy()
        return moved, touches

    def _course(self, bodies: Bodies, rates: Values, common: Values | None = None) -> Course:
        """How far bodies come in a step that move so; `common`: beside this, m/s (None: beside what most do)."""
        if common is None:
            common = np.median(np.concatenate([bodies.velocity, rates]), axis=0)
        return Course(rates, common, [self._reach(bodies, of) for of in (common, 0.0)])

    def _farther(self, bodies: Bodies, course: Course) -> tuple[Flags, Course]:
        """(n,) what comes much farther than on a course, beside the same velocity, and how far all do beside theirs."""
        now = self._course(bodies, course.rates, course.common).reach
        far = np.any([mine > FARTHER * then for mine, then in zip(now, course.reach, strict=True)], axis=0)
        return far, self._course(bodies, course.rates)

    def _reach(self, bodies: Bodies, common: Values | float) -> Values:
        """(n,) how far any point of a body comes in a step beside what moves with a `common` velocity, m/s: two things
        come together by no more than the sum of theirs."""
        turning = self._model.extent * np.linalg.norm(bodies.spin, axis=1)
        speed = np.linalg.norm(bodies.velocity - common, axis=1) + turning
        return np.asarray(self._rules.step * (speed + self._rules.fast))

    def _met(self, start: Bodies, course: Course, known: Event | None, far: Flags, kin: Kin | None) -> Event:
        """What comes together first in a step; `known` so far, without what comes `far`ther (n,) than was thought."""
        before, same = self._renewed(start, course, known.before if known else None, far)
        stage = Stage(self._rules.gravity) if known is None or known.last else known.stage
        event, kept = self._struck(start, before, stage, course, known, far, same)
        if event.last and kin is not None and self._goes_on(event, kin):
            events = OF_CROWD if self._crowded(event) else EVENTS
            quick = SOON * float(event.meeting.closing.max())
            stage = Stage(stage.gravity, np.zeros(self._count), events - 1, quick)
            event, kept = self._struck(start, before, stage, course, known, far, same)
        if known:
            event.near[: len(kept)] |= known.near[kept]
            event.near &= ~event.waits
            event.impulse[: len(kept)] = known.impulse[kept]
        return event

    def _goes_on(self, met: Event, kin: Kin) -> bool:
        """Whether the step is to be taken apart."""
        rules, meeting = self._rules, met.meeting
        waits = later(meeting.gap, meeting.closing, rules.step, rules.fast)
        return behind(met, waits, rules.fast * rules.step, self._count, kin)

    def _next(self, met: Event, bodies: Bodies) -> Event | None:
        """The event after one that left bodies with these velocities; None where they meet nothing else."""
        far, course = self._farther(bodies, met.course)
        contacts, kept = self._renewed(bodies, course, met.contacts, far)
        stage = met.stage.after_it(met.share)
        struck = _rows(met.near & met.strikes, kept, len(contacts))
        if not np.any(self._meeting(contacts, bodies, course.rates, stage, met.share, struck)[0].closing):
            return None
        return self._struck(bodies, contacts, stage, course, struck=struck)[0]

    def _struck(
        self, start: Bodies, before: Contacts, stage: Stage, course: Course, known: Event | None = None,
        far: Flags | None = None, kept: Ints | None = None, struck: Flags | None = None,
    ) -> tuple[Event, Ints]:  # fmt: skip
        """An event of bodies near to which is `before`, of which some have `struck` (k,) where they are; and which
        contacts known are kept, the first ones: those `kept` of what was known before, where nothing flies."""
        dt, rates, contacts, bodies = self._rules.step, course.rates, before, start
        meeting, parting = self._meeting(before, start, rates, stage, stage.begun, struck)
        share = self._flights(meeting, before, stage)
        flies = share > stage.since
        time = dt * (share - stage.since)
        fallen = time[:, None] * stage.gravity
        if np.any(flies):
            flying = replace(start, velocity=start.velocity + fallen / 2)
            bodies = replace(self._flown(flying, time), velocity=start.velocity)
        others = flies if known is None or far is None else far | (share != known.share)
        if kept is None or known is None or known.contacts is not known.before or np.any(flies):
            contacts, kept = self._renewed(bodies, course, known.contacts if known else before, others)
        if np.any(flies):
            lift = lifts(before, contacts, flies & stage.first)
            bodies = replace(bodies, place=bodies.place + lift)
            falling, lifted = replace(bodies, velocity=bodies.velocity + fallen), raised(contacts, lift)
            struck = None if struck is None else _rows(struck, kept, len(contacts))
            past = share if stage.apart else None
            meeting, parting = self._meeting(replace(contacts, gap=lifted), falling, rates, stage, past, struck)
        return Event(stage, course, before, bodies, share, contacts, meeting, parting), kept

    def _flights(self, meeting: Meetings, contacts: Contacts, stage: Stage) -> Values:
        """(n,) share of the step at which bodies are struck in an event."""
        if stage.begun is None:
            return flown(meeting, contacts.things, self._count)
        return flown_together(meeting, contacts.things, stage.begun, self._rules.fast * self._rules.step)

    def _renewed(self, bodies: Bodies, course: Course, known: Contacts | None, others: Flags) -> tuple[Contacts, Ints]:
        """Contacts `known`, those of bodies (n,) that are `others` now found again; and which are kept, which are the
        first. What of a crowd flies or goes farther is little of it."""
        if known is None:
            return self._find(bodies, course), np.empty(0, np.int64)
        stays = np.append(~others, np.ones(len(course.rates), bool))
        kept = np.flatnonzero(stays[known.things].all(axis=1))
        if not np.any(others):
            return known, kept
        return known.chosen(kept).and_more(self._find(bodies, course, others)), kept

    def _moved(self, start: Bodies, met: Event, rates: Values, *, rough: bool) -> tuple[Bodies, Touches, Event, bool]:
        """The bodies at the end of the step, what touched, the last event, and whether that is all that can be said of
        it: a crowd is only looked through where it may be `rough`."""
        dt, rough = self._rules.step, rough and met.last
        alone, every = np.ones(self._count, bool), Touches.none()
        following: Event | None = met
        while following is not None:
            now = following
            self._parting = now.parting
            force, touches, done = self._pushed(now, rates, rough=rough)
            bodies, every = self._driven_on(now, force), every.and_more(touches)
            alone &= ~np.any(force, axis=1)
            following = None if now.last else self._next(now, bodies)
        after = self._flown(bodies, dt * (1 - now.share))
        after.place[alone] = start.place[alone] + dt * (start.velocity[alone] + dt * self._rules.gravity / 2)
        return after, every, now, done

    def _meeting(
        self, contacts: Contacts, bodies: Bodies, rates: Values, stage: Stage, past: Values | None,
        struck: Flags | None,
    ) -> tuple[Meetings, Parting]:  # fmt: skip
        """How contacts act in a step, or at shares `past` (n,) of one that is taken apart, those but that have `struck`
        (k,), and how overlaps stand."""
        rules, motion = self._rules, self._motion(bodies, rates)
        gap, parting = self._parting(contacts.geoms, contacts.things, contacts.gap)
        closing = contacts.closing(*motion)
        if past is None:
            return meetings(gap, closing, rules.step, rules.fast, rules.restitution), parting
        gap, come, rest = so_far(contacts, gap, motion, rates, past, rules.step)
        strikes = closing > max(rules.fast, stage.quick)
        if struck is not None:
            strikes &= ~struck
        return meetings_apart(gap, closing, rules.step, rules.fast, rules.restitution, come, rest, strikes), parting

    def _motion(self, bodies: Bodies, rates: Values) -> tuple[Values, Values]:
        """(things, 3) velocities and (things, 3) spins."""
        return np.concatenate([bodies.velocity, rates]), np.concatenate([bodies.spin, 0 * rates])

    def _driven_on(self, met: Event, force: Values) -> Bodies:
        """The bodies of an event with the motion that forces and moments (n, 6) of a step give them."""
        dt, model, bodies = self._rules.step, self._model, met.bodies
        momentum = rotated(bodies.turn, model.inertia, bodies.spin)
        momentum += dt * np.einsum("nij,nj->ni", bodies.turn, force[:, 3:])
        velocity = bodies.velocity + dt * (met.stage.gravity + force[:, :3] / model.mass[:, None])
        spin = rotated(bodies.turn, model.inverse, momentum)
        size, most = np.linalg.norm(spin, axis=1), np.maximum(TURN / dt, np.linalg.norm(bodies.spin, axis=1))
        fast = np.any(force, axis=1) & (size > most)
        spin[fast] *= (most[fast] / size[fast])[:, None]
        return replace(bodies, velocity=velocity, spin=spin)

    def _flown(self, bodies: Bodies, time: Values) -> Bodies:
        """The bodies after times (n,) in which nothing acts, s."""
        model = self._model
        momentum = rotated(bodies.turn, model.inertia, bodies.spin)
        turn = tumbled(bodies.turn, model.inverse, momentum, time)
        place = bodies.place + time[:, None] * bodies.velocity
        return replace(bodies, place=place, turn=turn, spin=rotated(turn, model.inverse, momentum))

    # --- contacts ---

    def _find(self, bodies: Bodies, course: Course, only: Flags | None = None) -> Contacts:
        """Contacts of what comes together within the step, of all bodies or `only` some (n,)."""
        dt = self._rules.step
        slide = [dt * np.linalg.norm(course.rates - of, axis=1) for of in (course.common, 0.0)]
        return self._finder(bodies, self._way, course.reach, slide, dt, only)

    def _pushed(self, met: Event, rates: Values, *, rough: bool) -> tuple[Values, Touches, bool]:
        """Forces and moments (n, 6) that contacts give, these in the axes of the bodies, N and N m; what touched; and
        whether these are the last ones.

        What does not come near enough to touch is left out, and looked at again with the velocities that come of it.
        """
        crowded, done = self._crowded(met), True
        if not np.any(met.meeting.near):
            return np.zeros((self._count, 6)), Touches.none(), done
        if crowded:
            force, done = self._by_projections(met, rates, rough=rough), not rough
        else:
            force = self._by_newton(met, rates)
        rows = np.flatnonzero(met.impulse[:, 0] > 0)
        closing = np.where(met.strikes, met.meeting.closing, 0.0)
        return force, met.contacts.touches(rows, met.impulse[rows], closing), done

    def _crowded(self, met: Event) -> bool:
        """Whether these are too many contacts for Newton's method."""
        return np.count_nonzero(met.meeting.near) > CROWD

    def _by_newton(self, met: Event, rates: Values) -> Values:
        """Forces and moments (n, 6) of contacts by MuJoCo's solver.

        The convex problem wants what slips at a speed s to part at mu s, which would throw up what spins: contacts may
        come by as much nearer, mu s dt, with s as it comes out (see rigid.crowd). What is given too much of it sinks
        in by the difference, at every step in which it slides.
        """
        dt, contacts, kept, model = self._rules.step, met.contacts, met.near, self._model
        newton = self._newton = self._newton or Newton(model, self._rules)
        newton.begin(met.bodies, self._way[model.driven], rates[model.driven], contacts, met.stage.gravity)
        lifts = dt * contacts.friction
        thrown = lifts * contacts.slipping(*self._motion(met.bodies, rates), kept)
        for _ in range(SLIPS):
            force, each, pressed = newton.solved(met.meeting.aim + thrown, kept)
            motion = self._motion(self._driven_on(met, force), rates)
            missed = self._missed(met, kept, motion)
            kept, before = kept | missed, thrown
            thrown = np.minimum(thrown, lifts * contacts.slipping(*motion, kept))
            if not np.any(missed) and np.all((before - thrown)[pressed] < CLOSE * self._rules.fast * dt):
                break
        met.impulse[:] = np.where(pressed[:, None], dt * each, 0.0)  # not what pressed in a look before
        return force

    def _missed(self, met: Event, kept: Flags, motion: tuple[Values, Values]) -> Flags:
        """(k,) contacts beside those kept (k,) that things come to touch in with these velocities and spins."""
        rules, gap, closing = self._rules, met.meeting.gap, met.contacts.closing(*motion)
        missed: Flags = ~kept & (gap < rules.step * met.meeting.rest * closing)
        return missed if met.last else missed & ~later(gap, closing, rules.step, rules.fast)

    def _by_projections(self, met: Event, rates: Values, *, rough: bool) -> Values:
        """As `_by_newton`, whatever there is of them, from where it was left: where it may be `rough`, to see what is
        missed."""
        dt, bodies = self._rules.step, met.bodies
        inverse = bodies.turn @ self._model.inverse @ np.swapaxes(bodies.turn, 1, 2)
        free = self._motion(self._driven_on(met, np.zeros((self._count, 6))), rates)
        for number in range(1 if rough else LOOKS):
            rows = np.flatnonzero(met.near)
            some = met.contacts.chosen(rows)
            aim: Values = np.asarray(met.meeting.aim[rows] / dt)
            crowd = Crowd.of(some, some.parting(*free), aim, self._model.mass, inverse)
            enough = NEARLY * self._rules.fast
            most = ROUGH if rough or number else max(MOST, WORK // max(len(rows), 1))
            met.impulse[rows] = crowd.impulses(enough, most, met.impulse[rows])
            force = self._forces(bodies, crowd.gained(met.impulse[rows]))
            missed = self._missed(met, met.near, self._motion(self._driven_on(met, force), rates))
            met.near |= missed
            if not np.any(missed):
                break
        return force

    def _forces(self, bodies: Bodies, gained: Values) -> Values:
        """Forces and moments (n, 6), these in the axes of the bodies, that give them velocities and spins (n, 6) in a
        step, m/s and rad/s."""
        turning = np.einsum("nji,nj->ni", bodies.turn, gained[:, 3:])
        moment = np.einsum("nij,nj->ni", self._model.inertia, turning)
        return np.concatenate([self._model.mass[:, None] * gained[:, :3], moment], axis=1) / self._rules.step

    def depth(self, bodies: Bodies) -> list[tuple[int, int, float]]:
        """(thing, thing, depth in m) of what is in one another, the deepest place of each pair."""
        still = Course(np.zeros_like(self._way), np.zeros(3), 2 * [np.zeros(self._count)])
        contacts = self._find(bodies, still)
        count = int(contacts.things.max(initial=0)) + 1
        code, place = np.unique(np.sort(contacts.things, axis=1) @ np.array([count, 1]), return_inverse=True)
        depth: Values = np.zeros(len(code))
        np.maximum.at(depth, place, -contacts.gap)
        return [(int(each) // count, int(each) % count, float(depth[k])) for k, each in enumerate(code) if depth[k] > 0]


def _rows(flags: Flags, kept: Ints, count: int) -> Flags:
    """(count,) the flags of those that were kept, which are the first."""
    found = np.zeros(count, bool)
    found[: len(kept)] = flags[kept]
    return found
