"""Forces at points of the surfaces of bodies, handed to the nodes of the cells that hold the points."""

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
