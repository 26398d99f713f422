"""The rigid-body engine: MuJoCo finds contacts and their forces, with friction; bodies fly and turn by their momentum.

    v' = v + dt g + J / m,   x' = x + s dt (v + s dt g / 2) + (1 - s) dt v',   l' = l + r x J,   turns: rigid.tumbling

with impulses J for the law of rigid.meeting, of few contacts by rigid.newton, of many by rigid.crowd, where bodies are
after the share s of the step that they fly for before they are struck. MuJoCo's own contacts are springs and dashpots
that let things in, and its own way of turning bodies loses angular momentum: neither is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from .bodies import Bodies
from .contacts import Contacts
from .crowd import Crowd
from .finding import Finder
from .lifting import lifts, raised
from .meeting import Meetings, flown, meetings
from .model import Part, Rules, Stand, model_of
from .newton import Newton
from .siblings import Overlaps, Parting
from .touches import Touches
from .tumbling import rotated, tumbled

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

TURN = 1.0  # rad a step that contacts set a body spinning by, at most: they are of one place, and a crumb would whirl
ROUNDS = 3  # of looking for contacts, at most, where what is struck goes farther than was thought,
FARTHER = 1.5  # by as many times
MISSED = 0.25  # c_0 dt, that what nobody looked at may be in a floor by
SLIPS = 10  # rounds of slip, at most,
CLOSE = 0.02  # c_0: what slips otherwise than was thought by less, times mu, is not looked at again
CROWD = 300  # contacts: more are not given to Newton's method
NEARLY = 0.01  # c_0: what velocities of a crowd may be off by,
MOST, WORK = 150, 3_000_000  # after so many iterations, at most, of few contacts so many in all
LOOKS, ROUGH = 3, 30  # looks for what meets what, at most, and iterations of all but the first whole one


@dataclass
class _Met:
    """What comes together in a step.

    Attributes:
        start: the bodies before it.    before: what was near them then.
        bodies: where they are struck, after the share (n,) of it.
        contacts, meeting: k of them.    near: (k,) those that are looked at so far.
        impulse: (k, 3) of them so far, along their axes, N s.
    """

    start: Bodies
    before: Contacts
    bodies: Bodies
    share: Values
    contacts: Contacts
    meeting: Meetings
    near: Flags
    impulse: Values


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

    def advance(self, bodies: Bodies, ways: Values | None = None) -> tuple[Bodies, Touches]:
        """The bodies a step later, and what touched; `ways`: (stands, 3) where the reference points of what stands are
        at the end of the step, m (None: where they were)."""
        rates: Values = np.zeros_like(self._way) if ways is None else np.asarray((ways - self._way) / self._rules.step)
        common = np.median(np.concatenate([bodies.velocity, rates]), axis=0)
        reach = [self._reach(bodies, of) for of in (common, 0.0)]
        planes, end = self._model.planes, self._way if ways is None else ways
        known: _Met | None = None
        far: Flags = np.ones(self._count, bool)
        planes.begin()
        for _ in range(ROUNDS):
            met = known = self._met(bodies, rates, common, reach, known, far)
            moved, touches, done = self._moved(met, rates, rough=True)
            farther = [self._reach(moved, of) for of in (common, 0.0)]
            far = np.any([now > FARTHER * then for now, then in zip(farther, reach, strict=True)], axis=0)
            far |= planes.missed(moved, end, MISSED * self._rules.fast * self._rules.step)
            if not np.any(far):
                break
            reach = [np.where(far, np.maximum(now, then), then) for now, then in zip(farther, reach, strict=True)]
        if not done:
            moved, touches, _ = self._moved(met, rates, rough=False)
        if ways is not None:
            self._way = ways.copy()
        return moved, touches

    def _reach(self, bodies: Bodies, common: Values | float) -> Values:
        """(n,) how far any point of a body comes in a step beside what moves with a `common` velocity, m/s: two things
        come together by no more than the sum of theirs."""
        turning = self._model.extent * np.linalg.norm(bodies.spin, axis=1)
        speed = np.linalg.norm(bodies.velocity - common, axis=1) + turning
        return np.asarray(self._rules.step * (speed + self._rules.fast))

    def _met(
        self, start: Bodies, rates: Values, common: Values, reach: Sequence[Values], known: _Met | None, far: Flags
    ) -> _Met:
        """What comes together in a step where no point of the bodies comes farther than a reach (n,) beside what moves
        with a common velocity (3,), and than another (n,) beside what stands, m and m/s; `known` so far, without what
        comes `far`ther (n,) than was thought."""
        dt, g, bodies = self._rules.step, self._rules.gravity, start
        before, kept = self._renewed(start, rates, common, reach, known.before if known else None, far)
        contacts, (meeting, parting) = before, self._meeting(before, start, rates)
        share = flown(meeting, before.things, self._count)
        if np.any(share):
            fallen = dt * share[:, None] * g
            flying = replace(start, velocity=start.velocity + fallen / 2)
            bodies = replace(self._flown(flying, dt * share), velocity=start.velocity)
        others = share > 0 if known is None else far | (share != known.share)
        if known is None or known.contacts is not known.before or np.any(share):
            contacts, kept = self._renewed(bodies, rates, common, reach, known.contacts if known else before, others)
        if np.any(share):
            lift = lifts(before, contacts, share > 0)
            bodies = replace(bodies, place=bodies.place + lift)
            falling = replace(bodies, velocity=bodies.velocity + fallen)
            meeting, parting = self._meeting(replace(contacts, gap=raised(contacts, lift)), falling, rates)
        self._parting = parting
        near, impulse = meeting.near, np.zeros((len(contacts), 3))
        if known:
            near[: len(kept)] |= known.near[kept]
            impulse[: len(kept)] = known.impulse[kept]
        return _Met(start, before, bodies, share, contacts, meeting, near, impulse)

    def _renewed(
        self, bodies: Bodies, rates: Values, common: Values, reach: Sequence[Values], known: Contacts | None,
        others: Flags,
    ) -> tuple[Contacts, Ints]:  # fmt: skip
        """Contacts `known`, those of bodies (n,) that are `others` now found again; and which are kept, which are the
        first. What of a crowd flies or goes farther is little of it."""
        if known is None:
            return self._find(bodies, rates, common, reach), np.empty(0, np.int64)
        stays = np.append(~others, np.ones(len(rates), bool))
        kept = np.flatnonzero(stays[known.things].all(axis=1))
        if not np.any(others):
            return known, kept
        return known.chosen(kept).and_more(self._find(bodies, rates, common, reach, others)), kept

    def _moved(self, met: _Met, rates: Values, *, rough: bool) -> tuple[Bodies, Touches, bool]:
        """The bodies at the end of the step, what touched, and whether that is all that can be said of it: a crowd is
        only looked through where it may be `rough`."""
        dt, start = self._rules.step, met.start
        force, touches, done = self._pushed(met, rates, rough=rough)
        after = self._flown(self._driven_on(met.bodies, force), dt * (1 - met.share))
        alone = ~np.any(force, axis=1)
        after.place[alone] = start.place[alone] + dt * (start.velocity[alone] + dt * self._rules.gravity / 2)
        return after, touches, done

    def _meeting(self, contacts: Contacts, bodies: Bodies, rates: Values) -> tuple[Meetings, Parting]:
        """How contacts act in the step, and how overlaps stand then."""
        rules = self._rules
        gap, parting = self._parting(contacts.geoms, contacts.things, contacts.gap)
        closing = contacts.closing(*self._motion(bodies, rates))
        return meetings(gap, closing, rules.step, rules.fast, rules.restitution), parting

    def _motion(self, bodies: Bodies, rates: Values) -> tuple[Values, Values]:
        """(things, 3) velocities and (things, 3) spins."""
        return np.concatenate([bodies.velocity, rates]), np.concatenate([bodies.spin, 0 * rates])

    def _driven_on(self, bodies: Bodies, force: Values) -> Bodies:
        """The bodies with the motion that forces and moments (n, 6) of a step give them."""
        dt, model = self._rules.step, self._model
        momentum = rotated(bodies.turn, model.inertia, bodies.spin)
        momentum += dt * np.einsum("nij,nj->ni", bodies.turn, force[:, 3:])
        velocity = bodies.velocity + dt * (self._rules.gravity + force[:, :3] / model.mass[:, None])
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

    def _find(
        self, bodies: Bodies, rates: Values, common: Values, reach: Sequence[Values], only: Flags | None = None
    ) -> Contacts:
        """Contacts of what comes together within the step, see `_met`, of all bodies or `only` some (n,)."""
        dt = self._rules.step
        slide = [dt * np.linalg.norm(rates - of, axis=1) for of in (common, 0.0)]
        return self._finder(bodies, self._way, reach, slide, dt, only)

    def _pushed(self, met: _Met, rates: Values, *, rough: bool) -> tuple[Values, Touches, bool]:
        """Forces and moments (n, 6) that contacts give, these in the axes of the bodies, N and N m; what touched; and
        whether these are the last ones.

        What does not come near enough to touch is left out, and looked at again with the velocities that come of it.
        """
        crowded, done = np.count_nonzero(met.meeting.near) > CROWD, True
        if not np.any(met.meeting.near):
            return np.zeros((self._count, 6)), Touches.none(), done
        if crowded:
            force, done = self._by_projections(met, rates, rough=rough), not rough
        else:
            force = self._by_newton(met, rates)
        rows = np.flatnonzero(met.impulse[:, 0] > 0)
        return force, met.contacts.touches(rows, met.impulse[rows], met.meeting.closing), done

    def _by_newton(self, met: _Met, rates: Values) -> Values:
        """Forces and moments (n, 6) of contacts by MuJoCo's solver.

        The convex problem wants what slips at a speed s to part at mu s, which would throw up what spins: contacts may
        come by as much nearer, mu s dt, with s as it comes out (see rigid.crowd). What is given too much of it sinks
        in by the difference, at every step in which it slides.
        """
        dt, contacts, kept, model = self._rules.step, met.contacts, met.near, self._model
        newton = self._newton = self._newton or Newton(model, self._rules)
        newton.begin(met.bodies, self._way[model.driven], rates[model.driven], contacts)
        lifts = dt * contacts.friction
        thrown = lifts * contacts.slipping(*self._motion(met.bodies, rates), kept)
        for _ in range(SLIPS):
            force, each, pressed = newton.solved(met.meeting.aim + thrown, kept)
            motion = self._motion(self._driven_on(met.bodies, force), rates)
            missed = self._missed(met, kept, motion)
            kept, before = kept | missed, thrown
            thrown = np.minimum(thrown, lifts * contacts.slipping(*motion, kept))
            if not np.any(missed) and np.all((before - thrown)[pressed] < CLOSE * self._rules.fast * dt):
                break
        met.impulse[:] = np.where(pressed[:, None], dt * each, 0.0)  # not what pressed in a look before
        return force

    def _missed(self, met: _Met, kept: Flags, motion: tuple[Values, Values]) -> Flags:
        """(k,) contacts beside those kept (k,) that things come to touch in with these velocities and spins."""
        return np.asarray(~kept & (met.meeting.gap < self._rules.step * met.contacts.closing(*motion)))

    def _by_projections(self, met: _Met, rates: Values, *, rough: bool) -> Values:
        """As `_by_newton`, whatever there is of them, from where it was left: where it may be `rough`, to see what is
        missed."""
        dt, bodies = self._rules.step, met.bodies
        inverse = bodies.turn @ self._model.inverse @ np.swapaxes(bodies.turn, 1, 2)
        free = self._motion(self._driven_on(bodies, np.zeros((self._count, 6))), rates)
        for number in range(1 if rough else LOOKS):
            rows = np.flatnonzero(met.near)
            some = met.contacts.chosen(rows)
            aim: Values = np.asarray(met.meeting.aim[rows] / dt)
            crowd = Crowd.of(some, some.parting(*free), aim, self._model.mass, inverse)
            enough = NEARLY * self._rules.fast
            most = ROUGH if rough or number else max(MOST, WORK // max(len(rows), 1))
            met.impulse[rows] = crowd.impulses(enough, most, met.impulse[rows])
            force = self._forces(bodies, crowd.gained(met.impulse[rows]))
            missed = self._missed(met, met.near, self._motion(self._driven_on(bodies, force), rates))
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
        contacts = self._find(bodies, np.zeros_like(self._way), np.zeros(3), 2 * [np.zeros(self._count)])
        count = int(contacts.things.max(initial=0)) + 1
        code, place = np.unique(np.sort(contacts.things, axis=1) @ np.array([count, 1]), return_inverse=True)
        depth: Values = np.zeros(len(code))
        np.maximum.at(depth, place, -contacts.gap)
        return [(int(each) // count, int(each) % count, float(depth[k])) for k, each in enumerate(code) if depth[k] > 0]
