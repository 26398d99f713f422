"""Values of a few cells, on whatever rank they are: the ranks that own them work them out."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


class Asked:
    """Cells that this rank asks for, and those that others ask of it.

    Attributes:
        own: (m,) cells of this rank that any rank asks for, rising.
    """

    def __init__(self, comm: MPI.Comm, rank: Ints, index: Ints) -> None:
        """`rank`, `index`: (n,) who owns each of the cells that are asked for, and its number there (collective)."""
        self._comm, self._order = comm, np.argsort(rank, kind="stable")
        here = [index[rank == each] for each in range(comm.size)]
        there = comm.alltoall(here) if comm.size > 1 else here
        self.own: Ints = np.unique(np.concatenate(there))
        self._send = [np.searchsorted(self.own, each) for each in there]

    def __call__(self, values: Values) -> Values:
        """(n, k) values of the cells asked for, from those (m, k) of `own` (collective)."""
        parts = [values[rows] for rows in self._send]
        arrived = np.concatenate(self._comm.alltoall(parts) if self._comm.size > 1 else parts)
        result = np.empty_like(arrived)
        result[self._order] = arrived
        return result
