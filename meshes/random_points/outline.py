"""Plane outlines of straight pieces, and the triangles inside them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..data import Indices, MeshError, Points
from ..topology import Mask, components, distinct_rows, facets_of, signed_measures


@dataclass(frozen=True)
class Outline:
    """Closed polygons in any order; the body is inside an odd number of them.

    Attributes:
        points: (n, 2) [m].
        pieces: (k, 2) indices of the ends of each straight piece.
    """

    points: Points
    pieces: Indices

    def conforming(self) -> Outline:
        """The outline with pieces halved until each of them is an edge of the Delaunay triangles of its points.

        Raises:
            MeshError: pieces cross one another.
        """
        outline = self
        for _ in range(40):
            lost = outline._missing(delaunay(outline.points).simplices)
            if not lost.any():
                return outline
            where = outline.points[outline.pieces[lost][0]].mean(axis=0)
            outline = outline._halved(lost)
        raise MeshError(
            f"the outline meets itself near ({where[0]:.4g}, {where[1]:.4g}) m: {int(lost.sum())} of its pieces are "
            "cut by others, however short they are made; mend it there."
        )

    def _missing(self, simplices: Indices) -> Mask:
        """(k,) whether each piece is no edge of the triangles."""
        edges = np.sort(facets_of(simplices).reshape(-1, 2), axis=1)
        _, _, inverse = distinct_rows(np.concatenate([np.sort(self.pieces, axis=1), edges]))
        return ~np.isin(inverse[: len(self.pieces)], inverse[len(self.pieces) :])

    def _halved(self, chosen: Mask) -> Outline:
        """The outline with the chosen pieces cut at their middles."""
        ends = self.pieces[chosen]
        new = len(self.points) + np.arange(len(ends))
        halves = [np.stack([ends[:, 0], new], axis=1), np.stack([new, ends[:, 1]], axis=1)]
        points = np.concatenate([self.points, self.points[ends].mean(axis=1)])
        return Outline(points, np.concatenate([self.pieces[~chosen], *halves]))

    def inside(self, points: Points, simplices: Indices) -> Mask:
        """(m,) whether each triangle of a Delaunay triangulation that contains every piece is part of the body."""
        edges = np.sort(facets_of(simplices).reshape(-1, 2), axis=1)
        rows, _, edge_of = distinct_rows(np.concatenate([np.sort(self.pieces, axis=1), edges]))
        is_piece = np.zeros(len(rows), bool)
        is_piece[edge_of[: len(self.pieces)]] = True
        edge_of = edge_of[len(self.pieces) :]
        # triangles that are connected across edges that are no pieces lie on the same side: one of each part is tested
        order = np.argsort(edge_of, kind="stable")
        same = np.flatnonzero((np.diff(edge_of[order]) == 0) & ~is_piece[edge_of[order][:-1]])
        _, part = components(np.stack([order[same], order[same + 1]], axis=1) // 3, len(simplices))
        area = np.abs(signed_measures(points, simplices))
        ranked = np.lexsort((-area, part))
        largest = ranked[np.unique(part[ranked], return_index=True)[1]]
        spans = np.ptp(points[simplices], axis=1).max(axis=1)
        # triangles between points of one straight line are no cells
        return self._contains(points[simplices[largest]].mean(axis=1))[part] & (area > 1e-9 * spans**2)

    def _contains(self, points: Points) -> Mask:
        """(n,) whether points (n, 2) lie inside: a ray towards +x crosses an odd number of pieces."""
        start, end = self.points[self.pieces[:, 0]], self.points[self.pieces[:, 1]]
        x, y = points[:, :1], points[:, 1:]
        spans = (start[:, 1] > y) != (end[:, 1] > y)
        rise = np.where(end[:, 1] == start[:, 1], 1.0, end[:, 1] - start[:, 1])
        crossing_x = start[:, 0] + (y - start[:, 1]) / rise * (end[:, 0] - start[:, 0])
        return np.asarray((spans & (crossing_x > x)).sum(axis=1) % 2 == 1)


def delaunay(points: Points) -> Any:
    """SciPy's Delaunay triangulation of points (n, 2)."""
    from scipy.spatial import Delaunay

    return Delaunay(points)
