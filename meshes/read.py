"""Mesh files of all formats: the reader of each file."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from .abaqus import read_abaqus
from .data import MeshData, MeshError
from .medit import read_medit
from .mesh_conversion import MeshFileContents
from .meshio_reader import FORMATS, read_with_meshio
from .msh import msh_version, read_msh2, read_with_gmsh
from .nastran import read_nastran
from .obj_off import read_obj, read_off
from .plain_files import unreadable_reason
from .stl import read_stl
from .time_limit import read_with_time_limit
from .unv import read_unv
from .vtk_grid import ENDINGS as VTK_ENDINGS
from .vtk_readers import read_with_vtk

# by ending: readers that need no process of their own, or start one themselves
READERS: dict[str, Callable[[Path], MeshFileContents]] = {
    ".inp": read_abaqus, ".mesh": read_medit, ".obj": read_obj, ".off": read_off, ".stl": read_stl, ".unv": read_unv,
    **dict.fromkeys((".bdf", ".nas", ".fem"), read_nastran), **dict.fromkeys(VTK_ENDINGS, read_with_vtk),
}  # fmt: skip
_NASTRAN = re.compile(rb"^(BEGIN\s+BULK|GRID\*?[\s,])", re.MULTILINE | re.IGNORECASE)


def read_mesh(path: str | Path) -> MeshData:
    """The tetrahedra of a mesh file, or the triangles of a plane one, with its named groups; not checked.

    Sets of facets become facet groups, sets of cells regions, under the names of the file (Gmsh's physical names, cell
    sets, MED families, Abaqus node sets); integer tags without a name are called "tag-<n>".

    Raises:
        MeshError: the file is missing, of an unknown format or damaged, or holds no cells that can become simplices.
    """
    path = Path(path)
    return read_contents(path).simplices(f"Mesh file '{path}'")


def read_contents(path: Path) -> MeshFileContents:
    """All points, cells and sets of a mesh file.

    Raises:
        MeshError: the file is missing, of an unknown format or damaged.
    """
    if wrong := unreadable_reason(path):
        raise MeshError(f"Mesh file '{path}' {wrong}.")
    if path.stat().st_size == 0:
        raise MeshError(f"Mesh file '{path}' is empty.")
    ending = path.suffix.lower()
    if ending in READERS:
        return READERS[ending](path)
    if ending == ".med":
        from .med import read_med

        return read_with_time_limit(path, read_med, "h5py")
    if version := msh_version(path):
        return read_msh2(path) if version <= 2 else read_with_time_limit(path, read_with_gmsh, "gmsh")
    if ending not in FORMATS:
        allowed = sorted({*READERS, *FORMATS, ".med"})
        raise MeshError(
            f"Mesh file '{path}' is of no known kind; known endings: {', '.join(allowed)}. "
            "Export it as MSH 4.1 (gmsh), "
            "VTU (ParaView), MED (Salome) or Abaqus (.inp)."
        )
    if ending == ".dat" and _NASTRAN.search(path.read_bytes()):
        return read_nastran(path)
    return read_with_time_limit(path, read_with_meshio, "meshio")
