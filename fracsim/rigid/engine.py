"""The rigid-body engine: MuJoCo finds contacts and their forces, with friction; bodies fly and turn by their momentum.

    v' = v + dt g + J / m,   x' = x + s dt (v + s dt g / 2) + (1 - s) dt v',   l' = l + r x J,   turns: rigid.tumbling

with impulses J that MuJoCo's solver finds (a convex problem, elliptic friction cones) for the law of rigid.meeting,
where bodies are after the share s of the step that they fly for before they are struck. MuJoCo's own contacts are
springs and dashpots that let things in, and its own way of turning bodies loses angular momentum: neither is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from ..errors import NotConverged
from .bodies import Bodies
from .contacts import Contacts
from .crowd import Crowd
from .meeting import Meetings, flown, meetings
from .model import ITERATIONS, Part, Rules, Stand, model_of, plane_contact
from .siblings import Overlaps, Parting
from .touches import Touches
from .tumbling import rotated, tumbled

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

TURN = 1.0  # rad a step that contacts set a body spinning by, at most: they are of one place, and a crumb would whirl
ROUNDS = 3  # of looking for contacts, at most, where what is struck goes farther than was thought,
FARTHER = 1.5  # by as many times
SLIPS = 10  # rounds of slip, at most,
CLOSE = 0.02  # c_0: what slips otherwise than was thought by less, times mu, is not looked at again
FIELDS = ("frame", "dim", "friction", "solref", "solreffriction", "solimp", "includemargin", "exclude", "efc_address",
          "mu", "H", "flex", "elem", "vert", "adhesion", "surfacevel")  # fmt: skip
STAGES = (mujoco.mj_island, mujoco.mj_projectConstraint, mujoco.mj_fwdVelocity, mujoco.mj_fwdAcceleration,
          mujoco.mj_fwdConstraint)  # fmt: skip
AT_ONCE = 20  # iterations of Newton's method: what takes more is solved with softer contacts first,
SOFTER = (100.0, 10.0, 1.0)  # times what they give way by, each from where the last came to
CROWD = 300  # contacts: more are not given to Newton's method
ISLAND = 300  # rows of an island: three times its contacts
MOST, NEARLY = 300, 0.01  # iterations on a crowd, at most, and what velocities may be off by, c_0,
LOOKS, ROUGH = 3, 50  # after so many looks of so many iterations, at most, for what meets what


@dataclass
class _Met:
    """What comes together in a step.

    Attributes:
        start: the bodies before it.    bodies: where they are struck, after the share (n,) of it.
        contacts, meeting: k of them.    near: (k,) those that are looked at so far.
        impulse: (k, 3) of them so far, along their axes, N s.
    """

    start: Bodies
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
        self._data = mujoco.MjData(self._model.made)
        self._jammed = False  # whether contacts of this step were too many to be solved at once
        self._way: Values = np.array([stand.at for stand in stands]).reshape(-1, 3)  # where each was last, m
        planes = self._model.planes
        self._plane_contacts = [
            plane_contact(planes.normal[k], float(planes.friction[k]), rules) for k in range(len(planes.stand))
        ]
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
        self._data.qacc_warmstart[:] = 0.0  # or a restart would come to other digits
        for _ in range(ROUNDS):
            met = self._met(bodies, rates, common, reach)
            moved, touches, done = self._moved(met, rates, rough=True)
            farther = [self._reach(moved, of) for of in (common, 0.0)]
            if not any(np.any(now > FARTHER * then) for now, then in zip(farther, reach, strict=True)):
                break
            reach = [np.maximum(now, then) for now, then in zip(farther, reach, strict=True)]
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

    def _met(self, bodies: Bodies, rates: Values, common: Values, reach: Sequence[Values]) -> _Met:
        """What comes together in a step where no point of the bodies comes farther than a reach (n,) beside what moves
        with a common velocity (3,), and than another (n,) beside what stands, m and m/s."""
        dt, n, g = self._rules.step, self._count, self._rules.gravity
        start = bodies
        contacts = self._find(bodies, rates, common, reach)
        meeting, parting = self._meeting(contacts, bodies, rates)
        share = flown(meeting, contacts.things, n)
        if np.any(share):
            fallen = dt * share[:, None] * g
            flying = replace(bodies, velocity=bodies.velocity + fallen / 2)
            bodies = replace(self._flown(flying, dt * share), velocity=bodies.velocity)
            contacts = self._find(bodies, rates, common, reach)
            falling = replace(bodies, velocity=bodies.velocity + fallen)
            meeting, parting = self._meeting(contacts, falling, rates)
        self._parting = parting
        return _Met(start, bodies, share, contacts, meeting, meeting.near, np.zeros((len(contacts), 3)))

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

    # --- MuJoCo ---

    def _find(self, bodies: Bodies, rates: Values, common: Values, reach: Sequence[Values]) -> Contacts:
        """Contacts of what comes together within the step; see `_moved`."""
        model, data, n = self._model, self._data, self._count
        q, v = data.qpos.reshape(-1, 7), data.qvel.reshape(-1, 6)
        q[:n, :3], q[n:, :3] = bodies.place, self._way[model.driven]
        q[:n, 3:] = Rotation.from_matrix(bodies.turn).as_quat(scalar_first=True) if n else 1.0
        q[n:, 3:] = [1.0, 0.0, 0.0, 0.0]
        v[:n, :3], v[n:, :3], v[n:, 3:] = bodies.velocity, rates[model.driven], 0.0
        v[:n, 3:] = np.einsum("nji,nj->ni", bodies.turn, bodies.spin)
        of_thing = np.concatenate([reach[0], self._rules.step * np.linalg.norm(rates - common, axis=1)])
        model.made.geom_gap[:] = of_thing[model.thing]
        model.made.body_margin[:] = np.concatenate(
            [[of_thing[n:].max(initial=0.0)], reach[0], of_thing[n:][model.driven]]
        )
        for stage in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_collision):
            stage(model.made, data)
        self._add_planes(bodies, reach[1], self._rules.step * np.linalg.norm(rates, axis=1))
        found = data.contact
        geoms = found.geom.astype(np.int64).reshape(-1, 2)
        axes, places = found.frame.reshape(-1, 3, 3).copy(), np.concatenate([bodies.place, self._way])
        return Contacts.found(
            geoms, model.thing[geoms], found.pos.reshape(-1, 3).copy(), axes, found.dist.copy(), places
        )

    def _add_planes(self, bodies: Bodies, reach: Values, speeds: Values) -> None:
        """Contacts of hulls with planes, after those that MuJoCo finds. Raises NotConverged where there is no room."""
        planes, data = self._model.planes, self._data
        for number, parts, gaps, points in planes.near(bodies, self._way, reach, speeds, self._rules.step):
            first, alike = data.ncon, self._plane_contacts[number]
            # mj_addContact, one after the other, takes ten times as long
            data.ncon = first + len(parts)
            made = data.contact
            data.parena = data.ncon * made.dist.strides[0]
            if data.parena >= data.narena:
                raise NotConverged(
                    f"{data.ncon} contacts are more than the rigid engine has room for; a smaller time.step or a "
                    "larger mesh.h has fewer"
                )
            for name in FIELDS:
                getattr(made, name)[first:] = getattr(alike, name)
            made.dist[first:], made.pos[first:] = gaps, points
            made.geom[first:] = np.stack([np.full(len(parts), planes.geom[number]), parts], axis=1)

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
        data, n, dt, contacts = self._data, self._count, self._rules.step, met.contacts
        mujoco.mj_makeM(self._model.made, data)
        mujoco.mj_factorM(self._model.made, data)
        self._jammed, kept = False, met.near
        lifts = dt * data.contact.friction[:, 0]
        thrown = lifts * contacts.slipping(*self._motion(met.bodies, rates), kept)
        for _ in range(SLIPS):
            data.contact.dist[:], data.contact.exclude[:] = met.meeting.aim + thrown, ~kept
            self._solve()
            force = data.qfrc_constraint.reshape(-1, 6)[:n].copy()
            motion = self._motion(self._driven_on(met.bodies, force), rates)
            missed = self._missed(met, kept, motion)
            pressed = kept & (data.efc_force[data.contact.efc_address] > 0)
            kept, before = kept | missed, thrown
            thrown = np.minimum(thrown, lifts * contacts.slipping(*motion, kept))
            if not np.any(missed) and np.all((before - thrown)[pressed] < CLOSE * self._rules.fast * dt):
                break
        rows = np.flatnonzero(pressed)
        met.impulse[rows] = dt * data.efc_force[data.contact.efc_address[rows, None] + np.arange(3)]
        return force

    def _missed(self, met: _Met, kept: Flags, motion: tuple[Values, Values]) -> Flags:
        """(k,) contacts beside those kept (k,) that things come to touch in with these velocities and spins."""
        return np.asarray(~kept & (met.meeting.gap < self._rules.step * met.contacts.closing(*motion)))

    def _solve(self) -> None:
        """Forces of the contacts that are not excluded, for MuJoCo's data.

        Which of many contacts press Newton's method finds by trial: it flips some at every iteration. Soft ones, taken
        first, tell it sooner, and each harder set takes a dozen.
        """
        if not self._jammed:
            self._press(1.0, AT_ONCE)
            self._jammed = not self._simple()
        if self._jammed:
            for softer in SOFTER:
                self._press(softer, ITERATIONS)

    def _press(self, softer: float, most: int) -> None:
        """Solve, in so many iterations from the last solution on, with contacts that give way by so many times more."""
        made, data = self._model.made, self._data
        made.opt.iterations = most
        mujoco.mj_makeConstraint(made, data)
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

    def _by_projections(self, met: _Met, rates: Values, *, rough: bool) -> Values:
        """As `_by_newton`, whatever there is of them, from where it was left: where it may be `rough`, until nothing
        more is missed."""
        dt, bodies, friction = self._rules.step, met.bodies, self._data.contact.friction[:, 0]
        inverse = bodies.turn @ self._model.inverse @ np.swapaxes(bodies.turn, 1, 2)
        free = self._motion(self._driven_on(bodies, np.zeros((self._count, 6))), rates)
        for number in range(LOOKS):
            rows = np.flatnonzero(met.near)
            some = met.contacts.chosen(rows)
            crowd = Crowd.of(some, friction[rows], self._model.mass, inverse)
            aim: Values = np.asarray(met.meeting.aim[rows] / dt)
            enough, most = NEARLY * self._rules.fast, ROUGH if rough or number else MOST
            met.impulse[rows] = crowd.impulses(some.parting(*free), aim, enough, most, met.impulse[rows])
            force = self._forces(bodies, crowd.gained(met.impulse[rows]))
            missed = self._missed(met, met.near, self._motion(self._driven_on(bodies, force), rates))
            if not np.any(missed):
                break
            met.near |= missed
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
