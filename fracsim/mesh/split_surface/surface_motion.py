"""Children follow parents: the points of the split surface as a map of the nodes of the mesh.

    x = mean over p of (x_p + R_p (X - X_p))

with p the nodes of the point's group and R_p the polar rotation of the average deformation around p, so that turning
pieces do not shear (docs/theory.md#split-surface). With R held, the map is linear in the nodes and `weights` is its
matrix: its transpose hands forces at the points down to the nodes, which is M22 section 4.2.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from ..simplices import is_split, local_edges
from ..small_matrices import polar_rotation
from .entity_numbering import EntityNumbering

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class PointParents:
    """Parents of n points, by rows.

    Attributes:
        start: (n + 1,) the parents of point k are parents[start[k] : start[k + 1]], one or more.
        parents: nodes.
        arm: (parents, d) X - X_p, m: from the parent to the point in the reference configuration.
        nodes: how many nodes the mesh has.
    """

    start: Ints
    parents: Ints
    arm: Values
    nodes: int

    @classmethod
    def of(cls, parents: Ints, count: Ints, points: Values, node_points: Values) -> PointParents:
        """`count` (n,) of parents of each point, at `points` (n, d)."""
        arm = np.repeat(points, count, axis=0) - node_points[parents]
        return cls(np.concatenate([[0], np.cumsum(count)]), parents, arm, len(node_points))

    @property
    def first_parent(self) -> Ints:
        return self.parents[self.start[:-1]]

    @cached_property
    def weights(self) -> csr_matrix:
        """(n, nodes) each row is 1 / (number of parents) at the parents."""
        from scipy.sparse import csr_matrix  # a body that is whole is drawn without SciPy, 0.13 s of a start

        count = np.diff(self.start)
        return csr_matrix((np.repeat(1.0 / count, count), self.parents, self.start), shape=(len(count), self.nodes))

    @cached_property
    def rotating_nodes(self) -> Ints:
        """Nodes whose rotation matters: parents of points that are not where the parent is."""
        return np.unique(self.parents[np.any(self.arm != 0, axis=1)])

    def mean(self, nodal: Values) -> Values:
        """(n, ...) mean of nodal values (nodes, ...) over the parents."""
        return self._mean(nodal[self.parents])

    def _mean(self, each: Values) -> Values:
        """(n, ...) mean over the parents of values (parents, ...)."""
        count = np.diff(self.start).reshape(-1, *np.ones(each.ndim - 1, int))
        result: Values = np.add.reduceat(each, self.start[:-1], axis=0) / count
        return result

    def displacement(self, u: Values, rotation: Values) -> Values:
        """(n, d) x - X = mean of u_p + (R_p - 1)(X - X_p); `rotation` (turning, d, d), u (nodes, d) in m."""
        place = np.full(self.nodes, -1)
        place[self.rotating_nodes] = np.arange(len(self.rotating_nodes))
        entry = np.flatnonzero(np.any(self.arm != 0, axis=1))
        arm = self.arm[entry]
        each = u[self.parents]
        each[entry] += np.einsum("nij,nj->ni", rotation[place[self.parents[entry]]], arm) - arm
        return self._mean(each)


class NodalRotations:
    """R of some nodes: the polar rotation of the volume average of F over the whole (not split) cells around each.

    A node that has none turns with those that it is joined to; where these have none either its fragment is smaller
    than a cell and its rotation unknown: identity.
    """

    def __init__(self, skeleton: EntityNumbering, pattern: npt.NDArray[np.integer], nodes: Ints) -> None:
        d = skeleton.dim
        nodes, self._of = np.unique(_turning_with(skeleton, pattern)[nodes], return_inverse=True)
        place = np.full(len(skeleton.points), -1)
        place[nodes] = np.arange(len(nodes))
        around = np.any(place[skeleton.cells] >= 0, axis=1) & ~is_split(d)[pattern]
        self._cells = skeleton.cells[around]
        span = skeleton.points[self._cells]
        span = span[:, 1:] - span[:, :1]  # rows X_k - X_0
        self._inverse = np.linalg.inv(span) * np.abs(np.linalg.det(span))[:, None, None]  # d! V (X_k - X_0)^-1
        target = place[self._cells]
        cell, corner = np.nonzero(target >= 0)
        ones = np.ones(len(cell))
        self._identity = np.eye(d)
        self._sum: csr_matrix | None = None
        if len(nodes):
            from scipy.sparse import csr_matrix

            self._sum = csr_matrix((ones, (target[cell, corner], cell)), shape=(len(nodes), len(self._cells)))
            volume = self._sum @ np.abs(np.linalg.det(span))
            self._per_volume = 1.0 / np.where(volume > 0, volume, 1.0)  # none: the mean is 0 and F the identity

    def __call__(self, u: Values) -> Values:
        """(nodes, d, d) from displacements (N, d) in m: F = 1 + mean of grad u."""
        d = len(self._identity)
        if self._sum is None:
            return np.empty((0, d, d))
        moved = u[self._cells]
        moved = moved[:, 1:] - moved[:, :1]
        gradient = np.einsum("nkj,nki->nij", np.swapaxes(self._inverse, 1, 2), moved)
        mean = (self._sum @ gradient.reshape(-1, d * d)) * self._per_volume[:, None]
        F = mean.reshape(-1, d, d) + self._identity
        return polar_rotation(F)[self._of]


def _turning_with(skeleton: EntityNumbering, pattern: npt.NDArray[np.integer]) -> Ints:
    """(nodes,) the node whose rotation each node has: its own where it has a whole cell, else that of the nearest one
    with such a cell over intact edges, of these the first; its own, too, where there is none."""
    result = np.arange(len(skeleton.points))
    whole = np.zeros(len(result), bool)
    whole[skeleton.cells[~is_split(skeleton.dim)[pattern]]] = True
    if whole.all():
        return result
    pairs = local_edges(skeleton.dim)
    cells = np.flatnonzero(~whole[skeleton.cells].all(axis=1))
    intact = (np.asarray(pattern)[cells, None] >> np.arange(len(pairs))) & 1 == 0
    ends = skeleton.cells[cells][:, pairs][intact]
    ends = np.concatenate([ends, ends[:, ::-1]])
    known = whole.copy()
    while len(new := np.flatnonzero(~known[ends[:, 0]] & known[ends[:, 1]])):
        nearest = np.full(len(result), len(result))
        np.minimum.at(nearest, ends[new, 0], result[ends[new, 1]])
        at = np.unique(ends[new, 0])
        result[at], known[at] = nearest[at], True
    return result
