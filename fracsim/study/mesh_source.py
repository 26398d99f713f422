"""Meshes of a study as arrays: built, read or filled, checked and saved. No DOLFINx here."""

from __future__ import annotations

import dataclasses
import difflib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import TypeAdapter, ValidationError

from ..errors import InputError
from ..meshes import BUILDERS
from ..meshes.data import MeshData, MeshError
from ..meshes.parameters import SHORTEST, check_extent, is_length
from ..meshes.plain_files import MISSING, unreadable_reason
from . import MeshSettings
from .body import GIVEN_MESH, SOURCE_KEYS
from .error_messages import unknown_key_message, validation_message
from .plugins import PhysicsPart, find_plugin

if TYPE_CHECKING:
    from ..meshes.random_points.outline_file import PolygonOutline
    from ..meshes.surfaces.closed import ClosedSurface
    from ..meshes.vtkhdf import FileMesh


@dataclasses.dataclass(frozen=True)
class _GivenMesh:
    """Stands for a mesh that is handed over in Python; nothing is known of the mesh without it."""

    name = GIVEN_MESH

    def bounds(self) -> Any:
        """Raise MeshError: there is no mesh."""
        raise MeshError(
            f'builder = "{GIVEN_MESH}" stands for a mesh that is handed over in Python: run the study by '
            "fracsim.Simulation(study, mesh=...), or give builder, file, surface or outline"
        )

    cells_estimate = build = bounds


def find_builder(mesh: MeshSettings) -> Any:
    """Returns the builder of a [mesh] table with its parameters; None for a file or surface. No mesh is built.

    Raises:
        InputError: if there is no such builder, or a parameter or file is invalid.
    """
    if mesh.builder is None:
        _check_source(mesh)
        return None
    if mesh.builder == GIVEN_MESH:
        return _with_parameters(_GivenMesh, mesh.parameters)
    if mesh.builder not in BUILDERS:
        if (plugin := find_plugin("builders", mesh.builder)) is not None:
            return _with_parameters(_plugin_builder(plugin), mesh.parameters)
        near = difflib.get_close_matches(mesh.builder, BUILDERS, n=1)
        hint = f"did you mean {near[0]}?" if near else f"there are: {', '.join(BUILDERS)}"
        raise InputError(f'mesh.builder = "{mesh.builder}" is not a builder; {hint}')
    return _with_parameters(BUILDERS[mesh.builder], mesh.parameters)


def _with_parameters(kind: Any, parameters: dict[str, Any]) -> Any:
    """A builder of a class with the parameters of a study. InputError for an unknown or invalid parameter."""
    names = [field.name for field in dataclasses.fields(kind)]
    for key in parameters:
        if key not in names:
            raise InputError(unknown_key_message(f"mesh.{key}", names))
    try:
        # JSON keeps numbers strict, and converts a list to a tuple
        return _reader(kind).validate_json(json.dumps(parameters, default=str), strict=True)
    except ValidationError as error:
        raise InputError(validation_message(error.errors(), "mesh")) from None
    except ArithmeticError:
        # the number of cells overflows, or is zero
        listed = ", ".join(f"{key} = {value}" for key, value in parameters.items())
        raise InputError(
            f"mesh: {kind.name} with {listed}: numbers do not reach that far; take a larger h (lengths are in metres)"
        ) from None


def _plugin_builder(plugin: PhysicsPart) -> Any:
    """Class of the builder of a plug-in. InputError if it lacks what a builder has."""
    kind = plugin.value
    if not dataclasses.is_dataclass(kind) or not isinstance(kind, type):
        raise InputError(f"{plugin.label} is no dataclass: its fields are the keys of [mesh]")
    if missing := [
        name for name in ("name", "groups", "regions", "bounds", "cells_estimate", "build") if not hasattr(kind, name)
    ]:
        raise InputError(f"{plugin.label} has no {missing[0]}; a builder has what fracsim.meshes.Builder says")
    return kind


@cache
def _reader(kind: type) -> TypeAdapter[Any]:
    """Reader of the parameters of a builder, cached since pydantic takes longer to make it than to use it."""
    return TypeAdapter(kind)


def _check_source(mesh: MeshSettings) -> None:
    """InputError for a key that the source does not have, a file that is missing, or a value out of range."""
    source = next(name for name in SOURCE_KEYS if getattr(mesh, name) is not None)
    keys = SOURCE_KEYS[source]
    # the table accepts any key, since builders have parameters of their own
    for name in mesh.parameters:
        if name not in keys:
            raise InputError(
                f"mesh.{name} is not a known key beside mesh.{source}; known here: {', '.join((source, *keys))}"
            )
    check_file(getattr(mesh, source), f"mesh.{source}")
    for name, entry in keys.items():
        value: Any = mesh.parameters.get(name)
        if entry.boolean:
            valid = isinstance(value, bool)
        else:
            valid = is_length(value) and value >= SHORTEST and (not entry.integer or isinstance(value, int))
        if (name in mesh.parameters or entry.required) and not valid:
            raise InputError(f"mesh.{name} = {value}: {entry.meaning}")


def check_file(path: Path, key: str) -> None:
    """Raises InputError if a path of a study is not a plain file; `key` is its path in the study."""
    if wrong := unreadable_reason(path):
        raise InputError(f'{key} = "{path}"{": there is no such file" if wrong == MISSING else f" {wrong}"}')


REPAIR_HINT = "Or set [mesh] repair = true: it fills holes, makes parts that cross one body, and says what it changed."


def open_surface(mesh: MeshSettings) -> ClosedSurface | None:
    """Returns the closed surface of a [mesh] table in metres, checked but not filled; None if it has none.

    Raises:
        InputError: if the file is invalid, or the surface is open or intersects itself.
    """
    if mesh.surface is None:
        return None
    from ..meshes.surfaces.closed import RepairableSurfaceError
    from ..meshes.surfaces.repair import read_body

    _check_source(mesh)
    parameters = mesh.parameters
    repair, scale = bool(parameters.get("repair")), float(parameters.get("scale", 1.0))
    with _mesh_errors():
        try:
            return read_body(mesh.surface, scale, repair=repair, time_limit=parameters.get("time_limit"))
        except RepairableSurfaceError as error:
            raise MeshError(str(error) if repair else f"{error} {REPAIR_HINT}") from None


def open_outline(mesh: MeshSettings) -> PolygonOutline | None:
    """Returns the outline of a [mesh] table in metres, not filled; None if it has none.

    Raises:
        InputError: if the file is invalid.
    """
    if mesh.outline is None:
        return None
    from ..meshes.random_points.outline_file import read_outline

    _check_source(mesh)
    with _mesh_errors():
        return read_outline(mesh.outline, float(mesh.parameters.get("scale", 1.0)))


def read_obstacle_surface(file: Path, scale: float, key: str) -> ClosedSurface:
    """Returns the closed surface of an obstacle in metres; `key` is the path of its table in the study.

    Raises:
        InputError: if the file is invalid.
    """
    from ..meshes.surfaces.closed import read_surface

    try:
        return read_surface(file, scale)
    except MeshError as error:
        raise InputError(f"{key}.file: {error}") from None


def estimate_filled_cells(mesh: MeshSettings, surface: ClosedSurface) -> int:
    """Returns an estimate of the number of cells that fill a surface.

    Raises:
        InputError: if it is too large, or a cell is larger than the body.
    """
    from ..meshes.surfaces.fill import expected_cells

    with _mesh_errors():
        return expected_cells(surface, float(mesh.parameters["h"]))


def build_mesh(mesh: MeshSettings, surface: ClosedSurface | None = None) -> MeshData:
    """Returns the mesh of a [mesh] table, built, read or filled, and checked. Called on rank 0.

    Args:
        mesh: the table.
        surface: of the table, if it is open already.

    Raises:
        InputError: if the mesh is invalid.
    """
    from ..meshes.check import check_mesh

    builder = find_builder(mesh)
    surface = surface or open_surface(mesh)
    with _mesh_errors():
        if builder is not None:
            data = builder.build()
        elif surface is not None:
            data = _filled(mesh, surface)
        elif (outline := open_outline(mesh)) is not None:
            from ..meshes.random_points.outline_file import fill_outline

            data = fill_outline(outline, float(mesh.parameters["h"]), int(mesh.parameters.get("seed", 1)))
        elif mesh.shell is not None:
            from ..meshes.shell import read_shell

            parameters = mesh.parameters
            data = read_shell(mesh.shell, float(parameters["thickness"]), float(parameters.get("scale", 1.0)))
        else:
            from ..meshes.read import read_mesh  # only files need the readers of all formats

            assert mesh.file is not None
            data = read_mesh(mesh.file)
        join = mesh.file is not None and bool(mesh.parameters.get("join"))
        conforming = getattr(builder, "is_conforming", False)
        return _scaled(check_mesh(data, join=join, conforming=conforming), mesh)


def find_shared_mesh(mesh: MeshSettings) -> FileMesh | None:
    """Returns where the mesh of a [mesh] table lies in its file, if all ranks can read it. Called on rank 0.

    None if rank 0 has to build or read the mesh.

    Raises:
        InputError: if the table is invalid.
    """
    # bodies that are joined, and midside nodes, are found in the whole mesh
    if mesh.file is None or mesh.order == 2 or mesh.parameters.get("join"):
        return None
    from ..meshes.vtkhdf import find_file_mesh

    _check_source(mesh)
    return find_file_mesh(mesh.file)


def file_scale(mesh: MeshSettings) -> float:
    """Returns the scale of a mesh from a file, m per unit of length; 1 of any other mesh."""
    return float(mesh.parameters.get("scale", 1)) if mesh.file is not None else 1.0


def check_given_mesh(mesh: MeshData) -> MeshData:
    """Returns a mesh that was handed over, checked. Raises InputError if it is invalid."""
    from ..meshes.check import check_mesh

    with _mesh_errors():
        return check_mesh(mesh)


def _scaled(data: MeshData, mesh: MeshSettings) -> MeshData:
    """A mesh from a file in metres. It is scaled after its check, which recognises single precision by its bits."""
    scale = file_scale(mesh)
    if scale == 1:
        return data
    check_extent(data.points * scale, f"the mesh, with mesh.scale = {scale:g},")
    return dataclasses.replace(data, points=data.points * scale)


def _filled(mesh: MeshSettings, surface: ClosedSurface) -> MeshData:
    from ..meshes.surfaces.fill import fill_closed

    parameters = mesh.parameters
    return fill_closed(surface, float(parameters["h"]), f"Surface file '{mesh.surface}'", parameters.get("time_limit"))


@contextmanager
def _mesh_errors() -> Iterator[None]:
    """Convert errors of meshes into errors of the user's input."""
    try:
        yield
    except MeshError as error:
        raise InputError(f"mesh: {error}") from None


def save_mesh(data: MeshData, path: Path) -> tuple[str, ...]:
    """Save a mesh with its groups, in the format of the ending of the path; returns notes on what it does not keep.

    Raises:
        InputError: if the format is unknown or the file cannot be written.
    """
    from ..meshes.write import write_mesh

    try:
        return write_mesh(data, path)
    except MeshError as error:
        raise InputError(f"--out: {error}") from None
