"""Small collective operations: errors that reach every rank, sums, and gathering in the order of the input mesh."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..errors import FracsimError


def on_root[T](comm: MPI.Comm, work: Callable[[], T]) -> T | None:
    """Run `work` on rank 0 and return its result there, None elsewhere; a FracsimError is raised on every rank."""
    result, failure = None, None
    if comm.rank == 0:
        try:
            result = work()
        except FracsimError as error:
            failure = error
    failure = comm.bcast(failure)
    if failure is not None:
        raise failure
    return result


def from_root[T](comm: MPI.Comm, work: Callable[[], T]) -> T:
    """Run `work` on rank 0 and give its result to every rank; a FracsimError is raised on every rank."""
    result: T = comm.bcast(on_root(comm, work))
    return result


def agree(comm: MPI.Comm, problem: FracsimError | None) -> None:
    """Raise the problem of the lowest rank that has one, on every rank."""
    found = [each for each in comm.allgather(problem) if each is not None]
    if found:
        raise found[0]


def total(comm: MPI.Comm, values: Any) -> npt.NDArray[Any]:
    """Sum over the ranks, element by element."""
    local = np.atleast_1d(np.asarray(values))
    result = np.empty_like(local)
    comm.Allreduce(local, result, op=MPI.SUM)
    return result


def offset(comm: MPI.Intracomm, count: int) -> int:
    """Sum of `count` over the lower ranks."""
    before = comm.exscan(count)
    return int(before or 0)


class Gather:
    """Rows of owned entities brought to rank 0 in the order of the input mesh, whatever the partition.

    Output is written by rank 0 alone: files are the same at any rank count, and no parallel HDF5 is needed. The price,
    one copy of a field on rank 0, is small beside the tangent matrix.
    """

    def __init__(self, comm: MPI.Comm, input_index: npt.NDArray[np.int64]) -> None:
        """`input_index`: (n,) index in the input mesh of each entity this rank owns."""
        self.comm = comm
        self.count = len(input_index)
        pieces = comm.gather(np.ascontiguousarray(input_index))
        self._counts = [len(piece) for piece in pieces] if pieces is not None else None
        self._order = np.concatenate(pieces) if pieces is not None else None

    def __call__(self, values: npt.NDArray[Any]) -> npt.NDArray[Any] | None:
        """(n, ...) owned rows -> (N, ...) rows in input order on rank 0, None elsewhere."""
        rows = np.ascontiguousarray(values[: self.count])
        if self.comm.size == 1:
            result = np.empty_like(rows)
            result[self._order] = rows
            return result
        return self._gather(rows)

    def _gather(self, rows: npt.NDArray[Any]) -> npt.NDArray[Any] | None:
        width = int(np.prod(rows.shape[1:], dtype=int)) * rows.itemsize
        send = rows.view(np.uint8).reshape(-1) if rows.size else np.empty(0, np.uint8)
        if self._counts is None or self._order is None:
            self.comm.Gatherv(send, None)
            return None
        raw = np.empty(sum(self._counts) * width, np.uint8)
        sizes: Any = [count * width for count in self._counts]
        self.comm.Gatherv(send, (raw, sizes))
        arrived = raw.view(rows.dtype).reshape((-1, *rows.shape[1:]))
        result = np.empty_like(arrived)
        result[self._order] = arrived
        return result

    def scatter(self, values: npt.NDArray[Any] | None) -> npt.NDArray[Any]:
        """(N, ...) rows in input order on rank 0 -> the (n, ...) rows this rank owns."""
        parts = None
        if self._counts is not None and self._order is not None and values is not None:
            parts = np.split(values[self._order], np.cumsum(self._counts)[:-1])
        result: npt.NDArray[Any] = self.comm.scatter(parts)
        return result
