"""Products with a tangent that lacks low-rank updates of eliminated unknowns, or a coupling of few nodes.

Equations: docs/theory.md#linear-systems.
"""

from __future__ import annotations

from typing import Any

from petsc4py import PETSc

from ..mechanics.tangent import Tangent
from ..mesh.parallel import sum_over_ranks


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
