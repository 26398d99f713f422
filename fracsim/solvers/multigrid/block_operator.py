"""Products with the tangent in blocks of the d dofs of a node.

One index is read for d^2 values instead of for d, so that a product takes half the time. CG with multigrid computes
some six of them on the finest level in an iteration. The matrix of single entries, which smoothed aggregation needs, is
updated for a set-up of multigrid.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from petsc4py import PETSc

if TYPE_CHECKING:
    from dolfinx.fem import DofMap

    from ...mechanics.block_matrix import BlockMatrix
    from .levels import FineLevel


class BlockOperator:
    """Context of a PETSc matrix for products with the tangent.

    Attributes:
        tangent: matrix of single entries.
        assembled: blocks in which K is assembled.
        fine_level: copy of the tangent in single precision that products use; None: double precision.
    """

    def __init__(self, tangent: PETSc.Mat, assembled: BlockMatrix) -> None:
        self.tangent, self.assembled = tangent, assembled
        self.fine_level: FineLevel | None = None

    def multiply_by(self, fine_level: FineLevel | None) -> None:
        """Multiply with this copy of the tangent in single precision; None: in double precision."""
        self.fine_level = fine_level

    def mult(self, _: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Evaluate y = K x (collective)."""
        if self.fine_level is not None:
            self.fine_level.multiply(x, y)
        else:
            self.assembled.mult(x, y)

    def to_petsc(self) -> PETSc.Mat:
        """Return the operator as a PETSc matrix."""
        result: Any = PETSc.Mat().createPython(self.tangent.getSizes(), self, comm=self.tangent.comm)
        result.setUp()
        return result


def blocks_pay_off(dofs: DofMap, min_dofs: int) -> bool:
    """Return True if products in blocks are faster; small matrices stay in the cache in any form."""
    return dofs.index_map_bs > 1 and dofs.index_map.size_global * dofs.index_map_bs >= min_dofs
