"""Forces at points of the surfaces of bodies, handed to the nodes of the cells that hold the points.

Forces on circles of contact, with Hertz's pressure (K. L. Johnson, Contact Mechanics, 1985, eq. 3.39).

    p(r) = 3 F / (2 pi a^2) sqrt(1 - r^2 / a^2)

as points of equal force, in the plane across it: a share q of the force acts within r = a sqrt(1 - (1 - q)^(2/3)). They
lie on a spiral of golden angles, each with its mirror image, so that the force keeps its moment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from ..mesh.small_matrices import barycentric_gradients

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
NEAREST = 24  # cells whose middles are nearest to a point: one of them holds it, or is the nearest that could
FINE = 0.05  # mean edges: a smaller circle is a point
DENSE = 12.0  # points to a square edge
FEWEST, MOST = 8, 256  # pairs of points to a circle
GOLDEN = np.pi * (3 - np.sqrt(5))


@dataclass(frozen=True)
class PointLoads:
    """k forces on a mesh at rest.

    Attributes:
        nodes: (k, d + 1) of the cell that holds each point.    weights: (k, d + 1) barycentric, 0 to 1.
        force: (k, d) N, in the directions of the body at rest.
    """

    nodes: Ints
    weights: Values
    force: Values

    @property
    def owner(self) -> Ints:
        """(k,) the node that each point is nearest to, in the measure of its cell: it says which piece is pushed."""
        return np.asarray(np.take_along_axis(self.nodes, self.weights.argmax(axis=1)[:, None], axis=1)[:, 0])

    def of(self, chosen: Flags) -> PointLoads:
        """Some of them, by flags (k,)."""
        return PointLoads(self.nodes[chosen], self.weights[chosen], self.force[chosen])

    def nodal(self, count: int) -> Values:
        """(count, d) forces at the nodes of the mesh, N."""
        result = np.zeros((count, self.force.shape[1]))
        np.add.at(result, self.nodes, self.weights[:, :, None] * self.force[:, None])
        return result


def point_loads(places: Values, cells: Ints, points: Values, force: Values) -> PointLoads:
    """Loads `force` (k, d) at `points` (k, d), each in the one of `cells` (m, d + 1) that holds it or, where none does,
    at the nearest place of the nearest cell; `places`: (N, d) of the nodes.

    The hulls that collide are a little larger than the body: a point of touch may lie outside of it.
    """
    corners = places[cells]
    _, near = cKDTree(corners.mean(axis=1)).query(points, k=np.arange(1, min(NEAREST, len(cells)) + 1))
    of = corners[near.reshape(-1)]
    arm = np.repeat(points, near.shape[1], axis=0) - of[:, 0]
    weights = np.einsum("nkd,nd->nk", barycentric_gradients(of), arm)
    weights[:, 0] += 1.0
    inside = np.maximum(weights, 0.0)
    inside /= inside.sum(axis=1, keepdims=True)
    off = np.einsum("nk,nkd->nd", inside - weights, of)
    best = np.einsum("nd,nd->n", off, off).reshape(near.shape).argmin(axis=1)
    rows = np.arange(len(points))
    return PointLoads(cells[near[rows, best]].astype(np.int64), inside.reshape(*near.shape, -1)[rows, best], force)


def patches(points: Values, force: Values, radius: Values, edge: float) -> tuple[Values, Values]:
    """(n, 3) points and (n, 3) forces on circles of radii (k,) about points (k, 3), m, from forces (k, 3), N; `edge`:
    of the cells that they fall on, m."""
    wide = np.flatnonzero(radius > FINE * edge)
    if not len(wide):
        return points, force
    narrow = np.setdiff1d(np.arange(len(radius)), wide)
    pairs = np.clip(np.pi * DENSE / 2 * (radius[wide] / edge) ** 2, FEWEST, MOST).astype(np.int64)
    of = np.repeat(np.arange(len(wide)), pairs)
    number = np.arange(len(of)) - np.repeat(np.cumsum(pairs) - pairs, pairs)
    share = (number + 0.5) / pairs[of]
    r, angle = radius[wide][of] * np.sqrt(1 - (1 - share) ** (2 / 3)), GOLDEN * number
    first, second = _across(force[wide])
    arm = (r * np.cos(angle))[:, None] * first[of] + (r * np.sin(angle))[:, None] * second[of]
    middle, each = points[wide][of], (force[wide] / (2 * pairs[:, None]))[of]
    return (
        np.concatenate([points[narrow], middle + arm, middle - arm]),
        np.concatenate([force[narrow], each, each]),
    )


def _across(way: Values) -> tuple[Values, Values]:
    """Two (k, 3) unit vectors across directions (k, 3) of any length but none."""
    least = np.eye(3)[np.abs(way).argmin(axis=1)]
    first = np.cross(way, least)
    first /= np.linalg.norm(first, axis=1)[:, None]
    second = np.cross(way, first)
    return first, second / np.linalg.norm(second, axis=1)[:, None]
