"""Boundary conditions, loads, obstacles and cracks of a study as selectors and functions of time, for a dimension d.

`fracsim check` uses them to compare a study with its mesh, the scene to build terms, and reports to plot them. No
DOLFINx here.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from ..errors import InputError
from ..mechanics.time_functions import PlaceFunction, TabulatedFunction, TimeFunction, Values, constant_function
from ..mesh.crack_planes import CrackPlane, plane_crack, polygon_crack, segment_crack
from ..mesh.selectors import Group, PointsInBox, PointsOnPlane, Selector
from ..meshes.data import AXES
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
from .fracture import BrittleSettings, CrackSettings
from .mesh_source import check_file

Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class BoundaryCondition:
    """An entry of [[boundary]].

    Attributes:
        key: path in the study, such as `boundary.0`.
        kind: fix, displacement, velocity, traction, force or pressure.
        selector: of nodes or facets.
        function: of time: displacement (d,) in m for the three motions, traction (d,) or pressure (1,) in Pa, force
            (d,) in N, in 2D per metre of thickness.
        components: (d,) components that a motion prescribes; none for a load.
    """

    key: str
    kind: str
    selector: Selector
    function: TimeFunction | PlaceFunction
    components: Flags

    @property
    def prescribes_motion(self) -> bool:
        """True for the kinds fix, displacement and velocity."""
        return self.kind in MOTIONS


@dataclass(frozen=True)
class ObstaclePlacement:
    """An entry of [[obstacle]].

    Attributes:
        name, shape: as in the study.
        geometry: arguments of the shape.
        reference_point: (d,) at t = 0, m.
        displacement: function of time, (d,) in m; None for a fixed or free obstacle.
        friction: Coulomb's coefficient.
        free_motion: of a free obstacle.
        spin: (3,) angular velocity of a fixed or driven obstacle from a file, rad/s.
    """

    name: str
    shape: str
    geometry: dict[str, Any]
    reference_point: Values
    displacement: TimeFunction | None
    friction: float
    free_motion: FreeObstacleMotion | None = None
    spin: Values | None = None


@dataclass(frozen=True)
class FreeObstacleMotion:
    """Mass, constraints and initial motion of a free obstacle; d = 2 or 3, r = 1 or 3, p = d + r.

    Attributes:
        mass: kg (2D: per metre of thickness); None with a density.
        density: kg/m^3; None with a mass.
        hinge: (d,) point of rotation, m; None if the centre moves.
        pose_basis: (p, k) basis of the admissible increments of the pose.
        initial_rate: (k,) rates of these at the start, m/s and rad/s.
        gravity: (d,) m/s^2.
    """

    mass: float | None
    density: float | None
    hinge: Values | None
    pose_basis: Values
    initial_rate: Values
    gravity: Values


def boundary_conditions(study: Study, dim: int, functions: Sequence[Mapping[str, Any]] = ()) -> list[BoundaryCondition]:
    """Returns all entries of [[boundary]], then those with functions of the user.

    Args:
        study: the study.
        dim: dimension of the mesh.
        functions: entries `on`, one of displacement, traction, force and pressure, and for a displacement `components`.

    Raises:
        InputError: if an entry does not fit the dimension, or two contradict each other.
    """
    entries = [_condition(entry, dim, f"boundary.{i}", study.thickness) for i, entry in enumerate(study.boundary)]
    entries += [_user_condition(entry, dim, number, study) for number, entry in enumerate(functions)]
    check_conflicts(entries, dim)
    return entries


def check_conflicts(entries: Sequence[BoundaryCondition], dim: int) -> None:
    """Check that entries on the same selector do not contradict each other.

    Raises:
        InputError: if two motions prescribe the same component, or a load acts along a prescribed component, where it
            has no effect.
    """
    for motion, second in permutations(entries, 2):
        if motion.selector != second.selector or not motion.prescribes_motion:
            continue
        common = motion.components & (second.components if second.prescribes_motion else loaded_components(second, dim))
        if not common.any():
            continue
        axis = AXES[int(np.argmax(common))]
        if not second.prescribes_motion:
            raise InputError(
                f"{second.key}.{second.kind} acts along {axis} on {second.selector}, where {motion.key} prescribes "
                f"{axis}: it would do nothing; set its {axis} to 0, or leave {axis} free"
            )
        if {motion.kind, second.kind} != {"fix"}:
            raise InputError(
                f"{motion.key} and {second.key} both prescribe {axis} of {motion.selector}: remove one of them, or "
                f'give "free" for {axis}'
            )


def loaded_components(load: BoundaryCondition, dim: int) -> Flags:
    """Components (d,) along which a traction or force acts at any time; none for a pressure or a user's function."""
    if not isinstance(load.function, TabulatedFunction) or load.kind == "pressure":
        return np.zeros(dim, bool)
    return np.any(load.function.rows != 0, axis=0)


def _condition(entry: BoundarySettings, dim: int, key: str, thickness: float) -> BoundaryCondition:
    selector, value = find_selector(entry.on, dim, f"{key}.on"), getattr(entry, entry.kind)
    function: TimeFunction
    components: Flags = np.zeros(dim, bool)
    if entry.fix is not None:
        function, components = constant_function(np.zeros(dim)), _named(entry.fix, dim, key)
    else:
        function = table = time_function(value, f"{key}.{entry.kind}", 1 if entry.kind == "pressure" else dim)
        # "free" is nan: such a component is not prescribed
        if entry.kind in MOTIONS:
            components = ~np.isnan(table.rows[0])
        # a prescribed velocity is integrated exactly
        if entry.kind == "velocity":
            function = table.integral
        # forces of 2D bodies are per metre of thickness in the balance
        if entry.kind == "force":
            function = TabulatedFunction(table.times, np.asarray(table.rows / thickness))
    return BoundaryCondition(key, entry.kind, selector, function, components)


USER_CONDITIONS = ("displacement", "traction", "force", "pressure")


def _user_condition(entry: Mapping[str, Any], dim: int, number: int, study: Study) -> BoundaryCondition:
    """Returns a boundary condition whose value is a function of t (s), or of t and x (n, d), m."""
    key = f"boundary[{number}] (given in Python)"
    kinds = sorted(entry.keys() - {"on", "components"})
    if len(kinds) != 1 or kinds[0] not in USER_CONDITIONS or "on" not in entry or not callable(entry[kinds[0]]):
        raise InputError(
            f"{key} has {', '.join(entry)}: give on, and one of {', '.join(USER_CONDITIONS)} with a function of t, or "
            'of t and x, as in {"on": "right", "displacement": lambda t: [0.1 * t, 0.0]}'
        )
    kind, function = kinds[0], entry[kinds[0]]
    if "components" in entry and kind != "displacement":
        raise InputError(f"{key}: components are those of a displacement; {kind} has all of them: remove components")
    try:
        on = BoundarySettings.model_validate({"on": entry["on"], "fix": "x"}).on
    except ValidationError:
        raise InputError(f"{key}: on = {entry['on']!r} is no group, box or plane: {{'on': 'right'}}") from None
    components = _named(entry.get("components", AXES[:dim]), dim, key, "components")
    has_place, size = len(inspect.signature(function).parameters) > 1, 1 if kind == "pressure" else dim
    if has_place and kind == "force":
        raise InputError(f"{key}: a force is a resultant, which has no place: give a traction as a function of t and x")
    checked = _checked_function(function, size, f"{key}: {kind}")
    if not has_place:
        for t in (0.0, study.time.end):
            checked(t)
    share = 1 / study.thickness if kind == "force" else 1.0
    value = PlaceFunction(checked) if has_place else (lambda t: share * checked(t))
    prescribed = components if kind == "displacement" else np.zeros(dim, bool)
    return BoundaryCondition(key, kind, find_selector(on, dim, f"{key}.on"), value, prescribed)


def _checked_function(function: Callable[..., Any], size: int, what: str) -> Callable[..., Values]:
    """Returns a function of the user of t, or of t and n places, that raises InputError at values it cannot have.

    Args:
        function: returns `size` numbers, for each of the places if it has them.
        size: number of components.
        what: key and kind of the condition, for messages.
    """

    def values_at(t: float, *places: Values) -> Values:
        count = size * len(places[0]) if places else size
        try:
            values = np.asarray(function(t, *places), float).reshape(-1)
        except (TypeError, ValueError) as error:
            raise InputError(f"{what} at t = {t:g} s is no vector of numbers: {error}") from error
        if len(values) != count:
            needed = f"{size} for each of {len(places[0])} places" if places else str(size)
            raise InputError(
                f"{what} at t = {t:g} s has {len(values)} number{'s' * (len(values) != 1)}; {needed} needed"
            )
        if not np.isfinite(values).all():
            raise InputError(f"{what} at t = {t:g} s is {values[~np.isfinite(values)][0]:g}; finite numbers needed")
        return values

    return values_at


def _named(axes: str, dim: int, key: str, word: str = "fix") -> Flags:
    """Returns which components the letters of `fix` or `guide` name, (d,)."""
    if missing := set(axes) - set(AXES[:dim]):
        raise InputError(f'{key}.{word} = "{axes}": a {dim}D mesh has no {min(missing)}')
    return np.array([axis in axes for axis in AXES[:dim]])


def find_selector(where: str | BoxSelector | PlaneSelector, dim: int, key: str) -> Selector:
    """Returns the group, box or plane that a study selects.

    Raises:
        InputError: if a vector does not fit the dimension, or a normal is zero.
    """
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
    """Returns functions of time by name: gravity (d,) in m/s^2 and body_force (d,) in N/m^3, if [load] has them."""
    values = {} if study.load is None else {name: getattr(study.load, name) for name in ("gravity", "body_force")}
    return {name: time_function(value, f"load.{name}", dim) for name, value in values.items() if value is not None}


def tabulated_conditions(study: Study, dim: int) -> dict[str, tuple[Values, TimeFunction]]:
    """Returns times (n,), s, and the function of each table over time of a load or a motion, by its key.

    That of a velocity is the displacement, its integral.
    """
    of_boundary = [(f"boundary.{i}.{entry.kind}", getattr(entry, entry.kind)) for i, entry in enumerate(study.boundary)]
    of_load = [] if study.load is None else [("load.body_force", study.load.body_force)]
    of_obstacles = [
        (f"obstacle.{i}.{name}", getattr(entry, name))
        for i, entry in enumerate(study.obstacle)
        for name in ("displacement", "velocity")
    ]
    result: dict[str, tuple[Values, TimeFunction]] = {}
    for key, value in [*of_boundary, *of_load, *of_obstacles]:
        if isinstance(value, TimeTable):
            table = time_function(value, key, 1 if key.endswith("pressure") else dim)
            prescribed = TabulatedFunction(table.times, np.nan_to_num(table.rows))
            result[key] = table.times, prescribed.integral if key.endswith("velocity") else prescribed
    return result


def condition_notes(study: Study, dim: int) -> list[str]:
    """Sentences on tables that begin after the end of the run, and on displacements that jump at its start."""
    end = study.time.end
    notes = [
        f"{key}: its table begins at t = {times[0]:g} s, and the run ends at {end:g} s: only its first value acts"
        for key, (times, _) in tabulated_conditions(study, dim).items()
        if len(times) > 1 and times[0] >= end
    ]
    if not study.time.scheme_class.inertia:
        return notes
    for i, entry in enumerate(study.boundary):
        if entry.kind != "displacement":
            continue
        function = time_function(entry.displacement, f"boundary.{i}.displacement", dim)
        if (jump := float(np.abs(np.nan_to_num(function(0.0))).max())) > 0:
            notes.append(
                f"boundary.{i}.displacement is {jump:g} m at t = 0: its nodes jump there in the first step, which is "
                "an impact; let it grow from 0, as in { time = [0, 0.1], value = [[0, 0, 0], [0.02, 0, 0]] }"
            )
    return notes


def obstacle_placements(study: Study, dim: int) -> list[ObstaclePlacement]:
    """Returns all entries of [[obstacle]].

    Raises:
        InputError: if an entry does not fit the dimension.
    """
    load = volume_loads(study, dim)
    gravity = load["gravity"](0.0) if "gravity" in load else np.zeros(dim)
    entries = enumerate(study.obstacle)
    return [_placement(entry, dim, f"obstacle.{i}", gravity, study.thickness) for i, entry in entries]


def _placement(entry: ObstacleSettings, dim: int, key: str, gravity: Values, thickness: float) -> ObstaclePlacement:
    geometry = entry.geometry
    for name in {"normal", "axis", "size"} & set(geometry):
        geometry[name] = _vector(geometry[name], dim, f"{key}.{name}")
    if "normal" in geometry:
        geometry["direction"] = geometry.pop("normal")
    if entry.shape == "plane":
        geometry.pop("hollow", None)
    elif entry.shape == "sphere":
        geometry["dim"] = dim
    elif entry.shape == "cylinder" and dim == 2:
        raise InputError(f'{key}.shape = "cylinder": a 2D mesh has none; choose "sphere", which is a disk there')
    elif entry.shape == "mesh":
        _check_file(entry, dim, key)
    displacement: TimeFunction | None = None
    if entry.displacement is not None:
        displacement = time_function(entry.displacement, f"{key}.displacement", dim)
    elif entry.velocity is not None and not entry.is_free:
        displacement = time_function(entry.velocity, f"{key}.velocity", dim).integral
    free_motion = _free_motion(entry, dim, key, gravity, thickness) if entry.is_free else None
    point = check_size(entry.at, dim, f"{key}.at")
    spin = None if entry.spin is None or entry.is_free else check_size(entry.spin, 3, f"{key}.spin")
    return ObstaclePlacement(entry.name, entry.shape, geometry, point, displacement, entry.friction, free_motion, spin)


def _check_file(entry: ObstacleSettings, dim: int, key: str) -> None:
    if dim == 2:
        raise InputError(f'{key}.shape = "mesh": a 2D mesh has none; choose "box", "sphere", "capsule" or "plane"')
    # the schema requires a file for this shape
    assert entry.file is not None
    check_file(entry.file, f"{key}.file")


def _free_motion(entry: ObstacleSettings, dim: int, key: str, gravity: Values, thickness: float) -> FreeObstacleMotion:
    """Mass, admissible motions and initial rates of a free obstacle."""
    rotations = 1 if dim == 2 else 3
    velocity: Values = np.zeros(dim)
    if isinstance(entry.velocity, list):
        velocity = check_size(entry.velocity, dim, f"{key}.velocity")
    basis, hinge = np.eye(dim + rotations), None
    spin = [0.0] * (rotations if entry.hinge is None else 1) if entry.spin is None else entry.spin
    if entry.hinge is not None:
        hinge = check_size(entry.hinge.point, dim, f"{key}.hinge.point")
        basis, rotations = _hinge_basis(entry.hinge, dim, f"{key}.hinge.axis"), 1
    # the pose has translations first, then rotations
    rate = np.concatenate([velocity, check_size(spin, rotations, f"{key}.spin")])
    if entry.hinge is not None:
        rate = rate[dim:]
    elif entry.guide is not None:
        along = _named(entry.guide, dim, key, "guide")
        if np.any(velocity[~along]):
            raise InputError(f"{key}.velocity = {velocity.tolist()}: it moves along {entry.guide} alone")
        basis, rate = basis[:, :dim][:, along], velocity[along]
    mass = None if entry.mass is None else entry.mass / thickness
    return FreeObstacleMotion(mass, entry.density, hinge, basis, rate, gravity)


def _hinge_basis(hinge: HingeSettings, dim: int, key: str) -> Values:
    """Increment of the pose in a rotation about a hinge, (p, 1)."""
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
    """Returns velocity (d,) in m/s and spin in rad/s (one number in 2D) of [initial]; None without the table."""
    initial = study.initial
    if initial is None:
        return None
    velocity = None if initial.velocity is None else check_size(initial.velocity, dim, "initial.velocity")
    spin = None if initial.spin is None else check_size(initial.spin, 1 if dim == 2 else 3, "initial.spin")
    return velocity, spin


def initial_cracks(study: Study, dim: int) -> list[CrackPlane]:
    """Returns all entries of [[crack]].

    Raises:
        InputError: if an entry does not fit the dimension or has no extent.
    """
    return [_crack(entry, f"crack.{i}", dim) for i, entry in enumerate(study.crack)]


def _crack(entry: CrackSettings, key: str, dim: int) -> CrackPlane:
    if entry.plane is not None:
        point = check_size(entry.plane.point, dim, f"{key}.plane.point")
        return plane_crack(key, point, check_size(entry.plane.normal, dim, f"{key}.plane.normal"))
    if entry.segment is not None:
        if dim == 3:
            raise InputError(f"{key}.segment is for 2D meshes; this one has 3 dimensions: give a polygon or a plane")
        return segment_crack(key, np.array([check_size(end, dim, f"{key}.segment") for end in entry.segment]))
    assert entry.polygon is not None
    if dim == 2:
        raise InputError(f"{key}.polygon is for 3D meshes; this one has 2 dimensions: give a segment or a plane")
    return polygon_crack(key, np.array([check_size(corner, dim, f"{key}.polygon") for corner in entry.polygon]))


def grain_stretch(table: BrittleSettings, dim: int) -> Values | None:
    """Returns `stretch` of [brittle.grains], (d,); None without it."""
    if table.grains is None or table.grains.stretch is None:
        return None
    return check_size(table.grains.stretch, dim, "brittle.grains.stretch")


def fibre_direction(study: Study, dim: int) -> Values | None:
    """Returns the direction of [fracture.fibre], (d,); None without the table."""
    fibre = study.fracture.fibre if study.fracture is not None else None
    return None if fibre is None else check_size(fibre.direction, dim, "fracture.fibre.direction")


def step_size_function(timing: TimeSettings) -> TabulatedFunction | None:
    """Returns the longest step in s as a function of time; None if it is constant."""
    return time_function(timing.step, "time.step", 1) if isinstance(timing.step, TimeTable) else None


def time_function(value: Any, key: str, size: int) -> TabulatedFunction:
    """Returns a constant or a table as a function of time with `size` components; "free" becomes nan."""
    table = value if isinstance(value, TimeTable) else TimeTable(time=[0.0], value=[value])
    rows = np.array([check_size(row if isinstance(row, list) else [row], size, key) for row in table.value])
    if np.any(np.isnan(rows) != np.isnan(rows[0])):
        raise InputError(f'{key}: a component that is "free" at one time must be free at all of them')
    return TabulatedFunction(np.asarray(table.time), rows)


def check_size(values: Sequence[Any], size: int, key: str) -> Values:
    """Returns a vector of a study as an array (size,); "free" becomes nan.

    Raises:
        InputError: if its length does not fit the dimension of the mesh.
    """
    if len(values) != size:
        raise InputError(f"{key} = {values}: this mesh needs {size} number{'s'[: size != 1]}")
    return np.array([np.nan if value == "free" else float(value) for value in values])
