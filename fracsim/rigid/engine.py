"""The rigid-body engine: MuJoCo finds contacts and their forces, with friction; bodies fly and turn by their momentum.

    v' = v + dt (g + f / m),   x' = x + dt v',   turns: rigid.tumbling

with the contact forces f that MuJoCo finds for the start of the step (a convex problem, elliptic friction cones). Its
own way of turning bodies loses angular momentum in flight and is not used.

A contact is a spring and a dashpot that act within a few steps, whatever their size; the damping ratio z is that of a
bounce, e = exp(-pi z / sqrt(1 - z^2)). What comes fast is in the other by up to v dt when it is first felt, and bounces
the more for it, by 0.06 of its speed at most; where nothing shall bounce z = 2 leaves 0.05 of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import log, pi, sqrt
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from .bodies import Bodies
from .primitives import Primitive
from .touches import Touches
from .tumbling import tumbled

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Part = Values | Primitive  # corners (n, 3) of a hull about the body's centre, in its axes at rest, m; or a shape

RISE = 4.0  # steps: 1 / frequency of a contact that bounces
DEAD, LEAST = 2.0, 2.0  # damping ratio of what does not bounce, and its 1 / (z frequency) in steps: MuJoCo's least
IMPEDANCE = (0.95, 0.99, 1e-3, 0.5, 2.0)  # of contacts: near 1, they are hard
STICKS = 10.0  # how much harder contacts are along the surface than across it: what sticks creeps the less
HELD = 1e6  # mass of what is driven, in masses of all bodies
LEAST_MASS = 1e-14  # kg, and kg m^2 about any axis: the engine refuses what weighs less, and a speck may
SLAB = 20.0  # half the sides of a plane that is driven, in sizes of all that there is: the engine's planes stand still


@dataclass(frozen=True)
class Rules:
    """Of a study: `step` s, `gravity` (3,) m/s^2, `friction` of bodies with one another, `restitution` 0 to 1."""

    step: float
    gravity: Values
    friction: float = 0.0
    restitution: float = 0.0

    @property
    def damping(self) -> float:
        """Damping ratio z of contacts."""
        if self.restitution <= 0:
            return DEAD
        decay = -log(min(self.restitution, 0.999))
        return decay / sqrt(pi**2 + decay**2)


@dataclass(frozen=True)
class Stand:
    """Something that bodies meet and that nothing moves but its driver.

    Attributes:
        shape: about its reference point.    at: (3,) that point, m.    friction: Coulomb's coefficient with bodies.
        driven: whether it ever moves.
    """

    shape: Primitive
    at: Values
    friction: float = 0.0
    driven: bool = False


class Engine:
    """Bodies of fixed shapes, and what stands in their way. Another one is made where bodies break.

    Attributes:
        siblings: pairs of bodies, the lower first, that do not feel one another until they have been apart once.
    """

    def __init__(
        self,
        bodies: Bodies,
        parts: Sequence[Sequence[Part]],
        stands: Sequence[Stand],
        rules: Rules,
        siblings: set[tuple[int, int]] | None = None,
    ) -> None:
        """`parts`: convex parts of each body."""
        self._rules, self._count, self.siblings = rules, len(bodies), set(siblings or ())
        self._mass = np.maximum(bodies.mass, LEAST_MASS)
        self._inertia: Values = bodies.inertia + LEAST_MASS * np.eye(3)
        spec, things = _spec(rules), []
        for number, each in enumerate(parts):
            body = _free(spec, float(self._mass[number]), self._inertia[number])
            things += [number] * _add_parts(spec, body, each, rules.friction)
        heavy = HELD * max(float(bodies.mass.sum()), 1e-9)
        self._driven = [number for number, stand in enumerate(stands) if stand.driven]
        for number in self._driven:
            body, stand = _free(spec, heavy, heavy * np.eye(3), weightless=True), stands[number]
            shape, at = _movable(stand.shape, SLAB * _spread(bodies, parts))
            things += [self._count + number] * _add_parts(spec, body, [shape], stand.friction, 1, at)
        fixed = [number for number, stand in enumerate(stands) if not stand.driven]
        for number in fixed:
            stand = stands[number]
            _add_parts(spec, spec.worldbody, [stand.shape], stand.friction, 1, stand.at)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self._thing = self._things(things, fixed)
        self._way: Values = np.array([stand.at for stand in stands]).reshape(-1, 3)  # where each was last, m

    def _things(self, moving: list[int], fixed: list[int]) -> Ints:
        """(geoms,) the thing that each geom is of; geoms of the world come first."""
        return np.array([self._count + number for number in fixed] + moving, np.int64)

    def advance(self, bodies: Bodies, ways: Values | None = None) -> tuple[Bodies, Touches]:
        """The bodies a step later, and what touched; `ways`: (stands, 3) where the reference points of what stands are
        at the end of the step, m (None: where they were)."""
        rules, n, data = self._rules, self._count, self._data
        rates: Values = np.zeros_like(self._way) if ways is None else np.asarray((ways - self._way) / rules.step)
        self._place(bodies, rates)
        mujoco.mj_step1(self._model, data)
        if self.siblings:
            self._let_pass()
        mujoco.mj_step2(self._model, data)
        touches = self._touches(bodies, rates)
        force = data.qfrc_constraint.reshape(-1, 6)[:n]
        velocity = bodies.velocity + rules.step * (rules.gravity + force[:, :3] / self._mass[:, None])
        moment = np.einsum("nij,nj->ni", bodies.turn, force[:, 3:])
        turn, spin = tumbled(bodies.turn, self._inertia, bodies.spin, moment, rules.step)
        place = bodies.place + rules.step * velocity
        if ways is not None:
            self._way = ways.copy()
        return replace(bodies, place=place, velocity=velocity, turn=turn, spin=spin), touches

    def _place(self, bodies: Bodies, rates: Values) -> None:
        """Tell the engine where everything is, and how fast."""
        n, driven = self._count, self._driven
        q, v = self._data.qpos.reshape(-1, 7), self._data.qvel.reshape(-1, 6)
        q[:n, :3], q[n:, :3] = bodies.place, self._way[driven]
        q[:n, 3:] = Rotation.from_matrix(bodies.turn).as_quat(scalar_first=True) if n else 1.0
        q[n:, 3:] = [1.0, 0.0, 0.0, 0.0]
        v[:n, :3], v[n:, :3], v[n:, 3:] = bodies.velocity, rates[driven], 0.0
        v[:n, 3:] = np.einsum("nji,nj->ni", bodies.turn, bodies.spin)

    def _let_pass(self) -> None:
        """Contacts of siblings that have not been apart yet are none; those that no longer touch are apart."""
        data, contact = self._data, self._data.contact
        pair = np.sort(self._thing[contact.geom], axis=1) if data.ncon else np.empty((0, 2), np.int64)
        self.siblings &= {(int(a), int(b)) for a, b in pair[contact.dist < 0]}
        if not self.siblings:
            return
        known = np.array([a * self._count + b for a, b in self.siblings])
        passing = np.isin(pair[:, 0] * self._count + pair[:, 1], known) & (pair < self._count).all(axis=1)
        contact.exclude[passing] = 1
        mujoco.mj_makeConstraint(self._model, data)
        mujoco.mj_island(self._model, data)
        mujoco.mj_projectConstraint(self._model, data)
        mujoco.mj_fwdVelocity(self._model, data)

    def _touches(self, bodies: Bodies, rates: Values) -> Touches:
        """Contacts of the step that were felt, with what they gave."""
        contact = self._data.contact
        felt = np.flatnonzero((contact.efc_address >= 0) & (contact.exclude == 0))
        rows = contact.efc_address[felt, None] + np.arange(3)
        axes = contact.frame[felt].reshape(-1, 3, 3)
        impulse = self._rules.step * np.einsum("ki,kij->kj", self._data.efc_force[rows], axes)
        first, second = self._thing[contact.geom[felt]].reshape(-1, 2).T
        point, normal = contact.pos[felt].copy(), axes[:, 0]
        speed = self._velocity(bodies, rates, first, point) - self._velocity(bodies, rates, second, point)
        return Touches(first, second, point, normal, impulse, np.einsum("ki,ki->k", speed, normal))

    def _velocity(self, bodies: Bodies, rates: Values, thing: Ints, point: Values) -> Values:
        """(k, 3) of things at points, m/s."""
        result, moving = np.empty_like(point), thing < self._count
        result[moving] = bodies.velocity_at(point[moving], thing[moving])
        result[~moving] = rates[thing[~moving] - self._count]
        return result

    def depth(self, bodies: Bodies) -> list[tuple[int, int, float]]:
        """(thing, thing, depth in m) of what is in one another, the deepest place of each pair."""
        self._place(bodies, np.zeros_like(self._way))
        mujoco.mj_fwdPosition(self._model, self._data)
        contact = self._data.contact
        found: dict[tuple[int, int], float] = {}
        for (a, b), distance in zip(self._thing[contact.geom].reshape(-1, 2).tolist(), contact.dist, strict=True):
            key = min(a, b), max(a, b)
            found[key] = max(found.get(key, 0.0), -float(distance))
        return [(a, b, depth) for (a, b), depth in sorted(found.items()) if depth > 0]


def _spec(rules: Rules) -> Any:
    spec = mujoco.MjSpec()
    option = spec.option
    option.timestep, option.gravity = rules.step, rules.gravity
    option.cone, option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, STICKS
    option.tolerance, option.iterations = 1e-12, 200
    spec.compiler.balanceinertia = True  # of a sliver, which round-off has made flatter than flat
    spec.default.geom.solref = [max(RISE / rules.damping, LEAST) * rules.step, rules.damping]
    spec.default.geom.solimp = IMPEDANCE
    spec.default.geom.condim = 3
    return spec


def _spread(bodies: Bodies, parts: Sequence[Sequence[Part]]) -> float:
    """How far bodies lie apart, with their own size, m."""
    hulls = [np.abs(each).max() for part in parts for each in part if not isinstance(each, Primitive)]
    return float(np.ptp(bodies.place, axis=0).max() + 2 * max(hulls, default=1.0))


def _movable(shape: Primitive, side: float) -> tuple[Primitive, Values]:
    """A shape that may be driven and where it is on its body: of a plane the slab behind it, half as thick as wide."""
    if shape.kind != "plane":
        return shape, np.zeros(3)
    return Primitive("box", (side, side, side / 2), shape.turn, side), -side / 2 * shape.turn[:, 2]


def _free(spec: Any, mass: float, inertia: Values, weightless: bool = False) -> Any:
    """A body that nothing holds, about its centre of mass."""
    body = spec.worldbody.add_body()
    body.add_freejoint()
    body.explicitinertial, body.mass, body.ipos = True, mass, np.zeros(3)
    body.fullinertia = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    body.gravcomp = 1.0 if weightless else 0.0
    return body


def _add_parts(
    spec: Any, body: Any, parts: Sequence[Part], friction: float, priority: int = 0, at: Values | None = None
) -> int:
    """The parts of a body; returns how many. What has a priority says what friction is."""
    for part in parts:
        geom = body.add_geom()
        geom.friction, geom.priority = [friction, 0.0, 0.0], priority
        if at is not None:
            geom.pos = at
        if isinstance(part, Primitive):
            geom.type = getattr(mujoco.mjtGeom, f"mjGEOM_{part.kind.upper()}")
            geom.size = part.size
            geom.quat = Rotation.from_matrix(part.turn).as_quat(scalar_first=True)
        else:
            mesh = spec.add_mesh()
            mesh.name = f"part{len(spec.meshes)}"
            mesh.uservert, mesh.inertia = part.reshape(-1), mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
            geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, mesh.name
    return len(parts)
