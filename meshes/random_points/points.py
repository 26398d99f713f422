"""Random points at least some distance apart, as many as there is room for (a maximal Poisson disk sample)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ..data import Indices, MeshError, Points
from ..topology import Floats, Mask, orient_cells
from .outline import Outline, delaunay

APART = 0.75  # least distance of points over the cell size: the median edge is then 0.96 to 0.97 of the cell size
THROWS = 10  # rounds of points thrown, before the gaps that are left are looked for
GAPS = 50  # most rounds that fill gaps; five or six do

Size = Callable[[Points], Floats]  # cell sizes [m] at points (n, 2): (n,)


def scatter(outline: Outline, size: Size, seed: int = 1) -> tuple[Points, Indices]:
    """Nodes (n, 2), those of the outline first, and positive triangles (m, 3) inside it; same seed, same mesh.

    A point is at least 0.75 s from those there before it, s the cell size at it, and points are added until no circle
    around a triangle has a radius of more than that. Where s is constant, no angle is therefore below 30 degrees, but
    for triangles at the outline. Ebeida et al., A simple algorithm for maximal Poisson-disk sampling (2012).

    Args:
        outline: its pieces no longer than the cell size.

    Raises:
        MeshError: the outline meets itself.
    """
    random = np.random.default_rng(seed)
    outline = outline.conforming()
    points = _thrown(outline, size, random)
    for _ in range(GAPS):
        triangles = delaunay(points)
        inside = outline.inside(points, triangles.simplices)
        new = _in_gaps(points[triangles.simplices[inside]], size, random)
        new = new[_held(triangles, inside, new)]
        new = new[_first(new, APART * size(new))]
        if len(new) == 0:
            return points, orient_cells(points, triangles.simplices[inside].astype(np.int64))[0]
        points = np.concatenate([points, new])
    raise MeshError("random points did not come to an end; take a larger h.")


def _thrown(outline: Outline, size: Size, random: np.random.Generator) -> Points:
    """The outline's points and many random ones inside, one a square and round at most."""
    from scipy.spatial import cKDTree

    points = outline.points
    triangles = delaunay(points)
    inside = outline.inside(points, triangles.simplices)
    corners, sides = _squares(points, size)
    for _ in range(THROWS):
        new = corners + sides[:, None] * random.random(corners.shape)
        new = new[_held(triangles, inside, new)]
        apart = APART * size(new)
        free = cKDTree(points).query(new, distance_upper_bound=2 * apart.max(initial=0.0))[0] >= apart
        new, apart = new[free], apart[free]
        points = np.concatenate([points, new[_first(new, apart)]])
    return points


def _squares(points: Points, size: Size) -> tuple[Points, Floats]:
    """Squares over the bounding box, cut in four until none is larger than the cell size at its middle."""
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


def _held(triangles: Any, inside: Mask, points: Points) -> Mask:
    """Whether points lie in triangles that are part of the body: (n,)."""
    where = triangles.find_simplex(points)
    return np.asarray((where >= 0) & inside[where])


def _in_gaps(corners: Points, size: Size, random: np.random.Generator) -> Points:
    """A random point in the room that each too large circle around a triangle (m, 3, 2) leaves: (k, 2)."""
    centres, radii = _circles(corners)
    apart = APART * size(centres)
    wide = radii > 1.0001 * apart  # not what round-off leaves
    centres, room = centres[wide], (radii - apart)[wide]
    turns = 2 * np.pi * random.random(len(centres))
    reach = 0.7 * room * np.sqrt(random.random(len(centres)))  # sizes may differ from the centre's a little way off
    return centres + reach[:, None] * np.stack([np.cos(turns), np.sin(turns)], axis=1)


def _circles(corners: Points) -> tuple[Points, Floats]:
    """Centre (m, 2) and radius (m,) of the circle through the corners (m, 3, 2): 2 (x_i - x_0) . c = |x_i - x_0|^2."""
    spans = corners[:, 1:] - corners[:, :1]
    squares = np.einsum("mij,mij->mi", spans, spans)
    centre = np.linalg.solve(2 * spans, squares[:, :, None])[:, :, 0]
    return corners[:, 0] + centre, np.linalg.norm(centre, axis=1)


def _first(points: Points, apart: Floats) -> Mask:
    """Which of the points may stay: the first of any that are too near one another, as they stand: (n,)."""
    from scipy.spatial import cKDTree

    keep = np.ones(len(points), bool)
    if len(points) < 2:
        return keep
    pairs = cKDTree(points).query_pairs(float(apart.max()), output_type="ndarray")
    near = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1) < apart[pairs].max(axis=1)
    keep[pairs[near, 1]] = False  # the later of each pair, whether or not the earlier one stays: others come next round
    return keep
