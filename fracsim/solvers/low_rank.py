"""Low-rank updates of the tangent: products with eliminated unknowns, and the inverse with stiff couplings.

Equations: docs/theory.md#linear-systems.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from ..mechanics.extra_couplings import StiffCoupling
from ..mechanics.tangent import Tangent
from ..mesh.parallel import sum_over_ranks

Values = npt.NDArray[np.float64]


class LowRankOperator:
    """Context of the PETSc matrix K - sum of U C U^T + sum of C', for products.

    U C U^T belong to unknowns that terms have eliminated, C' are stiff couplings. Preconditioners are set up from K
    alone: an update of rank k costs k more iterations, and `WoodburyPreconditioner` inverts the couplings.
    """

    def __init__(self, matrix: PETSc.Mat, tangent: Tangent) -> None:
        """Combine products with K, `matrix`, and the updates of the present `tangent`."""
        self._matrix, self._tangent = matrix, tangent

    def mult(self, _: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Evaluate y = (K - sum of U C U^T + sum of C') x (collective)."""
        self._matrix.mult(x, y)
        for U, C in self._tangent.low_rank_updates:
            y.array_w[:] -= U @ (C @ sum_over_ranks(self._matrix.comm.tompi4py(), U.T @ x.array_r))
        for coupling in self._tangent.couplings.stiff:
            coupling.matrix.multAdd(x, y, y)

    def to_petsc(self) -> PETSc.Mat:
        """Return the operator as a PETSc matrix."""
        result: Any = PETSc.Mat().createPython(self._matrix.getSizes(), self, comm=self._matrix.comm)
        result.setUp()
        return result


class WoodburyPreconditioner:
    """Context of a PETSc preconditioner that inverts a few stiff couplings U S U^T and the body exactly.

    (P^-1 + U S U^T)^-1 = P - V G V^T,   V = P U,   G = (S^-1 + U^T V)^-1      (Sherman, Morrison, Woodbury 1950)

    P is the symmetric preconditioner of the body. A tangent costs one application of P for each of the m columns of U,
    an iteration 2 m products for each dof.
    """

    def __init__(self, base_pc: PETSc.PC, couplings: list[StiffCoupling], like: PETSc.Vec) -> None:
        """Compute V and G (collective).

        Args:
            base_pc: P, set up.
            couplings: U and S.
            like: a vector of the size of P.
        """
        self._base_pc, self._comm = base_pc, like.comm.tompi4py()
        U = np.concatenate([coupling.directions for coupling in couplings], axis=1)
        self._V = _apply_to_columns(base_pc, U, like)
        flexibility = np.diag(1.0 / np.concatenate([coupling.stiffness for coupling in couplings]))
        self._G = np.linalg.inv(flexibility + sum_over_ranks(self._comm, U.T @ self._V))

    def apply(self, _: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Evaluate y = (P - V G V^T) x (collective)."""
        self._base_pc.apply(x, y)
        y.array_w[:] -= self._V @ (self._G @ sum_over_ranks(self._comm, self._V.T @ x.array_r))


def _apply_to_columns(base_pc: PETSc.PC, U: Values, like: PETSc.Vec) -> Values:
    """Return P U, (owned dofs, m) (collective)."""
    x, y, V = like.duplicate(), like.duplicate(), np.empty_like(U)
    for column in range(U.shape[1]):
        x.array_w[:] = U[:, column]
        base_pc.apply(x, y)
        V[:, column] = y.array_r
    x.destroy()
    y.destroy()
    return V
