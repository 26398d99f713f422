"""The tangent in blocks of the d dofs of a node: what products are made with.

A product takes half the time, for an index is read for d^2 values instead of for d, and CG with multigrid makes some
six an iteration on the finest level. Where nothing but cells and their mass add to the tangent it is assembled in
blocks; ties of a few nodes to others (mechanics.block_matrix) stay beside these. Smoothed aggregation cannot set itself
up from blocks, so that there is a matrix of single entries, too, which is brought to where they are when multigrid is
set up. Where terms add to single entries the blocks are a copy of them, which costs what two iterations gain. Small
bodies have no use for it: their matrices stay in the cache, and each product is called from here.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from petsc4py import PETSc

if TYPE_CHECKING:
    from ...mechanics.block_matrix import BlockMatrix
    from .fine_level import FineLevel

SMALL = 10_000  # dofs below which a product costs no more than calling it


class BlockOperator:
    """The context of a PETSc matrix that is multiplied with.

    Attributes:
        tangent: the matrix of single entries that it is a copy of.
        assembled: products with the blocks, where they are assembled first.
        single: what is multiplied with instead, in single precision.
    """

    def __init__(self, tangent: PETSc.Mat, assembled: BlockMatrix | None, pattern: Callable[[], int]) -> None:
        """`pattern`: Stiffness.pattern."""
        self.tangent, self._pattern = tangent, pattern
        self.assembled = assembled
        self.single: FineLevel | None = None
        self._copy: PETSc.Mat | None = None
        self._copied, self._state = -1, -1  # pattern and state of the tangent

    def update_copy(self) -> None:
        """Be the tangent as it is now (collective)."""
        if self.assembled is not None or self._state == (state := self.tangent.stateGet()):
            return
        if self._copied != (pattern := self._pattern()):
            self.release_copy()
        self._copy = self.tangent.convert(PETSc.Mat.Type.BAIJ, self._copy or PETSc.Mat())
        self._copied, self._state = pattern, state

    def mult(self, _: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = K x (collective)."""
        if self.single is not None:
            self.single.multiply(x, y)
            return
        by = self.assembled or self._copy
        assert by is not None
        by.mult(x, y)

    def to_petsc(self) -> PETSc.Mat:
        """The matrix."""
        result: Any = PETSc.Mat().createPython(self.tangent.getSizes(), self, comm=self.tangent.comm)
        result.setUp()
        return result

    def release_copy(self) -> None:
        """Give the memory of PETSc's objects back."""
        if self._copy is not None:
            self._copy.destroy()
            self._copy = None


def blocks_pay_off(tangent: PETSc.Mat) -> bool:
    """Whether products with blocks are quicker."""
    return tangent.getBlockSize() > 1 and tangent.getSize()[0] >= SMALL
