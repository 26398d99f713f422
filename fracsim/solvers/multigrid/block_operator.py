"""Products with the tangent in blocks of the d dofs of a node.

One index is read for d^2 values instead of for d, so that a product takes half the time. CG with multigrid computes
some six of them on the finest level in an iteration. Where only cells, mass and ties contribute, K is assembled in
blocks, and the matrix of single entries, which smoothed aggregation needs, is updated for a set-up of multigrid. Where
terms add single entries the blocks are a copy of these.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from petsc4py import PETSc

if TYPE_CHECKING:
    from ...mechanics.block_matrix import BlockMatrix
    from .levels import FineLevel


class BlockOperator:
    """Context of a PETSc matrix for products with the tangent.

    Attributes:
        tangent: matrix of single entries.
        assembled: blocks in which K is assembled; None if they are a copy.
    """

    def __init__(self, tangent: PETSc.Mat, assembled: BlockMatrix | None) -> None:
        self.tangent, self.assembled = tangent, assembled
        self._fine_level: FineLevel | None = None
        self._copy: PETSc.Mat | None = None
        self._copied_state = -1

    @property
    def fine_level(self) -> FineLevel | None:
        """Copy of the tangent in single precision that products use; None: double precision."""
        return self._fine_level

    def multiply_by(self, fine_level: FineLevel | None) -> None:
        """Multiply with this copy of the tangent in single precision; None: in double precision."""
        self._fine_level = fine_level

    def pattern_changed(self) -> None:
        """Discard the copy: the tangent has entries at other positions."""
        self.release_copy()

    def update_copy(self) -> None:
        """Update the copy to the present tangent (collective)."""
        if self.assembled is not None or self._copied_state == (state := self.tangent.stateGet()):
            return
        self._copy = self.tangent.convert(PETSc.Mat.Type.BAIJ, self._copy or PETSc.Mat())
        self._copied_state = state

    def mult(self, _: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Evaluate y = K x (collective)."""
        if self._fine_level is not None:
            self._fine_level.multiply(x, y)
            return
        blocks = self.assembled or self._copy
        assert blocks is not None
        blocks.mult(x, y)

    def to_petsc(self) -> PETSc.Mat:
        """Return the operator as a PETSc matrix."""
        result: Any = PETSc.Mat().createPython(self.tangent.getSizes(), self, comm=self.tangent.comm)
        result.setUp()
        return result

    def release_copy(self) -> None:
        """Free the memory of the copy."""
        if self._copy is not None:
            self._copy.destroy()
            self._copy = None
        self._copied_state = -1


def blocks_pay_off(tangent: PETSc.Mat, min_dofs: int) -> bool:
    """Return True if products in blocks are faster; small matrices stay in the cache in any form."""
    return tangent.getBlockSize() > 1 and tangent.getSize()[0] >= min_dofs
