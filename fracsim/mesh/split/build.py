"""From damage to a closed surface: points, elements, and the nodes that each point follows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...meshes.topology import facets_of
from .follow import Follow
from .points import SurfacePoints
from .skeleton import CRACK, Skeleton
from .table import Elements, Table, table, table_of_whole_cells

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Split:
    """The surface of a state of damage, in the reference configuration.

    Attributes:
        points: (n, d) reference coordinates, m: nodes of the mesh first (3D: of its boundary), then the copies.
        follow: the nodes that each point follows.
        elements: (m, d) triangles with normals outwards (3D) or segments with the body to their left (2D): closed.
        cell: (m,) of the mesh. edge: (m,) whose breaking opened it, -1 on the boundary. origin: (m,) see Skeleton.
        fill: (k, 3) triangles that cover the body in 2D, none in 3D; fill_cell: (k,).
        broken: (E,) edges.
        pieces, piece_of_node: how many, and (N,), numbered by their lowest node.
    """

    points: Values
    follow: Follow
    elements: Ints
    cell: Ints
    edge: Ints
    origin: Ints
    fill: Ints
    fill_cell: Ints
    broken: npt.NDArray[np.bool_]
    pieces: int
    piece_of_node: Ints

    @property
    def piece_of_point(self) -> Ints:
        """(n,) the parents of a point are all of one piece."""
        return self.piece_of_node[self.follow.first_parent]


def split(
    skeleton: Skeleton,
    pattern: npt.NDArray[np.integer],
    cut: Values | None = None,
    table: Callable[[int], Table] = table,
) -> Split:
    """The surface of damage patterns (C,), as in EdgeGraph.pattern.

    `cut`: (E,) where edges are cut, from the lower node (0) to the higher (1); NaN: in the middle. `table`: what the
    patterns mean, by dimension.
    """
    rows = table if pattern.any() else table_of_whole_cells
    return _Builder(skeleton, pattern, cut, rows(skeleton.dim))()


def points_of(
    skeleton: Skeleton, pattern: npt.NDArray[np.integer], table: Callable[[int], Table] = table
) -> SurfacePoints:
    """The points of the same, cut in the middle."""
    damaged = np.flatnonzero(pattern)
    return SurfacePoints(skeleton, damaged, pattern[damaged].astype(np.int64), None, table(skeleton.dim))


class _Builder:
    """Works on the damaged cells only; the boundary facets of all others stay as they are."""

    def __init__(self, skeleton: Skeleton, pattern: npt.NDArray[np.integer], cut: Values | None, table: Table) -> None:
        self.skeleton, self.table = skeleton, table
        self.damaged = np.flatnonzero(pattern)
        self.pattern = pattern[self.damaged].astype(np.int64)
        self.place = np.full(len(pattern), -1)  # of a cell among the damaged ones
        self.place[self.damaged] = np.arange(len(self.damaged))
        self.broken = skeleton.broken_edges(pattern)
        self.points = SurfacePoints(skeleton, self.damaged, self.pattern, cut, table)

    def __call__(self) -> Split:
        parts = self._whole_facets(), self._torn_facets(), self._walls()
        elements, cell, edge, origin = (np.concatenate(each) for each in zip(*parts, strict=True))
        count, piece = self.skeleton.pieces(self.broken)
        points = self.points
        return Split(
            points.positions, points.follow, elements, cell, edge, origin, *self._fill(), self.broken, count, piece
        )

    def _whole_facets(self) -> tuple[Ints, ...]:
        """(corners, cell, edge, origin) of boundary facets of undamaged cells."""
        boundary = self.skeleton.boundary
        at = np.flatnonzero(self.place[boundary[:, 0]] < 0)
        cell = boundary[at, 0]
        corners = self.points.of_nodes(boundary_corners(self.skeleton, at))
        return corners, cell, np.full(len(at), -1), self.skeleton.origin[at]

    def _torn_facets(self) -> tuple[Ints, ...]:
        """The same of boundary facets of damaged cells."""
        cell, facet = self.skeleton.boundary.T
        at = np.flatnonzero(self.place[cell] >= 0)
        place = self.place[cell[at]]
        key = (self.skeleton.dim + 1) * self.pattern[place] + facet[at]
        corners, owner, edge = self._expand(self.table.facets, key, place)
        return corners, cell[at[owner]], edge, self.skeleton.origin[at[owner]]

    def _walls(self) -> tuple[Ints, ...]:
        """The same of both sides of the cracks."""
        corners, owner, edge = self._expand(self.table.walls, self.pattern, np.arange(len(self.damaged)))
        cell = self.damaged[owner]
        return corners, cell, self.skeleton.cell_edges[cell, edge], np.full(len(cell), CRACK)

    def _fill(self) -> tuple[Ints, Ints]:
        """Triangles that cover the body in 2D, and the cell of each."""
        if self.skeleton.dim == 3:
            return np.empty((0, 3), np.int64), np.empty(0, np.int64)
        whole = np.flatnonzero(self.place < 0)
        corners, owner, _ = self._expand(self.table.fill, self.pattern, np.arange(len(self.damaged)))
        triangles = np.concatenate([self.skeleton.cells[whole], corners])
        return triangles, np.concatenate([whole, self.damaged[owner]])

    def _expand(self, elements: Elements, key: Ints, place: Ints) -> tuple[Ints, Ints, Ints]:
        """(corners, owner, local edge) of the elements of each key; `place` of its damaged cell."""
        row, owner = elements.expand(key)
        of = place[owner]
        return self.points.of_corners(elements.corners[row], of, self.damaged[of]), owner, elements.edge[row]


def boundary_corners(skeleton: Skeleton, which: Ints) -> Ints:
    """(n, d) nodes of boundary facets, their normals outwards."""
    outward = facets_of(np.arange(skeleton.dim + 1)[None])[0]
    cell, facet = skeleton.boundary[which].T
    return skeleton.cells[cell[:, None], outward[facet]]
