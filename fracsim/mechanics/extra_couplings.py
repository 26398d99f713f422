"""Stiffness between nodes that share no cell, in a matrix over all dofs or between the few nodes that have it.

Two points in contact move as one along their normal. Smoothers and aggregates of multigrid do not represent such a
motion: with 15 pairs in contact CG takes 75 iterations where the body alone takes 12. A coupling of few nodes stays
beside the tangent, and its preconditioner solves for these nodes exactly (solvers.balancing).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from ..mesh.domain import Domain
from ..mesh.parallel import allgather, sum_over_ranks

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


class CouplingBuilder:
    """Builder of the coupling matrix of a term (`Term.coupling_matrix`), which owns the last one."""

    def __init__(self, domain: Domain) -> None:
        self._domain = domain
        self._last: PETSc.Mat | None = None

    def __call__(self, part: csr_matrix, nodes: Ints) -> PETSc.Mat:
        """Sum over ranks of their parts, as a matrix over all dofs (collective).

        Args:
            part: (n d, n d) stiffness, N/m.
            nodes: (n,) global numbers of its nodes.
        """
        self.destroy()
        d, owned = self._domain.dim, self._domain.node_count * self._domain.dim
        matrix = self._last = PETSc.Mat().create(self._domain.comm)
        matrix.setSizes(((owned, PETSc.DETERMINE),) * 2, bsize=d)
        matrix.setType(PETSc.Mat.Type.AIJ)
        matrix.setUp()
        dofs = (d * nodes[:, None] + np.arange(d)).reshape(-1).astype(PETSc.IntType)
        rows = np.flatnonzero(np.diff(part.indptr))
        start, columns = part.indptr[np.append(rows, len(dofs))].astype(PETSc.IntType), dofs[part.indices]
        matrix.setValuesIJV(start, columns, part.data, PETSc.InsertMode.ADD_VALUES, dofs[rows])
        matrix.assemble()
        return matrix

    def destroy(self) -> None:
        """Free PETSc's matrix."""
        if self._last is not None:
            self._last.destroy()
            self._last = None


class FewNodesCoupling:
    """Stiffness C between few nodes anywhere, which stays beside the tangent.

    Attributes:
        numbers: (m,) global numbers of the nodes, ascending, the same on all ranks.
        K: (m d, m d) their stiffness, N/m, the same on all ranks.
        nodes: (k,) local numbers of those that this rank owns.
        rows: the rows of K of these.
        dofs: (k d,) their dofs.
    """

    def __init__(self, domain: Domain, numbers: Ints, K: csr_matrix) -> None:
        self._comm, self.numbers, self.K, d = domain.comm, numbers, K, domain.dim
        first, end = domain.space.dofmap.index_map.local_range
        start, stop = np.searchsorted(numbers, [first, end])
        self.nodes: Ints = numbers[start:stop] - first
        self.rows, self.dofs = slice(d * start, d * stop), dofs_of_nodes(self.nodes, d)
        self._owned_K = K[self.rows]

    def at_all_nodes(self, values: Values) -> Values:
        """(m d,) values at all nodes, of those (k d,) of this rank (collective)."""
        result = np.zeros(self.K.shape[0])
        result[self.rows] = values
        return sum_over_ranks(self._comm, result)

    def without_dofs(self, domain: Domain, dofs: npt.NDArray[np.signedinteger]) -> FewNodesCoupling:
        """The coupling without those of owned dofs (j,), which are prescribed (collective)."""
        from scipy.sparse import csr_matrix, diags

        is_free = np.ones(domain.node_count * domain.dim)
        is_free[dofs] = 0.0
        free = diags(self.at_all_nodes(is_free[self.dofs]))
        return FewNodesCoupling(domain, self.numbers, csr_matrix(free @ self.K @ free))

    def owned_rows(self) -> csr_matrix:
        """(m d, m d) stiffness with the rows of this rank's nodes alone, N/m."""
        from scipy.sparse import csr_matrix

        first = np.zeros(self.K.shape[0] + 1, self.K.indptr.dtype)
        first[1:][self.rows] = np.diff(self._owned_K.indptr)
        return csr_matrix((self._owned_K.data, self._owned_K.indices, np.cumsum(first)), shape=self.K.shape)

    def add_product(self, x: Values, y: Values) -> None:
        """Add C x to y, both (owned dofs,) (collective)."""
        y[self.dofs] += self._owned_K @ self.at_all_nodes(x[self.dofs])


def sum_few_nodes(domain: Domain, part: csr_matrix, nodes: Ints, limit: int) -> FewNodesCoupling | None:
    """Sum over the ranks of their parts; None if more nodes than `limit` have entries (collective).

    Args:
        domain: the mesh.
        part: (n d, n d) stiffness, N/m.
        nodes: (n,) global numbers of its nodes.
        limit: largest number of nodes.
    """
    from scipy.sparse import csr_matrix

    d, entries = domain.dim, part.tocoo()
    used = np.unique(entries.row // d)
    parts = allgather(domain.comm, nodes[used])
    numbers = np.unique(np.concatenate(parts))
    if len(numbers) > limit:
        return None
    dofs = dofs_of_nodes(np.searchsorted(numbers, nodes), d)  # of the nodes that have entries
    all_parts = zip(*allgather(domain.comm, (dofs[entries.row], dofs[entries.col], entries.data)), strict=True)
    rows, columns, values = (np.concatenate(items) for items in all_parts)
    size = d * len(numbers)
    return FewNodesCoupling(domain, numbers, csr_matrix((values, (rows, columns)), shape=(size, size)))


def dofs_of_nodes(nodes: Ints, d: int) -> Ints:
    """(d n,) dofs of nodes (n,)."""
    return np.asarray(d * nodes[:, None] + np.arange(d)).reshape(-1)
