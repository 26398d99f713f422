"""A mesh from file: which reader reads which file."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from .abaqus import read_abaqus
from .data import MeshData, MeshError
from .medit import read_medit
from .mesh_conversion import MeshFileContents
from .meshio_reader import FORMATS, read_with_meshio
from .msh2 import SAVE, read_msh2
from .nastran import read_nastran
from .obj import read_obj, read_off
from .plain_files import unreadable_reason
from .stl import read_stl
from .time_limit import read_with_time_limit
from .unv import read_unv
from .vtk_readers import ENDINGS as VTK_ENDINGS
from .vtk_readers import read_with_vtk

OWN_READERS: dict[str, Callable[[Path], MeshFileContents]] = {
    ".inp": read_abaqus, ".mesh": read_medit, ".obj": read_obj, ".off": read_off, ".stl": read_stl, ".unv": read_unv,
    **dict.fromkeys((".bdf", ".nas", ".fem"), read_nastran), **dict.fromkeys(VTK_ENDINGS, read_with_vtk),
}  # fmt: skip
SECONDS, SLOW = 60, 1e6  # of another program on a file, and the bytes a second that it reads at least
MSH2 = 2  # version of MSH that is read here; later ones by gmsh
_NASTRAN = re.compile(rb"^(BEGIN\s+BULK|GRID\*?[\s,])", re.MULTILINE | re.IGNORECASE)


def read_mesh(path: str | Path) -> MeshData:
    """The tetrahedra of a mesh file, or the triangles of a plane one, with its named groups; not checked yet.

    Lower-order facets become facet groups, cells regions, under the names the file gives (Gmsh's physical names, cell
    sets, MED families, Abaqus node sets); integer tags without a name are called "tag-<n>".

    Raises:
        MeshError: the file is missing, of unknown kind or damaged, or holds no mesh of simplices.
    """
    path = Path(path)
    return read_contents(path).simplices(f"Mesh file '{path}'")


def read_contents(path: Path) -> MeshFileContents:
    """Everything in a mesh file.

    Raises:
        MeshError: the file is missing, of unknown kind or damaged.
    """
    if wrong := unreadable_reason(path):
        raise MeshError(f"Mesh file '{path}' {wrong}.")
    if path.stat().st_size == 0:
        raise MeshError(f"Mesh file '{path}' is empty.")
    ending = path.suffix.lower()
    if ending in OWN_READERS:
        return OWN_READERS[ending](path)
    if ending == ".med":
        from .med import read_med

        return _by_another_process(path, read_med, "h5py")
    version = _gmsh_version(path)
    if version > MSH2:
        from .gmsh_reader import read_with_gmsh

        return _by_another_process(path, read_with_gmsh, "gmsh")
    if version:
        return read_msh2(path)
    if ending not in FORMATS:
        allowed = sorted({*OWN_READERS, *FORMATS, ".med"})
        raise MeshError(
            f"Mesh file '{path}' is of no known kind; known endings: {', '.join(allowed)}. "
            "Export it as MSH 4.1 (gmsh), "
            "VTU (ParaView), MED (Salome) or Abaqus (.inp)."
        )
    if ending == ".dat" and _NASTRAN.search(path.read_bytes()):
        return read_nastran(path)
    return _by_another_process(path, read_with_meshio, "meshio")


def _by_another_process(path: Path, reader: Callable[[Path], MeshFileContents], program: str) -> MeshFileContents:
    return read_with_time_limit(path, reader, program, SECONDS + path.stat().st_size / SLOW)


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
        freefem = (
            ' (FreeFem\'s own .msh: savemesh(Th, "part.mesh") writes Medit instead.)' if head[:1].isdigit() else ""
        )
        raise MeshError(
            f"Mesh file '{path}' could not be read: it is no mesh of Gmsh, for it begins with {head[:16]!a}, not with "
            f"$MeshFormat.{freefem} {SAVE}."
        )
    _, result, remaining = head.partition(b"$MeshFormat")
    number = re.match(rb"\s*(\d{1,3})(\.\d*)?\s", remaining) if result else None
    if not number or int(number[1]) < 1:
        raise MeshError(
            f"Mesh file '{path}' could not be read: no version stands behind $MeshFormat: `4.1 0 8`. {SAVE}."
        )
    return int(number[1])
