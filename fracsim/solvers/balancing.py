"""Balancing preconditioner: exact solutions in a coarse space, and another preconditioner for what is left.

    P = Q + (1 - Q A) M (1 - A Q),   Q = Z E^-1 Z^T,   E = Z^T A Z

M is the preconditioner of the body, and the columns of Z span the coarse space. P is the abstract balancing
preconditioner, P_BNN of Tang et al. (2009), from Mandel (1993). It is symmetric, and positive definite where M and E
are. A Z has few rows, so that P costs about as much as M. The coarse space has the dofs of some nodes: of those that a
stiffness C beside the tangent K couples, as contact has it, and of those around which K has changed since M was set up.
A = K + C.

Equations: docs/theory.md#linear-systems.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc
from scipy.sparse import csr_matrix, vstack
from scipy.sparse.linalg import SuperLU, splu

from ..mechanics.extra_couplings import dofs_of_nodes
from ..mechanics.tangent import Tangent
from ..mesh.parallel import allgather, sum_over_ranks

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


class BalancingPreconditioner:
    """Context of the PETSc preconditioner P.

    Where E is singular or not finite P = M: the solve fails, and its step is halved.
    """

    def __init__(
        self, base_pc: PETSc.PC, Zt: csr_matrix, ZtA: csr_matrix, like: PETSc.Vec, *, must_be_positive: bool = False
    ) -> None:
        """Compute the factors of E (collective).

        Args:
            base_pc: M, set up.
            Zt: (m, dofs of all ranks) Z^T, the same on all ranks.
            ZtA: (m, dofs of all ranks) Z^T A, the same on all ranks.
            like: a vector of the size of P.
            must_be_positive: whether P = -M where E is indefinite, so that CG ends at once. With Q it might not notice
                that A is indefinite, and converge to a solution that is no direction of descent.
        """
        self._base_pc, self._comm, self._residual = base_pc, like.comm.tompi4py(), like.duplicate()
        factors = _factors_of(csr_matrix(ZtA @ Zt.T))
        # with pivots on the diagonal E has as many negative eigenvalues as U has negative entries there
        self._is_indefinite = must_be_positive and factors is not None and factors.U.diagonal().min() <= 0
        self._solve = None if factors is None or self._is_indefinite else factors.solve
        owned = slice(*like.getOwnershipRange())
        # owned dofs in which Z and A Z have entries, and these rows
        (self._dofs, self._Z, self._Zt), (self._coupled_dofs, self._AZ, self._ZtA) = map(
            _nonzero_rows, (Zt[:, owned], ZtA[:, owned])
        )
        # owned dofs of a Z of unit vectors, at which (1 - A Q) x = 0 but for round-off
        self._unit_dofs = self._dofs if Zt.nnz == Zt.shape[0] else self._dofs[:0]

    def apply(self, _: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Evaluate y = P x (collective)."""
        if self._solve is None:
            self._base_pc.apply(x, y)
            if self._is_indefinite:
                y.scale(-1.0)
            return
        residual, coupled = self._residual, self._coupled_dofs
        x.copy(residual)
        motion = self._solve(sum_over_ranks(self._comm, self._Zt @ x.array_r[self._dofs]))
        residual.array_w[coupled] -= self._AZ @ motion
        residual.array_w[self._unit_dofs] = 0.0
        self._base_pc.apply(residual, y)
        motion -= self._solve(sum_over_ranks(self._comm, self._ZtA @ y.array_r[coupled]))
        y.array_w[self._dofs] += self._Z @ motion

    def destroy(self, _: PETSc.PC) -> None:
        """Free PETSc's objects."""
        self._residual.destroy()

    def to_petsc(self) -> PETSc.PC:
        """Return P as a PETSc preconditioner, with the operators of M; it owns this object."""
        pc: PETSc.PC = PETSc.PC().createPython(self, comm=self._residual.comm)
        pc.setOperators(*self._base_pc.getOperators())
        return pc


def solve_nodes_exactly(base_pc: PETSc.PC, tangent: Tangent, changed: Ints | None, like: PETSc.Vec) -> PETSc.PC:
    """Return P whose coarse space has the dofs of changed nodes and of nodes that are coupled (collective).

    Args:
        base_pc: M, set up.
        tangent: K, with C beside it.
        changed: (k,) owned nodes around which K has changed since M was set up; None: there are none on any rank.
        like: a vector of the size of P.
    """
    index_map, d, coupling = tangent.domain.space.dofmap.index_map, tangent.domain.dim, tangent.couplings.beside
    first, end = index_map.local_range
    numbers = [] if coupling is None else [coupling.numbers]
    if changed is not None:
        numbers += allgather(tangent.domain.comm, changed + first)
    nodes = np.unique(np.concatenate(numbers))
    owned = nodes[slice(*np.searchsorted(nodes, [first, end]))] - first
    Zt = _unit_rows(nodes, d, index_map.size_global)
    # rows of all ranks, in the order of the ranks, which is that of the numbers
    ZtA = csr_matrix(vstack(allgather(tangent.domain.comm, tangent.owned_rows(owned))))
    if coupling is not None:
        at_coupled = _unit_rows(coupling.numbers, d, index_map.size_global)
        ZtA = ZtA + (Zt @ at_coupled.T) @ coupling.K @ at_coupled
    return BalancingPreconditioner(base_pc, Zt, ZtA, like, must_be_positive=changed is not None).to_petsc()


def _unit_rows(nodes: Ints, d: int, count: int) -> csr_matrix:
    """(d n, d count) rows of the identity at the dofs of nodes (n,) of `count`."""
    dofs = dofs_of_nodes(nodes, d)
    return csr_matrix((np.ones(len(dofs)), dofs, np.arange(len(dofs) + 1)), shape=(len(dofs), d * count))


def _nonzero_rows(transposed: csr_matrix) -> tuple[Ints, csr_matrix, csr_matrix]:
    """The numbers (k,) of the rows with entries of a matrix, these rows, and their transpose."""
    matrix = csr_matrix(transposed.T)
    rows = np.flatnonzero(np.diff(matrix.indptr))
    return rows, matrix[rows], csr_matrix(matrix[rows].T)


def _factors_of(E: csr_matrix) -> SuperLU | None:
    """Factors of a symmetric matrix; None where E is singular or not finite."""
    if not np.isfinite(E.data).all():
        return None
    options = {"SymmetricMode": True}
    try:
        return splu(E.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    except RuntimeError:  # a pivot is 0
        return None
