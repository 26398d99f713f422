"""The finest level of multigrid's cycle (vcycle), the tangent of now, which CG multiplies with as well.

The level keeps A' = S A S in single precision, half the bytes of A, and CG's product reads what the cycle's four have
just brought to the processor: with A in double precision beside it a step of M22's doormat takes 1.1 times as long. But
rounding takes 6e-8 of each block, and what moves along as one is resisted by the sum of them, where nothing but inertia
should hold it. So each row gets back what it has lost in all:

    A x ~ S^-1 A' S^-1 x + L x,    L_i = sym sum_j (A_ij - S_i^-1 A'_ij S_j^-1)

in double precision but for A' and L. Its energy is off by x_i . E_ij (x_j - x_i) alone, E what rounding took: by 6e-8
of a stiffness where neighbours move apart, which is next to the stiffness itself, and nothing where they move along.
"""

from __future__ import annotations

from ctypes import CDLL

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from .bcsr import GhostedVector
from .hierarchy import BlockCSRData, LevelData
from .smoother import SmoothedLevel

Values = npt.NDArray[np.float64]


class FineLevel(SmoothedLevel):
    """The level of the tangent."""

    def __init__(self, copy: LevelData, own: BlockCSRData, made: CDLL) -> None:
        """As any level."""
        super().__init__(copy, own, made)
        nodes, size = copy.nodes, copy.size
        self._unscaled = 1 / self.scale
        self._z = GhostedVector(nodes, size, np.float64)
        self._lost = np.zeros((nodes.size_local, size, size), np.float32)

    def assign_values(self, values: Values) -> None:
        """Those of the blocks of A, and what rounding takes from them (collective)."""
        super().assign_values(values)
        self._rows.compute_rounding_loss(values, self._unscaled, self._unscaled, self._lost)

    def multiply(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = A x (collective)."""
        given, found, n = x.array_r, y.array_w, self._owned
        np.multiply(given, self._unscaled[:n], out=self._z.array[:n])
        self._z.update_ghosts()
        self._rows.multiply(self._lost, self._unscaled, self._z, given, found)
        to, by_nodes = (each.reshape(-1, self._size) for each in (found, given))
        for each in self.extra_terms:
            to[each.nodes] += each.multiply(by_nodes[each.nodes])
