"""Points and faces of surfaces in text: Wavefront OBJ and OFF."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from .cell_sets import add_to_set
from .data import Indices
from .file_text import EXPORT_AGAIN, SourceText, excerpt, is_not_integer, refuse_line
from .mesh_conversion import Block, MeshFileContents

KINDS = {3: "triangle", 4: "quad"}  # by the number of corners; faces with more are polygons


def read_obj(path: Path) -> MeshFileContents:
    """Points (n, 3) and faces; sets of faces by the lines `g`, or where there are none by the lines `o`.

    An index k > 0 is the k-th point of the file, k < 0 the k-th from the last one before its line. Text behind the
    first slash of an index, or behind three coordinates, is left out.

    Raises:
        MeshError: a line is no point or face, or a face has a point that does not exist; the message names the line.
    """
    # Not by meshio 5.3: it takes a negative index for a point before the first, colours behind coordinates for more
    # coordinates, and refuses files whose numbers of normals or texture points differ from that of points.
    points: list[list[float]] = []
    blocks: list[tuple[int, list[list[int]]]] = []  # corners of a face, faces
    named: dict[str, list[tuple[str, int, int]]] = {"g": [], "o": []}  # name, block and face that follow the line
    highest = (-1, 0)  # the last point that a face names, and the line of the face
    for line, (word, *values) in _lines(path):
        try:
            if word == "v":
                x, y, z, *_ = map(float, values)
                points.append([x, y, z])
            elif word in named:
                block, face_number = (len(blocks) - 1, len(blocks[-1][1])) if blocks else (0, 0)
                named[word].append((" ".join(values), block, face_number))
            elif word == "f":
                face = [_index(value, len(points)) for value in values]
                highest = max(highest, (max(face), line), key=lambda pair: pair[0])
                if not blocks or blocks[-1][0] != len(face):
                    blocks.append((len(face), []))
                blocks[-1][1].append(face)
        except ValueError:
            expected = "three coordinates: v 0 0.5 1" if word == "v" else "points that are there before it: f 1 2 3"
            refuse_line(path, line, f"`{' '.join([word, *values])[:80]}` does not name {expected}.")
    if highest[0] >= len(points):
        last, line = highest
        refuse_line(path, line, f"there is no point {last + 1}, but {len(points)} in all.")
    faces = [Block(KINDS.get(corners, "polygon"), np.array(rows, np.int64)) for corners, rows in blocks]
    return MeshFileContents(np.array(points, np.float64).reshape(-1, 3), faces, _sets(named["g"] or named["o"], faces))


def _sets(named: list[tuple[str, int, int]], blocks: list[Block]) -> dict[str, list[Indices]]:
    """Sets of faces; a face is in the set of the last name before it.

    `named`: each name with the block and the number therein of the face that follows it.
    """
    sets: dict[str, list[Indices]] = {}
    ends = [tuple(start) for _, *start in named[1:]]
    for (name, *begin), end in zip(named, [*ends, (len(blocks), 0)], strict=False):
        for i, block in enumerate(blocks):
            first = begin[1] if i == begin[0] else 0
            stop = end[1] if i == end[0] else len(block.nodes)
            if name and begin[0] <= i <= end[0] and first < stop:
                add_to_set(sets, blocks, name, i, np.arange(first, stop))
    return sets


def _lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Number and words of each line that is not blank; a line continues after a backslash at its end."""
    begun = ""
    with path.open(encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, 1):
            whole = begun + line.partition("#")[0].rstrip()
            begun = whole[:-1] + " " if whole.endswith("\\") else ""
            if not begun and (words := whole.split()):
                yield number, words


def _index(text: str, count: int) -> int:
    """Index from 0 of an index as written behind `count` points; ValueError of an index before the first point."""
    written = int(text.partition("/")[0])
    index = written - 1 if written > 0 else count + written
    if written == 0 or index < 0:
        raise ValueError(text)
    return index


# --- OFF ------------------------------------------------------------------------------------------------------------

_OFF = re.compile(rb"\s*((?:ST|C|N)*OFF)\b")  # behind the coordinates come colours, normals, points of a texture
_COMMENT = re.compile(rb"#[^\n]*")
FACE_LINE = "a face is `number-of-corners corners...`, numbers from 0"


def read_off(path: Path) -> MeshFileContents:
    """Points (n, 3) and faces of an OFF file in text; colours and normals are left out.

    Raises:
        MeshError: the file is damaged; the message names file and line.
    """
    # Not by meshio 5.3, which takes neither counts behind the keyword nor normals and colours.
    source = SourceText(path, _COMMENT.sub(b"", path.read_bytes()))
    word = _OFF.match(source.text)
    if not word:
        source.refuse(0, f"`{excerpt(source.text[:80])}` is not OFF, with which such a file begins. {EXPORT_AGAIN}")
    lines = source.rows(word.end(), len(source.text), "counts, coordinates, or corners of a face")
    counts = lines.columns([0], 2)[0] if len(lines) and lines.counts[0] in (2, 3) else np.array([-1.0])
    if is_not_integer(counts).any() or counts.min() < 0:
        source.damaged(word.start(1), "no numbers of points and faces stand behind OFF: `8 6 0`.")
    points, faces = map(int, counts)
    if len(lines) != 1 + points + faces:
        where = int(lines.offsets[-1])
        source.damaged(where, f"{points} points and {faces} faces are declared, and {len(lines) - 1} lines are there.")
    if (short := lines.counts[1 : 1 + points] < 3).any():
        source.damaged(int(lines.offsets[1 + short.argmax()]), "a point has three coordinates: `0 0.5 1`.")
    rows = np.arange(1 + points, len(lines))
    corners = lines.columns(rows, 1)[:, 0]
    if (wrong := (corners < 3) | is_not_integer(corners) | (corners >= lines.counts[rows])).any():
        source.damaged(int(lines.offsets[rows[wrong.argmax()]]), f"the corners are too few or too many; {FACE_LINE}.")
    blocks = []
    for size in map(int, np.unique(corners)):
        same = rows[corners == size]
        nodes = lines.columns(same, 1 + size)[:, 1:]
        if (wrong := ((nodes < 0) | (nodes >= points) | is_not_integer(nodes)).any(axis=1)).any():
            source.damaged(
                int(lines.offsets[same[wrong.argmax()]]), f"a corner is none of the {points} points; {FACE_LINE}."
            )
        blocks.append(Block(KINDS.get(size, "polygon"), nodes.astype(np.int64)))
    return MeshFileContents(lines.columns(np.arange(1, 1 + points), 3), blocks, {})
