"""Finest level of the V cycle: the present tangent in single precision, which CG may multiply with as well.

A' = S A S has half the bytes of A, and products with it read what the cycle has just brought into the cache. Rounding
changes each block by 6e-8. Rigid motions are resisted by the sum of the blocks of a row alone; the loss of this sum is
added again:

    A x ~ S^-1 A' S^-1 x + L x,    L_i = sym sum_j (A_ij - S_i^-1 A'_ij S_j^-1)

The error of the energy of x is the sum of x_i . E_ij (x_j - x_i) with the loss E of each block. It vanishes where
neighbours move together.
"""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import CDLL
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from ..policy import DEFAULT_POLICY, SolverPolicy
from .bcsr import GhostedVector
from .hierarchy import BlockCSRData, LevelData
from .smoother import SmoothedLevel

if TYPE_CHECKING:
    from ...mechanics.block_matrix import TieMatrix

Values = npt.NDArray[np.float64]


class FineLevel(SmoothedLevel):
    """Level of the tangent."""

    def __init__(
        self, data: LevelData, pattern: BlockCSRData, code: CDLL, policy: SolverPolicy = DEFAULT_POLICY
    ) -> None:
        """Allocate the level (see `SmoothedLevel`)."""
        super().__init__(data, pattern, code, policy)
        nodes, size = data.nodes, data.size
        self._unscale = 1 / self.scale
        self._unscaled_x = GhostedVector(nodes, size, np.float64)
        self._lost = np.zeros((nodes.size_local, size, size), np.float32)

    def assign_values(self, values: Values, ties: Sequence[TieMatrix] = ()) -> None:
        """Assign the blocks of A and its ties, and compute the rounding loss of the blocks (collective)."""
        super().assign_values(values, ties)
        self._matrix.compute_rounding_loss(values, self._unscale, self._unscale, self._lost)

    def multiply(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Compute y = A x, in double precision but for A' and L (collective)."""
        values, product, n = x.array_r, y.array_w, self._owned
        np.multiply(values, self._unscale[:n], out=self._unscaled_x.array[:n])
        self._unscaled_x.update_ghosts()
        self._matrix.multiply(self._lost, self._unscale, self._unscaled_x, values, product)
        product_by_nodes, x_by_nodes = (array.reshape(-1, self._size) for array in (product, values))
        for tie in self.ties:
            product_by_nodes[tie.nodes] += tie.multiply(x_by_nodes[tie.nodes])
