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
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from .data import Indices, MeshError
from .mesh_conversion import Block, MeshFileContents
from .plain_files import find_external_data, is_hdf5, unreadable_reason_beside
from .tags import tag_sets
from .text_rows import SourceText, decode_text, shown

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
_PLY_BYTES = {
    "char": 1, "uchar": 1, "int8": 1, "uint8": 1, "short": 2, "ushort": 2, "int16": 2, "uint16": 2, "int": 4, "uint": 4,
    "int32": 4, "uint32": 4, "float": 4, "float32": 4, "int64": 8, "uint64": 8, "double": 8, "float64": 8,
}  # fmt: skip
SU2_NODES = {3: 2, 5: 3, 9: 4, 10: 4, 12: 8, 13: 6, 14: 5}  # of each type of element: those of VTK
# Formats that do not say how many elements they have: a part of the file with elements, and the number of one in it.
_LINE_NUMBER = re.compile(rb"^[ \t]*(\d{1,15})\b", re.MULTILINE)
_KRATOS = re.compile(rb"^[ \t]*Begin Elements\b[^\n]*\n.*?(?=^[ \t]*End\b)", re.MULTILINE | re.DOTALL)
_PERMAS = re.compile(rb"^\$ELEMENT\b[^\n]*\n[^$]*", re.MULTILINE)
_ELEMENTS = {
    ".mdpa": (_KRATOS, _LINE_NUMBER),
    ".post": (_PERMAS, _LINE_NUMBER), ".dato": (_PERMAS, _LINE_NUMBER),
    ".f3grid": (re.compile(rb".+", re.DOTALL), re.compile(rb"^Z[ \t]+\w+[ \t]+(\d{1,15})\b", re.MULTILINE)),
}  # fmt: skip
MAX_GAPS, MAX_GAP_SHARE = 3, 0.01  # element numbers left out that are told of, or so many of all elements
MAX_PLY_HEAD = 65536  # bytes
MAX_PLY_FILLING = 8  # bytes behind the last face, too few for a face
MAX_LINE_SEARCH = 1 << 26  # bytes of a file in which the line of a fault is looked for
MAX_READS_BEYOND_END = 1000  # times that a file is read beyond its end: no reader that comes to an end does so often


def read_with_meshio(path: Path) -> MeshFileContents:
    """Everything in a file, for a process of its own: damaged files make some readers of meshio wait or ask for memory.

    Raises:
        MeshError: the file is damaged, or names one that may not be read.
    """
    position: list[int] = []
    try:
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            contents = _contents(path, _mesh(path, position))
            return replace(contents, notes=contents.notes + _gap_note(path))
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
        second = path.stem + {".ele": ".node", ".node": ".ele"}[ending]
        _check(path, second)
        _check_begun(path)
        _check_begun(path.parent / second)
        _check_tetgen(path)
        _check_tetgen(path.parent / second)
    elif ending == ".ugrid":
        return _ugrid(path)
    elif is_hdf5(path):
        _check_hdf5(path, path)
    elif ending == ".ply":
        data = path.read_bytes()
        _check_ply(SourceText(path, data))
        with _Ending(io.BytesIO(_with_known_head(data))) as file:  # type: ignore[arg-type]
            mesh = meshio.read(file, "ply")
        _check_binary_ply(path, _with_known_head(data), mesh)
        return mesh
    elif FORMATS[ending][1]:
        _, name, text = FORMATS[ending]
        if name == "su2":
            _check_su2(path)
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


def _contents(path: Path, mesh: Any) -> MeshFileContents:
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


def _gap_note(path: Path) -> tuple[str, ...]:
    """A note where a few element numbers are left out, in a format that does not say how many elements it has."""
    patterns = _ELEMENTS.get(path.suffix.lower())
    if patterns is None:
        return ()
    section, element = patterns
    data = path.read_bytes().replace(b"\r", b"\n")
    numbers = [int(match[1]) for part in section.finditer(data) for match in element.finditer(data, *part.span())]
    distinct = np.unique(numbers)
    missing = int(distinct[-1]) - len(distinct) if len(distinct) else 0
    if not 0 < missing <= max(MAX_GAPS, MAX_GAP_SHARE * len(distinct)):
        return ()
    first = int(np.flatnonzero(np.append(distinct, 0) != np.arange(1, len(distinct) + 2))[0]) + 1
    return (
        f"Element numbers left out: {missing}, first {first}; are cells missing because lines of the file are lost?",
    )


# --- files before meshio opens them ---------------------------------------------------------------------------------


def _check_ply(source: SourceText) -> None:
    """MeshError for a file without the head of PLY; with its line for text with fewer lines than declared, or words."""
    text = source.text
    head = _PLY_HEAD.match(text[: 2 * MAX_PLY_HEAD])
    if not head:
        source.refuse(0, f"`{shown(text[:80])}` does not begin the head of PLY: `ply`, ..., `end_header`. {PLY_ADVICE}")
    elements = _ply_elements(head[1])
    if not re.search(rb"^format\s+ascii\b", head[1], re.MULTILINE):
        for element in elements:
            if len(element.properties) > 1 and any(words[0] == "list" for words in element.properties):
                why = f"a {element.name} has {len(element.properties)} properties, and of binary PLY only the corners"
                source.refuse(0, f"{why} are supported; save as text, or without colours of faces. {PLY_ADVICE}")
        return
    lines = source.rows(head.end(), len(text), "the numbers of a point or a face")
    allowed = ", ".join(f"{element.count} {element.name}" for element in elements)
    declared = sum(element.count for element in elements)
    if len(lines) < declared:
        why = f"the file ends after {len(lines)} lines of data, and declares {allowed}."
        source.refuse(len(text) - 1, f"{why} {PLY_ADVICE}")
    first = 0
    for element in elements:
        rows = slice(first, first + element.count)
        wrong = element.widths(lines.values, lines.begins[rows], lines.ends[rows]) != lines.counts[rows]
        if wrong.any():
            position = int(lines.offsets[rows][wrong.argmax()])
            line = shown(text[position : position + 80])
            why = f"`{line}` holds more or fewer numbers than a {element.name} has by the head and by its own counts."
            source.refuse(position, f"{why} The file declares {allowed}. {PLY_ADVICE}")
        first += element.count
    if len(lines) > declared:
        why = f"the file declares {allowed}, {declared} lines of data, and holds {len(lines)}."
        source.refuse(int(lines.offsets[declared]), f"{why} {PLY_ADVICE}")


@dataclass(frozen=True)
class _PlyElement:
    """An element of the head of a PLY file, such as `vertex`.

    Attributes:
        properties: the words behind `property`: ("float", "x") or ("list", "uchar", "int", "vertex_indices").
    """

    name: str
    count: int
    properties: list[list[str]]

    def widths(self, values: npt.NDArray[np.float64], begins: Indices, ends: Indices) -> Indices:
        """(n,) how many numbers each line of text has to hold: one a property; of a list, its count and as many."""
        position = begins.copy()
        for words in self.properties:
            if words[0] == "list":
                counts = np.where(position < ends, values[np.minimum(position, len(values) - 1)], 0)
                position += np.clip(np.nan_to_num(counts), 0, len(values)).astype(np.int64)
            position += 1
        widths: Indices = position - begins
        return widths


def _ply_elements(head: bytes) -> list[_PlyElement]:
    """The elements that the head of a PLY file declares."""
    elements: list[_PlyElement] = []
    for line in head.splitlines():
        words = decode_text(line).split()
        if words[:1] == ["element"] and len(words) == 3 and words[2].isdigit():
            elements.append(_PlyElement(words[1], int(words[2]), []))
        elif words[:1] == ["property"] and len(words) > 2 and elements:
            elements[-1].properties.append(words[1:])
    return elements


def _check_binary_ply(path: Path, data: bytes, mesh: Any) -> None:
    """MeshError for binary PLY, of types that meshio knows, with data behind the last face that it declares."""
    head = _PLY_HEAD.match(data[: 2 * MAX_PLY_HEAD])
    if not head or re.search(rb"^format\s+ascii\b", head[1], re.MULTILINE):
        return
    elements = _ply_elements(head[1])
    allowed = ", ".join(f"{element.count} {element.name}" for element in elements)
    begin = f"Mesh file '{path}' could not be read: "
    end = head.end()
    for element in elements:
        lists = [words for words in element.properties if words[0] == "list"]
        if not lists:
            end += element.count * sum(_PLY_BYTES[words[0]] for words in element.properties)
        else:
            count, corner = _PLY_BYTES[lists[0][1]], _PLY_BYTES[lists[0][2]]
            end += sum(len(block.data) * (count + corner * block.data.shape[1]) for block in mesh.cells)
    if data[end:].strip(b"\0\r\n\t \x1a") or len(data) - end > MAX_PLY_FILLING:
        raise MeshError(f"{begin}it declares {allowed}, and {len(data) - end} bytes are left behind them. {PLY_ADVICE}")


def _check_su2(path: Path) -> None:
    """MeshError where a list of SU2 holds more or fewer lines than declared, or an element of an unknown type."""
    source = SourceText(path, _without_comments(path, b"%"))
    heads = list(re.finditer(rb"^[ \t]*(\w+)[ \t]*=[ \t]*(\d*)[^\n]*\n?", source.text, re.MULTILINE))
    for head, after in zip(heads, [*heads[1:], None], strict=True):
        if head[1] not in (b"NPOIN", b"NELEM", b"MARKER_ELEMS") or not head[2]:
            continue
        word = decode_text(head[1])
        end = after.start() if after else len(source.text)
        rows = source.rows(head.end(), end, "the numbers of a point or an element")
        if word != "NPOIN" and len(rows):
            types = rows.columns(slice(None), 1)[:, 0]
            nodes = np.array([SU2_NODES.get(type_, -9) for type_ in types])
            wrong = (rows.counts != nodes + 1) & (rows.counts != nodes + 2)
            if wrong.any():
                position = int(wrong.argmax())
                count = int(rows.counts[position]) - 1
                supported = ", ".join(f"{type_} ({number} nodes)" for type_, number in SU2_NODES.items())
                why = f"an element has the type {types[position]:g} and {count} numbers behind it"
                source.refuse(int(rows.offsets[position]), f"{why}; supported are the types {supported}. {ADVICE}")
        if len(rows) != int(head[2]):
            source.damaged(head.start(1), f"{word}= {int(head[2])} is declared, and {len(rows)} lines stand there.")


def _ugrid(path: Path) -> Any:
    """meshio's mesh of UGRID; MeshError where anything stands behind the last cell that the file declares."""
    from meshio.ugrid._ugrid import determine_file_type, read_buffer

    kind = determine_file_type(str(path))
    with path.open(encoding="utf-8", errors="replace") if kind["type"] == "ascii" else path.open("rb") as file:
        mesh = read_buffer(file, kind)
        behind = len(file.read().strip())
    if behind:
        declared = ", ".join(f"{len(block.data)} {block.type}" for block in mesh.cells)
        raise MeshError(
            f"Mesh file '{path}' could not be read: it declares {len(mesh.points)} points and cells ({declared}), and "
            f"{behind} bytes are left behind them. Lists of other data are not supported. {ADVICE}"
        )
    return mesh


def _check_tetgen(path: Path) -> None:
    """MeshError where a file of TetGen holds more or fewer lines than declared, or lines of another length."""
    source = SourceText(path, _without_comments(path, b"#"))
    rows = source.rows(0, len(source.text), "the numbers of a node or an element")
    head = rows.columns([0], int(rows.counts[0]))[0].astype(np.int64) if len(rows) else []
    if path.suffix.lower() == ".ele" and len(head) == 3:
        width = 1 + int(head[1]) + int(head[2])
    elif path.suffix.lower() == ".node" and len(head) == 4:
        width = 1 + int(head[1]) + int(head[2]) + int(head[3])
    else:
        return  # refused by meshio
    if len(rows) - 1 != head[0]:
        source.damaged(int(rows.offsets[0]), f"{head[0]} lines are declared, and {len(rows) - 1} stand there.")
    wrong = rows.counts[1:] != width
    if wrong.any():
        position = 1 + int(wrong.argmax())
        source.damaged(
            int(rows.offsets[position]), f"{int(rows.counts[position])} numbers stand here instead of {width}."
        )


def _without_comments(path: Path, mark: bytes) -> bytes:
    """The text of a file, with blanks in the place of comments, so that offsets stay."""
    text = path.read_bytes().replace(b"\r", b" ")
    return re.sub(mark + rb"[^\n]*", lambda comment: b" " * len(comment[0]), text) if mark in text else text


def _with_known_head(data: bytes) -> bytes:
    """A PLY file with the names of its head that meshio knows: of the corners of faces, and of types."""
    head, mark, remaining = data.partition(b"end_header")
    if not mark or len(head) > MAX_PLY_HEAD:
        return data
    lines = [line.split() for line in head.splitlines()]
    for line in lines:
        if line[:1] == [b"property"]:
            line[1:-1] = [_PLY_TYPES.get(word, word) for word in line[1:-1]]
            if line[1:2] == [b"list"] and line[-1] == b"vertex_index":
                line[-1] = b"vertex_indices"
    return b"\n".join(b" ".join(line) for line in lines if line) + b"\n" + mark + remaining


def _check(path: Path, name: str) -> None:
    if wrong := unreadable_reason_beside(path, name):
        raise MeshError(f"Mesh file '{path}' could not be read: it names the file '{name}', which {wrong}.")


def _check_hdf5(path: Path, h5: Path) -> None:
    import h5py

    with h5py.File(h5) as file:
        if name := find_external_data(file):
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
        if self._beyond > MAX_READS_BEYOND_END:
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
    with path.open(encoding="utf-8", errors="replace") as file:
        if not any(line.strip() and not line.strip().startswith("#") for line in file):
            raise MeshError(f"Mesh file '{path}' could not be read: it holds no numbers.")
