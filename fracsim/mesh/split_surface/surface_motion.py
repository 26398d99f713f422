"""Motion of the points of the split surface with their parents, the nodes of their groups.

    x = mean over p of (x_p + R_p (X - X_p))

with p the nodes of the group of the point and R_p the polar rotation of the average deformation gradient around p, so
that rotating fragments do not shear (docs/theory.md#split-surface). For constant R the map is linear, with matrix
`weights`. The transpose distributes forces at points to nodes. Source: Mandal et al. (2022), section 4.2.
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
    """The parents of n points, row by row.

    Attributes:
        start: (n + 1,) the parents of point k are parents[start[k] : start[k + 1]], one or more.
        parents: (parents,) node numbers.
        arm: (parents, d) X - X_p, m, from the parent to the point in the reference configuration.
        nodes: number of nodes of the mesh.
    """

    start: Ints
    parents: Ints
    arm: Values
    nodes: int

    @classmethod
    def from_positions(cls, parents: Ints, count: Ints, points: Values, node_points: Values) -> PointParents:
        """Parents with their arms, from reference positions.

        `count`: (n,) number of parents of each point.    `points`: (n, d), m.    `node_points`: (nodes, d), m.
        """
        arm = np.repeat(points, count, axis=0) - node_points[parents]
        return cls(np.concatenate([[0], np.cumsum(count)]), parents, arm, len(node_points))

    @property
    def first_parent(self) -> Ints:
        """(n,) first parent of each point."""
        return self.parents[self.start[:-1]]

    @cached_property
    def weights(self) -> csr_matrix:
        """(n, nodes) matrix with 1 / (number of parents) in the columns of the parents."""
        # here, since output of an undamaged body does not need SciPy: 0.13 s of the start-up
        from scipy.sparse import csr_matrix

        count = np.diff(self.start)
        return csr_matrix((np.repeat(1.0 / count, count), self.parents, self.start), shape=(len(count), self.nodes))

    @cached_property
    def rotating_nodes(self) -> Ints:
        """Nodes whose rotation is needed: parents with a nonzero arm."""
        return np.unique(self.parents[np.any(self.arm != 0, axis=1)])

    def mean(self, nodal: Values) -> Values:
        """(n, ...) mean of nodal values (nodes, ...) over the parents."""
        return self._mean(nodal[self.parents])

    def _mean(self, values: Values) -> Values:
        """(n, ...) mean over the parents of values (parents, ...)."""
        count = np.diff(self.start).reshape(-1, *np.ones(values.ndim - 1, int))
        result: Values = np.add.reduceat(values, self.start[:-1], axis=0) / count
        return result

    def displacement(self, u: Values, rotation: Values) -> Values:
        """(n, d) x - X = mean of u_p + (R_p - 1)(X - X_p), m.

        `rotation`: (rotating_nodes, d, d).    `u`: (nodes, d), m.
        """
        row = np.full(self.nodes, -1)
        row[self.rotating_nodes] = np.arange(len(self.rotating_nodes))
        entry = np.flatnonzero(np.any(self.arm != 0, axis=1))
        arm = self.arm[entry]
        displacement = u[self.parents]
        displacement[entry] += np.einsum("nij,nj->ni", rotation[row[self.parents[entry]]], arm) - arm
        return self._mean(displacement)


class NodalRotations:
    """Rotations R of nodes: polar rotations of the volume average of F over the unsplit cells around each node.

    A node without such a cell has the rotation of the nearest node that has one, along intact edges. If there is none,
    R is the identity: the fragment is smaller than a cell, and its rotation is unknown.
    """

    def __init__(self, topology: EntityNumbering, pattern: npt.NDArray[np.integer], nodes: Ints) -> None:
        d = topology.dim
        nodes, self._of = np.unique(_rotation_source(topology, pattern)[nodes], return_inverse=True)
        row = np.full(len(topology.points), -1)
        row[nodes] = np.arange(len(nodes))
        around = np.any(row[topology.cells] >= 0, axis=1) & ~is_split(d)[pattern]
        self._cells = topology.cells[around]
        span = topology.points[self._cells]
        # rows X_k - X_0
        span = span[:, 1:] - span[:, :1]
        # d! V (X_k - X_0)^-1
        self._inverse = np.linalg.inv(span) * np.abs(np.linalg.det(span))[:, None, None]
        target = row[self._cells]
        cell, corner = np.nonzero(target >= 0)
        ones = np.ones(len(cell))
        self._identity = np.eye(d)
        self._sum: csr_matrix | None = None
        if len(nodes):
            from scipy.sparse import csr_matrix

            self._sum = csr_matrix((ones, (target[cell, corner], cell)), shape=(len(nodes), len(self._cells)))
            volume = self._sum @ np.abs(np.linalg.det(span))
            # without cells the mean is 0 and F the identity
            self._per_volume = 1.0 / np.where(volume > 0, volume, 1.0)

    def __call__(self, u: Values) -> Values:
        """(nodes, d, d) rotations R for displacements u (N, d), m, with F = 1 + mean of grad u."""
        d = len(self._identity)
        if self._sum is None:
            return np.empty((0, d, d))
        moved = u[self._cells]
        moved = moved[:, 1:] - moved[:, :1]
        gradient = np.einsum("nkj,nki->nij", np.swapaxes(self._inverse, 1, 2), moved)
        mean = (self._sum @ gradient.reshape(-1, d * d)) * self._per_volume[:, None]
        F = mean.reshape(-1, d, d) + self._identity
        return polar_rotation(F)[self._of]


def _rotation_source(topology: EntityNumbering, pattern: npt.NDArray[np.integer]) -> Ints:
    """(N,) the node whose rotation each node has.

    That is the node itself if it has an unsplit cell or if no connected node has one. Otherwise it is the nearest such
    node along intact edges, the lowest one of several.
    """
    result = np.arange(len(topology.points))
    has_unsplit_cell = np.zeros(len(result), bool)
    has_unsplit_cell[topology.cells[~is_split(topology.dim)[pattern]]] = True
    if has_unsplit_cell.all():
        return result
    pairs = local_edges(topology.dim)
    cells = np.flatnonzero(~has_unsplit_cell[topology.cells].all(axis=1))
    intact = (np.asarray(pattern)[cells, None] >> np.arange(len(pairs))) & 1 == 0
    ends = topology.cells[cells][:, pairs][intact]
    ends = np.concatenate([ends, ends[:, ::-1]])
    has_rotation = has_unsplit_cell.copy()
    while len(new := np.flatnonzero(~has_rotation[ends[:, 0]] & has_rotation[ends[:, 1]])):
        nearest = np.full(len(result), len(result))
        np.minimum.at(nearest, ends[new, 0], result[ends[new, 1]])
        reached = np.unique(ends[new, 0])
        result[reached], has_rotation[reached] = nearest[reached], True
    return result
