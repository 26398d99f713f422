"""Random points in a plane outline with a minimum distance, as many as fit (a maximal Poisson disk sample)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..data import Indices, MeshError, Points
from ..topology import Floats, Mask, components, distinct_rows, facets_of, orient_cells, signed_measures


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


@dataclass(frozen=True)
class SamplingSettings:
    """Settings of the sample."""

    distance: float = 0.75  # minimum of points, over the cell size: the median edge is 0.96 to 0.97 of the cell size
    random_rounds: int = 10  # of points at random, before gaps are searched
    max_gap_rounds: int = 50  # that fill gaps; five or six suffice


SAMPLING = SamplingSettings()
Size = Callable[[Points], Floats]  # cell sizes [m] at points (n, 2): (n,)


def scatter(outline: Outline, size: Size, seed: int = 1) -> tuple[Points, Indices]:
    """Nodes (n, 2), those of the outline first, and positive triangles (m, 3) inside it.

    With the cell size s at a point, its distance from earlier points is at least 0.75 s, and points are added until no
    circumradius exceeds that. If s is constant, no angle is below 30 degrees, except of triangles at the outline.
    Source: Ebeida et al. (2012), A simple algorithm for maximal Poisson-disk sampling.

    Args:
        outline: with pieces no longer than the cell size.
        size: cell size [m] at points.
        seed: of the random numbers; the same seed gives the same mesh.

    Raises:
        MeshError: the outline meets itself.
    """
    random = np.random.default_rng(seed)
    outline = outline.conforming()
    points = _random_points(outline, size, random)
    for _ in range(SAMPLING.max_gap_rounds):
        triangles = delaunay(points)
        inside = outline.inside(points, triangles.simplices)
        new = _gap_points(points[triangles.simplices[inside]], size, random)
        new = new[_in_body(triangles, inside, new)]
        new = new[spaced(new, SAMPLING.distance * size(new))]
        if len(new) == 0:
            return points, orient_cells(points, triangles.simplices[inside].astype(np.int64))[0]
        points = np.concatenate([points, new])
    raise MeshError("random points did not come to an end; take a larger h.")


def _random_points(outline: Outline, size: Size, random: np.random.Generator) -> Points:
    """The points of the outline and random ones inside, at most one for each square in each round."""
    from scipy.spatial import cKDTree

    points = outline.points
    triangles = delaunay(points)
    inside = outline.inside(points, triangles.simplices)
    corners, sides = _squares(points, size)
    for _ in range(SAMPLING.random_rounds):
        new = corners + sides[:, None] * random.random(corners.shape)
        new = new[_in_body(triangles, inside, new)]
        apart = SAMPLING.distance * size(new)
        free = cKDTree(points).query(new, distance_upper_bound=2 * apart.max(initial=0.0))[0] >= apart
        new, apart = new[free], apart[free]
        points = np.concatenate([points, new[spaced(new, apart)]])
    return points


def _squares(points: Points, size: Size) -> tuple[Points, Floats]:
    """Lower corners and sides of squares over the bounding box, each no larger than the cell size at its centre."""
    low = points.min(axis=0)
    corners, sides = low[None], np.array([np.ptp(points, axis=0).max()])
    done: list[tuple[Points, Floats]] = []
    quarters = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]) / 2
    high = points.max(axis=0)
    while len(corners):
        large = sides > size(corners + sides[:, None] / 2)
        done.append((corners[~large], sides[~large]))
        corners = (corners[large, None] + sides[large, None, None] * quarters).reshape(-1, 2)
        sides = np.repeat(sides[large] / 2, 4)
        over = (corners < high).all(axis=1)
        corners, sides = corners[over], sides[over]
    return np.concatenate([c for c, _ in done]), np.concatenate([s for _, s in done])


def _in_body(triangles: Any, inside: Mask, points: Points) -> Mask:
    """(n,) whether points lie in triangles that are part of the body."""
    where = triangles.find_simplex(points)
    return np.asarray((where >= 0) & inside[where])


def _gap_points(corners: Points, size: Size, random: np.random.Generator) -> Points:
    """(k, 2) a random point in the gap of each triangle (m, 3, 2) with too large a circumcircle."""
    centres, radii = circumcircles(corners)
    apart = SAMPLING.distance * size(centres)
    wide = radii > 1.0001 * apart  # more than round-off
    centres, gap = centres[wide], (radii - apart)[wide]
    angles = 2 * np.pi * random.random(len(centres))
    distance = 0.7 * gap * np.sqrt(random.random(len(centres)))  # not all of the gap, since the cell size may vary
    return centres + distance[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def circumcircles(corners: Points) -> tuple[Points, Floats]:
    """Circumcentres (m, 2) and circumradii (m,) of triangles (m, 3, 2): 2 (x_i - x_0) . c = |x_i - x_0|^2."""
    spans = corners[:, 1:] - corners[:, :1]
    centre = _solve_pairs(2 * spans, np.einsum("mij,mij->mi", spans, spans))
    return corners[:, 0] + centre, np.linalg.norm(centre, axis=1)


def _solve_pairs(A: Floats, b: Floats) -> Floats:
    """Solutions x (m, 2) of A x = b by elimination with pivots, for A (m, 2, 2) and b (m, 2).

    LAPACK's round-off depends on the processor, and with it the points that are drawn next: the mesh of a study.
    """
    row = np.arange(len(A))
    pivot = (np.abs(A[:, 1, 0]) > np.abs(A[:, 0, 0])).astype(int)
    first, second = A[row, pivot], A[row, 1 - pivot]
    factor = second[:, 0] * (1.0 / first[:, 0])
    y = (b[row, 1 - pivot] - factor * b[row, pivot]) / (second[:, 1] - factor * first[:, 1])
    return np.stack([(b[row, pivot] - y * first[:, 1]) / first[:, 0], y], axis=1)


def spaced(points: Points, apart: Floats) -> Mask:
    """(n,) whether each point has its distance from all earlier ones."""
    from scipy.spatial import cKDTree

    keep = np.ones(len(points), bool)
    if len(points) < 2:
        return keep
    # each point's own distance: the largest one would find most of the points of a finely meshed part
    within = cKDTree(points).query_ball_point(points, apart)
    first = np.repeat(np.arange(len(points)), [len(numbers) for numbers in within])
    second = np.concatenate(within)
    near = (np.linalg.norm(points[first] - points[second], axis=1) < apart[first]) & (first != second)
    # even if the earlier one is left out too: the next round fills the gap
    keep[np.maximum(first, second)[near]] = False
    return keep
