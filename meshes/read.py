"""A mesh from file: by gmsh (.msh), VTK (its formats, Exodus), readers of their names, and meshio for all else."""

from __future__ import annotations

import contextlib
import io
import re
import warnings
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from .abaqus import read_abaqus
from .contents import Block, Contents
from .data import Indices, MeshData, MeshError
from .gmsh_session import session
from .meshio_reader import meshio_mesh
from .obj import read_obj
from .plain_files import wrong_with
from .stl import read_stl
from .tags import tag_sets
from .timed import Died, within
from .vtk_readers import ENDINGS as VTK_ENDINGS
from .vtk_readers import read_with_vtk

OWN_READERS = {".obj": read_obj, ".stl": read_stl}  # in place of meshio's


def read_mesh(path: str | Path) -> MeshData:
    """The tetrahedra of a mesh file, or the triangles of a plane one, with its named groups; not checked yet.

    Lower-order facets become facet groups, cells regions, under the names the file gives (Gmsh's physical names, cell
    sets, MED families, Abaqus node sets); integer tags without a name are called "tag-<n>".

    Raises:
        MeshError: the file is missing, of unknown kind or damaged, or holds no mesh of simplices.
    """
    path = Path(path)
    return read_contents(path).simplices(f"Mesh file '{path}'")


def read_contents(path: Path) -> Contents:
    """Everything in a mesh file.

    Raises:
        MeshError: the file is missing, of unknown kind or damaged.
    """
    if wrong := wrong_with(path):
        raise MeshError(f"Mesh file '{path}' {wrong}.")
    if path.stat().st_size == 0:
        raise MeshError(f"Mesh file '{path}' is empty.")
    if path.suffix.lower() == ".inp":
        return read_abaqus(path)
    if path.suffix.lower() in VTK_ENDINGS:
        return read_with_vtk(path)
    version = _gmsh_version(path)
    if version >= 4:
        return _read_with_gmsh(path)
    return replace(_read_with_meshio(path), copies=version > 0)


def _gmsh_version(path: Path) -> int:
    """Major version of Gmsh's own format; 0 for any other file. MeshError for a .msh that is none.

    What does not begin as a mesh, gmsh takes for a script and runs, its shell commands too.
    """
    if path.suffix.lower() != ".msh":
        return 0
    with path.open("rb") as file:
        head = file.read(65536)
    if not head.startswith((b"$MeshFormat", b"$Comments")):
        if head.lstrip()[:1] == b"(":
            return 0  # of ANSYS Fluent
        raise MeshError(
            f"Mesh file '{path}' could not be read: it is no mesh of Gmsh, for it begins with {head[:16]!a}, not with "
            "$MeshFormat. Save it as MSH 4.1 or 2.2, for example by `gmsh -3 part.geo -o part.msh`."
        )
    _, found, rest = head.partition(b"$MeshFormat")
    number = re.match(rb"\s*(\d{1,3})(\.\d*)?\s", rest) if found else None
    return int(number[1]) if number else 0


# --- Gmsh's .msh, version 4 -----------------------------------------------------------------------------------------
# Not by meshio (5.3), which refuses files where only some cells are in a physical group, and keeps one unnamed group of
# each. Version 2 not by gmsh, which puts all elements of one entity into all groups that one of them is in.

GMSH_SHAPES = {"Point": "vertex", "Line": "line", "Triangle": "triangle", "Tetrahedron": "tetra"}
GMSH_SHAPES |= {"Quadrilateral": "quad", "Hexahedron": "hexahedron", "Prism": "wedge", "Pyramid": "pyramid"}


SLOW = 1e6  # bytes a second that gmsh reads at least


def _read_with_gmsh(path: Path) -> Contents:
    """By a process of its own: damaged files have been seen to end gmsh by SIGABRT."""
    try:
        return within(60 + path.stat().st_size / SLOW, _contents_by_gmsh, path)
    except Died as died:
        raise MeshError(
            f"Mesh file '{path}' could not be read: gmsh died ({died.how}); the file is damaged, or there is not "
            "enough memory."
        ) from None
    except MeshError as error:
        raise MeshError(f"Mesh file '{path}' could not be read: {error}") from error
    except TimeoutError:
        raise MeshError(f"Mesh file '{path}' could not be read: gmsh did not end; the file is damaged.") from None


def _contents_by_gmsh(path: Path) -> Contents:
    # by a name of its own: of part.msh.opt beside part.msh gmsh would run the commands
    with TemporaryDirectory() as folder, session() as gmsh:
        linked = Path(folder) / "mesh.msh"
        linked.symlink_to(path.resolve())
        gmsh.merge(str(linked))
        return _contents_of_model(gmsh)


def _contents_of_model(gmsh: Any) -> Contents:
    tags, coordinates, _ = gmsh.model.mesh.getNodes()
    place = np.full(int(tags.max(initial=0)) + 1, -1, np.int64)
    place[tags] = np.arange(len(tags))
    blocks: list[Block] = []
    owners: list[tuple[int, int]] = []
    for entity in gmsh.model.getEntities():
        for kind, _, nodes in zip(*gmsh.model.mesh.getElements(*entity), strict=True):
            name, _, order, count, _, _ = gmsh.model.mesh.getElementProperties(kind)
            shape = GMSH_SHAPES.get(name.split()[0], name)
            blocks.append(Block(shape if order == 1 else f"{shape}{count}", place[nodes].reshape(-1, count)))
            owners.append(entity)
    return Contents(coordinates.reshape(-1, 3), blocks, _physical_groups(gmsh, blocks, owners))


def _physical_groups(gmsh: Any, blocks: list[Block], owners: list[tuple[int, int]]) -> dict[str, list[Indices]]:
    """Physical groups by name; entities of several dimensions may share one."""
    sets: dict[str, list[Indices]] = {}
    for dim, tag in gmsh.model.getPhysicalGroups():
        name = gmsh.model.getPhysicalName(dim, tag) or f"tag-{tag}"
        entities = set(gmsh.model.getEntitiesForPhysicalGroup(dim, tag).tolist())
        members = sets.setdefault(name, [np.zeros(0, np.int64) for _ in blocks])
        for i, (block, owner) in enumerate(zip(blocks, owners, strict=True)):
            if owner[0] == dim and owner[1] in entities:
                members[i] = np.arange(len(block.nodes))
    return sets


# --- everything else ------------------------------------------------------------------------------------------------


def _read_with_meshio(path: Path) -> Contents:
    mesh = _meshio_mesh(path)
    points = np.asarray(mesh.points)
    if points.ndim != 2 or points.shape[1] not in (2, 3):
        raise MeshError(f"Mesh file '{path}' holds points of shape {points.shape}; (n, 2) or (n, 3) is needed.")
    blocks = [_block(block) for block in mesh.cells]
    sets, _, notes = tag_sets(mesh.cell_data, blocks, partial(_names_of, mesh))
    named = _named_sets(mesh, blocks)
    nodes = {str(name): np.asarray(members, np.int64) for name, members in (mesh.point_sets or {}).items()}
    return Contents(points.astype(np.float64), blocks, sets | named, nodes, notes=notes)


def _meshio_mesh(path: Path) -> Any:
    """meshio's mesh; its exits become errors and its printing is kept for their message."""
    import meshio

    known = sorted({*meshio.extension_to_filetypes, *VTK_ENDINGS})
    if not any(path.name.lower().endswith(extension) for extension in known):
        raise MeshError(f"Mesh file '{path}' is of no known kind; known endings: {', '.join(known)}.")
    said = io.StringIO()
    try:
        with _quiet(said):
            return OWN_READERS.get(path.suffix.lower(), meshio_mesh)(path)
    except MeshError:
        raise
    except (Exception, SystemExit) as error:  # meshio's readers raise whatever their parsers raise, or exit
        reason = "" if isinstance(error, SystemExit) else str(error)
        reason = " ".join((reason or said.getvalue()).split()) or type(error).__name__
        raise MeshError(
            f"Mesh file '{path}' could not be read: {reason[:300]} (damaged, or of another kind?)"
        ) from error


@contextlib.contextmanager
def _quiet(said: io.StringIO) -> Iterator[None]:
    """Keep what Python code prints, and drop its warnings (meshio multiplies in 32 bits on every text STL)."""
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def _block(block: Any) -> Block:
    if isinstance(block.data, np.ndarray) and block.data.dtype != object:
        return Block(block.type, np.asarray(block.data, np.int64))
    return Block(block.type, np.zeros((len(block.data), 0), np.int64))  # polygons and polyhedra: refused by kind later


def _named_sets(mesh: Any, blocks: list[Block]) -> dict[str, list[Indices]]:
    """Cell sets that have names in the file."""
    sets = {}
    for name, members in (mesh.cell_sets or {}).items():
        if len(members) == len(blocks) and not str(name).startswith("gmsh:"):
            sets[str(name)] = [np.asarray([] if part is None else part, np.int64) for part in members]
    return sets


def _names_of(mesh: Any, tag: int, dim: int) -> list[str]:
    """Names of a tag: of MED families, of a field of the same dimension, or made from the number."""
    families = getattr(mesh, "cell_tags", {}).get(tag)
    if families:
        return [str(name) for name in families]
    for name, value in (mesh.field_data or {}).items():
        if np.shape(value) == (2,) and (int(value[0]), int(value[1])) == (tag, dim):
            return [str(name)]
    return [f"tag-{tag}"]
