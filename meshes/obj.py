"""Points and faces of a Wavefront OBJ file.

Not by meshio (5.3): it takes a negative index for one before the first point, colours behind the coordinates for more
coordinates, and refuses files with another count of normals or texture points than of points.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .data import MeshError

KINDS = {3: "triangle", 4: "quad"}


def read_obj(path: Path) -> Any:
    """A meshio.Mesh of the points (n, 3) and faces; "obj:group_ids" counts the lines `g`, -1 before the first.

    An index k > 0 is the k-th point of the file, k < 0 the k-th from the last one before its line. What stands behind
    the first slash of an index, or behind three coordinates, is left out.

    Raises:
        MeshError: a line that is no point or face, or a face with a point that does not exist; with its number.
    """
    import meshio

    points: list[list[float]] = []
    blocks: list[tuple[int, list[list[int]], list[int]]] = []  # corners of a face, faces, groups
    group, farthest = -1, (-1, 0)  # the last point that a face names, and its line
    for number, (word, *values) in _lines(path):
        try:
            if word == "v":
                x, y, z, *_ = map(float, values)
                points.append([x, y, z])
            elif word == "g":
                group += 1
            elif word == "f":
                face = [_place(value, len(points)) for value in values]
                farthest = max(farthest, (max(face), number), key=lambda found: found[0])
                if not blocks or blocks[-1][0] != len(face):
                    blocks.append((len(face), [], []))
                blocks[-1][1].append(face)
                blocks[-1][2].append(group)
        except ValueError:
            what = "three coordinates: v 0 0.5 1" if word == "v" else "points that are there before it: f 1 2 3"
            line = " ".join([word, *values])[:80]
            raise MeshError(f"Mesh file '{path}', line {number}: `{line}` does not name {what}.") from None
    if farthest[0] >= len(points):
        last, number = farthest
        raise MeshError(f"Mesh file '{path}', line {number}: there is no point {last + 1}, but {len(points)} in all.")
    cells = [(KINDS.get(corners, "polygon"), np.array(faces)) for corners, faces, _ in blocks]
    groups = [np.array(groups) for *_, groups in blocks]
    return meshio.Mesh(np.array(points).reshape(-1, 3), cells, cell_data={"obj:group_ids": groups})


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
    place = index - 1 if index > 0 else count + index
    if index == 0 or place < 0:
        raise ValueError(text)
    return place
