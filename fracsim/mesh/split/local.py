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
from .identity import identity
from .places import Places, gradient_entries, middles
from .skeleton import CRACK, Skeleton

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
        self._skeleton = Skeleton(mesh)
        self.follow_damage(np.zeros(len(mesh.cells), np.uint8))

    def follow_damage(self, pattern: npt.NDArray[np.uint8]) -> None:
        """Be the surface of a body with these patterns of broken edges, (cells,) (collective)."""
        made = split(self._skeleton, pattern)
        if self._domain.order == 2:
            from .refined import with_middles_of

            made = with_middles_of(made, self._domain, pattern)
        area = _areas(made, self._skeleton)
        self._touching = np.flatnonzero(area > 0)
        self.area, self._made = area[self._touching], made
        rows, nodes, values = _entries(made, self._touching)
        matrices = [self._mean(self._touching, rows, nodes, values)]
        if self._domain.comm.allreduce(len(made.follow.turning)) > 0:
            matrices.append(self._arms(made, pattern, rows, nodes, values, self._touching))
        self.columns, (mean, *arms) = _on_columns(matrices)
        middle = middles(made.points, made.follow)[self._touching]
        out = made.points[self._touching] - middle
        self.at = Places(mean, middle, arms[0] if arms else csr_matrix(mean.shape), out)

    def identity(self, points: Ints | None = None) -> Values:
        """(k, 2 d + 1) rows that tell `points` (k,), or the copies `at.copies`, from all others, whatever breaks
        (split.identity)."""
        domain, which = self._domain, self.at.copies if points is None else points
        return identity(self._made, self._touching[which], domain.node_input, domain.size)

    def facets(self) -> tuple[Ints, Values]:
        """(m, d) points of the elements that make up the areas of points, and their measures (m,), m^2 (2D: m)."""
        elements, measure = _touched(self._made, self._skeleton)
        real = measure > 0
        return np.searchsorted(self._touching, elements[real]), measure[real]

    def _mean(self, touching: Ints, rows: Ints, nodes: Ints, values: Values) -> PETSc.Mat:
        """(points, nodes) mean over the parents of each point."""
        return self._matrix(len(touching), 1, rows, self._global(nodes), values)

    def _arms(
        self, made: Split, pattern: npt.NDArray[np.uint8], rows: Ints, nodes: Ints, values: Values, touching: Ints
    ) -> PETSc.Mat:
        """(points, nodes) arms times the averages of gradients around the parents (collective)."""
        d = self._domain.dim
        arm = made.follow.arm[_of_points(made, touching)]
        gradients = self._gradients(pattern)
        by = np.repeat(rows, d), (d * self._global(nodes)[:, None] + np.arange(d)).reshape(-1)
        arms = self._matrix(len(touching), d, *by, (values[:, None] * arm).reshape(-1))
        result = arms.matMult(gradients)
        for used in (arms, gradients):
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


def _mesh_of(domain: Domain) -> MeshData:
    """This rank's cells, and which of their facets are on the boundary of the body."""
    exterior = domain._exterior
    geometry = dolfinx.mesh.entities_to_geometry(domain.mesh, domain.dim - 1, exterior)
    of_geometry = np.empty(len(domain.mesh.geometry.x), np.int64)
    of_geometry[domain.corner_geometry] = domain.cell_nodes
    facets = of_geometry[geometry].reshape(-1, domain.dim)
    return MeshData(domain.nodes, domain.cell_nodes.astype(np.int64), {OUTSIDE: facets})


def _touched(made: Split, skeleton: Skeleton) -> tuple[Ints, Values]:
    """(m, d) elements of cracks and of the body's own boundary, and their measures (m,)."""
    outside = np.flatnonzero([OUTSIDE in name for name in skeleton.origins])
    elements = made.elements[np.isin(made.origin, [CRACK, *outside])]
    corners = made.points[elements]
    if skeleton.dim == 2:
        return elements, np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)
    spanned = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return elements, np.linalg.norm(spanned, axis=1) / 2


def _areas(made: Split, skeleton: Skeleton) -> Values:
    """(points,) a d-th of the measure of the elements around each."""
    elements, measure = _touched(made, skeleton)
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


def _on_columns(matrices: list[PETSc.Mat]) -> tuple[Ints, list[csr_matrix]]:
    """The columns that are used, and this rank's rows of the matrices on them; the matrices are given back."""
    found = [each.getValuesCSR() for each in matrices]
    for each in matrices:
        each.destroy()
    columns, place = np.unique(np.concatenate([columns for _, columns, _ in found]), return_inverse=True)
    places = np.split(place.reshape(-1), np.cumsum([len(columns) for _, columns, _ in found])[:-1])
    shape = len(found[0][0]) - 1, len(columns)
    each = zip(found, places, strict=True)
    return columns, [csr_matrix((entries, at, start), shape=shape) for (start, _, entries), at in each]


class Following:
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

    def handed_down(self, forces: Values) -> Values:
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
