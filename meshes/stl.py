"""STL files, text or binary, as any program writes them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import numpy.typing as npt

from .file_text import parse_numbers, refuse_file, refuse_line, with_line_feeds
from .mesh_conversion import Block, MeshFileContents

HEAD = np.dtype([("text", "S80"), ("count", "<u4")])  # of a binary file
TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
MAX_ROUNDING = 1e-3  # spacing of the coordinates of a binary file over the size of its body
_WORDS = re.compile(rb"^[ \t]*(vertex|end[ \t]*facet|end[ \t]*loop)\b", re.IGNORECASE | re.MULTILINE)
_VERTEX = rb"\s*+vertex([ \t]++\S++[ \t]++\S++[ \t]++\S++)[ \t]*+\n"
_FACET = re.compile(
    rb"(\s*+(?:end[ \t]*+solid\b[^\n]*+\n\s*+solid\b[^\n]*+\n\s*+)?+facet\b[^\n]*+\n\s*+outer[ \t]*+loop[ \t]*+\n"
    + 3 * _VERTEX + rb"\s*+end[ \t]*+loop[ \t]*+\n\s*+end[ \t]*+facet\b)", re.IGNORECASE,
)  # fmt: skip
_END_FACET = re.compile(rb"end[ \t]*facet\b", re.IGNORECASE)
_END_SOLID = re.compile(rb"\s*end[ \t]*solid\b[^\n]*\s*", re.IGNORECASE)


def read_stl(path: Path) -> MeshFileContents:
    """The triangles, each with three points of its own, since STL repeats them.

    Raises:
        MeshError: the file is neither text nor binary STL, or was cut off; with the line of a text file.
    """
    # Not by meshio 5.3, which knows `endloop` in one word alone, and reads beyond the end of a file that was cut off.
    data, head, size = path.read_bytes(), HEAD.itemsize, TRIANGLE.itemsize
    declared = int.from_bytes(data[head - 4 : head], "little")
    beyond = len(data) - head - size * declared
    if declared and beyond >= 0:  # never of text, whose letters are a huge number
        if beyond and beyond % size == 0:
            refuse_file(path, f"it declares {declared} triangles, and holds {declared + beyond // size}")
        corners = np.frombuffer(data, TRIANGLE, declared, head)["corners"].astype(np.float64)
        _check_resolution(path, corners)
    elif data[:4096].lstrip()[:5].lower() == b"solid" and b"\0" not in data[head:4096]:
        data = with_line_feeds(data)
        regular = _corners_of_regular_text(data)
        corners = _corners_of_text(path, data) if regular is None else regular
    elif len(data) < head:
        refuse_file(path, f"it begins with {data[:16]!a}, not as STL does (`solid`)")
    else:
        holds = (len(data) - head) // size
        refuse_file(
            path,
            f"it declares {declared} triangles, and has room for {holds}",
            "It is damaged or no STL file; export it again.",
        )
    triangles = np.arange(3 * len(corners)).reshape(-1, 3)
    return MeshFileContents(corners.reshape(-1, 3), [Block("triangle", triangles)], {})


def _check_resolution(path: Path, corners: npt.NDArray[np.float64]) -> None:
    """Raise MeshError if a body is so far from the origin that coordinates of 32 bits round off its shape."""
    finite = corners[np.isfinite(corners).all(axis=(1, 2))].reshape(-1, 3)
    if not len(finite) or np.array_equal(finite, np.rint(finite)):  # whole numbers are exact
        return
    rounding, size = float(np.spacing(np.float32(np.abs(finite).max()))), float(np.ptp(finite, axis=0).max())
    if 0 < MAX_ROUNDING * size < rounding:
        refuse_file(
            path,
            f"its coordinates have 32 bits, which round them by up to {rounding / 2:.2g} so far from the origin, of "
            f"{size:.3g} that it measures",
            "Move the body to the origin before the export, or export it as OBJ.",
        )


def _corners_of_regular_text(data: bytes, part: int = 1 << 22) -> npt.NDArray[np.float64] | None:
    """(k, 3, 3) corners of a text in which each facet has seven lines; None of any other text.

    Faster than `_corners_of_text`, which can tell what is wrong. `part`: bytes that are read at a time.
    """
    corners: list[npt.NDArray[np.float64]] = []
    begin = data.find(b"\n") + 1
    while not _END_SOLID.fullmatch(data, begin):
        last = _END_FACET.search(data, begin + part)
        facets = _FACET.findall(data, begin, last.end() if last else len(data))
        begin += sum(len(facet[0]) for facet in facets)
        values = parse_numbers(b"".join(vertex for facet in facets for vertex in facet[1:]))
        if not facets or (last and begin != last.end()) or values is None or len(values) != 9 * len(facets):
            return None
        corners.append(values.reshape(-1, 3, 3))
    return np.concatenate(corners) if corners else None


def _corners_of_text(path: Path, data: bytes) -> npt.NDArray[np.float64]:
    """(k, 3, 3) corners: the numbers behind each `vertex`, three of them for each `endfacet`."""
    parts = _WORDS.split(data)
    joined = {word: b"".join(word.split()).lower() for word in set(parts[1::2])}
    words = [joined[word] for word in parts[1::2]]
    ends = sum(word == b"endfacet" for word in words)
    texts = [text.split() for word, text in zip(words, parts[2::2], strict=True) if word == b"vertex"]
    # the keywords of one facet after another
    expected = [b"vertex"] * 3 + [b"endloop", b"endfacet"]
    wrong = next((i for i, word in enumerate(words) if word != expected[i % 5]), len(words))
    if wrong < len(words) or len(words) % 5 or not ends:
        refuse_line(
            path,
            _line(parts, wrong),
            f"a facet of STL has three lines `vertex x y z`, then `endloop` and `endfacet` ({ends} of them are whole). "
            "The file is damaged or was cut off; export it again.",
        )
    if not re.search(rb"end\s*solid", parts[-1], re.IGNORECASE):
        refuse_line(
            path,
            _line(parts, len(words)),
            f"the file ends without `endsolid` behind {ends} facets. It was cut off; export it again.",
        )
    bad = next((i for i, text in enumerate(texts) if not _are_three_numbers(text)), None)
    if bad is not None:
        line = _line(parts, [i for i, word in enumerate(words) if word == b"vertex"][bad])
        coordinates = b" ".join(texts[bad])[:60].decode("utf-8", "replace")
        refuse_line(path, line, f"`vertex {coordinates}` does not name three coordinates: vertex 0 0.5 1.")
    return np.array([x for text in texts for x in text]).astype(np.float64).reshape(-1, 3, 3)


def _are_three_numbers(text: list[bytes]) -> bool:
    try:
        return len([float(x) for x in text]) == 3
    except ValueError:
        return False


def _line(parts: list[bytes], word: int) -> int:
    """The line, counted from 1, of the keyword number `word` of a file that was split at its keywords."""
    return 1 + sum(part.count(b"\n") for part in parts[: 2 * word + 1])
