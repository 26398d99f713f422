"""What contacts of an event give: few of them by rigid.newton, a crowd by rigid.crowd.

What does not come near enough to touch is left out, and looked at again with the velocities that come of it.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from .bodies import Bodies
from .crowd import Crowd
from .events import Event
from .meeting import later
from .model import Model, Rules
from .motion import driven_on, forces, of_things
from .newton import Newton
from .touches import Touches
from .waiting import Helper

Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Motions = tuple[Values, Values]  # velocities and spins of things

SLIPS = 10  # rounds of slip, at most,
CLOSE = 0.02  # c_0: what slips otherwise than was thought by less, times mu, is not looked at again
CROWD = 300  # contacts: more are not given to Newton's method
NEARLY = 0.01  # c_0: what velocities of a crowd may be off by,
MOST, WORK = 150, 3_000_000  # after so many iterations, at most, of few contacts so many in all
LOOKS, ROUGH = 3, 30  # looks for what meets what, at most, and iterations of all but the first whole one


def crowded(met: Event) -> bool:
    """Whether these are too many contacts for Newton's method."""
    return np.count_nonzero(met.meeting.near) > CROWD


class Pushing:
    """Of the bodies of a model."""

    def __init__(self, model: Model, rules: Rules, helper: Helper | None = None) -> None:
        """`helper`: a second thread (None: there is none)."""
        self._model, self._rules, self._helper = model, rules, helper
        self._newton: Newton | None = None

    def __call__(self, met: Event, ways: Values, *, rough: bool) -> tuple[Values, Touches, bool]:
        """Forces and moments (n, 6) that contacts give, these in the axes of the bodies, N and N m; what touched; and
        whether these are the last ones: a crowd is only looked through where it may be `rough`. `ways`: (stands, 3)."""
        if not np.any(met.meeting.near):
            return np.zeros((len(met.bodies), 6)), Touches.none(), True
        if crowded(met):
            force, done = self._by_projections(met, rough=rough), not rough
        else:
            force, done = self._by_newton(met, ways), True
        rows = np.flatnonzero(met.impulse[:, 0] > 0)
        closing = np.where(met.strikes, met.meeting.closing, 0.0)
        return force, met.contacts.touches(rows, met.impulse[rows], closing), done

    def driven_on(self, met: Event, force: Values) -> Bodies:
        """The bodies of an event with the motion that forces and moments (n, 6) of a step give them."""
        return driven_on(self._model, met.bodies, force, met.stage.gravity, self._rules.step)

    def _by_newton(self, met: Event, ways: Values) -> Values:
        """Forces and moments (n, 6) of contacts by MuJoCo's solver.

        The convex problem wants what slips at a speed s to part at mu s, which would throw up what spins: contacts may
        come by as much nearer, mu s dt, with s as it comes out (see rigid.crowd). What is given too much of it sinks
        in by the difference, at every step in which it slides.
        """
        dt, contacts, kept, model = self._rules.step, met.contacts, met.near, self._model
        rates, newton = met.course.rates, self._newton or Newton(model, self._rules)
        self._newton = newton
        newton.begin(met.bodies, ways[model.driven], rates[model.driven], contacts, met.stage.gravity)
        lifts = dt * contacts.friction
        thrown = lifts * contacts.slipping(*of_things(met.bodies, rates), kept)
        for _ in range(SLIPS):
            force, each, pressed = newton.solved(met.meeting.aim + thrown, kept)
            motion = of_things(self.driven_on(met, force), rates)
            missed = self._missed(met, kept, motion)
            kept, before = kept | missed, thrown
            thrown = np.minimum(thrown, lifts * contacts.slipping(*motion, kept))
            if not np.any(missed) and np.all((before - thrown)[pressed] < CLOSE * self._rules.fast * dt):
                break
        met.impulse[:] = np.where(pressed[:, None], dt * each, 0.0)  # not what pressed in a look before
        return force

    def _by_projections(self, met: Event, *, rough: bool) -> Values:
        """As `_by_newton`, whatever there is of them, from where it was left: where it may be `rough`, to see what is
        missed."""
        dt, bodies, model, rates = self._rules.step, met.bodies, self._model, met.course.rates
        inverse = bodies.turn @ model.inverse @ np.swapaxes(bodies.turn, 1, 2)
        free = of_things(self.driven_on(met, np.zeros((len(bodies), 6))), rates)
        for number in range(1 if rough else LOOKS):
            rows = np.flatnonzero(met.near)
            some = met.contacts.chosen(rows)
            aim: Values = np.asarray(met.meeting.aim[rows] / dt)
            crowd = Crowd.of(some, some.parting(*free), aim, model.mass, inverse)
            enough = NEARLY * self._rules.fast
            most = ROUGH if rough or number else max(MOST, WORK // max(len(rows), 1))
            met.impulse[rows] = crowd.impulses(enough, most, met.impulse[rows], self._helper)
            force = forces(model, bodies, crowd.gained(met.impulse[rows]), dt)
            missed = self._missed(met, met.near, of_things(self.driven_on(met, force), rates))
            met.near |= missed
            if not np.any(missed):
                break
        return force

    def _missed(self, met: Event, kept: Flags, motion: Motions) -> Flags:
        """(k,) contacts beside those kept (k,) that things come to touch in with these velocities and spins."""
        rules, gap, closing = self._rules, met.meeting.gap, met.contacts.closing(*motion)
        missed: Flags = ~kept & (gap < rules.step * met.meeting.rest * closing)
        return missed if met.last else missed & ~later(gap, closing, rules.step, rules.fast)
