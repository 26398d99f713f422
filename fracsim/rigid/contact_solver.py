"""What contacts of an event give: few of them by Newton's method, a crowd by projected gradients.

What does not come near enough to touch is left out, and looked at again with the velocities that come of it.

Forces of contacts by MuJoCo's solver: a convex problem with elliptic friction cones, by Newton's method.

Its model has bodies without shapes; it is made where it is needed first, for the solver's start takes the inverse of
the mass matrix for each body, which is most of what a crowd's model would cost.

Impulses of a crowd of contacts: Coulomb's law for all of them at once.

    u = u_0 + J M^-1 J^T p,   K_mu = {|p_t| <= mu p_n},   K_mu  3  p  _|_  u + (r / dt + mu |u_t|) n

with the velocities u of the second thing beside the first after the step, u_0 of them without impulses p, and r the
distance that may be lost (G. De Saxce, Z.-Q. Feng 1991: with mu |u_t| it is Coulomb's law, without it a convex problem
that lifts what slips). It is solved by projections onto the cones,

    p  <-  P_K(q - D^-1 (u(q) + (r / dt + mu |u_t|) n)),   q = p + beta (p - p_before)

with Nesterov's beta, begun anew for the contacts of a body on which p turns back (H. Mazhar et al. 2015, ACM Trans.
Graph. 34; B. O'Donoghue, E. Candes 2015). Of a body with rows J of each contact, w = tr J M^-1 J^T,

    J M^-1 J^T <= D = sum over bodies of lambda w,   lambda the largest eigenvalue of M^-1 sum J^T J / w   (6, 6)

at most as many as it has contacts (R. Tonge et al. 2012) and mostly half of that: no step is too long, whatever bodies
weigh. lambda^64 is taken for the trace of the 64th power, at most 6 times as much, which is 3 % of lambda. Only
contacts that press, or that things would go through, are solved for: of what lies near in a heap fewer than half press.
Which these are is looked at again after LOOK, 2 LOOK, 4 LOOK iterations. Newton's method on the convex problem needs
factors of one great matrix each time, and which of a thousand hard contacts press it finds by trial.
Gauss and Seidel's sweeps cost as much as these iterations and leave up to four times the error after as many.

What is done to each contact in each iteration is in projected_gradient.c, compiled where it is needed first: to one
half of the contacts and to the other, by one thread or by two.

Equations: docs/theory.md#motion-and-contact-of-rigid-bodies.
"""

from __future__ import annotations

import ctypes
from ctypes import c_double, c_int64, c_void_p
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from ..errors import NotConverged
from ..mesh.c_library import Float64, Int64, load_library, struct_pointer
from .bodies import Bodies, orientation
from .contact_law import later
from .contact_points import Contacts
from .contact_records import Touches
from .free_flight import driven_on, forces, of_things
from .impact_sequence import Event
from .mujoco_model import Model, Rules
from .worker_ranks import Helper

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
HARD = 0.9999  # impedance of contacts, which MuJoCo lets be no harder: what they give way by, in steps, is 1 - HARD
IMPEDANCE = [HARD, HARD, 1e-3, 0.5, 2.0]
TOLERANCE, ITERATIONS = 1e-10, 200  # of MuJoCo's solver, to the mean inertia, and at most
HELD = 1e6  # mass of what is driven, in masses of all bodies
MEMORY, LEAST_MEMORY = 2**18, 2**26  # bytes a body, and in all
FIELDS = ("dim", "solref", "solreffriction", "solimp", "includemargin", "efc_address", "mu", "H", "flex", "elem",
          "vert", "adhesion", "surfacevel")  # fmt: skip
STAGES = (mujoco.mj_island, mujoco.mj_projectConstraint, mujoco.mj_fwdVelocity, mujoco.mj_fwdAcceleration,
          mujoco.mj_fwdConstraint)  # fmt: skip
AT_ONCE = 60  # iterations of Newton's method: what takes more is solved with softer contacts first,
SOFTER = (100.0, 10.0, 1.0)  # times what they give way by, each from where the last came to
ISLAND = 300  # rows of an island: three times its contacts
SOURCE = Path(__file__).with_name("projected_gradient.c")
FEW = 1000  # contacts: fewer are not worth a second thread
Motions = tuple[Values, Values]  # velocities and spins of things
SLIPS = 10  # rounds of slip, at most,
CLOSE = 0.02  # c_0: what slips otherwise than was thought by less, times mu, is not looked at again
CROWD = 300  # contacts: more are not given to Newton's method
NEARLY = 0.01  # c_0: what velocities of a crowd may be off by,
MOST, WORK = 150, 3_000_000  # after so many iterations, at most, of few contacts so many in all
LOOKS, ROUGH = 3, 30  # looks for what meets what, at most, and iterations of all but the first whole one


class Newton:
    """Of the bodies of a model, and what is driven in it."""

    def __init__(self, model: Model, rules: Rules) -> None:
        n = self._count = len(model.mass)
        self._made = _dynamics(model, rules)
        self._data, self._alike = mujoco.MjData(self._made), _contact(rules)
        moving = np.concatenate([np.arange(n), n + model.driven])
        things = int(np.concatenate([model.thing, moving]).max(initial=0)) + 1
        self._geom = np.zeros(things, int)  # all that stands still is one
        self._geom[moving] = 1 + np.arange(len(moving))

    def begin(self, bodies: Bodies, ways: Values, rates: Values, contacts: Contacts, gravity: Values) -> None:
        """A step of the bodies, of what is driven at `ways` (driven, 3) at `rates` (driven, 3), and these contacts,
        with `gravity` (3,) m/s^2. Raises NotConverged where there is no room for them."""
        made, data, n = self._made, self._data, self._count
        made.opt.gravity[:] = gravity
        q, v = data.qpos.reshape(-1, 7), data.qvel.reshape(-1, 6)
        q[:n, :3], q[n:, :3] = bodies.place, ways
        q[:n, 3:], q[n:, 3:] = orientation(bodies.turn), [1.0, 0.0, 0.0, 0.0]
        v[:n, :3], v[n:, :3], v[n:, 3:] = bodies.velocity, rates, 0.0
        v[:n, 3:] = np.einsum("nji,nj->ni", bodies.turn, bodies.spin)
        for stage in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_makeM, mujoco.mj_factorM):
            stage(made, data)
        self._fill(contacts)
        data.qacc_warmstart[:] = 0.0  # or a restart would come to other digits

    def _fill(self, contacts: Contacts) -> None:
        """Contacts as MuJoCo has them: mj_addContact, one after the other, takes ten times as long."""
        data, k = self._data, len(contacts)
        data.ncon = k
        made = data.contact
        data.parena = k * made.dist.strides[0]
        if data.parena >= data.narena:
            raise NotConverged(
                f"{k} contacts are more than the rigid engine has room for; a smaller time.step or a larger mesh.h has "
                "fewer"
            )
        for name in FIELDS:
            getattr(made, name)[:] = getattr(self._alike, name)
        made.geom[:], made.pos[:] = self._geom[contacts.things], contacts.point
        made.frame[:] = contacts.axes.reshape(-1, 9)
        made.friction[:], made.friction[:, :2] = 0.0, np.maximum(contacts.friction, mujoco.mjMINMU)[:, None]

    def solved(self, aim: Values, kept: Flags) -> tuple[Values, Values, Flags]:
        """Forces and moments (n, 6) that kept (k,) contacts give, which may come nearer by aims (k,) m, these in the
        axes of the bodies, N and N m; the forces (k, 3) of contacts along their axes, N; and which (k,) press.

        Which of many contacts press Newton's method finds by trial: it flips some at every iteration. Where it has not
        found them after many, soft ones, taken first, tell it sooner, and each harder set takes a dozen. A later look
        begins where the last one came to, and is mostly done at once.
        """
        data = self._data
        data.contact.dist[:], data.contact.exclude[:] = aim, ~kept
        self._press(1.0, AT_ONCE)
        if not self._simple():
            for softer in SOFTER:
                self._press(softer, ITERATIONS)
        pressed = kept & (data.efc_force[data.contact.efc_address] > 0)
        rows, each = np.flatnonzero(pressed), np.zeros((len(kept), 3))
        each[rows] = data.efc_force[data.contact.efc_address[rows, None] + np.arange(3)]
        return data.qfrc_constraint.reshape(-1, 6)[: self._count].copy(), each, pressed

    def _press(self, softer: float, most: int) -> None:
        """Solve, in so many iterations from the last solution on, with contacts that give way by so many times more."""
        made, data = self._made, self._data
        made.opt.iterations = most
        mujoco.mj_makeConstraint(made, data)
        if softer > 1:
            data.efc_R[:] *= softer
            data.efc_D[:] /= softer
        for stage in STAGES:
            stage(made, data)
        data.qacc_warmstart[:] = data.qacc

    def _simple(self) -> bool:
        """Whether what was solved at once has been solved; MuJoCo counts iterations of the first twenty islands."""
        data, many = self._data, self._data.nisland
        if not many or data.island_nefc[:many].max() < ISLAND:
            return bool(data.solver_niter[: max(many, 1)].max() < AT_ONCE)
        return many <= len(data.solver_niter) and bool(data.solver_niter[:many].max() < AT_ONCE)


def _dynamics(model: Model, rules: Rules) -> Any:
    """MuJoCo's model of bodies without shapes: a geom each, for contacts to name them by, and one of all that stands
    still, the first."""
    spec, driven = mujoco.MjSpec(), len(model.driven)
    option = spec.option
    option.timestep, option.gravity = rules.step, rules.gravity
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.tolerance, option.iterations = TOLERANCE / (HELD if driven else 1.0), ITERATIONS  # of what is not driven
    spec.compiler.balanceinertia = True  # of a sliver, which round-off has made flatter than flat
    spec.memory = max(LEAST_MEMORY, MEMORY * (len(model.mass) + driven))
    _name(spec.worldbody)
    for mass, inertia in zip(model.mass, [*model.inertia], strict=True):
        _free(spec, float(mass), inertia)
    heavy = HELD * max(float(model.mass.sum()), 1e-9)
    for _ in range(driven):
        _free(spec, heavy, heavy * np.eye(3), weightless=True)
    return spec.compile()


def _free(spec: Any, mass: float, inertia: Values, weightless: bool = False) -> None:
    """A body that nothing holds, about its centre of mass."""
    body = spec.worldbody.add_body()
    body.add_freejoint()
    body.explicitinertial, body.mass, body.ipos = True, mass, np.zeros(3)
    body.fullinertia = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    body.gravcomp = 1.0 if weightless else 0.0
    _name(body)


def _name(body: Any) -> None:
    """What contacts call a body by: a geom that meets nothing."""
    geom = body.add_geom()
    geom.type, geom.size = mujoco.mjtGeom.mjGEOM_SPHERE, np.ones(3)
    geom.contype = geom.conaffinity = 0


def _contact(rules: Rules) -> Any:
    """A contact as MuJoCo has them, but for what it touches and where: accelerations -(c + r / dt) / dt."""
    made = mujoco.MjContact()
    made.dim, made.flex, made.elem, made.vert = 3, [-1, -1], [-1, -1], [-1, -1]
    made.solref, made.solimp = [-HARD / rules.step**2, -HARD / rules.step], IMPEDANCE
    return made


class _Crowd(ctypes.Structure):
    """As projected_gradient.c has it."""

    _fields_ = (("count", c_int64), ("bodies", c_int64), ("contact", Float64),
                ("things", Int64), ("mass", Float64), ("inertia", Float64))  # fmt: skip


@dataclass(frozen=True)
class Crowd:
    """k contacts of n bodies.

    Attributes:
        contacts: (k, 19) axes, arms of the two things, u_0 with r / dt, friction.    things: (k, 2), n of all that
        stands.    mass: (n,) 1 / kg, inverse.    inertia: (n, 3, 3) likewise, in the axes of space.
    """

    contacts: Values
    things: Ints
    mass: Values
    inertia: Values

    @classmethod
    def of(cls, contacts: Contacts, free: Values, aim: Values, mass: Values, inverse: Values) -> Crowd:
        """Of contacts of bodies with masses (n,) kg and inverse inertia (n, 3, 3) in the axes of space; `free`: (k, 3)
        m/s, u_0; `aim`: (k,) m/s, r / dt."""
        count = len(contacts)
        rows: Values = np.empty((count, 19))
        rows[:, :9], rows[:, 15:18], rows[:, 18] = contacts.axes.reshape(count, 9), free, contacts.friction
        rows[:, 9:15] = contacts.arms.reshape(count, 6)
        rows[:, 15] += aim
        things = np.ascontiguousarray(np.minimum(contacts.things, len(mass)))
        return cls(rows, things, 1 / mass, np.ascontiguousarray(inverse))

    def impulses(self, enough: float, most: int, start: Values, helper: Helper | None = None) -> Values:
        """(k, 3) N s that second things receive, along the axes of the contacts; `enough`: m/s that velocities may be
        off by; `most`: of iterations; `start`: (k, 3) N s from where to go on; `helper`: a second thread, with which
        all comes out the same to the last digit."""
        p, loops = np.array(start, order="C"), _loops()
        now = c_void_p(loops.begun(self._given, c_double(enough), c_int64(most), p))
        if not now:
            raise MemoryError(f"no room for {len(p)} contacts")
        if helper is not None and len(p) >= FEW:
            helper.both(lambda: loops.impulses(now), lambda: loops.help(now))
        else:
            loops.impulses(now)
        loops.finished(now)
        return p

    def gained(self, impulses: Values) -> Values:
        """(n, 6) velocities and spins that impulses (k, 3) give."""
        level: Values = np.empty((len(self.mass) + 1, 6))
        load_library(SOURCE).gained(self._given, np.ascontiguousarray(impulses), level)
        return level[:-1]

    def bound(self) -> Values:
        """(k,) D."""
        d: Values = np.empty(len(self.contacts))
        if load_library(SOURCE).bound(self._given, d):
            raise MemoryError(f"no room for {len(d)} contacts")
        return d

    @cached_property
    def _given(self) -> Any:
        """For C; the arrays are this crowd's, and stay as long as it."""
        arrays = map(struct_pointer, (self.contacts, self.things, self.mass, self.inertia))
        return ctypes.byref(_Crowd(len(self.contacts), len(self.mass), *arrays))


def _loops() -> ctypes.CDLL:
    """The functions of projected_gradient.c, one of which tells where something is."""
    return load_library(SOURCE)


def projected(p: Values, mu: Values) -> Values:
    """(k, 3) the nearest of each cone |p_t| <= mu p_n."""
    near = np.array(p, order="C")
    load_library(SOURCE).projected(c_int64(len(mu)), near, mu)
    return near


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
        come by as much nearer, mu s dt, with s as it comes out (see rigid.contact_solver). What is given too much of it
        sinks in by the difference, at every step in which it slides.
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
