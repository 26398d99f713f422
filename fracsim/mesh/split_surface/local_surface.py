"""The split surface of the cells of this rank, as points that are linear in the nodes, for contact.

    x = mean over p of (x_p + F_p (X - X_p)) = sum over nodes a of w_a x_a

with F_p the volume average of the deformation gradient of the intact cells around p on all ranks, or the identity if
there are none. The map is linear in the nodes, unlike that of `surface_motion` with polar rotations. Sum w_a = 1, and
affine motions are reproduced. Hence the transpose of w distributes forces to nodes with equal resultant and moment
(docs/theory.md#split-surface).

Nothing is gathered. A point on the border of two ranks exists on both, with the area of the elements of each rank.
"""

from __future__ import annotations

import dolfinx
import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import csr_matrix

from ...meshes.data import MeshData
from ..domain import Domain
from ..ghost_exchange import sum_at_nodes
from ..parallel import rank_offset
from .closed_surface import SplitSurface
from .entity_numbering import CRACK, EntityNumbering
from .surface_map import gradient_entries, mean_parent_positions

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
OUTSIDE = "outside"  # facet group of the boundary of the body; borders between ranks do not belong to it


def local_map_parts(
    domain: Domain, surface: SplitSurface, points: Ints, intact: npt.NDArray[np.bool_]
) -> tuple[csr_matrix, Values, csr_matrix, Values]:
    """Arguments of a SurfaceMap for points (k,) of a surface of this rank, with global nodes as columns (collective).

    `intact`: (cells,) flags of the cells of which gradients are averaged.
    """
    start, entries = _parents_of(surface, points)
    parents, arm = surface.parents.parents[entries], surface.parents.arm[entries]
    means = _global_matrix(domain, start, _global_numbers(domain, parents), _shares(start))
    turning = domain.comm.allreduce(bool(np.any(arm)), op=MPI.LOR)
    arms = _arm_matrix(domain, start, parents, arm, intact) if turning else csr_matrix(means.shape)
    middle = mean_parent_positions(surface.points, surface.parents)[points]
    return means, middle, arms, surface.points[points] - middle


def _arm_matrix(domain: Domain, start: Ints, parents: Ints, arm: Values, intact: npt.NDArray[np.bool_]) -> csr_matrix:
    """(points, global nodes) matrix of the means over parents of arm times averaged gradient (collective)."""
    comm, d = domain.comm, domain.dim
    numbers = _by_axis(_global_numbers(domain, parents), d)
    arms = _global_matrix(domain, d * start, numbers, (_shares(start)[:, None] * arm).reshape(-1), d)
    gradients, rows = _gradient_entries(domain, intact, parents[np.any(arm != 0, axis=1)])
    if comm.size == 1:
        return (arms @ gradients).tocsr()
    count = arms.shape[0]
    number = rank_offset(comm, count) + np.arange(count)
    left = _assemble_petsc(comm, (count, d * domain.node_count), arms, number)
    right = _assemble_petsc(comm, (d * domain.node_count, domain.node_count), gradients, rows)
    product = left.matMult(right)
    first, nodes, values = product.getValuesCSR()
    for matrix in (left, right, product):
        matrix.destroy()
    return _global_matrix(domain, first, nodes, values)


def _gradient_entries(domain: Domain, intact: npt.NDArray[np.bool_], parents: Ints) -> tuple[csr_matrix, Ints]:
    """(d local nodes, global nodes) shares of this rank in d/dX_j of a nodal field, averaged over intact cells.

    Also returns (d local nodes,) the global number of each row. Sums of rows over the ranks are right for nodes that
    are among the `parents` of any rank (collective).
    """
    d = domain.dim
    is_parent = sum_at_nodes(domain, parents, np.ones((len(parents), 1)))[:, 0] > 0
    cells = np.flatnonzero(intact & is_parent[domain.cell_nodes].any(axis=1))
    corners, volume = domain.cell_nodes[cells].astype(np.int64), domain.volumes[cells][:, None]
    # sums at other nodes lack cells: their rows are not used
    around = np.maximum(sum_at_nodes(domain, corners, volume)[:, 0], np.finfo(float).tiny)
    rows, columns, values = gradient_entries(domain.nodes[corners], volume / around[corners], corners)
    nodes = _global_numbers(domain, np.arange(len(domain.nodes)))
    shape = d * len(nodes), domain.space.dofmap.index_map.size_global
    return csr_matrix((values, (rows, nodes[columns])), shape=shape), _by_axis(nodes, d)


def _global_numbers(domain: Domain, nodes: Ints) -> Ints:
    return domain.space.dofmap.index_map.local_to_global(nodes.astype(np.int32)).astype(np.int64)


def _global_matrix(domain: Domain, start: Ints, columns: Ints, values: Values, width: int = 1) -> csr_matrix:
    """Sparse matrix with `width` columns for each global node."""
    shape = len(start) - 1, width * domain.space.dofmap.index_map.size_global
    return csr_matrix((values, columns, start), shape=shape)


def _assemble_petsc(comm: MPI.Comm, owned: tuple[int, int], rows: csr_matrix, number: Ints) -> PETSc.Mat:
    """PETSc matrix with `owned` rows and columns on this rank: the sum of the `rows` of all ranks (collective).

    `number`: global number of each row.
    """
    matrix = PETSc.Mat().create(comm)
    matrix.setSizes(((owned[0], PETSc.DETERMINE), (owned[1], PETSc.DETERMINE)))
    matrix.setType(PETSc.Mat.Type.AIJ)
    # without preallocation, since other ranks add entries
    matrix.setUp()
    used = np.flatnonzero(np.diff(rows.indptr))
    start = np.append(rows.indptr[used], rows.nnz)
    indices = [numbers.astype(PETSc.IntType) for numbers in (start, rows.indices, number[used])]
    matrix.setValuesIJV(indices[0], indices[1], rows.data, PETSc.InsertMode.ADD_VALUES, indices[2])
    matrix.assemble()
    return matrix


def local_mesh(domain: Domain) -> MeshData:
    """The cells of this rank as a mesh, with the boundary facets of the body as group OUTSIDE."""
    exterior = domain.facets.boundary
    geometry = dolfinx.mesh.entities_to_geometry(domain.mesh, domain.dim - 1, exterior)
    of_geometry = np.full(len(domain.mesh.geometry.x), -1, np.int64)
    of_geometry[domain.corner_geometry] = domain.cell_nodes
    # curved facets have midside nodes, too, behind their corners
    facets = of_geometry[geometry.reshape(len(exterior), -1)[:, : domain.dim]]
    return MeshData(domain.nodes, domain.cell_nodes.astype(np.int64), {OUTSIDE: facets})


def contact_elements(surface: SplitSurface, topology: EntityNumbering) -> tuple[Ints, Values]:
    """(m, d) elements of crack faces and of the boundary of the body, and (m,) their areas (2D: lengths)."""
    outside = np.flatnonzero([OUTSIDE in name for name in topology.origins])
    elements = surface.elements[np.isin(surface.origin, [CRACK, *outside])]
    corners = surface.points[elements]
    if topology.dim == 2:
        return elements, np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)
    spanned = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return elements, np.linalg.norm(spanned, axis=1) / 2


def _parents_of(surface: SplitSurface, points: Ints) -> tuple[Ints, Ints]:
    """(k + 1,) start of the parents of each of the points (k,), and their positions in `surface.parents.parents`."""
    begin, count = surface.parents.start[points], np.diff(surface.parents.start)[points]
    start = np.concatenate([[0], np.cumsum(count)])
    return start, np.repeat(begin - start[:-1], count) + np.arange(start[-1])


def _shares(start: Ints) -> Values:
    """(parents,) 1 / number of parents of the same point."""
    count = np.diff(start)
    return np.repeat(1.0 / count, count)


def _by_axis(numbers: Ints, d: int) -> Ints:
    """(d k,) d n + j for numbers n (k,) and axes j."""
    return (d * numbers[:, None] + np.arange(d)).reshape(-1)


def restrict_to_used_columns(matrices: list[csr_matrix]) -> tuple[Ints, list[csr_matrix]]:
    """The columns that have entries, and the matrices restricted to them."""
    for matrix in matrices:
        matrix.sum_duplicates()  # now, as the restricted matrices share the values
    columns = np.unique(np.concatenate([matrix.indices for matrix in matrices])).astype(np.int64)
    shape = matrices[0].shape[0], len(columns)
    return columns, [
        csr_matrix((matrix.data, np.searchsorted(columns, matrix.indices), matrix.indptr), shape=shape)
        for matrix in matrices
    ]


class NodeExchange:
    """Values of nodes of all ranks at the nodes that this rank selects, and sums of their parts back."""

    def __init__(self, domain: Domain, nodes: Ints) -> None:
        """`nodes`: (k,) global numbers of the selected nodes (collective)."""
        self._dim = domain.dim
        self._nodes = PETSc.Vec().createMPI((domain.node_count * domain.dim, PETSc.DETERMINE), bsize=domain.dim,
                                            comm=domain.comm)  # fmt: skip
        self._local = PETSc.Vec().createSeq(len(nodes) * domain.dim, bsize=domain.dim)
        selected = PETSc.IS().createBlock(domain.dim, nodes.astype(PETSc.IntType), comm=PETSc.COMM_SELF)
        self._scatter = PETSc.Scatter().create(self._nodes, selected, self._local, None)
        selected.destroy()

    def __call__(self, owned: Values) -> Values:
        """(k, d) values at the selected nodes of a field with `owned` dofs (collective)."""
        self._nodes.placeArray(np.ascontiguousarray(owned))
        self._scatter.scatter(self._nodes, self._local, PETSc.InsertMode.INSERT, PETSc.ScatterMode.FORWARD)
        self._nodes.resetArray(force=True)
        return np.asarray(self._local.array_r.reshape(-1, self._dim))

    def sum_at_nodes(self, parts: Values) -> Values:
        """(owned dofs,) sums over ranks of `parts` (k, d) at the selected nodes (collective)."""
        self._local.array_w[:] = parts.reshape(-1)
        self._nodes.set(0.0)
        self._scatter.scatter(self._local, self._nodes, PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)
        return self._nodes.array_r.copy()

    def destroy(self) -> None:
        """Free the PETSc objects."""
        for petsc_object in (self._nodes, self._local, self._scatter):
            petsc_object.destroy()
