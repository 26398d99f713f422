"""What nothing else here reads, by meshio: XDMF, PLY, TetGen, SU2, AVS, Fluent and others.

Before meshio opens a file, all that the file names has been looked at: data of XDMF and HDF5, the second file of
TetGen. What meshio raises is of use to a programmer; a message for users has the format and, of text, the line.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import warnings
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from .contents import Block, Contents
from .data import Indices, MeshError
from .plain_files import data_elsewhere, is_hdf5, wrong_beside
from .tags import tag_sets
from .text_rows import SourceText, decoded, shown

# Endings: the format, meshio's name of it where meshio reads it line by line, and whether it is text.
FORMATS: dict[str, tuple[str, str, bool]] = {
    ".meshb": ("Medit, binary", "", False), ".su2": ("SU2", "su2", True),
    ".vol": ("Netgen", "netgen", True), ".avs": ("AVS UCD", "avsucd", True), ".post": ("PERMAS", "permas", True),
    ".dato": ("PERMAS", "permas", True), ".dat": ("Tecplot", "tecplot", True), ".tec": ("Tecplot", "tecplot", True),
    ".mdpa": ("Kratos", "mdpa", False), ".xdmf": ("XDMF", "", False),
    ".xmf": ("XDMF", "", False), ".ply": ("PLY", "ply", False), ".ele": ("TetGen", "", False),
    ".node": ("TetGen", "", False), ".msh": ("ANSYS Fluent", "ansys", False), ".cgns": ("CGNS", "", False),
    ".h5m": ("MOAB", "", False), ".hmf": ("HMF", "", False), ".xml": ("DOLFIN XML", "", False),
    ".f3grid": ("FLAC3D", "", False), ".ugrid": ("UGRID", "", False), ".svg": ("SVG", "", False),
    ".wkt": ("WKT", "", False),
}  # fmt: skip
ADVICE = (
    "Supported are nodes with simplices, hexahedra, prisms and pyramids; export the mesh again, or in another format: "
    "MSH 4.1 (gmsh), VTU (ParaView), MED (Salome), Abaqus (.inp)."
)
PLY_ADVICE = "Supported are points and faces; export the surface again, as PLY, STL or OBJ (Blender, MeshLab)."
_PLY_HEAD = re.compile(rb"ply[ \t]*\r?\n(.*?)^[ \t]*end_header[ \t]*\r?\n", re.DOTALL | re.MULTILINE)
_PLY_TYPES = {b"char": b"int8", b"uchar": b"uint8", b"ushort": b"uint16", b"uint": b"uint32"}
MAX_PLY_HEAD = 65536  # bytes
MAX_LINE_SEARCH = 1 << 26  # bytes of a file in which the line of a fault is looked for
MOST_BEYOND = 1000  # times that a file is read beyond its end: no reader that comes to an end does so often


def read_with_meshio(path: Path) -> Contents:
    """Everything in a file, for a process of its own: damaged files make some readers of meshio wait or ask for memory.

    Raises:
        MeshError: the file is damaged, or names one that may not be read.
    """
    position: list[int] = []
    try:
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return _contents(path, _mesh(path, position))
    except MeshError:
        raise
    except (Exception, SystemExit):  # readers of meshio raise whatever their parsers raise, or exit
        _refuse(path, position[0] if position else None)


def _refuse(path: Path, position: int | None) -> NoReturn:
    """MeshError; `position`: in bytes, where its reader stopped."""
    format_, _, text = FORMATS.get(path.suffix.lower(), ("this kind", "", False))
    where = ""
    if text and position is not None and path.stat().st_size < MAX_LINE_SEARCH:
        data = path.read_bytes()
        lines = data[:position].rstrip(b"\r\n").split(b"\n")
        where = f" Its reader stopped at line {len(lines)}: `{shown(lines[-1])}`."
        if position >= len(data):
            where = f" Its reader came to the end, line {len(lines)}: was the file cut off?"
    raise MeshError(
        f"Mesh file '{path}' could not be read: it is damaged, or no file of the format {format_}, or holds something "
        f"of it that is not supported.{where} {PLY_ADVICE if format_ == 'PLY' else ADVICE}"
    )


def _mesh(path: Path, position: list[int]) -> Any:
    """meshio's mesh; where that fails, and the file is read from its beginning on, `position` tells how far."""
    import meshio

    ending = path.suffix.lower()
    if ending in (".xdmf", ".xmf"):
        return _xdmf_reader(path).read()
    if ending in (".ele", ".node"):
        other = path.stem + {".ele": ".node", ".node": ".ele"}[ending]
        _check(path, other)
        _check_begun(path)
        _check_begun(path.parent / other)
    elif is_hdf5(path):
        _check_hdf5(path, path)
    elif ending == ".ply":
        data = path.read_bytes()
        _check_ply(SourceText(path, data))
        with _Ending(io.BytesIO(_with_known_head(data))) as file:  # type: ignore[arg-type]
            return meshio.read(file, "ply")
    elif FORMATS[ending][1]:
        _, name, text = FORMATS[ending]
        with _Ending(path.open("rb", buffering=0)) as file:
            stream = _Lines(file) if text else file
            try:
                return meshio.ansys.read(file) if name == "ansys" else meshio.read(stream, name)
            except (Exception, SystemExit):
                with contextlib.suppress(OSError, ValueError):
                    position.append(stream.tell() & (1 << 63) - 1)  # of text, higher bits are of its decoder
                raise
    return meshio.read(path)


# --- contents of meshio's mesh --------------------------------------------------------------------------------------


def _contents(path: Path, mesh: Any) -> Contents:
    points = np.asarray(mesh.points)
    if points.ndim != 2 or points.shape[1] not in (2, 3):
        raise MeshError(f"Mesh file '{path}' holds points of shape {points.shape}; (n, 2) or (n, 3) is needed.")
    blocks = [_block(block) for block in mesh.cells]
    sets, used, notes = tag_sets(mesh.cell_data, blocks, partial(_names_of, mesh))
    named = _named_sets(mesh, blocks)
    nodes = {str(name): np.asarray(members, np.int64) for name, members in (mesh.point_sets or {}).items()}
    unused = [key for key in [*mesh.cell_data, *mesh.point_data] if key not in used and ":" not in key]
    if unused:
        notes += (f"Not used: the arrays {', '.join(unused)}.",)
    return Contents(points.astype(np.float64), blocks, sets | named, nodes, notes=notes)


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
    """Names of a tag: of a field of the same dimension, or made from the number."""
    for name, value in (mesh.field_data or {}).items():
        if np.shape(value) == (2,) and (int(value[0]), int(value[1])) == (tag, dim) and str(name).strip():
            return [str(name)]
    return [f"tag-{tag}"]


# --- files before meshio opens them ---------------------------------------------------------------------------------


def _check_ply(source: SourceText) -> None:
    """MeshError for a file without the head of PLY; with its line for text with fewer lines than declared, or words."""
    text = source.text
    head = _PLY_HEAD.match(text[: 2 * MAX_PLY_HEAD])
    if not head:
        source.refuse(0, f"`{shown(text[:80])}` does not begin the head of PLY: `ply`, ..., `end_header`. {PLY_ADVICE}")
    if not re.search(rb"^format\s+ascii\b", head[1], re.MULTILINE):
        return
    declared = re.findall(rb"^element\s+(\w+)\s+(\d+)", head[1], re.MULTILINE)
    lines = source.rows(head.end(), len(text), "the numbers of a point or a face")
    if len(lines) < sum(int(count) for _, count in declared):
        known = ", ".join(f"{int(count)} {decoded(word)}" for word, count in declared)
        why = f"the file ends after {len(lines)} lines of data, and declares {known}."
        source.refuse(len(text) - 1, f"{why} {PLY_ADVICE}")


def _with_known_head(data: bytes) -> bytes:
    """A PLY file with the names of its head that meshio knows: of the corners of faces, and of types."""
    head, mark, rest = data.partition(b"end_header")
    if not mark or len(head) > MAX_PLY_HEAD:
        return data
    lines = [line.split() for line in head.splitlines()]
    for line in lines:
        if line[:1] == [b"property"]:
            line[1:-1] = [_PLY_TYPES.get(word, word) for word in line[1:-1]]
            if line[1:2] == [b"list"] and line[-1] == b"vertex_index":
                line[-1] = b"vertex_indices"
    return b"\n".join(b" ".join(line) for line in lines if line) + b"\n" + mark + rest


def _check(path: Path, name: str) -> None:
    if wrong := wrong_beside(path, name):
        raise MeshError(f"Mesh file '{path}' could not be read: it names the file '{name}', which {wrong}.")


def _check_hdf5(path: Path, h5: Path) -> None:
    import h5py

    with h5py.File(h5) as file:
        if name := data_elsewhere(file):
            raise MeshError(
                f"Mesh file '{path}' could not be read: the data of '{name}' in {h5.name} lie in another file; save "
                "all in one."
            )


def _xdmf_reader(path: Path) -> Any:
    """A reader of meshio's that looks at what each item names before it opens that."""
    from meshio.xdmf.main import XdmfReader

    looked_at: set[str] = set()

    class Reader(XdmfReader):  # type: ignore[misc]
        def _read_data_item(self, item: Any, root: Any = None) -> Any:
            named = "Reference" not in item.attrib and item.get("Format") in ("HDF", "Binary")
            if named and (text := (item.text or "").strip()):
                name = text.rpartition(":")[0] if item.get("Format") == "HDF" else text
                if name not in looked_at:
                    _check(path, name)
                    if item.get("Format") == "HDF":
                        _check_hdf5(path, path.parent / name)
                    looked_at.add(name)
                if item.get("Format") == "Binary":
                    item.text = os.path.abspath(path.parent / name)  # meshio looks in the working folder
            return super()._read_data_item(item, root)

    return Reader(str(path))


class _Ending(io.BufferedReader):
    """A file that ends with an error where it is read beyond its end again and again: readers of meshio's wait there
    for what does not come, where a file has been cut off."""

    _beyond = 0

    def _checked(self, data: bytes) -> bytes:
        self._beyond = 0 if data else self._beyond + 1
        if self._beyond > MOST_BEYOND:
            raise EOFError("it ends in the middle of a section")
        return data

    def read(self, size: int | None = -1, /) -> bytes:
        return self._checked(super().read(size))

    def read1(self, size: int = -1, /) -> bytes:
        return self._checked(super().read1(size))

    def readline(self, size: int | None = -1, /) -> bytes:
        return self._checked(super().readline(size))


class _Lines(io.TextIOWrapper):
    """Text whose position can be told while it is read line by line."""

    def __init__(self, file: _Ending) -> None:
        super().__init__(file, encoding="utf-8", errors="replace")

    def __next__(self) -> str:  # type: ignore[override]
        if line := self.readline():
            return line
        raise StopIteration


def _check_begun(path: Path) -> None:
    """MeshError for a file of TetGen without numbers, of which meshio waits for the first line."""
    with path.open(errors="replace") as file:
        if not any(line.strip() and not line.strip().startswith("#") for line in file):
            raise MeshError(f"Mesh file '{path}' could not be read: it holds no numbers.")
