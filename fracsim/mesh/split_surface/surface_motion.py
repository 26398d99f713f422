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
from mpi4py import MPI

from ..parallel import RowRouting
from ..simplices import is_split, local_edges
from ..small_matrices import cofactors, polar_rotation

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

    from .mesh_part import MeshPart

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
    def _with_arm(self) -> Ints:
        """Positions in `parents` of those with a nonzero arm."""
        return np.flatnonzero(self.arm.any(axis=1))

    @cached_property
    def _rotation_row(self) -> Ints:
        """Index into `rotating_nodes` of each parent with a nonzero arm."""
        row = np.full(self.nodes, -1)
        row[self.rotating_nodes] = np.arange(len(self.rotating_nodes))
        return row[self.parents[self._with_arm]]

    @cached_property
    def rotating_nodes(self) -> Ints:
        """Nodes whose rotation is needed: parents with a nonzero arm."""
        return np.unique(self.parents[self._with_arm])

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
        arm = self.arm[self._with_arm]
        displacement = u[self.parents]
        turned = np.einsum("nij,nj->ni", rotation[self._rotation_row], arm)
        displacement[self._with_arm] += turned - arm
        return self._mean(displacement)


class NodalGradients:
    """Volume averages of grad u over the unsplit cells around nodes; 0 at nodes without such a cell.

    Attributes:
        row: (N,) row of each node in the results, -1 for other nodes.
    """

    def __init__(self, part: MeshPart, pattern: npt.NDArray[np.integer], wanted: npt.NDArray[np.bool_]) -> None:
        """`wanted`: (N,) flags of nodes; those that any rank flags have rows (collective)."""
        # here, since output of an undamaged body does not need SciPy
        from scipy.sparse import csr_matrix

        topology = part.skeleton
        self._part, self._dim = part, topology.dim
        everywhere = np.arange(len(topology.points))
        self._nodes = np.flatnonzero(part.sum_at(everywhere, wanted[:, None].astype(float))[:, 0])
        self.row = np.full(len(topology.points), -1)
        self.row[self._nodes] = np.arange(len(self._nodes))
        around = np.any(self.row[topology.cells] >= 0, axis=1) & ~is_split(self._dim)[pattern]
        self._cells = topology.cells[around]
        span = topology.points[self._cells]
        # rows X_k - X_0
        span = span[:, 1:] - span[:, :1]
        # d! V (X_k - X_0)^-T
        cofactor = cofactors(span)
        determinant = np.einsum("nj,nj->n", span[:, 0], cofactor[:, 0])
        self._inverse = cofactor * np.sign(determinant)[:, None, None]
        target = self.row[self._cells]
        cell, corner = np.nonzero(target >= 0)
        ones = np.ones(len(cell))
        self._sum = csr_matrix((ones, (target[cell, corner], cell)), shape=(len(self._nodes), len(self._cells)))
        volume = part.sum_at(self._nodes, (self._sum @ np.abs(determinant))[:, None])
        self._per_volume = 1.0 / np.where(volume > 0, volume, 1.0)

    def __call__(self, u: Values) -> Values:
        """(rows, d, d) averages for displacements u (N, d), m (collective)."""
        d, moved = self._dim, u[self._cells]
        moved = moved[:, 1:] - moved[:, :1]
        gradient = np.einsum("nkj,nki->nij", self._inverse, moved)
        mean = self._part.sum_at(self._nodes, self._sum @ gradient.reshape(-1, d * d)) * self._per_volume
        return mean.reshape(-1, d, d)


class NodalRotations:
    """Rotations R of nodes: polar rotations of the volume average of F over the unsplit cells around each node.

    A node without such a cell has the rotation of the nearest node that has one, along intact edges. If there is none,
    R is the identity: the fragment is smaller than a cell, and its rotation is unknown.
    """

    def __init__(self, part: MeshPart, pattern: npt.NDArray[np.integer], nodes: Ints) -> None:
        """`nodes`: (k,) of this rank (collective)."""
        comm, self._identity = part.comm, np.eye(part.skeleton.dim)
        # of all nodes, since ranks find the nearest ones together
        sources = _rotation_source(part, pattern)[nodes]
        self._is_used = comm.allreduce(len(nodes) > 0, op=MPI.LOR)
        if not self._is_used:
            return
        keys, self._of = np.unique(sources, return_inverse=True)
        # the owner of a node has its rotation
        self._routing = RowRouting(comm, keys % comm.size)
        asked = np.searchsorted(part.node_numbers, self._routing.send(keys) // comm.size)
        is_asked = np.zeros(len(part.node_numbers), bool)
        is_asked[asked] = True
        self._gradients = NodalGradients(part, pattern, is_asked)
        self._asked = self._gradients.row[asked]

    def __call__(self, u: Values) -> Values:
        """(nodes, d, d) rotations R for displacements u (N, d), m, with F = 1 + mean of grad u (collective)."""
        if not self._is_used:
            return np.empty((0, *self._identity.shape))
        F = self._gradients(u) + self._identity
        return self._routing.send_back(polar_rotation(F)[self._asked])[self._of]


def _rotation_source(part: MeshPart, pattern: npt.NDArray[np.integer]) -> Ints:
    """(N,) the node whose rotation each node has, as its number in the input mesh times the ranks plus its owner.

    That is the node itself if it has an unsplit cell or if no connected node has one. Otherwise it is the nearest such
    node along intact edges, the lowest one of several (collective).
    """
    topology, comm = part.skeleton, part.comm
    result = part.node_numbers * comm.size + part.owner
    lacks_unsplit_cell = np.ones(len(result), np.int64)
    lacks_unsplit_cell[topology.cells[~is_split(topology.dim)[pattern]]] = 0
    has_rotation = part.least(lacks_unsplit_cell) == 0
    if comm.allreduce(bool(has_rotation.all()), op=MPI.LAND):
        return result
    pairs = local_edges(topology.dim)
    cells = np.flatnonzero(~has_rotation[topology.cells].all(axis=1))
    intact = (np.asarray(pattern)[cells, None] >> np.arange(len(pairs))) & 1 == 0
    ends = topology.cells[cells][:, pairs][intact]
    ends = np.concatenate([ends, ends[:, ::-1]])
    far = np.iinfo(np.int64).max
    while True:
        new = np.flatnonzero(~has_rotation[ends[:, 0]] & has_rotation[ends[:, 1]])
        nearest: Ints = np.full(len(result), far)
        np.minimum.at(nearest, ends[new, 0], result[ends[new, 1]])
        nearest = part.least(nearest)
        reached = np.flatnonzero(nearest < far)
        if not comm.allreduce(len(reached) > 0, op=MPI.LOR):
            return result
        result[reached], has_rotation[reached] = nearest[reached], True
