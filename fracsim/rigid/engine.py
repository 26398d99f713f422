"""The rigid-body engine: MuJoCo finds contacts and their forces, with friction; bodies fly and turn by their momentum.

    v' = v + dt g + J / m,   x' = x + s dt (v + s dt g / 2) + (1 - s) dt v',   l' = l + r x J,   turns: rigid.bodies

with impulses J (rigid.contact_solver) for the law of rigid.contact_law, where bodies are after the share s of the step
that they fly for before they are struck (rigid.impact_step); some steps are taken apart (rigid.impact_sequence).
MuJoCo's own contacts are springs and dashpots that let things in, and its own way of turning bodies loses angular
momentum: neither is used.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from .bodies import Bodies
from .collision_detection import Finder
from .contact_records import Touches
from .contact_solver import Pushing
from .core_contact import Cores
from .fragment_overlap import Overlaps, Parting
from .free_flight import flown
from .impact_sequence import Event, Kin
from .impact_step import Striking
from .mujoco_model import Part, Rules, Stand, model_of
from .swept_bounds import course_of, still
from .worker_ranks import Helper

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

ROUNDS = 3  # of looking for contacts, at most, where what is struck goes farther than was thought
MISSED = 0.25  # c_0 dt, that what nobody looked at may be in a floor by


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
        helper: Helper | None = None,
        cores: Cores | None = None,
    ) -> None:
        """`parts`: convex parts of each body, `outer`: its outermost points (None: all corners), both turned by `turn`
        (n, 3, 3) (None: not at all); `overlaps`: of bodies by their names (n,), ascending, or numbers; `helper`: a
        second thread (None: there is none); `cores` of the first bodies, which pieces that overlap keep out of."""
        self._rules, self._count = rules, len(bodies)
        self._model = model_of(bodies, parts, stands, rules, outer, turn)
        self._finder = Finder(self._model, helper, cores, rules.friction)
        self._push = Pushing(self._model, rules, helper)
        self._way: Values = np.array([stand.at for stand in stands]).reshape(-1, 3)  # where each was last, m
        known = np.arange(len(bodies)) if names is None else names
        self._parting = Parting.of(overlaps or Overlaps.none(), known, self._model.first, len(self._model.thing))

    @property
    def overlaps(self) -> Overlaps:
        """Of pieces that lie in one another from birth, as they are now."""
        return self._parting.overlaps

    def advance(self, bodies: Bodies, ways: Values | None = None, kin: Kin | None = None) -> tuple[Bodies, Touches]:
        """The bodies a step later, and what touched; `ways`: (stands, 3) where the reference points of what stands are
        at the end of the step, m (None: where they were); `kin`: of what may break, see rigid.impact_sequence (None:
        nothing does).

        What is struck goes farther than it would have, and what it meets there is looked for in rounds."""
        model, rules = self._model, self._rules
        rates: Values = np.zeros_like(self._way) if ways is None else np.asarray((ways - self._way) / rules.step)
        course, end = course_of(model, rules, bodies, rates), self._way if ways is None else ways
        looked, known = model.planes.looked(), None
        far: Flags = np.ones(self._count, bool)
        strikes = Striking(model, rules, self._finder, self._way, looked, self._parting, kin)
        for _ in range(ROUNDS):
            met = known = strikes.first(bodies, course, known, far)
            moved, touches, last, done = self._moved(bodies, met, strikes, rough=True)
            # what is struck in an event but the last has been looked for again with what that left it
            far = last.last & last.course.farther(course_of(model, rules, moved, rates, last.course.common))
            far |= model.planes.missed(moved, end, MISSED * rules.fast * rules.step, looked)
            if not np.any(far):
                break
            course = course.widened(far, course_of(model, rules, moved, rates, course.common))
        if not done:
            moved, touches, last, _ = self._moved(bodies, met, strikes, rough=False)
        self._parting, self._way = last.parting, self._way if ways is None else ways.copy()
        return moved, touches

    def _moved(
        self, start: Bodies, met: Event, strikes: Striking, *, rough: bool
    ) -> tuple[Bodies, Touches, Event, bool]:
        """The bodies at the end of the step, what touched, the last event, and whether that is all that can be said of
        it: a crowd is only looked through where it may be `rough`."""
        dt, rough = self._rules.step, rough and met.last
        alone, every = np.ones(self._count, bool), Touches.none()
        following: Event | None = met
        while following is not None:
            now = following
            force, touches, done = self._push(now, self._way, rough=rough)
            bodies, every = self._push.driven_on(now, force), every.and_more(touches)
            alone &= ~np.any(force, axis=1)
            following = None if now.last else strikes.after(now, bodies)
        after = flown(self._model, bodies, dt * (1 - now.share))
        after.place[alone] = start.place[alone] + dt * (start.velocity[alone] + dt * self._rules.gravity / 2)
        return after, every, now, done

    def depth(self, bodies: Bodies) -> list[tuple[int, int, float]]:
        """(thing, thing, depth in m) of what is in one another by more than hulls of pieces are from birth, the deepest
        place of each pair."""
        rest, looked = still(len(self._way), self._count), self._model.planes.looked()
        contacts = self._finder(bodies, self._way, rest, self._rules.step, looked)
        gap, _ = self._parting(contacts.geoms, contacts.things, contacts.gap)
        count = int(contacts.things.max(initial=0)) + 1
        code, place = np.unique(np.sort(contacts.things, axis=1) @ np.array([count, 1]), return_inverse=True)
        depth: Values = np.zeros(len(code))
        np.maximum.at(depth, place, -gap)
        return [(int(each) // count, int(each) % count, float(depth[k])) for k, each in enumerate(code) if depth[k] > 0]
