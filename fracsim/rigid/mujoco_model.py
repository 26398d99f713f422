"""Scene as MuJoCo's collision detection has it: bodies as unions of convex parts, and obstacles."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntFlag
from functools import cached_property
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from .bodies import Bodies, quaternions
from .cylinder_contact import CylinderContacts
from .obstacles import Part, PrescribedObstacle, PrimitiveShape
from .plane_contacts import PlaneContacts

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class ModelSettings:
    """Numbers of the model.

    Attributes:
        min_mass: kg, and kg m^2 of the inertia; MuJoCo refuses smaller values.
        slab_size: half the side of the box that stands for a driven plane, in sizes of the scene. MuJoCo's planes are
            fixed.
        bytes_per_part: memory for pairs of parts that may touch, as a search begins.
        max_counted_parts: parts of a body that count for this memory; of a shell with many parts few touch.
        max_bytes: largest memory; it grows up to there where contacts need it.
        growth: factor of the memory where it is too small.
        min_bytes: least memory for them.
        min_impact_speed: m/s; slower contacts are no impacts, whatever the step is.
    """

    min_mass: float = 1e-14
    slab_size: float = 20.0
    bytes_per_part: int = 2**18
    max_counted_parts: int = 32
    max_bytes: int = 2**33
    growth: int = 4
    min_bytes: int = 2**26
    min_impact_speed: float = 1e-3


SETTINGS = ModelSettings()


class CollisionBit(IntFlag):
    """Bits of MuJoCo's masks of what collides.

    Planes collide with primitive shapes alone, since PlaneContacts finds their contacts with hulls; cylinders with
    cylinders, and prisms in them (obstacles) with prisms; all with everything else.
    """

    PLANE = 1
    GENERAL = 2
    CYLINDER = 4
    PRISM = 8


_warned: set[str] = set()


def _print_warning(text: str) -> None:
    """Print a warning of MuJoCo once, which by itself would write a file into the working folder."""
    message = text.partition(" at DOF")[0]
    # the search for contacts (collision_detection) repeats itself with more memory
    if message not in _warned and not message.startswith("Too many contacts"):
        _warned.add(message)
        print(f"fracsim: note: MuJoCo: {message}", file=sys.stderr)


mujoco.set_mju_user_warning(_print_warning)


@dataclass(frozen=True)
class ContactParameters:
    """Time step and contact of a study.

    Attributes:
        time_step: s.
        gravity: (3,) m/s^2.
        friction: coefficient of Coulomb's friction between bodies.
        restitution: coefficient of restitution, 0 to 1.
    """

    time_step: float
    gravity: Values
    friction: float = 0.0
    restitution: float = 0.0

    @cached_property
    def impact_threshold(self) -> float:
        """c_0 = 2 g dt, m/s: bodies that approach faster are not in resting contact."""
        return max(2 * float(np.linalg.norm(self.gravity)) * self.time_step, SETTINGS.min_impact_speed)


@dataclass(frozen=True)
class MujocoModel:
    """Model for MuJoCo's collision detection, and mass properties of its bodies.

    Attributes:
        spec: MuJoCo's description of the model, of bodies that are placed and have no dynamics.
        body_of_geom: (geoms,) numbers of bodies, then of prescribed obstacles.
        first_geom: (n,) first geom of each body.
        driven: numbers of driven obstacles.
        mass: (n,) kg, none below the least one.
        inertia: (n, 3, 3) kg m^2, likewise.
        inverse_inertia: (n, 3, 3).
        extent: (n,) distance that each body reaches from its centre, m.
        planes: contacts of hulls with planes, which MuJoCo does not search for.
        cylinders: and capsules among bodies and obstacles.
    """

    spec: Any
    body_of_geom: Ints
    first_geom: Ints
    driven: Ints
    mass: Values
    inertia: Values
    inverse_inertia: Values
    extent: Values
    planes: PlaneContacts
    cylinders: CylinderContacts


def build_model(
    bodies: Bodies,
    parts: Sequence[Sequence[Part]],
    obstacles: Sequence[PrescribedObstacle],
    parameters: ContactParameters,
    hull_points: Sequence[Values] | None = None,
    rotation: Values | None = None,
) -> MujocoModel:
    """Return the model of bodies and obstacles.

    Args:
        bodies: n of them.
        parts: convex parts of each body; arrays that several bodies share become one mesh.
        obstacles: prescribed ones.
        parameters: of contact.
        hull_points: outermost points of each body, m; None: all corners of the parts.
        rotation: (n, 3, 3) from the axes of parts and points to those of the bodies at rest; None: identity.
    """
    mass, inertia = np.maximum(bodies.mass, SETTINGS.min_mass), bodies.inertia + SETTINGS.min_mass * np.eye(3)
    rotation = np.tile(np.eye(3), (len(bodies), 1, 1)) if rotation is None else rotation
    spec, moving, meshes, count = mujoco.MjSpec(), [], _Meshes(), len(bodies)
    for number, body_parts in enumerate(parts):
        body = _add_placed_body(spec)
        turn = rotation[number]
        moving += [number] * _add_parts(spec, body, body_parts, parameters.friction, meshes=meshes, rotation=turn)
    driven = [number for number, obstacle in enumerate(obstacles) if obstacle.driven]
    fixed = [number for number, obstacle in enumerate(obstacles) if not obstacle.driven]
    for number in driven:
        obstacle = obstacles[number]
        shape, offset = _movable_shape(obstacle.shape, SETTINGS.slab_size * _scene_size(bodies, parts))
        is_plane, body = obstacle.shape.kind == "plane", _add_placed_body(spec)
        geoms = _add_parts(spec, body, [shape], obstacle.friction, 1, offset, is_plane=is_plane, meshes=meshes)
        moving += [count + number] * geoms
    for number in fixed:
        obstacle = obstacles[number]
        is_plane = obstacle.shape.kind == "plane"
        _add_parts(
            spec, spec.worldbody, [obstacle.shape], obstacle.friction, 1, obstacle.position, is_plane=is_plane,
            meshes=meshes,
        )  # fmt: skip
    # MuJoCo numbers the geoms of the world, which are those of fixed obstacles, first
    first_geom = len(fixed) + np.searchsorted(moving, np.arange(count))
    body_of_geom = np.array([count + number for number in fixed] + moving, np.int64)
    points = parts
    if hull_points is not None:
        points = [[*body_parts, outer] for body_parts, outer in zip(parts, hull_points, strict=True)]
    extent = _extents(points)
    planes = _make_plane_contacts(parts, obstacles, body_of_geom, first_geom, hull_points, rotation, extent)
    counted = sum(min(len(body_parts), SETTINGS.max_counted_parts) for body_parts in parts) + len(obstacles)
    spec.memory = max(SETTINGS.min_bytes, SETTINGS.bytes_per_part * counted)
    inverse: Values = np.asarray(np.linalg.inv(inertia)) if count else inertia
    driven_numbers = np.array(driven, np.int64)
    cylinders = _find_cylinders(parts, obstacles, rotation, first_geom)
    return MujocoModel(
        spec, body_of_geom, first_geom, driven_numbers, mass, inertia, inverse, extent, planes, cylinders
    )  # fmt: skip


def _has_prism(body_parts: Sequence[Part]) -> bool:
    """Return whether a body is a cylinder with the prism in it."""
    first = body_parts[0]
    return len(body_parts) > 1 and isinstance(first, PrimitiveShape) and first.kind == "cylinder"


def _find_cylinders(
    parts: Sequence[Sequence[Part]], obstacles: Sequence[PrescribedObstacle], rotation: Values, first_geom: Ints
) -> CylinderContacts:  # fmt: skip
    """Return the cylinders and capsules among bodies and obstacles.

    Args:
        parts: of n bodies.
        obstacles: prescribed ones.
        rotation: (n, 3, 3) of the parts.
        first_geom: (n,).
    """
    n, shapes = len(parts), [obstacle.shape for obstacle in obstacles]
    turns = np.concatenate([rotation, np.tile(np.eye(3), (len(shapes), 1, 1))])
    total = n + len(shapes)
    axis: Values = np.zeros((total, 3))
    radius, half_length, is_capsule = np.zeros(total), np.zeros(total), np.zeros(total, bool)
    prism_geom = np.full(total, -1)
    for number, part in enumerate([*(body_parts[0] for body_parts in parts), *shapes]):
        if isinstance(part, PrimitiveShape) and part.kind in ("cylinder", "capsule"):
            axis[number], is_capsule[number] = turns[number] @ part.rotation[:, 2], part.kind == "capsule"
            radius[number], half_length[number], _ = part.size
    for number, body_parts in enumerate(parts):
        if _has_prism(body_parts):
            prism_geom[number] = first_geom[number] + 1
    planes = n + np.flatnonzero([shape.kind == "plane" for shape in shapes])
    return CylinderContacts(n, axis, radius, half_length, is_capsule, prism_geom, planes)


def _make_plane_contacts(
    parts: Sequence[Sequence[Part]], obstacles: Sequence[PrescribedObstacle], body_of_geom: Ints, first_geom: Ints,
    hull_points: Sequence[Values] | None, rotation: Values, extent: Values,
) -> PlaneContacts:  # fmt: skip
    """Return the planes among the obstacles, and the outermost points of bodies or all corners of their parts."""
    planes = [number for number, obstacle in enumerate(obstacles) if obstacle.shape.kind == "plane"]
    numbers = np.array(planes, np.int64)
    normal = np.array([obstacles[number].shape.rotation[:, 2] for number in numbers]).reshape(-1, 3)
    # body, geom and corners of each hull
    hulls = [
        (body, first_geom[body] + k, part)
        for body, body_parts in enumerate(parts)
        for k, part in enumerate(body_parts) if not isinstance(part, PrimitiveShape)
    ]  # fmt: skip
    if hull_points is not None:
        hulls = [
            (body, first_geom[body] + _has_prism(parts[body]), points) for body, points in enumerate(hull_points)
        ]  # fmt: skip
    corners = np.concatenate([np.empty((0, 3)), *(points for *_, points in hulls)])
    sizes = [len(points) for *_, points in hulls]
    body, geom = (np.repeat(np.array([hull[k] for hull in hulls], np.int64), sizes) for k in (0, 1))
    corners = np.einsum("kij,kj->ki", rotation[body], corners)
    plane_geom = [np.flatnonzero(body_of_geom == len(parts) + number)[0] for number in numbers]
    friction = np.array([obstacles[number].friction for number in numbers])
    is_optional = np.array([_has_prism(body_parts) for body_parts in parts], bool)
    return PlaneContacts(
        numbers, np.array(plane_geom, np.int64), normal, friction, corners, body, geom, extent, is_optional
    )  # fmt: skip


def _scene_size(bodies: Bodies, parts: Sequence[Sequence[Part]]) -> float:
    """Return the distance over which bodies are spread, with their own size, m."""
    sizes = [
        np.abs(part.extreme_points if isinstance(part, PrimitiveShape) else part).max()
        for body_parts in parts for part in body_parts
    ]  # fmt: skip
    return float(np.ptp(bodies.position, axis=0).max() + 2 * max(sizes, default=1.0))


def _extents(parts: Sequence[Sequence[Part]]) -> Values:
    """Return the distances (n,), m, that bodies reach from their centres."""
    points = [
        (body, part.extreme_points if isinstance(part, PrimitiveShape) else part)
        for body, body_parts in enumerate(parts)
        for part in body_parts
    ]
    extent = np.zeros(len(parts))
    if points:
        body = np.repeat([number for number, _ in points], [len(x) for _, x in points])
        np.maximum.at(extent, body, np.linalg.norm(np.concatenate([x for _, x in points]), axis=1))
    return extent


def _movable_shape(shape: PrimitiveShape, side: float) -> tuple[PrimitiveShape, Values]:
    """Return a shape that can be driven, and its offset (3,), m: for a plane a box behind it, half as thick as wide."""
    if shape.kind != "plane":
        return shape, np.zeros(3)
    box = PrimitiveShape("box", (side, side, side / 2), shape.rotation, side)
    return box, -side / 2 * shape.rotation[:, 2]


def _add_placed_body(spec: Any) -> Any:
    """Add a body whose position is set directly."""
    # With free joints MuJoCo would compute the inverse of the mass matrix, at a cost that grows with the square of the
    # number of bodies. Pairs of bodies without any joint are not searched for contacts.
    body = spec.worldbody.add_body()
    body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE)
    body.explicitinertial, body.mass, body.inertia = True, 1.0, np.ones(3)
    return body


class _Meshes:
    """Names of the hulls of a model, by the identity of their arrays of corners."""

    def __init__(self) -> None:
        self._names: dict[int, str] = {}

    def name(self, spec: Any, corners: Values) -> str:
        """Return the name of a hull with corners (n, 3), which is added if it is new."""
        name = self._names.get(id(corners))
        if name is None:
            mesh, name = spec.add_mesh(), f"part{len(self._names)}"
            mesh.name, mesh.uservert = name, corners.reshape(-1)
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
            self._names[id(corners)] = name
        return name


def _add_parts(
    spec: Any, body: Any, parts: Sequence[Part], friction: float, priority: int = 0, offset: Values | None = None,
    *, is_plane: bool = False, meshes: _Meshes | None = None, rotation: Values | None = None,
) -> int:  # fmt: skip
    """Add geoms to a body, rotated by `rotation` (3, 3) about its centre; return their number.

    A contact has the friction of the geom with the higher priority.
    """
    has_prism = _has_prism(parts)
    rotation = np.eye(3) if rotation is None else rotation
    quat = quaternions(rotation[None])[0]
    for part in parts:
        geom = body.add_geom()
        geom.friction, geom.priority = [friction, 0.0, 0.0], priority
        if offset is not None:
            geom.pos = offset
        if isinstance(part, PrimitiveShape) and part.friction is not None:
            geom.friction, geom.priority = [part.friction, 0.0, 0.0], 1
        if isinstance(part, PrimitiveShape) and part.corners is None:
            geom.type = getattr(mujoco.mjtGeom, f"mjGEOM_{part.kind.upper()}")
            geom.size = part.size
            geom.quat = Rotation.from_matrix(rotation @ part.rotation).as_quat(scalar_first=True)
            bits = CollisionBit.PLANE
            if not is_plane:
                bits |= CollisionBit.CYLINDER if has_prism else CollisionBit.GENERAL
        else:
            corners = part if not isinstance(part, PrimitiveShape) else part.corners
            assert meshes is not None and corners is not None
            geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, meshes.name(spec, corners)
            geom.quat, bits = quat, CollisionBit.PRISM if has_prism else CollisionBit.GENERAL
        geom.contype, geom.conaffinity = bits, bits | (0 if is_plane else CollisionBit.GENERAL)
    return len(parts)
