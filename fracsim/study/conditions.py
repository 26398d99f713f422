"""What the tables of a study say of a body with d dimensions: places, and functions of time. No DOLFINx here.

The one interpretation of [[boundary]], [load], [initial] and a fibre: `fracsim check` asks here whether they fit the
mesh, the scene builds its terms from what comes out, reports plot it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import InputError
from ..mechanics.time_functions import TabulatedFunction, TimeFunction, Values, constant_function
from ..mesh.crack_planes import CrackPlane, plane, polygon, segment
from ..mesh.selectors import Group, PointsInBox, PointsOnPlane, Selector
from ..meshes.text import AXES
from . import (
    MOTIONS,
    BoundarySettings,
    BoxSelector,
    HingeSettings,
    ObstacleSettings,
    PlaneSelector,
    Study,
    TimeSettings,
    TimeTable,
)
from .fracture import CrackSettings
from .mesh_source import check_file

Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class BoundaryCondition:
    """An entry of [[boundary]].

    Attributes:
        key: where the study has it.    kind: fix, displacement, velocity, traction, force or pressure.
        function: of time: displacement (d,) in m of the three motions, traction (d,) or pressure (1,) in Pa, force (d,)
            in N, in 2D per metre of thickness.
        components: (d,) which components a motion prescribes; none of a load.
    """

    key: str
    kind: str
    place: Selector
    function: TimeFunction
    components: Flags

    @property
    def prescribes_motion(self) -> bool:
        """Whether it prescribes a motion."""
        return self.kind in MOTIONS


@dataclass(frozen=True)
class ObstaclePlacement:
    """An entry of [[obstacle]].

    Attributes:
        geometry: arguments of its shape.    at: (d,) its reference point at t = 0, m.    moved: (d,) m of time.
    """

    name: str
    shape: str
    geometry: dict[str, Any]
    reference_point: Values
    displacement: TimeFunction | None
    friction: float
    free_motion: FreeObstacleMotion | None = None
    spin: Values | None = None  # rad/s, at which a driven one turns


@dataclass(frozen=True)
class FreeObstacleMotion:
    """What an entry of [[obstacle]] says of one that is free; d = 2 or 3, r = 1 or 3, p = d + r.

    Attributes:
        mass: kg (2D: per metre of thickness), or density: kg/m^3.
        hinge: (d,) the point that it turns about, m; None: its centre moves.
        ways: (p, k) what it may do: increments of its pose.    rate: (k,) how fast at the start, m/s and rad/s.
        gravity: (d,) m/s^2.
    """

    mass: float | None
    density: float | None
    hinge: Values | None
    pose_basis: Values
    initial_rate: Values
    gravity: Values


def boundary_conditions(study: Study, dim: int) -> list[BoundaryCondition]:
    """All entries of [[boundary]]. InputError where one does not fit the dimension, or two do not agree."""
    entries = [_condition(entry, dim, f"boundary.{i}", study.thickness) for i, entry in enumerate(study.boundary)]
    check_conflicts(entries, dim)
    return entries


def check_conflicts(entries: Sequence[BoundaryCondition], dim: int) -> None:
    """InputError where two entries prescribe the same component of the same place, or a load acts along one that is
    prescribed there and so does nothing."""
    for one, other in permutations(entries, 2):
        if one.place != other.place or not one.prescribes_motion:
            continue
        both = one.components & (other.components if other.prescribes_motion else _acts(other, dim))
        if not both.any():
            continue
        axis = AXES[int(np.argmax(both))]
        if not other.prescribes_motion:
            raise InputError(
                f"{other.key}.{other.kind} acts along {axis} on {other.place}, where {one.key} prescribes {axis}: it "
                f"would do nothing; set its {axis} to 0, or leave {axis} free"
            )
        if {one.kind, other.kind} != {"fix"}:
            raise InputError(
                f"{one.key} and {other.key} both prescribe {axis} of {one.place}: remove one of them, or give "
                f'"free" for {axis}'
            )


def _acts(load: BoundaryCondition, dim: int) -> Flags:
    """(d,) components along which a traction or a force ever acts; a pressure has none of its own."""
    if load.kind == "pressure":
        return np.zeros(dim, bool)
    assert isinstance(load.function, TabulatedFunction)
    return np.any(load.function.rows != 0, axis=0)


def _condition(entry: BoundarySettings, dim: int, key: str, thickness: float) -> BoundaryCondition:
    place, value = find_selector(entry.on, dim, f"{key}.on"), getattr(entry, entry.kind)
    function: TimeFunction
    components: Flags = np.zeros(dim, bool)
    if entry.fix is not None:
        function, components = constant_function(np.zeros(dim)), _named(entry.fix, dim, key)
    else:
        function = table = time_function(value, f"{key}.{entry.kind}", 1 if entry.kind == "pressure" else dim)
        if entry.kind in MOTIONS:
            components = ~np.isnan(table.rows[0])
        if entry.kind == "velocity":
            function = table.integral
        if entry.kind == "force":
            function = TabulatedFunction(table.times, np.asarray(table.rows / thickness))
    return BoundaryCondition(key, entry.kind, place, function, components)


def _named(axes: str, dim: int, key: str, word: str = "fix") -> Flags:
    """(d,) the components that `fix` names."""
    if beyond := set(axes) - set(AXES[:dim]):
        raise InputError(f'{key}.{word} = "{axes}": a {dim}D mesh has no {min(beyond)}')
    return np.array([axis in axes for axis in AXES[:dim]])


def find_selector(where: str | BoxSelector | PlaneSelector, dim: int, key: str) -> Selector:
    """A place of the study. InputError where its vectors do not fit the dimension, or a normal is zero."""
    if isinstance(where, str):
        return Group(where)
    if isinstance(where, BoxSelector):
        lower, upper = (_vector(corner, dim, f"{key}.box") for corner in where.box)
        return PointsInBox(lower, upper)
    normal, point = (_vector(getattr(where, name), dim, f"{key}.{name}") for name in ("normal", "point"))
    try:
        return PointsOnPlane(point, normal, where.within)
    except InputError as error:
        raise InputError(f"{key}.{error}") from None


def _vector(values: Sequence[float], dim: int, key: str) -> tuple[float, ...]:
    return tuple(float(value) for value in check_size(values, dim, key))


def volume_loads(study: Study, dim: int) -> dict[str, TimeFunction]:
    """gravity (d,) in m/s^2 and body_force (d,) in N/m^3, as far as [load] has them."""
    given = {} if study.load is None else {key: getattr(study.load, key) for key in ("gravity", "body_force")}
    return {key: time_function(value, f"load.{key}", dim) for key, value in given.items() if value is not None}


def obstacle_placements(study: Study, dim: int) -> list[ObstaclePlacement]:
    """All entries of [[obstacle]]. InputError where one does not fit the dimension."""
    load = volume_loads(study, dim)
    gravity = load["gravity"](0.0) if "gravity" in load else np.zeros(dim)
    entries = enumerate(study.obstacle)
    return [_placing(entry, dim, f"obstacle.{i}", gravity, study.thickness) for i, entry in entries]


def _placing(entry: ObstacleSettings, dim: int, key: str, gravity: Values, thickness: float) -> ObstaclePlacement:
    given = entry.geometry
    for name in {"normal", "axis", "size"} & set(given):
        given[name] = _vector(given[name], dim, f"{key}.{name}")
    if "normal" in given:
        given["direction"] = given.pop("normal")
    if entry.shape == "plane":
        given.pop("hollow", None)
    elif entry.shape == "sphere":
        given["dim"] = dim
    elif entry.shape == "cylinder" and dim == 2:
        raise InputError(f'{key}.shape = "cylinder": a 2D mesh has none; choose "sphere", which is a disk there')
    elif entry.shape == "mesh":
        _check_file(entry, dim, key)
    moved: TimeFunction | None = None
    if entry.displacement is not None:
        moved = time_function(entry.displacement, f"{key}.displacement", dim)
    elif entry.velocity is not None and not entry.is_free:
        moved = time_function(entry.velocity, f"{key}.velocity", dim).integral
    loose = _loose(entry, dim, key, gravity, thickness) if entry.is_free else None
    at, turns = check_size(entry.at, dim, f"{key}.at"), entry.spin is not None and not entry.is_free
    spin = check_size(entry.spin, 3, f"{key}.spin") if turns and entry.spin is not None else None
    return ObstaclePlacement(entry.name, entry.shape, given, at, moved, entry.friction, loose, spin)


def _check_file(entry: ObstacleSettings, dim: int, key: str) -> None:
    if dim == 2:
        raise InputError(f'{key}.shape = "mesh": a 2D mesh has none; choose "box", "sphere", "capsule" or "plane"')
    assert entry.file is not None  # the schema sees to it
    check_file(entry.file, f"{key}.file")


def _loose(entry: ObstacleSettings, dim: int, key: str, gravity: Values, thickness: float) -> FreeObstacleMotion:
    """What is free of an entry, and how it starts."""
    turns = 1 if dim == 2 else 3
    velocity = np.zeros(dim) if entry.velocity is None else check_size(entry.velocity, dim, f"{key}.velocity")  # type: ignore[arg-type]
    ways, hinge = np.eye(dim + turns), None
    spin = [0.0] * (turns if entry.hinge is None else 1) if entry.spin is None else entry.spin
    if entry.hinge is not None:
        hinge = check_size(entry.hinge.point, dim, f"{key}.hinge.point")
        ways, turns = _about(entry.hinge, dim, f"{key}.hinge.axis"), 1
    rate = np.concatenate([velocity, check_size(spin, turns, f"{key}.spin")])
    if entry.hinge is not None:
        rate = rate[dim:]
    elif entry.guide is not None:
        along = _named(entry.guide, dim, key, "guide")
        if np.any(velocity[~along]):
            raise InputError(f"{key}.velocity = {velocity.tolist()}: it moves along {entry.guide} alone")
        ways, rate = ways[:, :dim][:, along], velocity[along]
    mass = None if entry.mass is None else entry.mass / thickness
    return FreeObstacleMotion(mass, entry.density, hinge, ways, rate, gravity)


def _about(hinge: HingeSettings, dim: int, key: str) -> Values:
    """(p, 1) increment of the pose about a hinge."""
    if dim == 2:
        if hinge.axis is not None:
            raise InputError(f"{key} = {hinge.axis}: in 2D bodies turn in the plane; remove axis")
        return np.array([[0.0], [0.0], [1.0]])
    if hinge.axis is None:
        raise InputError(f"{key} is missing: in 3D a hinge has a point and an axis")
    axis = check_size(hinge.axis, dim, key)
    length = float(np.linalg.norm(axis))
    if not length > 0:
        raise InputError(f"{key} = {hinge.axis} is no direction: give 3 numbers that are not all zero")
    return np.concatenate([np.zeros(3), axis / length])[:, None]


def initial_motion(study: Study, dim: int) -> tuple[Values | None, Values | None] | None:
    """Velocity (d,) in m/s and spin in rad/s (one number in 2D) of [initial]; None without the table."""
    initial = study.initial
    if initial is None:
        return None
    velocity = None if initial.velocity is None else check_size(initial.velocity, dim, "initial.velocity")
    spin = None if initial.spin is None else check_size(initial.spin, 1 if dim == 2 else 3, "initial.spin")
    return velocity, spin


def initial_cracks(study: Study, dim: int) -> list[CrackPlane]:
    """[[crack]] of a body with d dimensions. InputError where they are of another, or have no extent."""
    return [_crack(entry, f"crack.{i}", dim) for i, entry in enumerate(study.crack)]


def _crack(entry: CrackSettings, key: str, dim: int) -> CrackPlane:
    if entry.plane is not None:
        point = check_size(entry.plane.point, dim, f"{key}.plane.point")
        return plane(key, point, check_size(entry.plane.normal, dim, f"{key}.plane.normal"))
    if entry.segment is not None:
        if dim == 3:
            raise InputError(f"{key}.segment is for 2D meshes; this one has 3 dimensions: give a polygon or a plane")
        return segment(key, np.array([check_size(end, dim, f"{key}.segment") for end in entry.segment]))
    assert entry.polygon is not None
    if dim == 2:
        raise InputError(f"{key}.polygon is for 3D meshes; this one has 2 dimensions: give a segment or a plane")
    return polygon(key, np.array([check_size(corner, dim, f"{key}.polygon") for corner in entry.polygon]))


def fibre_direction(study: Study, dim: int) -> Values | None:
    """(d,) of [fracture.fibre]; None without the table."""
    fibre = study.fracture.fibre if study.fracture is not None else None
    return None if fibre is None else check_size(fibre.direction, dim, "fracture.fibre.direction")


def step_size_function(timing: TimeSettings) -> TabulatedFunction | None:
    """The longest step, s, at a time; None where it is the same all the time."""
    return time_function(timing.step, "time.step", 1) if isinstance(timing.step, TimeTable) else None


def time_function(value: Any, key: str, size: int) -> TabulatedFunction:
    """A constant or a table as a function of time that returns `size` numbers; "free" becomes nan."""
    table = value if isinstance(value, TimeTable) else TimeTable(time=[0.0], value=[value])
    rows = np.array([check_size(row if isinstance(row, list) else [row], size, key) for row in table.value])
    if np.any(np.isnan(rows) != np.isnan(rows[0])):
        raise InputError(f'{key}: a component that is "free" at one time must be free at all of them')
    return TabulatedFunction(np.asarray(table.time), rows)


def check_size(values: Sequence[Any], size: int, key: str) -> Values:
    """A constant vector; InputError where it does not fit the dimension of the mesh. "free" becomes nan."""
    if len(values) != size:
        raise InputError(f"{key} = {values}: this mesh needs {size} number{'s'[: size != 1]}")
    return np.array([np.nan if value == "free" else float(value) for value in values])
