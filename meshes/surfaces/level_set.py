"""Triangles of even size on the zero level of a depth function.

The body-centred lattice and the snapping of its nodes are those of Labelle and Shewchuk, Isosurface stuffing (SIGGRAPH
2007); of its tetrahedra only the cut surface is taken, which gmsh then fills.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..data import Indices, Points
from ..topology import Floats, Mask, distinct_rows, edges_of

# (n, 3) points -> depth (n,) [m], positive inside, and its gradient (n, 3)
Depth = Callable[[Points], tuple[Floats, Floats]]


@dataclass(frozen=True)
class LatticeSettings:
    """Settings of the surface from a lattice."""

    spacing: float = 1.25  # lattice constant over the median edge of the triangles (measured on spheres)
    snap: float = 0.35  # share of an edge: a node whose edge is cut nearer to it is moved onto the surface
    smoothing_steps: int = 4
    newton_steps: int = 4  # of a projection onto the surface


LATTICE = LatticeSettings()


def level_surface(depth: Depth, low: Floats, high: Floats, h: float) -> tuple[Points, Indices]:
    """Points and triangles of the closed surface depth = 0 in the box from `low` to `high`, with edges near h [m]."""
    nodes, tets = _lattice(low, high, LATTICE.spacing * h)
    value = depth(nodes)[0]
    near = _nodes_to_snap(value, edges_of(tets[_is_cut(value, tets)]))
    nodes[near] = _projected(depth, nodes[near])
    value[near] = 0.0
    corners = _cut(np.sign(value).astype(np.int64), tets[_is_cut(value, tets)])
    pairs, _, triangles = distinct_rows(corners.reshape(-1, 2))
    first, second = pairs.T
    # linear interpolation along the edge, then Newton's method
    share = np.where(first == second, 0.0, value[first] / np.where(first == second, 1.0, value[first] - value[second]))
    points = _projected(depth, nodes[first] + share[:, None] * (nodes[second] - nodes[first]))
    return _smoothed(depth, points, _without_sheets(triangles.reshape(-1, 3)))


def _is_cut(value: Floats, tets: Indices) -> Mask:
    """Whether the surface cuts or touches each tetrahedron."""
    return np.asarray((value[tets].max(axis=1) >= 0) & (value[tets].min(axis=1) <= 0))


def _lattice(low: Floats, high: Floats, step: float) -> tuple[Points, Indices]:
    """Nodes and tetrahedra of the body-centred lattice around the box.

    Nodes are corners and centres of cubes; a tetrahedron has two neighbouring centres and an edge between them.
    """
    count = np.ceil((high - low) / step).astype(int) + 4
    origin = (low + high) / 2 - step * count / 2
    corner = np.arange(np.prod(count + 1)).reshape(count + 1)
    centre = np.arange(np.prod(count)).reshape(count) + corner.size
    corners, centres = (np.indices(shape).reshape(3, -1).T for shape in (tuple(count + 1), tuple(count)))
    nodes = origin + step * np.concatenate([corners, centres + 0.5])
    tets = []
    # two cubes that share a face: their centres and each edge of the face are a tetrahedron
    for axis in range(3):
        cells, faces = np.moveaxis(centre, axis, 0), np.moveaxis(corner, axis, 0)[1:-1]
        around = (faces[:, :-1, :-1], faces[:, 1:, :-1], faces[:, 1:, 1:], faces[:, :-1, 1:])
        for a, b in zip(around, around[1:] + around[:1], strict=True):
            tets.append(np.stack([cells[:-1], cells[1:], a, b], axis=-1).reshape(-1, 4))
    return nodes, np.concatenate(tets)


def _nodes_to_snap(value: Floats, edges: Indices) -> Indices:
    """Nodes on the surface, or with an edge that is cut near to them."""
    a, b = value[edges].T
    cut = a * b < 0
    edges, a, b = edges[cut], a[cut], b[cut]
    share = a / (a - b)
    near = [edges[share < LATTICE.snap, 0], edges[share > 1 - LATTICE.snap, 1]]
    return np.unique(np.concatenate([*near, np.flatnonzero(value == 0)]))


def _cut(sign: Indices, tets: Indices) -> Indices:
    """(k, 3, 2) triangles at which tetrahedra are cut; a corner is the pair of nodes between which it lies.

    A node on the surface is paired with itself. A face on the surface counts for the tetrahedron inside.
    """
    cuts = []
    patterns, which = np.unique(sign[tets], axis=0, return_inverse=True)
    for number, pattern in enumerate(patterns):
        inside, on, outside = ([int(i) for i in np.flatnonzero(pattern == s)] for s in (1, 0, -1))
        # no cut; or it touches a node or an edge only
        if not inside or len(on) + len(outside) == 0 or (not outside and len(on) < 3):
            continue
        # corners in order around the cut: a triangle, or a quadrilateral between two nodes inside and two outside
        ring = [(i, i) for i in on] + [(i, o) for i in inside for o in outside]
        if len(inside) == len(outside) == 2:
            ring[2], ring[3] = ring[3], ring[2]
        fan = [(ring[0], ring[k], ring[k + 1]) for k in range(1, len(ring) - 1)]
        cuts.append(tets[which.ravel() == number][:, np.array(fan)].reshape(-1, 3, 2))
    return np.sort(np.concatenate(cuts), axis=2)


def _without_sheets(triangles: Indices) -> Indices:
    """Triangles without those that occur twice, from both sides, where the body has no thickness."""
    _, counts, inverse = distinct_rows(np.sort(triangles, axis=1))
    return triangles[counts[inverse] == 1]


def _projected(depth: Depth, points: Points) -> Points:
    """Points moved onto the surface along the gradient, by Newton's method."""
    for _ in range(LATTICE.newton_steps):
        value, gradient = depth(points)
        points = points - (value / np.einsum("ni,ni->n", gradient, gradient))[:, None] * gradient
    return points


def _smoothed(depth: Depth, points: Points, triangles: Indices) -> tuple[Points, Indices]:
    """The surface with points moved half-way to the mean of their neighbours and back to the surface, a few times."""
    edges = np.concatenate([pairs := edges_of(triangles), pairs[:, ::-1]])
    degree = np.bincount(edges[:, 0], minlength=len(points))[:, None]
    for _ in range(LATTICE.smoothing_steps):
        sums = np.stack([np.bincount(edges[:, 0], column, len(points)) for column in points[edges[:, 1]].T], axis=1)
        points = _projected(depth, (points + sums / degree) / 2)
    return points, triangles
