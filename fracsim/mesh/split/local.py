"""The split surface of this rank's cells, as points that follow nodes linearly: what an obstacle touches.

    x = mean over p of (x_p + F_p (X - X_p)) = sum over nodes a of w_a x_a

with F_p the volume average of the deformation gradient of the intact cells around p, on all ranks; the identity where
there are none. Unlike the polar rotation of `follow` this is linear in the nodes, sum w_a = 1, and every affine motion
is reproduced: the transpose of w hands forces down to the nodes with their resultant and their moment (METHOD 9).

Nothing is gathered. A point on the border of two ranks is there on both, each time with the area of that rank's own
elements around it.
"""

from __future__ import annotations

import dolfinx
import numpy as np
import numpy.typing as npt
from dolfinx import la
from petsc4py import PETSc
from scipy.sparse import csr_matrix

from ...meshes.data import MeshData
from ..domain import Domain
from ..ranks import offset
from ..simplices import is_split
from .build import Split, split
from .skeleton import CRACK, Skeleton

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
OUTSIDE = "outside"  # the group of the body's own boundary: the borders of a rank are none of it


class LocalSurface:
    """Points of the surface of this rank's cells.

    Attributes:
        points: (n, d) reference coordinates, m.    area: (n,) share of each in the surface, m^2 (2D: m).
        weights: (n, columns) w.    columns: (columns,) global numbers of the nodes that the points follow.
    """

    def __init__(self, domain: Domain) -> None:
        self._domain = domain
        self._skeleton = Skeleton(_mesh_of(domain))
        self.follow_damage(np.zeros(domain.cell_count, np.uint8))

    def follow_damage(self, pattern: npt.NDArray[np.uint8]) -> None:
        """Be the surface of a body with these patterns of broken edges, (cells,) (collective)."""
        made = split(self._skeleton, pattern)
        area = _areas(made, self._skeleton)
        touching = np.flatnonzero(area > 0)
        self.points, self.area = made.points[touching], area[touching]
        rows, nodes, values = _entries(made, touching)
        turning = self._domain.comm.allreduce(len(made.follow.turning)) > 0
        matrix = self._mean(touching, rows, nodes, values)
        if turning:
            matrix = self._turned(matrix, made, pattern, rows, nodes, values, touching)
        start, columns, entries = matrix.getValuesCSR()
        matrix.destroy()
        self.columns, place = np.unique(columns, return_inverse=True)
        shape = len(touching), len(self.columns)
        self.weights = csr_matrix((entries, place.reshape(-1), start), shape=shape)

    def _mean(self, touching: Ints, rows: Ints, nodes: Ints, values: Values) -> PETSc.Mat:
        """(points, nodes) mean over the parents of each point."""
        return self._matrix(len(touching), 1, rows, self._global(nodes), values)

    def _turned(
        self, mean: PETSc.Mat, made: Split, pattern: npt.NDArray[np.uint8], rows: Ints, nodes: Ints, values: Values,
        touching: Ints,
    ) -> PETSc.Mat:  # fmt: skip
        """mean + arms times the averages of gradients around the parents: w (collective)."""
        d = self._domain.dim
        arm = made.follow.arm[_of_points(made, touching)]
        gradients = self._gradients(pattern)
        by = np.repeat(rows, d), (d * self._global(nodes)[:, None] + np.arange(d)).reshape(-1)
        arms = self._matrix(len(touching), d, *by, (values[:, None] * arm).reshape(-1))
        result = arms.matMult(gradients)
        result.axpy(1.0, mean, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        for used in (mean, arms, gradients):
            used.destroy()
        return result

    def _gradients(self, pattern: npt.NDArray[np.uint8]) -> PETSc.Mat:
        """(d nodes, nodes) d/dX_j of a nodal field, averaged over the intact cells around each node (collective)."""
        domain, d = self._domain, self._domain.dim
        cells = np.flatnonzero(~is_split(d)[pattern])
        corners, volume = domain.cell_nodes[cells].astype(np.int64), domain.volumes[cells]
        share = volume[:, None] / self._summed(corners, volume)[corners]
        number = self._global(corners.reshape(-1)).reshape(corners.shape)
        entries = gradient_entries(domain.nodes[corners], share, number)
        return self._matrix(domain.node_count * d, 1, *entries, local=False)

    def _summed(self, corners: Ints, volume: Values) -> Values:
        """(nodes,) volume of the cells around each node, on all ranks, m^d (collective)."""
        result = la.vector(self._domain.space.dofmap.index_map, 1, np.float64)
        np.add.at(result.array, corners, volume[:, None])
        result.scatter_reverse(la.InsertMode.add)
        result.scatter_forward()
        return np.maximum(result.array, np.finfo(float).tiny)

    def _global(self, nodes: Ints) -> Ints:
        return self._domain.space.dofmap.index_map.local_to_global(nodes.astype(np.int32)).astype(np.int64)

    def _matrix(
        self, count: int, width: int, rows: Ints, columns: Ints, values: Values, *, local: bool = True
    ) -> PETSc.Mat:
        """A matrix of `count` rows of this rank and `width` columns a node from its entries, summed; `local`: rows are
        numbered from this rank's first (collective)."""
        owned = self._domain.node_count * width
        matrix = PETSc.Mat().create(self._domain.comm)
        matrix.setSizes(((count, PETSc.DETERMINE), (owned, PETSc.DETERMINE)))
        matrix.setType(PETSc.Mat.Type.AIJ)
        first = offset(self._domain.comm, count) if local else 0
        matrix.setUp()  # PETSc counts entries itself: rows of other ranks have them, too
        here, place = np.unique(rows + first, return_inverse=True)
        summed = csr_matrix((values, (place.reshape(-1), columns)), shape=(len(here), matrix.size[1]))
        indices = [each.astype(PETSc.IntType) for each in (summed.indptr, summed.indices, here)]
        matrix.setValuesIJV(indices[0], indices[1], summed.data, PETSc.InsertMode.ADD_VALUES, indices[2])
        matrix.assemble()
        return matrix


def whole_weights(made: Split, skeleton: Skeleton, pattern: npt.NDArray[np.uint8], places: Values) -> csr_matrix:
    """(n, nodes) w of points at reference `places` (n, d), which may be others than the surface's own; one rank that
    has the whole mesh."""
    d, count, follow = skeleton.dim, len(made.points), made.follow
    parents = np.diff(follow.start)
    rows = np.repeat(np.arange(count), parents)
    share, arm = np.repeat(1.0 / parents, parents), places[rows] - skeleton.points[follow.parents]
    mean = csr_matrix((share, (rows, follow.parents)), shape=(count, follow.nodes))
    corners = skeleton.cells[~is_split(d)[pattern]]
    X = skeleton.points[corners]
    volume = np.abs(np.linalg.det(X[:, 1:] - X[:, :1]))
    around = np.bincount(corners.reshape(-1), np.repeat(volume, d + 1), minlength=follow.nodes)
    at, of, values = gradient_entries(X, volume[:, None] / around[corners], corners)
    gradients = csr_matrix((values, (at, of)), shape=(d * follow.nodes, follow.nodes))
    of_arm = (d * follow.parents[:, None] + np.arange(d)).reshape(-1)
    arms = csr_matrix(((share[:, None] * arm).reshape(-1), (np.repeat(rows, d), of_arm)),
                      shape=(count, d * follow.nodes))  # fmt: skip
    return (mean + arms @ gradients).tocsr()


def gradient_entries(X: Values, share: Values, number: Ints) -> tuple[Ints, Ints, Values]:
    """Entries (row, column, value) of the averages of d/dX_j around nodes: row d p + j, column a.

    `X` (cells, d + 1, d) corners, `number` (cells, d + 1) of their nodes, `share` (cells, d + 1) of each cell in the
    average around each of its nodes.
    """
    d = X.shape[2]
    inverse = np.linalg.inv(X[:, 1:] - X[:, :1])  # of rows X_k - X_0: column k is the gradient of corner k + 1
    slope = np.concatenate([-inverse.sum(axis=2)[:, :, None], inverse], axis=2)  # cell, axis, corner
    entries = share[:, :, None, None] * slope[:, None]  # cell, corner, axis, corner
    at = np.broadcast_to((d * number[:, :, None] + np.arange(d))[..., None], entries.shape)
    of = np.broadcast_to(number[:, None, None, :], entries.shape)
    return at.reshape(-1), of.reshape(-1), entries.reshape(-1)


def _mesh_of(domain: Domain) -> MeshData:
    """This rank's cells, and which of their facets are on the boundary of the body."""
    exterior = domain._exterior
    geometry = dolfinx.mesh.entities_to_geometry(domain.mesh, domain.dim - 1, exterior)
    of_geometry = np.empty(len(domain.mesh.geometry.x), np.int64)
    of_geometry[domain.mesh.geometry.dofmap] = domain.cell_nodes
    facets = of_geometry[geometry].reshape(-1, domain.dim)
    return MeshData(domain.nodes, domain.cell_nodes.astype(np.int64), {OUTSIDE: facets})


def _areas(made: Split, skeleton: Skeleton) -> Values:
    """(points,) a d-th of the measure of the elements around each, of cracks and of the body's own boundary."""
    outside = np.flatnonzero([OUTSIDE in name for name in skeleton.origins])
    elements = made.elements[np.isin(made.origin, [CRACK, *outside])]
    corners = made.points[elements]
    if skeleton.dim == 2:
        measure = np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)
    else:
        measure = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    result = np.zeros(len(made.points))
    np.add.at(result, elements, measure[:, None] / skeleton.dim)
    return result


def _of_points(made: Split, points: Ints) -> Ints:
    """Places of the parents of some points in `follow.parents`, in their order."""
    start, count = made.follow.start[points], np.diff(made.follow.start)[points]
    return np.repeat(start - np.concatenate([[0], np.cumsum(count)[:-1]]), count) + np.arange(count.sum())


def _entries(made: Split, points: Ints) -> tuple[Ints, Ints, Values]:
    """(row, local node, 1 / number of parents) of each parent of some points."""
    count = np.diff(made.follow.start)[points]
    rows = np.repeat(np.arange(len(points)), count)
    return rows, made.follow.parents[_of_points(made, points)], np.repeat(1.0 / count, count)


class Following:
    """Carries values between the nodes of a body, wherever they are, and the points of this rank's surface."""

    def __init__(self, domain: Domain, surface: LocalSurface) -> None:
        """For the surface as it is now (collective)."""
        self.weights, self._dim = surface.weights, domain.dim
        self._nodes = PETSc.Vec().createMPI((domain.node_count * domain.dim, PETSc.DETERMINE), bsize=domain.dim,
                                            comm=domain.comm)  # fmt: skip
        self._here = PETSc.Vec().createSeq(len(surface.columns) * domain.dim, bsize=domain.dim)
        columns = PETSc.IS().createBlock(domain.dim, surface.columns.astype(PETSc.IntType), comm=PETSc.COMM_SELF)
        self._scatter = PETSc.Scatter().create(self._nodes, columns, self._here, None)
        columns.destroy()

    def __call__(self, owned: Values) -> Values:
        """(n, d) values at the points of a field given by its owned dofs (collective)."""
        self._nodes.array_w[:] = owned
        self._scatter.scatter(self._nodes, self._here, PETSc.InsertMode.INSERT, PETSc.ScatterMode.FORWARD)
        return np.asarray(self.weights @ self._here.array_r.reshape(-1, self._dim))

    def handed_down(self, forces: Values) -> Values:
        """(owned dofs,) nodal forces of forces (n, d) at the points, N (collective)."""
        self._here.array_w[:] = (self.weights.T @ forces).reshape(-1)
        self._nodes.set(0.0)
        self._scatter.scatter(self._here, self._nodes, PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)
        return self._nodes.array_r.copy()

    def destroy(self) -> None:
        """Give the memory of PETSc's objects back."""
        for kept in (self._nodes, self._here, self._scatter):
            kept.destroy()
