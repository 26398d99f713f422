"""The model of a scene that MuJoCo finds contacts in: bodies of convex parts, and what stands in their way.

Contacts of hulls with planes: every corner that may come as far.

MuJoCo finds three places of a hull at most. A shard that turns fast falls through a floor with a fourth. Which corners
may come as far is told by how bodies move as a step begins: what something strikes comes down with others, and is
looked at once more with these.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from ..contact.shape_base import frame_about
from .bodies import Bodies, orientation
from .obstacle_shapes import Primitive

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
SURELY, SLACK = 1.5, 0.25  # times what a corner comes in a step, and of what its body may: it is looked at
NEAREST = 6  # corners of a body that are looked at in any case
SECTORS, LOWEST, WIDEST = 8, 2, 1  # of a body around its centre: corners that may touch in each, lowest and outermost
_warned: set[str] = set()
Part = Values | Primitive  # corners (n, 3) of a hull about the body's centre, in its axes at rest, m; or a shape
LEAST_MASS = 1e-14  # kg, and kg m^2 about any axis: the engine refuses what weighs less, and a speck may
SLAB = 20.0  # half the sides of a plane that is driven, in sizes of all that there is: the engine's planes stand still
MEMORY, LEAST_MEMORY = 2**18, 2**26  # bytes a part, and in all: pairs of parts that may touch are held at once
FLAT, OTHER = 1, 2  # bits of what meets what
SLOW = 1e-3  # m/s: what comes together slower than this strikes nothing, whatever the step


def _first(of: Ints, value: Values, many: int) -> Flags:
    """(k,) whether corners of groups (k,) are among the `many` with the least value (k,) of theirs."""
    order = np.lexsort((value, of))
    _, start, count = np.unique(of[order], return_index=True, return_counts=True)
    rank = np.empty(len(of), np.int64)
    rank[order] = np.arange(len(of)) - np.repeat(start, count)
    return np.asarray(rank < many)


def _bearing(of: Ints, arm: Values, across: Values, later: Values) -> Flags:
    """(k,) which corners of bodies (k,) at `arm` (k, 3) from their centres bear: those `later` (k,) lowest and those
    farthest out in every direction along the plane with axes (3, 3), the last one its normal; all of a body that has
    few."""
    along = arm @ across[:, 0], arm @ across[:, 1]
    sector = np.floor((np.arctan2(*along) / (2 * np.pi) + 0.5) * SECTORS).astype(np.int64)
    group = SECTORS * of + np.minimum(sector, SECTORS - 1)
    few = np.bincount(of) <= SECTORS * (LOWEST + WIDEST)
    return np.asarray(_first(group, later, LOWEST) | _first(group, -np.hypot(*along), WIDEST) | few[of])


@dataclass
class Looked:
    """(p, N) corners that were looked at in a step when it was last asked for what is near, and those that are in any
    case."""

    at: Flags
    always: Flags


@dataclass(frozen=True)
class Planes:
    """p planes, and N corners of hulls.

    Attributes:
        stand, geom: (p,) their numbers among what stands and of the engine.    normal: (p, 3) outwards.
        friction: (p,)    corners: (N, 3) about the centres of the bodies at rest, m.    of, part: (N,) body and geom.
        extent: (n,) how far each body reaches from its centre, m.
    """

    stand: Ints
    geom: Ints
    normal: Values
    friction: Values
    corners: Values
    of: Ints
    part: Ints
    extent: Values

    @cached_property
    def across(self) -> list[Values]:
        """(3, 3) axes of each, the last one its normal."""
        return [frame_about(normal) for normal in self.normal]

    def looked(self) -> Looked:
        """As a step begins: nothing has been missed in it."""
        none = np.zeros((len(self.stand), len(self.corners)), bool)
        return Looked(none, none.copy())

    def missed(self, bodies: Bodies, ways: Values, deep: float, looked: Looked) -> Flags:
        """(n,) bodies with corners that are in a plane by more than `deep`, m, and were not looked at: now they are, in
        this step, as far as they bear. `bodies`, `ways`: (stands, 3) where things are after it."""
        found = np.zeros(len(bodies), bool)
        for number, (stand, normal) in enumerate(zip(self.stand, [*self.normal], strict=True)):
            near, gap = self._around(bodies, ways[stand], normal, np.zeros(len(bodies)))
            rows = np.flatnonzero((gap < -deep) & ~looked.at[number, near])
            if len(rows):
                of = self.of[near[rows]]
                bears = _bearing(of, self._arms(bodies, near[rows]), self.across[number], gap[rows])
                looked.always[number, near[rows[bears]]] = found[of] = True
        return found

    def _around(
        self, bodies: Bodies, way: Values, normal: Values, reach: Values, only: Flags | None = None
    ) -> tuple[Ints, Values]:
        """Corners (k,) of bodies that come near a plane with a normal (3,) through a point (3,), and how far from it
        they are (k,), m; `reach`: (n,) how far each and the plane come, m; `only`: (n,) of these bodies."""
        height, across = (bodies.place - way) @ normal, np.einsum("nij,i->nj", bodies.turn, normal)
        low = height < self.extent + reach
        near = np.flatnonzero((low if only is None else low & only)[self.of])
        of = self.of[near]
        return near, np.einsum("kj,kj->k", across[of], self.corners[near]) + height[of]

    def _arms(self, bodies: Bodies, corners: Ints) -> Values:
        """(k, 3) corners (k,) beside the centres of their bodies, m."""
        return np.asarray(np.einsum("kij,kj->ki", bodies.turn[self.of[corners]], self.corners[corners]))

    def near(
        self, bodies: Bodies, ways: Values, reach: Values, speeds: Values, step: float, looked: Looked,
        only: Flags | None = None,
    ) -> list[tuple[int, Ints, Values, Values]]:  # fmt: skip
        """Of each plane that anything is near to: its number here, the parts (k,) that are, the distances (k,) of
        corners and the points (k, 3), m. `ways`, `speeds`: (stands, 3) and (stands,) where planes are and what they
        come in a step, m; `reach`: (n,) what bodies do; `step`: s; `only`: (n,) of these bodies."""
        if not len(self.stand) or not len(self.corners):
            return []
        found = []
        for number, (stand, normal) in enumerate(zip(self.stand, [*self.normal], strict=True)):
            near, gap = self._around(bodies, ways[stand], normal, reach + speeds[stand], only)
            seen, always = looked.at[number], looked.always[number]
            seen[slice(None) if only is None else only[self.of]] = False
            rows = np.flatnonzero((gap < reach[self.of[near]] + speeds[stand]) | always[near])
            if len(rows):
                near, of, gap = near[rows], self.of[near[rows]], gap[rows]
                arms = self._arms(bodies, near)
                x = arms + bodies.place[of]
                way = -step * np.einsum("ki,i->k", bodies.velocity_at(x, of), normal)
                soon = np.flatnonzero(gap < SURELY * way + SLACK * reach[of] + speeds[stand])
                kept = _first(of, gap, NEAREST) | always[near]
                kept[soon] |= _bearing(of[soon], arms[soon], self.across[number], (gap - way)[soon])
                seen[near[kept]] = True
                points = x[kept] - gap[kept, None] / 2 * normal
                found.append((number, self.part[near[kept]], gap[kept], points))
        return found


def _warn(text: str) -> None:
    """Tell a warning of MuJoCo once; by itself it writes them into MUJOCO_LOG.TXT of the working folder."""
    known = text.partition(" at DOF")[0]
    if known not in _warned:
        _warned.add(known)
        print(f"fracsim: note: MuJoCo: {known}", file=sys.stderr)


mujoco.set_mju_user_warning(_warn)


@dataclass(frozen=True)
class Rules:
    """Of a study: `step` s, `gravity` (3,) m/s^2, `friction` of bodies with one another, `restitution` 0 to 1."""

    step: float
    gravity: Values
    friction: float = 0.0
    restitution: float = 0.0

    @cached_property
    def fast(self) -> float:
        """m/s: what comes together faster than resting contact explains, 2 g dt, strikes."""
        return max(2 * float(np.linalg.norm(self.gravity)) * self.step, SLOW)


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


@dataclass(frozen=True)
class Model:
    """As MuJoCo has it, which finds contacts in it: bodies that are put where they are, and weigh nothing.

    Attributes:
        made: MuJoCo's.    thing: (geoms,) bodies by their numbers, then what stands.    first: (n,) geom of each body.
        driven: numbers of what is driven.    mass, inertia: (n,) kg and (n, 3, 3) kg m^2 of bodies, none too light.
        inverse: (n, 3, 3) of the inertia.
        extent: (n,) how far each reaches from its centre, m.    planes: of what stands, whose contacts with hulls
        MuJoCo leaves alone.
    """

    made: Any
    thing: Ints
    first: Ints
    driven: Ints
    mass: Values
    inertia: Values
    inverse: Values
    extent: Values
    planes: Planes


def model_of(
    bodies: Bodies,
    parts: Sequence[Sequence[Part]],
    stands: Sequence[Stand],
    rules: Rules,
    outer: Sequence[Values] | None = None,
    turn: Values | None = None,
) -> Model:
    """Of bodies of these convex parts and `outer` points, turned by `turn` (n, 3, 3). What several bodies
    share is made once. MuJoCo numbers the geoms of what stands still first."""
    mass, inertia = np.maximum(bodies.mass, LEAST_MASS), bodies.inertia + LEAST_MASS * np.eye(3)
    turn = np.tile(np.eye(3), (len(bodies), 1, 1)) if turn is None else turn
    quat = orientation(turn)
    spec, things, meshes, count = mujoco.MjSpec(), [], _Meshes(), len(bodies)
    for number, each in enumerate(parts):
        things += [number] * _add_parts(spec, _placed(spec), each, rules.friction, meshes=meshes, quat=quat[number])
    driven, fixed = ([number for number, each in enumerate(stands) if each.driven == which] for which in (True, False))
    for number in driven:
        stand = stands[number]
        shape, at = _movable(stand.shape, SLAB * _spread(bodies, parts))
        flat, body = stand.shape.kind == "plane", _placed(spec)
        things += [count + number] * _add_parts(spec, body, [shape], stand.friction, 1, at, flat=flat, meshes=meshes)
    for number in fixed:
        stand = stands[number]
        flat = stand.shape.kind == "plane"
        _add_parts(spec, spec.worldbody, [stand.shape], stand.friction, 1, stand.at, flat=flat, meshes=meshes)
    first = len(fixed) + np.searchsorted(things, np.arange(count))
    thing = np.array([count + number for number in fixed] + things, np.int64)
    extent = _extents(parts if outer is None else [[*each, more] for each, more in zip(parts, outer, strict=True)])
    planes = _planes(parts, stands, thing, first, outer, turn, extent)
    spec.memory = max(LEAST_MEMORY, MEMORY * len(thing))
    inverse: Values = np.asarray(np.linalg.inv(inertia)) if count else inertia
    return Model(spec.compile(), thing, first, np.array(driven, np.int64), mass, inertia, inverse, extent, planes)


def _planes(
    parts: Sequence[Sequence[Part]], stands: Sequence[Stand], thing: Ints, first: Ints, outer: Sequence[Values] | None,
    turn: Values, extent: Values,
) -> Planes:  # fmt: skip
    """Planes among what stands, and the outermost points of bodies, of the first of their parts, or all corners."""
    stand = np.array([number for number, each in enumerate(stands) if each.shape.kind == "plane"], np.int64)
    normal = np.array([stands[number].shape.turn[:, 2] for number in stand]).reshape(-1, 3)
    hulls = [(number, first[number] + place, each) for number, part in enumerate(parts)
             for place, each in enumerate(part) if not isinstance(each, Primitive)]  # fmt: skip
    if outer is not None:
        hulls = [(number, first[number], each) for number, each in enumerate(outer)]
    corners = np.concatenate([np.empty((0, 3)), *(each for *_, each in hulls)])
    sizes = [len(each) for *_, each in hulls]
    of, part = (np.repeat(np.array([each[k] for each in hulls], np.int64), sizes) for k in (0, 1))
    corners = np.einsum("kij,kj->ki", turn[of], corners)
    geom = np.array([np.flatnonzero(thing == len(parts) + number)[0] for number in stand], np.int64)
    friction = np.array([stands[k].friction for k in stand])
    return Planes(stand, geom, normal, friction, corners, of, part, extent)


def _spread(bodies: Bodies, parts: Sequence[Sequence[Part]]) -> float:
    """How far bodies lie apart, with their own size, m."""
    hulls = [np.abs(each).max() for part in parts for each in part if not isinstance(each, Primitive)]
    return float(np.ptp(bodies.place, axis=0).max() + 2 * max(hulls, default=1.0))


def _extents(parts: Sequence[Sequence[Part]]) -> Values:
    """(n,) how far bodies reach from their centres, m."""
    shapes = [(number, each.span if isinstance(each, Primitive) else each)
              for number, part in enumerate(parts) for each in part]  # fmt: skip
    reach = np.zeros(len(parts))
    if shapes:
        of = np.repeat([number for number, _ in shapes], [len(each) for _, each in shapes])
        np.maximum.at(reach, of, np.linalg.norm(np.concatenate([each for _, each in shapes]), axis=1))
    return reach


def _movable(shape: Primitive, side: float) -> tuple[Primitive, Values]:
    """A shape that may be driven and where it is on its body: of a plane the slab behind it, half as thick as wide."""
    if shape.kind != "plane":
        return shape, np.zeros(3)
    return Primitive("box", (side, side, side / 2), shape.turn, side), -side / 2 * shape.turn[:, 2]


def _placed(spec: Any) -> Any:
    """A body that is put where it is. One that is free would cost MuJoCo the inverse of its mass matrix, which grows
    as their number squared; two that could not move at all would not be looked at."""
    body = spec.worldbody.add_body()
    body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE)
    body.explicitinertial, body.mass, body.inertia = True, 1.0, np.ones(3)
    return body


class _Meshes:
    """Names of the hulls that a model has, by the arrays of their corners."""

    def __init__(self) -> None:
        self._names: dict[int, str] = {}

    def name(self, spec: Any, corners: Values) -> str:
        """Of a hull with corners (n, 3), which is added where it is not there."""
        name = self._names.get(id(corners))
        if name is None:
            mesh, name = spec.add_mesh(), f"part{len(self._names)}"
            mesh.name, mesh.uservert = name, corners.reshape(-1)
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
            self._names[id(corners)] = name
        return name


def _add_parts(
    spec: Any, body: Any, parts: Sequence[Part], friction: float, priority: int = 0, at: Values | None = None,
    *, flat: bool = False, meshes: _Meshes | None = None, quat: Values | None = None,
) -> int:  # fmt: skip
    """The parts of a body, hulls turned by `quat`; returns how many. What has a priority says what friction is. What is
    `flat` meets no hulls as MuJoCo goes: those contacts are found by rigid.mujoco_model."""
    for part in parts:
        geom = body.add_geom()
        geom.friction, geom.priority = [friction, 0.0, 0.0], priority
        if at is not None:
            geom.pos = at
        if isinstance(part, Primitive) and part.friction is not None:
            geom.friction, geom.priority = [part.friction, 0.0, 0.0], 1
        if isinstance(part, Primitive) and part.corners is None:
            geom.type = getattr(mujoco.mjtGeom, f"mjGEOM_{part.kind.upper()}")
            geom.size = part.size
            geom.quat = Rotation.from_matrix(part.turn).as_quat(scalar_first=True)
            geom.contype = geom.conaffinity = FLAT if flat else FLAT | OTHER
        else:
            corners = part if not isinstance(part, Primitive) else part.corners
            assert meshes is not None and corners is not None
            geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, meshes.name(spec, corners)
            geom.contype = geom.conaffinity = OTHER
            if quat is not None:
                geom.quat = quat
    return len(parts)
