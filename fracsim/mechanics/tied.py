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
        nodes: (m,) local numbers of those that this rank owns.
    """

    def __init__(self, comm: MPI.Comm, K: csr_matrix, here: Ints, nodes: Ints, free: Values) -> None:
        """`K`: (n, n) N/m; `here`: (m,) which of the n are this rank's `nodes`; `free`: (m, d) 1, and 0 of prescribed
        dofs."""
        self.nodes, self._comm, self._K, self._here, self._free = nodes, comm, K, here, free

    def product(self, x: Reals) -> Values:
        """(m, d) K x at the nodes of this rank, of x there (collective)."""
        every = np.zeros((self._K.shape[0], x.shape[1]))
        every[self._here] = x * self._free
        return np.asarray((self._K @ total(self._comm, every))[self._here] * self._free)
