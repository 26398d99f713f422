"""Forces of contacts by MuJoCo's solver: a convex problem with elliptic friction cones, by Newton's method.

Its model has bodies without shapes; it is made where it is needed first, for the solver's start takes the inverse of
the mass matrix for each body, which is most of what a crowd's model would cost.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from ..errors import NotConverged
from .bodies import Bodies
from .contacts import Contacts
from .model import Model, Rules
from .tumbling import orientation

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
