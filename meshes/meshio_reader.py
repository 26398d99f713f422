"""Formats that meshio reads: XDMF, PLY, TetGen, SU2, AVS, Fluent and others.

The files that a file names (data of XDMF and HDF5, the second file of TetGen) are checked before meshio opens them.
Errors of meshio become messages with the format and, of text, the line.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import warnings
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NoReturn, cast

import numpy as np

from .cell_sets import tag_sets
from .data import Indices, MeshError
from .file_text import SourceText, decode_text, excerpt, refuse_file
from .mesh_conversion import DAMAGE, Block, MeshFileContents
from .plain_files import find_external_data, is_hdf5, unreadable_reason_beside
from .ply import PLY_ADVICE, check_ply_length, checked_ply

# Ending -> format, its name in meshio if meshio reads it line by line, and whether it is text
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
SU2_NODES = {3: 2, 5: 3, 9: 4, 10: 4, 12: 8, 13: 6, 14: 5}  # element type (those of VTK) -> number of nodes
# Formats that do not declare how many elements they have -> a section of elements, and the number of one in it
_LINE_NUMBER = re.compile(rb"^[ \t]*(\d{1,15})\b", re.MULTILINE)
_KRATOS = re.compile(rb"^[ \t]*Begin Elements\b[^\n]*\n.*?(?=^[ \t]*End\b)", re.MULTILINE | re.DOTALL)
_PERMAS = re.compile(rb"^\$ELEMENT\b[^\n]*\n[^$]*", re.MULTILINE)
_ELEMENTS = {
    ".mdpa": (_KRATOS, _LINE_NUMBER),
    ".post": (_PERMAS, _LINE_NUMBER), ".dato": (_PERMAS, _LINE_NUMBER),
    ".f3grid": (re.compile(rb".+", re.DOTALL), re.compile(rb"^Z[ \t]+\w+[ \t]+(\d{1,15})\b", re.MULTILINE)),
}  # fmt: skip


def read_with_meshio(path: Path) -> MeshFileContents:
    """Points, cells and sets of a file.

    To be called in a process with limits: damaged files make some readers of meshio wait, or ask for memory.

    Raises:
        MeshError: the file is damaged, or names one that may not be read.
    """
    stopped_at: list[int] = []
    try:
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            contents = _contents(path, _mesh(path, stopped_at))
            return replace(contents, notes=contents.notes + _gap_note(path))
    except MeshError:
        raise
    except (Exception, SystemExit):  # readers of meshio raise whatever their parsers raise, or exit
        _refuse(path, stopped_at[0] if stopped_at else None)


def _refuse(path: Path, offset: int | None) -> NoReturn:
    """Raises MeshError; `offset`: where meshio's reader stopped, if known."""
    format_, _, text = FORMATS.get(path.suffix.lower(), ("this kind", "", False))
    where = ""
    if text and offset is not None and path.stat().st_size < 1 << 26:  # lines of larger files take long to count
        data = path.read_bytes()
        lines = data[:offset].rstrip(b"\r\n").split(b"\n")
        where = f"Its reader stopped at line {len(lines)}: `{excerpt(lines[-1])}`. "
        if offset >= len(data):
            where = f"Its reader came to the end, line {len(lines)}: was the file cut off? "
    reason = f"it is damaged, or no file of the format {format_}, or holds something of it that is not supported"
    refuse_file(path, reason, f"{where}{PLY_ADVICE if format_ == 'PLY' else ADVICE}")


def _mesh(path: Path, stopped_at: list[int]) -> Any:
    """The mesh that meshio reads; if it fails on text, the offset at which it stopped is added to `stopped_at`."""
    import meshio

    ending = path.suffix.lower()
    if ending in (".xdmf", ".xmf"):
        return _xdmf_reader(path).read()
    if ending in (".ele", ".node"):
        second = path.stem + {".ele": ".node", ".node": ".ele"}[ending]
        _check_beside(path, second)
        _check_tetgen(path)
        _check_tetgen(path.parent / second)
    elif ending == ".ugrid":
        return _ugrid(path)
    elif is_hdf5(path):
        _check_hdf5(path, path)
    elif ending == ".ply":
        data = checked_ply(path)
        # a BytesIO has all methods of a raw stream that BufferedReader calls
        with _EndingReader(cast(io.RawIOBase, io.BytesIO(data))) as file:
            mesh = meshio.read(file, "ply")
        check_ply_length(path, data, mesh)
        return mesh
    elif FORMATS[ending][1]:
        _, name, text = FORMATS[ending]
        if name == "su2":
            _check_su2(path)
        with _EndingReader(path.open("rb", buffering=0)) as file:
            stream = _TextLines(file) if text else file
            try:
                return meshio.ansys.read(file) if name == "ansys" else meshio.read(stream, name)
            except (Exception, SystemExit):
                with contextlib.suppress(OSError, ValueError):
                    stopped_at.append(stream.tell() & (1 << 63) - 1)  # the state of the text decoder is in higher bits
                raise
    return meshio.read(path)


# --- contents of meshio's mesh --------------------------------------------------------------------------------------


def _contents(path: Path, mesh: Any) -> MeshFileContents:
    """The arrays of meshio's mesh."""
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
    return MeshFileContents(points.astype(np.float64), blocks, sets | named, nodes, notes=notes)


def _block(block: Any) -> Block:
    if isinstance(block.data, np.ndarray) and block.data.dtype != object:
        return Block(block.type, np.asarray(block.data, np.int64))
    return Block(block.type, np.zeros((len(block.data), 0), np.int64))  # polygons and polyhedra: refused by kind later


def _named_sets(mesh: Any, blocks: list[Block]) -> dict[str, list[Indices]]:
    """Sets of cells that the file names."""
    sets = {}
    for name, members in (mesh.cell_sets or {}).items():
        if len(members) == len(blocks) and not str(name).startswith("gmsh:"):
            sets[str(name)] = [np.asarray([] if part is None else part, np.int64) for part in members]
    return sets


def _names_of(mesh: Any, tag: int, dim: int) -> list[str]:
    """Names of a tag: that of the field data with its number and dimension, else "tag-<n>"."""
    for name, value in (mesh.field_data or {}).items():
        if np.shape(value) == (2,) and (int(value[0]), int(value[1])) == (tag, dim) and str(name).strip():
            return [str(name)]
    return [f"tag-{tag}"]


def _gap_note(path: Path) -> tuple[str, ...]:
    """A note if a few element numbers are unused in a format that does not declare how many elements it has."""
    patterns = _ELEMENTS.get(path.suffix.lower())
    if patterns is None:
        return ()
    section, element = patterns
    data = path.read_bytes().replace(b"\r", b"\n")
    numbers = [int(match[1]) for part in section.finditer(data) for match in element.finditer(data, *part.span())]
    unused, first = DAMAGE.gaps_in(np.array(numbers, np.int64), 1)
    if not unused:
        return ()
    return (
        f"Element numbers left out: {unused}, first {first}; are cells missing because lines of the file are lost?",
    )


# --- files before meshio opens them ---------------------------------------------------------------------------------


def _check_su2(path: Path) -> None:
    """Raise MeshError if a list of SU2 has more or fewer lines than declared, or an element of an unknown type."""
    source = SourceText(path, _without_comments(path, b"%"))
    heads = list(re.finditer(rb"^[ \t]*(\w+)[ \t]*=[ \t]*(\d*)[^\n]*\n?", source.text, re.MULTILINE))
    for head, after in zip(heads, [*heads[1:], None], strict=True):
        if head[1] not in (b"NPOIN", b"NELEM", b"MARKER_ELEMS") or not head[2]:
            continue
        keyword = decode_text(head[1])
        end = after.start() if after else len(source.text)
        rows = source.rows(head.end(), end, "the numbers of a point or an element")
        if keyword != "NPOIN" and len(rows):
            types = rows.columns(slice(None), 1)[:, 0]
            nodes = np.array([SU2_NODES.get(type_, -9) for type_ in types])
            wrong = (rows.counts != nodes + 1) & (rows.counts != nodes + 2)
            if wrong.any():
                row = int(wrong.argmax())
                count = int(rows.counts[row]) - 1
                supported = ", ".join(f"{type_} ({number} nodes)" for type_, number in SU2_NODES.items())
                why = f"an element has the type {types[row]:g} and {count} numbers behind it"
                source.refuse(int(rows.offsets[row]), f"{why}; supported are the types {supported}. {ADVICE}")
        if len(rows) != int(head[2]):
            source.damaged(head.start(1), f"{keyword}= {int(head[2])} is declared, and {len(rows)} lines stand there.")


def _ugrid(path: Path) -> Any:
    """The mesh that meshio reads from a UGRID file; MeshError if data follow the last cell that it declares."""
    from meshio.ugrid._ugrid import determine_file_type, read_buffer

    kind = determine_file_type(str(path))
    with path.open(encoding="utf-8", errors="replace") if kind["type"] == "ascii" else path.open("rb") as file:
        mesh = read_buffer(file, kind)
        behind = len(file.read().strip())
    if behind:
        declared = ", ".join(f"{len(block.data)} {block.type}" for block in mesh.cells)
        refuse_file(
            path,
            f"it declares {len(mesh.points)} points and cells ({declared}), and {behind} bytes are left behind them",
            f"Lists of other data are not supported. {ADVICE}",
        )
    return mesh


def _check_tetgen(path: Path) -> None:
    """Raise MeshError if a file of TetGen is empty, or has other numbers of lines or columns than declared."""
    # meshio waits for the first line of a file without numbers
    source = SourceText(path, _without_comments(path, b"#"))
    rows = source.rows(0, len(source.text), "the numbers of a node or an element")
    if not len(rows):
        refuse_file(path, "it holds no numbers")
    head = rows.columns([0], int(rows.counts[0]))[0].astype(np.int64)
    if path.suffix.lower() == ".ele" and len(head) == 3:
        width = 1 + int(head[1]) + int(head[2])
    elif path.suffix.lower() == ".node" and len(head) == 4:
        width = 1 + int(head[1]) + int(head[2]) + int(head[3])
    else:
        return  # meshio refuses it
    if len(rows) - 1 != head[0]:
        source.damaged(int(rows.offsets[0]), f"{head[0]} lines are declared, and {len(rows) - 1} stand there.")
    wrong = rows.counts[1:] != width
    if wrong.any():
        row = 1 + int(wrong.argmax())
        source.damaged(int(rows.offsets[row]), f"{int(rows.counts[row])} numbers stand here instead of {width}.")


def _without_comments(path: Path, mark: bytes) -> bytes:
    """The text of a file with blanks in place of comments, so that offsets stay."""
    text = path.read_bytes().replace(b"\r", b" ")
    return re.sub(mark + rb"[^\n]*", lambda comment: b" " * len(comment[0]), text) if mark in text else text


def _check_beside(path: Path, name: str) -> None:
    """Raise MeshError if a file that the file names is not a plain file in its folder."""
    if reason := unreadable_reason_beside(path, name):
        refuse_file(path, f"it names the file '{name}', which {reason}", "Put all files of the mesh into one folder.")


def _check_hdf5(path: Path, h5: Path) -> None:
    """Raise MeshError if an HDF5 file has data in other files; `path`: the file that names it, or the same."""
    import h5py

    with h5py.File(h5) as file:
        if name := find_external_data(file):
            refuse_file(path, f"the data of '{name}' in {h5.name} lie in another file", "Save all in one.")


def _xdmf_reader(path: Path) -> Any:
    """A reader of XDMF by meshio, which checks each file that a data item names before it opens it."""
    from meshio.xdmf.main import XdmfReader

    checked: set[str] = set()

    class Reader(XdmfReader):  # type: ignore[misc]
        def _read_data_item(self, item: Any, root: Any = None) -> Any:
            named = "Reference" not in item.attrib and item.get("Format") in ("HDF", "Binary")
            if named and (text := (item.text or "").strip()):
                name = text.rpartition(":")[0] if item.get("Format") == "HDF" else text
                if name not in checked:
                    _check_beside(path, name)
                    if item.get("Format") == "HDF":
                        _check_hdf5(path, path.parent / name)
                    checked.add(name)
                if item.get("Format") == "Binary":
                    item.text = os.path.abspath(path.parent / name)  # meshio looks in the working folder
            return super()._read_data_item(item, root)

    return Reader(str(path))


class _EndingReader(io.BufferedReader):
    """A file that raises EOFError if it is read beyond its end again and again.

    Some readers of meshio wait there for the end of a section, if a file was cut off.
    """

    _beyond = 0  # reads beyond the end, one after another
    _max_beyond = 1000  # no reader that comes to an end does so often

    def _checked(self, data: bytes) -> bytes:
        self._beyond = 0 if data else self._beyond + 1
        if self._beyond > self._max_beyond:
            raise EOFError("it ends in the middle of a section")
        return data

    def read(self, size: int | None = -1, /) -> bytes:
        return self._checked(super().read(size))

    def read1(self, size: int = -1, /) -> bytes:
        return self._checked(super().read1(size))

    def readline(self, size: int | None = -1, /) -> bytes:
        return self._checked(super().readline(size))


class _TextLines:
    """The text of a file, whose position can be told while it is read line by line; else as TextIOWrapper."""

    def __init__(self, file: io.BufferedReader) -> None:
        self._text = io.TextIOWrapper(file, encoding="utf-8", errors="replace")

    def __iter__(self) -> Iterator[str]:
        return self

    def __next__(self) -> str:
        # next() of a TextIOWrapper reads ahead and forbids tell(); readline() does not
        if line := self._text.readline():
            return line
        raise StopIteration

    def __getattr__(self, name: str) -> Any:
        return getattr(self._text, name)
