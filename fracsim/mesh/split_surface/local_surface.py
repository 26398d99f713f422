"""The split surface of this rank's cells, as points that follow nodes linearly: what an obstacle touches.

    x = mean over p of (x_p + F_p (X - X_p)) = sum over nodes a of w_a x_a

with F_p the volume average of the deformation gradient of the intact cells around p, on all ranks; the identity where
there are none. Unlike the polar rotation of `follow` this is linear in the nodes, sum w_a = 1, and every affine motion
is reproduced: the transpose of w hands forces down to the nodes with their resultant and their moment
(docs/theory.md#split-surface).

Nothing is gathered. A point on the border of two ranks is there on both, each time with the area of that rank's own
elements around it.
"""

from __future__ import annotations

import dolfinx
import numpy as np
import numpy.typing as npt
from dolfinx import la
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import csr_matrix

from ...meshes.data import MeshData
from ..domain import Domain
from ..parallel import offset
from ..simplices import is_split
from .closed_surface import SplitSurface, build_split_surface
from .entity_numbering import CRACK, EntityNumbering
from .point_matching import point_identity
from .surface_map import SurfaceMap, gradient_entries, middles

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
OUTSIDE = "outside"  # the group of the body's own boundary: the borders of a rank are none of it


class LocalSurface:
    """Points of the surface of this rank's cells.

    Attributes:
        at: where the n points are.    area: (n,) share of each in the surface, m^2 (2D: m).
        columns: global numbers of the nodes that the points follow: the columns of the weights of `at`.
    """

    def __init__(self, domain: Domain) -> None:
        self._domain = domain
        mesh = _mesh_of(domain)
        self._skeleton = EntityNumbering(mesh)
        self.update_damage(np.zeros(len(mesh.cells), np.uint8))

    def update_damage(self, pattern: npt.NDArray[np.uint8]) -> None:
        """Be the surface of a body with these patterns of broken edges, (cells,) (collective)."""
        made = build_split_surface(self._skeleton, pattern)
        if self._domain.order == 2:
            from .quadratic_surface import with_midside_points

            made = with_midside_points(made, self._domain, pattern)
        area = _areas(made, self._skeleton)
        self._touching = np.flatnonzero(area > 0)
        self.area, self._made = area[self._touching], made
        means = self._means(made)
        turning = self._domain.comm.allreduce(len(made.parents.rotating_nodes)) > 0
        arms = self._arms(made, pattern) if turning else csr_matrix(means.shape)
        self.columns, (means, arms) = _on_columns([means, arms])
        middle = middles(made.points, made.parents)[self._touching]
        out = made.points[self._touching] - middle
        self.at = SurfaceMap(means, middle, arms, out)

    def identity(self, points: Ints | None = None) -> Values:
        """(k, 2 d + 1) rows that tell `points` (k,), or the copies `at.copies`, from all others, whatever breaks
        (split.identity)."""
        domain, which = self._domain, self.at.copies if points is None else points
        return point_identity(self._made, self._touching[which], domain.node_input, domain.size)

    def facets(self) -> tuple[Ints, Values]:
        """(m, d) points of the elements that make up the areas of points, and their measures (m,), m^2 (2D: m)."""
        elements, measure = _touched(self._made, self._skeleton)
        real = measure > 0
        return np.searchsorted(self._touching, elements[real]), measure[real]

    def _means(self, made: SplitSurface) -> csr_matrix:
        """(points, nodes of all ranks) means over the parents of each point."""
        start, of = _parents_of(made, self._touching)
        return self._wide(start, self._global(made.parents.parents[of]), _shares(start))

    def _arms(self, made: SplitSurface, pattern: npt.NDArray[np.uint8]) -> csr_matrix:
        """(points, nodes of all ranks) arms times the averages of gradients, means over the parents (collective)."""
        comm, d = self._domain.comm, self._domain.dim
        start, of = _parents_of(made, self._touching)
        parents, arm = made.parents.parents[of], made.parents.arm[of]
        arms = self._wide(d * start, _by_axis(self._global(parents), d), (_shares(start)[:, None] * arm).reshape(-1), d)
        count = arms.shape[0]
        left = _assembled(comm, (count, d * self._domain.node_count), arms, offset(comm, count) + np.arange(count))
        right = self._gradients(pattern, parents[np.any(arm != 0, axis=1)])
        product = left.matMult(right)
        rows, nodes, values = product.getValuesCSR()
        for used in (left, right, product):
            used.destroy()
        return self._wide(rows, nodes, values)

    def _gradients(self, pattern: npt.NDArray[np.uint8], parents: Ints) -> PETSc.Mat:
        """(d nodes, nodes) d/dX_j of a nodal field, averaged over the intact cells around each node that is one of the
        `parents` on any rank (collective)."""
        domain, d = self._domain, self._domain.dim
        wanted = self._summed(parents, 1.0) > 0
        cells = np.flatnonzero(~is_split(d)[pattern] & wanted[domain.cell_nodes].any(axis=1))
        corners, volume = domain.cell_nodes[cells].astype(np.int64), domain.volumes[cells][:, None]
        # sums around other nodes lack cells, and their rows are of no use
        around = np.maximum(self._summed(corners, volume), np.finfo(float).tiny)
        rows, columns, values = gradient_entries(domain.nodes[corners], volume / around[corners], corners)
        nodes = self._global(np.arange(len(domain.nodes)))
        shape = d * len(nodes), self._domain.space.dofmap.index_map.size_global
        entries = csr_matrix((values, (rows, nodes[columns])), shape=shape)
        return _assembled(domain.comm, (d * domain.node_count, domain.node_count), entries, _by_axis(nodes, d))

    def _summed(self, nodes: Ints, values: Values | float) -> Values:
        """(nodes,) sums of the values at each node, on all ranks (collective)."""
        result = la.vector(self._domain.space.dofmap.index_map, 1, np.float64)
        every = np.broadcast_to(values, nodes.shape).reshape(-1)
        result.array[:] = np.bincount(nodes.reshape(-1), every, len(result.array))
        result.scatter_reverse(la.InsertMode.add)
        result.scatter_forward()
        return np.asarray(result.array)

    def _global(self, nodes: Ints) -> Ints:
        return self._domain.space.dofmap.index_map.local_to_global(nodes.astype(np.int32)).astype(np.int64)

    def _wide(self, start: Ints, columns: Ints, values: Values, width: int = 1) -> csr_matrix:
        """Rows with `width` columns for each node of all ranks."""
        shape = len(start) - 1, width * self._domain.space.dofmap.index_map.size_global
        return csr_matrix((values, columns, start), shape=shape)


def _assembled(comm: MPI.Comm, owned: tuple[int, int], rows: csr_matrix, number: Ints) -> PETSc.Mat:
    """A matrix with so many rows and columns of this rank: sums of the `rows`, of all ranks, with the same `number`
    (collective)."""
    matrix = PETSc.Mat().create(comm)
    matrix.setSizes(((owned[0], PETSc.DETERMINE), (owned[1], PETSc.DETERMINE)))
    matrix.setType(PETSc.Mat.Type.AIJ)
    matrix.setUp()  # PETSc counts entries itself: rows of other ranks have them, too
    used = np.flatnonzero(np.diff(rows.indptr))
    start = np.append(rows.indptr[used], rows.nnz)
    indices = [each.astype(PETSc.IntType) for each in (start, rows.indices, number[used])]
    matrix.setValuesIJV(indices[0], indices[1], rows.data, PETSc.InsertMode.ADD_VALUES, indices[2])
    matrix.assemble()
    return matrix


def _mesh_of(domain: Domain) -> MeshData:
    """This rank's cells, and which of their facets are on the boundary of the body."""
    exterior = domain._exterior
    geometry = dolfinx.mesh.entities_to_geometry(domain.mesh, domain.dim - 1, exterior)
    of_geometry = np.empty(len(domain.mesh.geometry.x), np.int64)
    of_geometry[domain.corner_geometry] = domain.cell_nodes
    facets = of_geometry[geometry].reshape(-1, domain.dim)
    return MeshData(domain.nodes, domain.cell_nodes.astype(np.int64), {OUTSIDE: facets})


def _touched(made: SplitSurface, skeleton: EntityNumbering) -> tuple[Ints, Values]:
    """(m, d) elements of cracks and of the body's own boundary, and their measures (m,)."""
    outside = np.flatnonzero([OUTSIDE in name for name in skeleton.origins])
    elements = made.elements[np.isin(made.origin, [CRACK, *outside])]
    corners = made.points[elements]
    if skeleton.dim == 2:
        return elements, np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)
    spanned = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return elements, np.linalg.norm(spanned, axis=1) / 2


def _areas(made: SplitSurface, skeleton: EntityNumbering) -> Values:
    """(points,) a d-th of the measure of the elements around each."""
    elements, measure = _touched(made, skeleton)
    shares = np.repeat(measure / skeleton.dim, skeleton.dim)
    return np.asarray(np.bincount(elements.reshape(-1), shares, len(made.points)), np.float64)


def _parents_of(made: SplitSurface, points: Ints) -> tuple[Ints, Ints]:
    """Of k points: (k + 1,) where the parents of each begin, and the places of these in `follow.parents`."""
    begin, count = made.parents.start[points], np.diff(made.parents.start)[points]
    start = np.concatenate([[0], np.cumsum(count)])
    return start, np.repeat(begin - start[:-1], count) + np.arange(start[-1])


def _shares(start: Ints) -> Values:
    """1 / number of the parents of a point, for each of them."""
    count = np.diff(start)
    return np.repeat(1.0 / count, count)


def _by_axis(numbers: Ints, d: int) -> Ints:
    """d n + j, of numbers n and axes j."""
    return (d * numbers[:, None] + np.arange(d)).reshape(-1)


def _on_columns(matrices: list[csr_matrix]) -> tuple[Ints, list[csr_matrix]]:
    """The columns that are used, and the matrices on them."""
    used = np.zeros(matrices[0].shape[1], bool)
    for each in matrices:
        used[each.indices] = True
    columns, place = np.flatnonzero(used), np.cumsum(used) - 1
    shape = matrices[0].shape[0], len(columns)
    return columns, [csr_matrix((each.data, place[each.indices], each.indptr), shape=shape) for each in matrices]


class ParentMatrix:
    """Carries values between the nodes of a body, wherever they are, and the points of this rank's surface.

    Attributes:
        dim: of the body.    comm: its ranks.
    """

    def __init__(self, domain: Domain, surface: LocalSurface) -> None:
        """For the surface as it is now (collective)."""
        self._surface, self.dim, self.comm = surface, domain.dim, domain.comm
        self._nodes = PETSc.Vec().createMPI((domain.node_count * domain.dim, PETSc.DETERMINE), bsize=domain.dim,
                                            comm=domain.comm)  # fmt: skip
        self._here = PETSc.Vec().createSeq(len(surface.columns) * domain.dim, bsize=domain.dim)
        columns = PETSc.IS().createBlock(domain.dim, surface.columns.astype(PETSc.IntType), comm=PETSc.COMM_SELF)
        self._scatter = PETSc.Scatter().create(self._nodes, columns, self._here, None)
        columns.destroy()

    def __call__(self, owned: Values) -> Values:
        """(n, d) values at the points of a field given by its owned dofs (collective)."""
        return np.asarray(self._surface.at.weights @ self.nodal(owned))

    def nodal(self, owned: Values) -> Values:
        """(columns, d) values at the nodes that the points follow (collective)."""
        self._nodes.array_w[:] = owned
        self._scatter.scatter(self._nodes, self._here, PETSc.InsertMode.INSERT, PETSc.ScatterMode.FORWARD)
        return np.asarray(self._here.array_r.reshape(-1, self.dim))

    def assemble_to_nodes(self, forces: Values) -> Values:
        """(owned dofs,) nodal forces of forces (n, d) at the points, N (collective)."""
        return self.summed(self._surface.at.weights.T @ forces)

    def summed(self, parts: Values) -> Values:
        """(owned dofs,) sums over ranks of their parts (columns, d) at the nodes that points follow (collective)."""
        self._here.array_w[:] = parts.reshape(-1)
        self._nodes.set(0.0)
        self._scatter.scatter(self._here, self._nodes, PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)
        return self._nodes.array_r.copy()

    def destroy(self) -> None:
        """Give the memory of PETSc's objects back."""
        for kept in (self._nodes, self._here, self._scatter):
            kept.destroy()
