"""Stiffness between a few nodes anywhere, beside a tangent in blocks: what `Term.tied` gives."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from scipy.sparse import csr_matrix

from ..mesh.ranks import total

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Reals = npt.NDArray[np.floating[Any]]


class Tied:
    """K of nodes that all ranks know, the same along each axis.

    Attributes:
        K: (n, n) N/m.    nodes: (m,) local numbers of those that this rank owns.    here: (m,) which of the n they are.
    """

    def __init__(self, comm: MPI.Comm, K: csr_matrix, here: Ints, nodes: Ints, free: Values) -> None:
        """`K`: (n, n) N/m; `here`: (m,) which of the n are this rank's `nodes`; `free`: (m, d) 1, and 0 of prescribed
        dofs."""
        self.K, self.nodes, self.here, self._comm, self._free = K, nodes, here, comm, free

    def product(self, x: Reals) -> Values:
        """(m, d) K x at the nodes of this rank, of x there (collective)."""
        every = np.zeros((self.K.shape[0], x.shape[1]))
        every[self.here] = x * self._free
        return np.asarray((self.K @ total(self._comm, every))[self.here] * self._free)
