"""Exact solutions for some nodes in a preconditioner, and products of a tangent with low-rank updates or a coupling.

The preconditioner of a tangent K with a coupling C of few nodes, as contact has it, is

    P = Q + (1 - Q A) M (1 - A Q),   Q = Z E^-1 Z^T,   E = Z^T A Z,   A = K + C

M is the preconditioner of the body, made for an earlier K. Z has the dofs of the nodes that C couples, and of those
around which K has changed since M was set up (C = 0 there): Q solves for these nodes exactly, and M for what is left.
A Z has few rows (Mandel 1993; Tang et al. 2009).

Where E is singular or not finite, P = M: the solve fails, and its step is halved. Where nodes have changed and E is
indefinite, P = -M: CG ends at once, as A is indefinite. With Q it might not notice, and converge to a solution that is
no direction of descent.

Equations: docs/theory.md#linear-systems.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc
from scipy.sparse import csr_matrix, vstack
from scipy.sparse.linalg import SuperLU, splu

from ..mechanics.extra_couplings import FewNodesCoupling, dofs_of_nodes
from ..mechanics.tangent import Tangent
from ..mesh.parallel import allgather, sum_over_ranks

Values = npt.NDArray[np.float64]


class CoupledNodesPreconditioner:
    """Context of the PETSc preconditioner P."""

    def __init__(
        self, base_pc: PETSc.PC, coupling: FewNodesCoupling, tangent: Tangent, like: PETSc.Vec,
        *, must_be_positive: bool = False,
    ) -> None:  # fmt: skip
        """Compute A Z and the factors of E (collective).

        Args:
            base_pc: M, set up.
            coupling: C.
            tangent: K.
            like: a vector of the size of P.
            must_be_positive: whether P = -M where E is indefinite.
        """
        self._base_pc, self._coupling, self._comm = base_pc, coupling, like.comm.tompi4py()
        self._residual = like.duplicate()
        first, end = like.getOwnershipRange()
        # rows of K of all coupled nodes, in the order of the ranks, which is that of their numbers
        rows = csr_matrix(vstack(allgather(self._comm, tangent.owned_rows(coupling.nodes))))
        coupled = dofs_of_nodes(coupling.numbers, tangent.domain.dim)
        E = rows[:, coupled] + coupling.K
        factors = _factors_of(E)
        # with pivots on the diagonal E has as many negative eigenvalues as U has negative entries there
        self._is_indefinite = must_be_positive and factors is not None and factors.U.diagonal().min() <= 0
        self._solve = None if factors is None or self._is_indefinite else factors.solve
        columns = csr_matrix(rows[:, first:end].T)
        self._changed = np.flatnonzero(np.diff(columns.indptr))  # owned dofs in which K Z has entries
        self._KZ = columns[self._changed]
        self._KZt = csr_matrix(self._KZ.T)

    def apply(self, _: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Evaluate y = P x (collective)."""
        coupling, residual, changed = self._coupling, self._residual, self._changed
        if self._solve is None:
            self._base_pc.apply(x, y)
            if self._is_indefinite:
                y.scale(-1.0)  # which ends CG
            return
        x.copy(residual)
        motion = self._solve(coupling.at_all_nodes(x.array_r[coupling.dofs]))
        with_motion = self._KZ @ motion
        residual.array_w[changed] -= with_motion
        residual.array_w[coupling.dofs] = 0.0  # as E is solved exactly
        self._base_pc.apply(residual, y)
        force = sum_over_ranks(self._comm, self._KZt @ y.array_r[changed])
        force += coupling.K @ coupling.at_all_nodes(y.array_r[coupling.dofs])
        y.array_w[coupling.dofs] += (motion - self._solve(force))[coupling.rows]

    def destroy(self, _: PETSc.PC) -> None:
        """Free PETSc's objects."""
        self._residual.destroy()


def _factors_of(E: csr_matrix) -> SuperLU | None:
    """Factors of a symmetric matrix; None where E is singular or not finite."""
    if not np.isfinite(E.data).all():
        return None
    options = {"SymmetricMode": True}
    try:
        return splu(E.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    except RuntimeError:  # a pivot is 0
        return None


class LowRankOperator:
    """Context of the PETSc matrix K - sum of U C U^T + C', for products.

    U C U^T belong to unknowns that terms have eliminated, C' couples few nodes. Preconditioners are set up from K
    alone: an update of rank k costs k more iterations, and `CoupledNodesPreconditioner` has C'.
    """

    def __init__(self, matrix: PETSc.Mat, tangent: Tangent) -> None:
        """Combine products with K, `matrix`, and the updates of the present `tangent`."""
        self._matrix, self._tangent = matrix, tangent

    def mult(self, _: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Evaluate y = (K - sum of U C U^T + C') x (collective)."""
        self._matrix.mult(x, y)
        for U, C in self._tangent.low_rank_updates:
            y.array_w[:] -= U @ (C @ sum_over_ranks(self._matrix.comm.tompi4py(), U.T @ x.array_r))
        if (coupling := self._tangent.couplings.beside) is not None:
            coupling.add_product(x.array_r, y.array_w)

    def to_petsc(self) -> PETSc.Mat:
        """Return the operator as a PETSc matrix."""
        result: Any = PETSc.Mat().createPython(self._matrix.getSizes(), self, comm=self._matrix.comm)
        result.setUp()
        return result
