"""Values of a few cells, on whatever rank they are: the ranks that own them work them out."""

from __future__ import annotations

from math import prod

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ...mesh.ranks import alltoall

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


class Asked:
    """Cells that this rank asks for, and those that others ask of it.

    Attributes:
        own: (m,) cells of this rank that any rank asks for; on one rank in the order in which they are.
    """

    def __init__(self, comm: MPI.Comm, rank: Ints, index: Ints) -> None:
        """`rank`, `index`: (n,) who owns each of the cells that are asked for, and its number there (collective)."""
        self._comm = comm
        if comm.size == 1:
            self.own: Ints = index
            return
        self._order = np.argsort(rank, kind="stable")
        here = [index[rank == each] for each in range(comm.size)]
        there = alltoall(comm, here)
        self.own = np.unique(np.concatenate(there))
        self._send = [np.searchsorted(self.own, each) for each in there]

    def __call__(self, *fields: Values) -> list[Values]:
        """(n, ...) values of the cells asked for, from those (m, ...) of `own`; from other ranks they come with one
        component after the other in memory (collective)."""
        if self._comm.size == 1:
            return list(fields)
        tails = [each.shape[1:] for each in fields]
        rows = np.concatenate([each.reshape(len(each), prod(tail)).T for each, tail in zip(fields, tails, strict=True)])
        arrived = np.concatenate(alltoall(self._comm, [rows[:, each] for each in self._send]), axis=1)
        result = np.empty_like(arrived)
        result[:, self._order] = arrived
        parts = np.split(result, np.cumsum([prod(tail) for tail in tails])[:-1])
        shaped = [part.reshape(*tail, result.shape[1]) for part, tail in zip(parts, tails, strict=True)]
        return [np.moveaxis(each, -1, 0) for each in shaped]
