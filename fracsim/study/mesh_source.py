"""From the [mesh] table to a checked mesh in arrays. No DOLFINx here."""

from __future__ import annotations

import dataclasses
import difflib
import json
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from ..errors import InputError
from ..meshes import BUILDERS
from ..meshes.data import MeshData, MeshError
from ..meshes.parameters import is_number
from . import Mesh
from .explain import explain, unknown_key


def find_builder(mesh: Mesh) -> Any:
    """The builder of a [mesh] table with its parameters checked, None for a file or surface. No mesh is built."""
    if mesh.builder is None:
        _check_source(mesh)
        return None
    if mesh.builder not in BUILDERS:
        near = difflib.get_close_matches(mesh.builder, BUILDERS, n=1)
        hint = f"did you mean {near[0]}?" if near else f"there are: {', '.join(BUILDERS)}"
        raise InputError(f'mesh.builder = "{mesh.builder}" is not a builder; {hint}')
    return _with_parameters(BUILDERS[mesh.builder], mesh.parameters)


def _with_parameters(kind: Any, parameters: dict[str, Any]) -> Any:
    known = [field.name for field in dataclasses.fields(kind)]
    for key in parameters:
        if key not in known:
            raise InputError(unknown_key(f"mesh.{key}", known))
    try:
        # through JSON: strict about numbers, and yet a list becomes a tuple
        return TypeAdapter(kind).validate_json(json.dumps(parameters, default=str), strict=True)
    except ValidationError as error:
        raise InputError(explain(error.errors(), "mesh")) from None
    except ArithmeticError:  # the count of its cells overflows, or there are none
        given = ", ".join(f"{key} = {value}" for key, value in parameters.items())
        raise InputError(
            f"mesh: {kind.name} with {given}: numbers do not reach that far; take a larger h (lengths are in metres)"
        ) from None


def _check_source(mesh: Mesh) -> None:
    path, allowed = (mesh.file, ()) if mesh.file is not None else (mesh.surface, ("h",))
    assert path is not None
    key = "file" if mesh.file is not None else "surface"
    for name in mesh.parameters:
        if name not in allowed:
            known = ", ".join(("file",) if key == "file" else ("surface", "h"))
            raise InputError(f"mesh.{name} is not a known key beside mesh.{key}; known here: {known}")
    if not Path(path).is_file():
        raise InputError(f'mesh.{key} = "{path}": there is no such file')
    h = mesh.parameters.get("h")
    if key == "surface" and not (h is not None and is_number(h) and h > 0):
        raise InputError(f"mesh.h = {h}: a surface is filled with cells of size h > 0 (m)")


def build_mesh(mesh: Mesh) -> MeshData:
    """Build or read, then check (rank 0). InputError with what is wrong."""
    from ..meshes.check import check_mesh

    builder = find_builder(mesh)
    try:
        if builder is not None:
            data = builder.build()
        elif mesh.file is not None:
            from ..meshes.read import read_mesh

            data = read_mesh(mesh.file)
        else:
            from ..meshes.surfaces.fill import fill_surface

            assert mesh.surface is not None
            data = fill_surface(mesh.surface, float(mesh.parameters["h"]))
        return check_mesh(data)
    except MeshError as error:
        raise InputError(f"mesh: {error}") from None


def save_mesh(data: MeshData, path: Path) -> None:
    """Save with groups, in the format that the ending of the path names. InputError where that cannot be done."""
    from ..meshes.write import write_mesh

    try:
        write_mesh(data, path)
    except MeshError as error:
        raise InputError(f"--out: {error}") from None
