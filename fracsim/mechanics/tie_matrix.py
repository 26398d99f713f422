"""Stiffness between a few nodes anywhere, beside a tangent in blocks: what `Term.tied` gives."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from dolfinx.common import IndexMap
from mpi4py import MPI
from scipy.sparse import csr_matrix

from ..mesh.parallel import sum_over_ranks

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Reals = npt.NDArray[np.floating[Any]]


class TieMatrix:
    """K of nodes that all ranks know, the same along each axis.

    Attributes:
        K: (n, n) N/m.    nodes: (m,) local numbers of those that this rank owns.    here: (m,) which of the n they are.
    """

    def __init__(self, comm: MPI.Comm, K: csr_matrix, here: Ints, nodes: Ints, free: Values) -> None:
        """`K`: (n, n) N/m; `here`: (m,) which of the n are this rank's `nodes`; `free`: (m, d) 1, and 0 of prescribed
        dofs."""
        self.K, self.nodes, self.indices, self._comm, self._free = K, nodes, here, comm, free

    @property
    def diagonal(self) -> Values:
        """(m, d) of K at the nodes of this rank."""
        return np.asarray(self.K.diagonal()[self.indices][:, None] * self._free)

    def multiply(self, x: Reals) -> Values:
        """(m, d) K x at the nodes of this rank, of x there (collective)."""
        every = np.zeros((self.K.shape[0], x.shape[1]))
        every[self.indices] = x * self._free
        return np.asarray((self.K @ sum_over_ranks(self._comm, every))[self.indices] * self._free)

    def owned_rows(self, nodes: Ints, every: IndexMap) -> csr_matrix:
        """(d n, dofs of all ranks) those of owned nodes (n,); `every`: the nodes of the body (collective)."""
        d = self._free.shape[1]
        names = every.local_to_global(self.nodes.astype(np.int32))
        told = np.zeros((self.K.shape[0], d + 1))
        told[self.indices] = np.concatenate([names[:, None], self._free], axis=1)
        told = sum_over_ranks(self._comm, told)
        place = np.full(every.size_local, -1)
        place[nodes] = np.arange(len(nodes))
        row_of = np.full(len(told), -1)
        row_of[self.indices] = place[self.nodes]
        K, axes = self.K.tocoo(), np.arange(d)
        inside = row_of[K.row] >= 0
        row, column = row_of[K.row[inside]], told[K.col[inside], 0].astype(np.int64)
        values = K.data[inside][:, None] * told[K.row[inside], 1:] * told[K.col[inside], 1:]
        at = tuple((d * each[:, None] + axes).reshape(-1) for each in (row, column))
        return csr_matrix((values.reshape(-1), at), shape=(d * len(nodes), d * every.size_global))
