"""Values of the cells of other ranks near this rank's own."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from .parallel import allgather, exchange_rows

Values = npt.NDArray[np.float64]


class RankHalo:
    """Brings rows of the cells within a distance of this rank's cells: first its own, then those of other ranks."""

    def __init__(self, comm: MPI.Comm, centroids: Values, distance: float) -> None:
        self.comm = comm
        self._send: list[npt.NDArray[np.int64]] = [np.empty(0, np.int64)] * comm.size
        if comm.size == 1:
            return
        d = centroids.shape[1]
        empty = np.full((2, d), np.inf) * [[1], [-1]]
        box = np.array([centroids.min(axis=0), centroids.max(axis=0)]) if len(centroids) else empty
        boxes = allgather(comm, box)
        for rank, (low, high) in enumerate(boxes):
            if rank != comm.rank:
                close = np.all((centroids >= low - distance) & (centroids <= high + distance), axis=1)
                self._send[rank] = np.flatnonzero(close).astype(np.int64)
        sent = np.array([len(part) for part in self._send], np.int64)
        received = np.empty_like(sent)
        comm.Alltoall(sent, received)
        self._sent, self._received = sent, received
        self._rows = np.concatenate(self._send)

    def __call__(self, values: Values) -> Values:
        """(cells, n) rows -> (cells + halo, n) rows."""
        if self.comm.size == 1:
            return values
        send = np.ascontiguousarray(values[self._rows], float)
        return np.concatenate([values, exchange_rows(self.comm, send, self._sent, self._received)])
