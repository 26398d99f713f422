"""Outlines in text files, filled with triangles between random points."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..data import Indices, MeshData, MeshError, Points
from ..file_text import decode_text
from ..parameters import check_extent, require_affordable, require_positive
from ..plain_files import unreadable_reason
from ..topology import Floats, boundary_facets, signed_measures
from .points import Outline, scatter


@dataclass(frozen=True)
class PolygonOutline:
    """Closed polygons with facet groups; the body is inside an odd number of them.

    Attributes:
        start: (k, 2) first end of each side [m].
        end: (k, 2) second end of each side [m].
        groups: (k,) facet group of each side; "" for none but `outline`, which has all sides.
    """

    start: Points
    end: Points
    groups: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the facet groups."""
        return ("outline", *(name for name in dict.fromkeys(self.groups) if name))

    @property
    def area(self) -> float:
        """Area of the largest polygon less that of all others [m^2], which are holes in it as a rule."""
        sides = np.cumsum([0, *self._lengths()])
        twice = self.start[:, 0] * self.end[:, 1] - self.start[:, 1] * self.end[:, 0]
        loops = np.abs(np.add.reduceat(twice, sides[:-1])) / 2
        return float(2 * loops.max() - loops.sum())

    def _lengths(self) -> list[int]:
        """Number of sides of each polygon; one ends where the next side does not start."""
        last = np.flatnonzero(np.any(self.end[:-1] != self.start[1:], axis=1)) + 1
        return [int(count) for count in np.diff([0, *last, len(self.start)])]

    def cells_estimate(self, h: float) -> int:
        """Approximate number of triangles of size h [m]; at least one at each part of a side."""
        parts = np.linalg.norm(self.end - self.start, axis=1).sum() / h
        # random points make 2.6 triangles for an area of h^2
        return max(1, round(2.6 * abs(self.area) / h**2), round(parts))


def read_outline(path: str | Path, scale: float = 1.0) -> PolygonOutline:
    """Polygons of a text file.

    A line is a corner: `x, y`, or `x, y, group` with the facet group of the side that begins there. A blank line ends a
    polygon; `#` begins a comment. Numbers are separated by commas or blanks.

    Args:
        path: the file.
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
    loops = [_without_repeated_corners(loop) for loop in loops if loop]
    if not loops or min(map(len, loops)) < 3:
        raise MeshError(f"outline file '{path}': a polygon needs three corners or more, a line `x, y` each.")
    corners = [scale * np.array([corner[:2] for corner in loop]) for loop in loops]
    check_extent(np.concatenate(corners), f"outline file '{path}'")
    start, end = np.concatenate(corners), np.concatenate([np.roll(loop, -1, axis=0) for loop in corners])
    return PolygonOutline(start, end, tuple(corner[2] for loop in loops for corner in loop))


def _corner(words: list[str], where: str) -> tuple[float, float, str]:
    """Coordinates and group of a line; `where`: begins the message of a MeshError."""
    try:
        x, y = (float(word) for word in words[:2])
        if len(words) > 3 or not np.isfinite([x, y]).all():
            raise ValueError
    except ValueError:
        raise MeshError(
            f"{where}: write `x, y` or `x, y, group`, numbers in metres; found {' '.join(words)}."
        ) from None
    return x, y, words[2] if len(words) == 3 else ""


def _without_repeated_corners(loop: list[tuple[float, float, str]]) -> list[tuple[float, float, str]]:
    """A polygon without repeated corners, such as the last one of a polygon that is closed in the file."""
    return [corner for corner, after in zip(loop, [*loop[1:], loop[0]], strict=True) if corner[:2] != after[:2]]


def fill_outline(drawn: PolygonOutline, h: float, seed: int = 1) -> MeshData:
    """The mesh of triangles of size h [m] between random points inside an outline.

    Raises:
        MeshError: h is out of range, or the outline intersects itself.
    """
    require_positive("outline", h=h)
    _check_crossings(drawn)
    require_affordable("outline", h, drawn.cells_estimate(h))
    outline = _split_sides(drawn, h)
    points, cells = scatter(outline, lambda at: np.full(len(at), h), seed)
    facets = boundary_facets(cells)
    side = _nearest_side(points[facets].mean(axis=1), drawn)
    names = np.array(drawn.groups)[side]
    groups = {"outline": facets} | {name: facets[names == name] for name in drawn.names[1:]}
    if not signed_measures(points, cells).sum() > 0:
        raise MeshError("the outline encloses nothing.")
    return MeshData(points, cells, groups)


def _check_crossings(drawn: PolygonOutline) -> None:
    """Raise MeshError if two sides cross: each has the ends of the other on its two sides."""
    # each side is compared with each: of longer outlines `scatter` finds it, later
    if len(drawn.start) > 3000:
        return
    a, b = drawn.start, drawn.end

    def left(of: Points) -> Floats:
        """(k, k) 1 if point j lies to the left of side i, -1 to the right."""
        (ax, ay), (bx, by), (x, y) = a.T[..., None], b.T[..., None], of.T[:, None]
        return np.asarray(np.sign((bx - ax) * (y - ay) - (by - ay) * (x - ax)))

    # the ends of side j lie on two sides of side i, and the reverse
    apart = left(a) * left(b) < 0
    crossed = np.argwhere(apart & apart.T)
    if len(crossed):
        (x, y), (u, v) = (tuple(a[side]) for side in crossed[0])
        raise MeshError(
            f"the outline meets itself: the sides that begin at ({x:.4g}, {y:.4g}) and ({u:.4g}, {v:.4g}) m cross."
        )


def _split_sides(drawn: PolygonOutline, h: float) -> Outline:
    """The outline with sides cut into equal parts of at most h [m]."""
    length = np.linalg.norm(drawn.end - drawn.start, axis=1)
    parts = np.maximum(1, np.ceil(length / h * (1 - 1e-9))).astype(np.int64)
    side = np.repeat(np.arange(len(parts)), parts)
    first = np.cumsum(parts) - parts
    share = (np.arange(len(side)) - first[side]) / parts[side]
    points = drawn.start[side] + share[:, None] * (drawn.end - drawn.start)[side]
    # each part ends at the next point, the last of a polygon at its first
    after = np.arange(1, len(points) + 1)
    ends = np.cumsum(drawn._lengths())
    last = np.append(first, len(points))[ends] - 1
    after[last] = np.append(first, len(points))[np.append(0, ends[:-1])]
    return Outline(points, np.stack([np.arange(len(points)), after], axis=1))


def _nearest_side(at: Points, drawn: PolygonOutline) -> Indices:
    """(n,) the side nearest to each point (n, 2)."""
    along = drawn.end - drawn.start
    from_start = at[:, None] - drawn.start
    share = np.clip(np.einsum("nki,ki->nk", from_start, along) / np.einsum("ki,ki->k", along, along), 0, 1)
    distance: Floats = np.linalg.norm(from_start - share[..., None] * along, axis=2)
    return np.asarray(distance.argmin(axis=1))
