"""The finest level of the V cycle: the present tangent in single precision, with which CG may multiply as well.

A' = S A S has half the bytes of A, and products with it read what the cycle has just brought to the cache. Rounding
takes 6e-8 of each block. Rigid motions are resisted by the sum of the blocks of a row alone, so each row gets back what
it has lost in all:

    A x ~ S^-1 A' S^-1 x + L x,    L_i = sym sum_j (A_ij - S_i^-1 A'_ij S_j^-1)

The energy of x is off by sum of x_i . E_ij (x_j - x_i), E the loss of each block: 6e-8 of a stiffness where neighbours
move apart, and nothing where they move together.
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
    """The level of the tangent."""

    def __init__(
        self, data: LevelData, pattern: BlockCSRData, code: CDLL, policy: SolverPolicy = DEFAULT_POLICY
    ) -> None:
        """As any level."""
        super().__init__(data, pattern, code, policy)
        nodes, size = data.nodes, data.size
        self._unscale = 1 / self.scale
        self._unscaled_x = GhostedVector(nodes, size, np.float64)
        self._lost = np.zeros((nodes.size_local, size, size), np.float32)

    def assign_values(self, values: Values, ties: Sequence[TieMatrix] = ()) -> None:
        """Take the blocks of A and its ties, and evaluate what rounding takes from the blocks (collective)."""
        super().assign_values(values, ties)
        self._matrix.compute_rounding_loss(values, self._unscale, self._unscale, self._lost)

    def multiply(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = A x, in double precision but for A' and L (collective)."""
        values, product, n = x.array_r, y.array_w, self._owned
        np.multiply(values, self._unscale[:n], out=self._unscaled_x.array[:n])
        self._unscaled_x.update_ghosts()
        self._matrix.multiply(self._lost, self._unscale, self._unscaled_x, values, product)
        product_by_nodes, x_by_nodes = (array.reshape(-1, self._size) for array in (product, values))
        for tie in self.ties:
            product_by_nodes[tie.nodes] += tie.multiply(x_by_nodes[tie.nodes])
