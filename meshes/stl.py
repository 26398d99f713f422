"""Triangles of an STL file, text or binary, of any writer.

Not by meshio (5.3), which takes only `endloop` in one word, and reads on behind the end of a file that was cut.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import numpy.typing as npt

from .data import MeshError
from .mesh_conversion import Block, MeshFileContents
from .text_rows import parse_numbers

HEAD = 84  # bytes of a binary file before its triangles: 80 of text, 4 of their number
TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_WORDS = re.compile(rb"^[ \t]*(vertex|end[ \t]*facet|end[ \t]*loop)\b", re.IGNORECASE | re.MULTILINE)
_VERTEX = rb"\s*+vertex([ \t]++\S++[ \t]++\S++[ \t]++\S++)[ \t]*+\n"
_FACET = re.compile(
    rb"(\s*+(?:end[ \t]*+solid\b[^\n]*+\n\s*+solid\b[^\n]*+\n\s*+)?+facet\b[^\n]*+\n\s*+outer[ \t]*+loop[ \t]*+\n"
    + 3 * _VERTEX + rb"\s*+end[ \t]*+loop[ \t]*+\n\s*+end[ \t]*+facet\b)", re.IGNORECASE,
)  # fmt: skip
_END_FACET = re.compile(rb"end[ \t]*facet\b", re.IGNORECASE)
_END_SOLID = re.compile(rb"\s*end[ \t]*solid\b[^\n]*\s*", re.IGNORECASE)
PART = 1 << 22  # bytes of a text that are read at a time


def read_stl(path: Path) -> MeshFileContents:
    """The triangles, each with three points of its own: STL repeats them.

    Raises:
        MeshError: the file is neither text nor binary STL, or was cut off; with the line of a text file.
    """
    data = path.read_bytes()
    declared = int.from_bytes(data[80:HEAD], "little")
    beyond = len(data) - HEAD - TRIANGLE.itemsize * declared
    if declared and beyond >= 0:  # never of text, which gives a huge number there
        if beyond and beyond % TRIANGLE.itemsize == 0:
            raise MeshError(
                f"Mesh file '{path}' could not be read: it declares {declared} triangles, and holds "
                f"{declared + beyond // TRIANGLE.itemsize}. It is damaged; export it again."
            )
        corners = np.frombuffer(data, TRIANGLE, declared, HEAD)["corners"].astype(np.float64)
    elif data[:4096].lstrip()[:5].lower() == b"solid" and b"\0" not in data[HEAD:4096]:
        if b"\r" in data:
            data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
        plain = _of_plain_text(data)
        corners = _of_text(path, data) if plain is None else plain
    elif len(data) < HEAD:
        raise MeshError(
            f"Mesh file '{path}' could not be read: it begins with {data[:16]!a}, not as STL does (`solid`)."
        )
    else:
        room = (len(data) - HEAD) // TRIANGLE.itemsize
        raise MeshError(
            f"Mesh file '{path}' could not be read: it declares {declared} triangles, and has room for {room}. It is "
            "damaged or no STL file; export it again."
        )
    triangles = np.arange(3 * len(corners)).reshape(-1, 3)
    return MeshFileContents(corners.reshape(-1, 3), [Block("triangle", triangles)], {})


def _of_plain_text(data: bytes) -> npt.NDArray[np.float64] | None:
    """(k, 3, 3) corners of a text in which each facet has its seven lines; None of any other text.

    In parts: with less time and memory than `_of_text`, which says what is wrong.
    """
    corners: list[npt.NDArray[np.float64]] = []
    begin = data.find(b"\n") + 1
    while not _END_SOLID.fullmatch(data, begin):
        last = _END_FACET.search(data, begin + PART)
        facets = _FACET.findall(data, begin, last.end() if last else len(data))
        begin += sum(len(facet[0]) for facet in facets)
        values = parse_numbers(b"".join(vertex for facet in facets for vertex in facet[1:]))
        if not facets or (last and begin != last.end()) or values is None or len(values) != 9 * len(facets):
            return None
        corners.append(values.reshape(-1, 3, 3))
    return np.concatenate(corners) if corners else None


def _of_text(path: Path, data: bytes) -> npt.NDArray[np.float64]:
    """(k, 3, 3) corners: what stands behind each `vertex`; three for each `endfacet`."""
    parts = _WORDS.split(data)
    plain = {word: b"".join(word.split()).lower() for word in set(parts[1::2])}
    words = [plain[word] for word in parts[1::2]]
    ends = sum(word == b"endfacet" for word in words)
    texts = [text.split() for word, text in zip(words, parts[2::2], strict=True) if word == b"vertex"]
    expected = [b"vertex"] * 3 + [b"endloop", b"endfacet"]
    wrong = next((i for i, word in enumerate(words) if word != expected[i % 5]), len(words))
    if wrong < len(words) or len(words) % 5 or not ends:
        raise MeshError(
            f"Mesh file '{path}', line {_line(parts, wrong)}: a facet of STL has three lines `vertex x y z`, then "
            f"`endloop` and `endfacet` ({ends} of them are whole). The file is damaged or was cut off; export it again."
        )
    if not re.search(rb"end\s*solid", parts[-1], re.IGNORECASE):
        raise MeshError(
            f"Mesh file '{path}', line {_line(parts, len(words))}: the file ends without `endsolid` behind {ends} "
            "facets. It was cut off; export it again."
        )
    try:
        if any(len(text) != 3 for text in texts):
            raise ValueError
        return np.array([x for text in texts for x in text]).astype(np.float64).reshape(-1, 3, 3)
    except ValueError:
        bad = next(i for i, text in enumerate(texts) if not _are_three_numbers(text))
        number = _line(parts, [i for i, word in enumerate(words) if word == b"vertex"][bad])
        said = b" ".join(texts[bad])[:60].decode("utf-8", "replace")
        raise MeshError(
            f"Mesh file '{path}', line {number}: `vertex {said}` does not name three coordinates: vertex 0 0.5 1."
        ) from None


def _are_three_numbers(text: list[bytes]) -> bool:
    try:
        return len([float(x) for x in text]) == 3
    except ValueError:
        return False


def _line(parts: list[bytes], word: int) -> int:
    """The line, from 1, of a keyword of a file that was split at them."""
    return 1 + sum(part.count(b"\n") for part in parts[: 2 * word + 1])
