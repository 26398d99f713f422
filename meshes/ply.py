"""PLY files, checked against their head before and after meshio reads them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .data import Indices
from .file_text import SourceText, decode_text, excerpt, refuse_file

PLY_ADVICE = "Supported are points and faces; export the surface again, as PLY, STL or OBJ (Blender, MeshLab)."
_HEAD = re.compile(rb"ply[ \t]*\r?\n(.*?)^[ \t]*end_header[ \t]*\r?\n", re.DOTALL | re.MULTILINE)
# Type of a property -> its bytes. meshio does not know the names char, uchar, ushort and uint: they become NumPy's.
_TYPES = {
    "char": 1, "uchar": 1, "int8": 1, "uint8": 1, "short": 2, "ushort": 2, "int16": 2, "uint16": 2, "int": 4, "uint": 4,
    "int32": 4, "uint32": 4, "float": 4, "float32": 4, "int64": 8, "uint64": 8, "double": 8, "float64": 8,
}  # fmt: skip
_KNOWN_TYPES = {b"char": b"int8", b"uchar": b"uint8", b"ushort": b"uint16", b"uint": b"uint32"}
MAX_HEAD = 65536  # bytes; more is no head of PLY


def checked_ply(path: Path) -> bytes:
    """The bytes of a PLY file as meshio can read them.

    Raises:
        MeshError: the head is not PLY's, lines of text do not fit it, or binary faces have other properties.
    """
    data = path.read_bytes()
    _check_text(SourceText(path, data))
    return _with_known_head(data)


@dataclass(frozen=True)
class PlyElement:
    """An element that the head of a PLY file declares, such as `vertex`.

    Attributes:
        name: of the element.
        count: of its lines or records.
        properties: for each property the words behind `property`: ["float", "x"] or ["list", "uchar", "int", "..."].
    """

    name: str
    count: int
    properties: list[list[str]]

    def widths(self, values: npt.NDArray[np.float64], begins: Indices, ends: Indices) -> Indices:
        """(n,) how many numbers each line has to hold: one for a property; for a list its count and as many.

        Args:
            values: all numbers of the file.
            begins: (n,) index of the first number of each line.
            ends: (n,) index behind the last number of each line.
        """
        end = begins.copy()
        for words in self.properties:
            if words[0] == "list":
                counts = np.where(end < ends, values[np.minimum(end, len(values) - 1)], 0)
                end += np.clip(np.nan_to_num(counts), 0, len(values)).astype(np.int64)
            end += 1
        widths: Indices = end - begins
        return widths


def _declared_elements(head: bytes) -> list[PlyElement]:
    """The elements that a head declares."""
    elements: list[PlyElement] = []
    for line in head.splitlines():
        words = decode_text(line).split()
        if words[:1] == ["element"] and len(words) == 3 and words[2].isdigit():
            elements.append(PlyElement(words[1], int(words[2]), []))
        elif words[:1] == ["property"] and len(words) > 2 and elements:
            elements[-1].properties.append(words[1:])
    return elements


def _check_text(source: SourceText) -> None:
    """Raise MeshError if the head or, of a file in text, a line is not as PLY has it."""
    text = source.text
    head = _HEAD.match(text[: 2 * MAX_HEAD])
    if not head:
        begin = excerpt(text[:80])
        source.refuse(0, f"`{begin}` does not begin the head of PLY: `ply`, ..., `end_header`. {PLY_ADVICE}")
    elements = _declared_elements(head[1])
    if not re.search(rb"^format\s+ascii\b", head[1], re.MULTILINE):
        for element in elements:
            # meshio reads only the list of corners of a binary face
            if len(element.properties) > 1 and any(words[0] == "list" for words in element.properties):
                why = f"a {element.name} has {len(element.properties)} properties, and of binary PLY only the corners"
                source.refuse(0, f"{why} are supported; save as text, or without colours of faces. {PLY_ADVICE}")
        return
    lines = source.rows(head.end(), len(text), "the numbers of a point or a face")
    contents = ", ".join(f"{element.count} {element.name}" for element in elements)
    declared = sum(element.count for element in elements)
    if len(lines) < declared:
        why = f"the file ends after {len(lines)} lines of data, and declares {contents}."
        source.refuse(len(text) - 1, f"{why} {PLY_ADVICE}")
    first = 0
    for element in elements:
        rows = slice(first, first + element.count)
        wrong = element.widths(lines.values, lines.begins[rows], lines.ends[rows]) != lines.counts[rows]
        if wrong.any():
            offset = int(lines.offsets[rows][wrong.argmax()])
            line = excerpt(text[offset : offset + 80])
            why = f"`{line}` holds more or fewer numbers than a {element.name} has by the head and by its own counts."
            source.refuse(offset, f"{why} The file declares {contents}. {PLY_ADVICE}")
        first += element.count
    if len(lines) > declared:
        why = f"the file declares {contents}, {declared} lines of data, and holds {len(lines)}."
        source.refuse(int(lines.offsets[declared]), f"{why} {PLY_ADVICE}")


def check_ply_length(path: Path, data: bytes, mesh: Any) -> None:
    """Raise MeshError if a binary file goes on behind the last element that it declares.

    Args:
        path: the file, for the message.
        data: its bytes, of `checked_ply`.
        mesh: meshio's mesh.
    """
    head = _HEAD.match(data[: 2 * MAX_HEAD])
    if not head or re.search(rb"^format\s+ascii\b", head[1], re.MULTILINE):
        return
    elements = _declared_elements(head[1])
    contents = ", ".join(f"{element.count} {element.name}" for element in elements)
    end = head.end()
    for element in elements:
        lists = [words for words in element.properties if words[0] == "list"]
        if not lists:
            end += element.count * sum(_TYPES[words[0]] for words in element.properties)
        else:
            count, corner = _TYPES[lists[0][1]], _TYPES[lists[0][2]]
            end += sum(len(block.data) * (count + corner * block.data.shape[1]) for block in mesh.cells)
    # a few blanks may follow, too few bytes for a face
    if data[end:].strip(b"\0\r\n\t \x1a") or len(data) - end > 8:
        refuse_file(path, f"it declares {contents}, and {len(data) - end} bytes are left behind them", PLY_ADVICE)


def _with_known_head(data: bytes) -> bytes:
    """A PLY file whose head has the names that meshio knows, of types and of the corners of faces."""
    head, keyword, body = data.partition(b"end_header")
    if not keyword or len(head) > MAX_HEAD:
        return data
    lines = [line.split() for line in head.splitlines()]
    for line in lines:
        if line[:1] == [b"property"]:
            line[1:-1] = [_KNOWN_TYPES.get(word, word) for word in line[1:-1]]
            if line[1:2] == [b"list"] and line[-1] == b"vertex_index":
                line[-1] = b"vertex_indices"
    return b"\n".join(b" ".join(line) for line in lines if line) + b"\n" + keyword + body
