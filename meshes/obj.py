"""Points and faces of files of surfaces in text: Wavefront OBJ, and OFF.

Not by meshio (5.3). Of OBJ it takes a negative index for one before the first point, colours behind the coordinates for
more coordinates, and refuses files with another count of normals or texture points than of points. Of OFF it takes
neither counts behind the keyword nor normals and colours.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from .data import Indices, MeshError
from .mesh_conversion import Block, MeshFileContents
from .text_rows import EXPORT_AGAIN, SourceText, is_not_integer, shown

KINDS = {3: "triangle", 4: "quad"}


def read_obj(path: Path) -> MeshFileContents:
    """Points (n, 3) and faces; sets of faces by the lines `g`, or where there are none by the lines `o`.

    An index k > 0 is the k-th point of the file, k < 0 the k-th from the last one before its line. What stands behind
    the first slash of an index, or behind three coordinates, is left out.

    Raises:
        MeshError: a line that is no point or face, or a face with a point that does not exist; with its number.
    """
    points: list[list[float]] = []
    blocks: list[tuple[int, list[list[int]]]] = []  # corners of a face, faces
    named: dict[str, list[tuple[str, int, int]]] = {"g": [], "o": []}  # name, block and face that come behind the line
    farthest = (-1, 0)  # the last point that a face names, and its line
    for number, (word, *values) in _lines(path):
        try:
            if word == "v":
                x, y, z, *_ = map(float, values)
                points.append([x, y, z])
            elif word in named:
                position = (len(blocks) - 1, len(blocks[-1][1])) if blocks else (0, 0)
                named[word].append((" ".join(values), *position))
            elif word == "f":
                face = [_place(value, len(points)) for value in values]
                farthest = max(farthest, (max(face), number), key=lambda result: result[0])
                if not blocks or blocks[-1][0] != len(face):
                    blocks.append((len(face), []))
                blocks[-1][1].append(face)
        except ValueError:
            description = "three coordinates: v 0 0.5 1" if word == "v" else "points that are there before it: f 1 2 3"
            line = " ".join([word, *values])[:80]
            raise MeshError(f"Mesh file '{path}', line {number}: `{line}` does not name {description}.") from None
    if farthest[0] >= len(points):
        last, number = farthest
        raise MeshError(f"Mesh file '{path}', line {number}: there is no point {last + 1}, but {len(points)} in all.")
    result = [Block(KINDS.get(corners, "polygon"), np.array(faces, np.int64)) for corners, faces in blocks]
    return MeshFileContents(
        np.array(points, np.float64).reshape(-1, 3), result, _sets(named["g"] or named["o"], result)
    )


def _sets(named: list[tuple[str, int, int]], blocks: list[Block]) -> dict[str, list[Indices]]:
    """Sets of faces from the places at which their names stand; a face is in the set of the last name before it."""
    sets: dict[str, list[Indices]] = {}
    ends = [tuple(position) for _, *position in named[1:]]
    for (name, *begin), end in zip(named, [*ends, (len(blocks), 0)], strict=False):
        for i, block in enumerate(blocks):
            first = begin[1] if i == begin[0] else 0
            stop = end[1] if i == end[0] else len(block.nodes)
            if name and begin[0] <= i <= end[0] and first < stop:
                members = sets.setdefault(name, [np.zeros(0, np.int64) for _ in blocks])
                members[i] = np.union1d(members[i], np.arange(first, stop)).astype(np.int64)
    return sets


def _lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Numbers and words of the lines that say anything; a line continues after a backslash at its end."""
    begun = ""
    with path.open(encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, 1):
            whole = begun + line.partition("#")[0].rstrip()
            begun = whole[:-1] + " " if whole.endswith("\\") else ""
            if not begun and (words := whole.split()):
                yield number, words


def _place(text: str, count: int) -> int:
    """Index from 0 of an index as it is written after `count` points. ValueError where it can be none."""
    index = int(text.partition("/")[0])
    position = index - 1 if index > 0 else count + index
    if index == 0 or position < 0:
        raise ValueError(text)
    return position


# --- OFF ------------------------------------------------------------------------------------------------------------

_OFF = re.compile(rb"\s*((?:ST|C|N)*OFF)\b")  # behind the coordinates come colours, normals, points of a texture
_COMMENT = re.compile(rb"#[^\n]*")
FACE = "a face is `number-of-corners corners...`, numbers from 0"


def read_off(path: Path) -> MeshFileContents:
    """Points (n, 3) and faces of an OFF file in text; colours and normals are left out.

    Raises:
        MeshError: the file is damaged; the message names file and line.
    """
    source = SourceText(path, _COMMENT.sub(b"", path.read_bytes()))
    word = _OFF.match(source.text)
    if not word:
        source.refuse(0, f"`{shown(source.text[:80])}` is not OFF, with which such a file begins. {EXPORT_AGAIN}")
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
        source.damaged(int(lines.offsets[rows[wrong.argmax()]]), f"the corners are too few or too many; {FACE}.")
    blocks = []
    for size in map(int, np.unique(corners)):
        same = rows[corners == size]
        nodes = lines.columns(same, 1 + size)[:, 1:]
        if (wrong := ((nodes < 0) | (nodes >= points) | is_not_integer(nodes)).any(axis=1)).any():
            source.damaged(
                int(lines.offsets[same[wrong.argmax()]]), f"a corner is none of the {points} points; {FACE}."
            )
        blocks.append(Block(KINDS.get(size, "polygon"), nodes.astype(np.int64)))
    return MeshFileContents(lines.columns(np.arange(1, 1 + points), 3), blocks, {})
