"""Triangles of even size on the zero level of a function, for bodies that are given by how deep a point lies in them.

The body-centred lattice and the snapping of its nodes are those of Labelle and Shewchuk, Isosurface stuffing (SIGGRAPH
2007); of its tetrahedra only the cut surface is taken, which gmsh then fills.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..data import Indices, Points
from ..topology import Floats, Mask, distinct_rows, edges_of

# (n, 3) points -> depth (n,) [m], positive inside, and its gradient (n, 3)
Depth = Callable[[Points], tuple[Floats, Floats]]

SNAP = 0.35  # a node whose edge is cut nearer to it than this share of the edge is moved onto the surface
SPACING = 1.25  # lattice constant over the median edge of the triangles (measured on spheres)
ROUNDS = 4  # of evening out


def level_surface(depth: Depth, low: Floats, high: Floats, h: float) -> tuple[Points, Indices]:
    """Points on the surface depth = 0 within the box and triangles between them, closed, with edges of about h [m]."""
    nodes, tets = _lattice(low, high, SPACING * h)
    value = depth(nodes)[0]
    near = _too_near(value, edges_of(tets[_meets(value, tets)]))
    nodes[near] = _projected(depth, nodes[near])
    value[near] = 0.0
    corners = _cut(np.sign(value).astype(np.int64), tets[_meets(value, tets)])
    pairs, _, triangles = distinct_rows(corners.reshape(-1, 2))
    first, second = pairs.T
    share = np.where(first == second, 0.0, value[first] / np.where(first == second, 1.0, value[first] - value[second]))
    points = _projected(depth, nodes[first] + share[:, None] * (nodes[second] - nodes[first]))
    return _evened(depth, points, _single(triangles.reshape(-1, 3)))


def _meets(value: Floats, tets: Indices) -> Mask:
    """Tetrahedra that the surface cuts or touches."""
    return np.asarray((value[tets].max(axis=1) >= 0) & (value[tets].min(axis=1) <= 0))


def _lattice(low: Floats, high: Floats, step: float) -> tuple[Points, Indices]:
    """Corners and centres of cubes around the box, and tetrahedra of two neighbouring centres and an edge between."""
    count = np.ceil((high - low) / step).astype(int) + 4
    origin = (low + high) / 2 - step * count / 2
    corner = np.arange(np.prod(count + 1)).reshape(count + 1)
    centre = np.arange(np.prod(count)).reshape(count) + corner.size
    positions = [np.indices(shape).reshape(3, -1).T for shape in (tuple(count + 1), tuple(count))]
    nodes = origin + step * np.concatenate([positions[0], positions[1] + 0.5])
    tets = []
    for axis in range(3):
        cells, faces = np.moveaxis(centre, axis, 0), np.moveaxis(corner, axis, 0)[1:-1]
        around = (faces[:, :-1, :-1], faces[:, 1:, :-1], faces[:, 1:, 1:], faces[:, :-1, 1:])
        for a, b in zip(around, around[1:] + around[:1], strict=True):
            tets.append(np.stack([cells[:-1], cells[1:], a, b], axis=-1).reshape(-1, 4))
    return nodes, np.concatenate(tets)


def _too_near(value: Floats, edges: Indices) -> Indices:
    """Nodes beside which an edge is cut."""
    a, b = value[edges].T
    cut = a * b < 0
    edges, a, b = edges[cut], a[cut], b[cut]
    share = a / (a - b)
    return np.unique(np.concatenate([edges[share < SNAP, 0], edges[share > 1 - SNAP, 1], np.flatnonzero(value == 0)]))


def _cut(sign: Indices, tets: Indices) -> Indices:
    """Triangles (k, 3, 2) where the tetrahedra are cut; a corner is the pair of nodes between which it lies.

    A node on the surface is the pair of itself. Faces that lie on the surface count for the cell inside, once.
    """
    result = []
    patterns, which = np.unique(sign[tets], axis=0, return_inverse=True)
    for number, pattern in enumerate(patterns):
        inside, on, outside = ([int(i) for i in np.flatnonzero(pattern == s)] for s in (1, 0, -1))
        if not inside or len(on) + len(outside) == 0 or (not outside and len(on) < 3):
            continue
        ring = [(i, i) for i in on] + [(i, o) for i in inside for o in outside]
        if len(inside) == len(outside) == 2:
            ring[2], ring[3] = ring[3], ring[2]
        fan = [(ring[0], ring[k], ring[k + 1]) for k in range(1, len(ring) - 1)]
        result.append(tets[which.ravel() == number][:, np.array(fan)].reshape(-1, 3, 2))
    return np.sort(np.concatenate(result), axis=2)


def _single(triangles: Indices) -> Indices:
    """Without those that occur twice, from both sides: the body has no thickness there."""
    _, counts, inverse = distinct_rows(np.sort(triangles, axis=1))
    return triangles[counts[inverse] == 1]


def _projected(depth: Depth, points: Points) -> Points:
    """Points moved onto the surface along the gradient (Newton)."""
    for _ in range(4):
        value, gradient = depth(points)
        points = points - (value / np.einsum("ni,ni->n", gradient, gradient))[:, None] * gradient
    return points


def _evened(depth: Depth, points: Points, triangles: Indices) -> tuple[Points, Indices]:
    """Each point moved half-way to the mean of its neighbours and back to the surface, a few times."""
    edges = np.concatenate([pairs := edges_of(triangles), pairs[:, ::-1]])
    degree = np.bincount(edges[:, 0], minlength=len(points))[:, None]
    for _ in range(ROUNDS):
        sums = np.stack([np.bincount(edges[:, 0], column, len(points)) for column in points[edges[:, 1]].T], axis=1)
        points = _projected(depth, (points + sums / degree) / 2)
    return points, triangles
