"""Outlines in text files, filled with triangles between random points: plane bodies without preferred directions."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..data import Indices, MeshData, MeshError, Points
from ..file_text import decode_text
from ..parameters import check_extent, positive, require_affordable
from ..plain_files import unreadable_reason
from ..topology import Floats, boundary_facets, signed_measures
from .outline import Outline
from .points import scatter

MAX_CHECKED_SIDES = 3000  # of which each is held against each
CELLS = 2.6  # triangles over area / h^2 that random points make


@dataclass(frozen=True)
class Drawn:
    """Closed polygons of straight sides; what lies inside an odd number of them is the body.

    Attributes:
        start, end: (k, 2) of the sides [m].
        groups: (k,) name of the facet group of each side; "" for none but `outline`, which is all of them.
    """

    start: Points
    end: Points
    groups: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Facet groups."""
        return ("outline", *(name for name in dict.fromkeys(self.groups) if name))

    @property
    def area(self) -> float:
        """What the polygons enclose [m^2]; holes count as such where they lie inside one polygon."""
        sides = np.cumsum([0, *self._lengths()])
        twice = self.start[:, 0] * self.end[:, 1] - self.start[:, 1] * self.end[:, 0]
        loops = np.abs(np.add.reduceat(twice, sides[:-1])) / 2
        return float(2 * loops.max() - loops.sum())

    def _lengths(self) -> list[int]:
        """How many sides each polygon has: one ends where the next side does not go on from there."""
        last = np.flatnonzero(np.any(self.end[:-1] != self.start[1:], axis=1)) + 1
        return [int(count) for count in np.diff([0, *last, len(self.start)])]

    def cells_estimate(self, h: float) -> int:
        """About how many triangles of size h [m] fill it: one at each part of a side at least."""
        parts = np.linalg.norm(self.end - self.start, axis=1).sum() / h
        return max(1, round(CELLS * abs(self.area) / h**2), round(parts))


def read_outline(path: str | Path, scale: float = 1.0) -> Drawn:
    """Polygons of a text file: a line `x, y` a corner, or `x, y, group` where the side that begins there is in a facet
    group; a blank line ends a polygon; `#` begins a remark. Commas or blanks part numbers.

    Args:
        scale: metres for each unit of length of the file.

    Raises:
        MeshError: the file cannot be read, or a polygon has fewer than three corners.
    """
    if wrong := unreadable_reason(path):
        raise MeshError(f"outline file '{path}' {wrong}.")
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise MeshError(f"outline file '{path}' cannot be read: {error.strerror}.") from None
    if b"\0" in data:
        raise MeshError(f"outline file '{path}' is no text; save it as plain text: a line `x, y` for each corner.")
    lines = decode_text(data).splitlines()
    loops: list[list[tuple[float, float, str]]] = [[]]
    for number, line in enumerate(lines, 1):
        if words := line.partition("#")[0].replace(",", " ").split():
            loops[-1].append(_corner(words, f"outline file '{path}', line {number}"))
        elif "#" not in line and loops[-1]:
            loops.append([])
    loops = [_open(loop) for loop in loops if loop]
    if not loops or min(map(len, loops)) < 3:
        raise MeshError(f"outline file '{path}': a polygon needs three corners or more, a line `x, y` each.")
    corners = [scale * np.array([corner[:2] for corner in loop]) for loop in loops]
    check_extent(np.concatenate(corners), f"outline file '{path}'")
    start, end = np.concatenate(corners), np.concatenate([np.roll(item, -1, axis=0) for item in corners])
    return Drawn(start, end, tuple(corner[2] for loop in loops for corner in loop))


def _corner(words: list[str], where: str) -> tuple[float, float, str]:
    try:
        x, y = (float(word) for word in words[:2])
        if len(words) > 3 or not np.isfinite([x, y]).all():
            raise ValueError
    except ValueError:
        raise MeshError(
            f"{where}: write `x, y` or `x, y, group`, numbers in metres; found {' '.join(words)}."
        ) from None
    return x, y, words[2] if len(words) == 3 else ""


def _open(loop: list[tuple[float, float, str]]) -> list[tuple[float, float, str]]:
    """Without corners that repeat the one before, as the last does where a polygon is closed by hand."""
    return [corner for corner, after in zip(loop, [*loop[1:], loop[0]], strict=True) if corner[:2] != after[:2]]


def fill_outline(drawn: Drawn, h: float, seed: int = 1) -> MeshData:
    """Triangles of size h [m] between random points inside an outline; its sides are cut into equal parts of h at most.

    Raises:
        MeshError: h is out of range, or the outline meets itself.
    """
    positive("outline", h=h)
    _check_apart(drawn)
    require_affordable("outline", h, drawn.cells_estimate(h))
    outline = _in_parts(drawn, h)
    points, cells = scatter(outline, lambda at: np.full(len(at), h), seed)
    facets = boundary_facets(cells)
    side = _side_of(points[facets].mean(axis=1), drawn)
    names = np.array(drawn.groups)[side]
    groups = {"outline": facets} | {name: facets[names == name] for name in drawn.names[1:]}
    if not signed_measures(points, cells).sum() > 0:
        raise MeshError("the outline encloses nothing.")
    return MeshData(points, cells, groups)


def _check_apart(drawn: Drawn) -> None:
    """MeshError where two sides cross: each has the ends of the other on both hands. Points would find it late."""
    if len(drawn.start) > MAX_CHECKED_SIDES:
        return
    a, b = drawn.start, drawn.end

    def left(of: Points) -> Floats:
        """(k, k) on which hand of side i the point j lies."""
        (ax, ay), (bx, by), (x, y) = a.T[..., None], b.T[..., None], of.T[:, None]
        return np.asarray(np.sign((bx - ax) * (y - ay) - (by - ay) * (x - ax)))

    apart = left(a) * left(b) < 0
    crossed = np.argwhere(apart & apart.T)
    if len(crossed):
        (x, y), (u, v) = (tuple(a[side]) for side in crossed[0])
        raise MeshError(
            f"the outline meets itself: the sides that begin at ({x:.4g}, {y:.4g}) and ({u:.4g}, {v:.4g}) m cross."
        )


def _in_parts(drawn: Drawn, h: float) -> Outline:
    """Sides cut into equal parts of length h at most."""
    length = np.linalg.norm(drawn.end - drawn.start, axis=1)
    parts = np.maximum(1, np.ceil(length / h * (1 - 1e-9))).astype(np.int64)
    side = np.repeat(np.arange(len(parts)), parts)
    first = np.cumsum(parts) - parts
    share = (np.arange(len(side)) - first[side]) / parts[side]
    points = drawn.start[side] + share[:, None] * (drawn.end - drawn.start)[side]
    # each part leads to the next point, the last of a polygon to its first
    after = np.arange(1, len(points) + 1)
    ends = np.cumsum(drawn._lengths())
    last = np.append(first, len(points))[ends] - 1
    after[last] = np.append(first, len(points))[np.append(0, ends[:-1])]
    return Outline(points, np.stack([np.arange(len(points)), after], axis=1))


def _side_of(at: Points, drawn: Drawn) -> Indices:
    """(n,) the side that each point (n, 2) lies on."""
    along = drawn.end - drawn.start
    from_start = at[:, None] - drawn.start
    share = np.clip(np.einsum("nki,ki->nk", from_start, along) / np.einsum("ki,ki->k", along, along), 0, 1)
    distance: Floats = np.linalg.norm(from_start - share[..., None] * along, axis=2)
    return np.asarray(distance.argmin(axis=1))
