"""Collective operations: errors that reach every rank, sums, gathering in input order, and halos of cells."""

from __future__ import annotations

import os
import pickle
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

# s that a rank which failed waits for the failure messages of other ranks
FAILURE_WAIT = 5.0
# first letters of the names of processes that start ranks
LAUNCHERS = ("prte", "orte", "mpirun", "mpiexec", "hydra", "slurmstepd")
Values = npt.NDArray[np.float64]


def on_root[T](comm: MPI.Comm, work: Callable[[], T]) -> T | None:
    """The result of `work` on rank 0, None elsewhere; an exception of `work` is raised on every rank."""
    result, failure = None, None
    if comm.rank == 0:
        try:
            result = work()
        except (SystemExit, Exception) as error:
            failure = error
    root_failure = comm.bcast(_picklable(failure))
    if failure is not None:
        raise failure
    if root_failure is not None:
        raise root_failure
    return result


def from_root[T](comm: MPI.Comm, work: Callable[[], T]) -> T:
    """The result of `work`, called on rank 0, on every rank; an exception of `work` is raised on every rank."""
    result: T = bcast(comm, on_root(comm, work))
    return result


def _picklable(failure: BaseException | None) -> BaseException | None:
    """The exception, or a RuntimeError with the same message if the exception cannot be pickled."""
    try:
        pickle.loads(pickle.dumps(failure))
    except Exception:
        return RuntimeError(f"{type(failure).__name__}: {failure}")
    return failure


def raise_on_all_ranks(comm: MPI.Comm, failure: Exception | None) -> None:
    """Raise on every rank if any rank has failed: its own exception, or that of the lowest rank (collective)."""
    failures = [error for error in comm.allgather(_picklable(failure)) if error is not None]
    if failure is not None:
        raise failure
    if failures:
        raise failures[0]


def find_failed_ranks(comm: MPI.Intracomm, patience: float) -> set[int]:
    """The ranks that have failed within `patience` seconds, this rank included; each rank that fails calls this."""
    # other ranks may be waiting in a collective operation: only messages between two ranks are safe
    other_ranks = [rank for rank in range(comm.size) if rank != comm.rank]
    # no other message has this tag
    tag = 7919
    sent = [comm.isend(None, rank, tag) for rank in other_ranks]
    failed, deadline = {comm.rank}, time.monotonic() + patience
    while len(failed) < comm.size and time.monotonic() < deadline:
        for rank in other_ranks:
            if rank not in failed and comm.iprobe(rank, tag):
                comm.recv(source=rank, tag=tag)
                failed.add(rank)
        time.sleep(0.005)
    if len(failed) == comm.size:
        MPI.Request.waitall(sent)
    return failed


def abort_unless_all_failed(comm: MPI.Intracomm, message: str, code: int, *, late: bool = False) -> None:
    """Return if every rank has failed; otherwise print the message once and end all ranks with the exit code.

    `late`: other ranks are given more time, since rank 0 may be drawing a picture before it fails.
    """
    failed = find_failed_ranks(comm, 12 * FAILURE_WAIT if late else FAILURE_WAIT)
    if len(failed) == comm.size:
        return
    if comm.rank > min(failed):
        # meanwhile a lower rank prints its message and ends all ranks
        time.sleep(FAILURE_WAIT)
    print(message or f"fracsim: rank {comm.rank} ended alone", file=sys.stderr, flush=True)
    # MPICH's mpirun ends without what it has not passed on yet: half a second is enough
    time.sleep(0.5)
    comm.Abort(code or 1)
    # MPICH may return before mpirun has ended this rank
    os._exit(code or 1)


@contextmanager
def failing_together(comm: MPI.Intracomm) -> Iterator[None]:
    """Context in which an exception that only some ranks raise ends all ranks, with its traceback (collective).

    The other ranks would wait for these for ever.
    """
    try:
        yield
    except Exception as error:
        if comm.size > 1:
            abort_unless_all_failed(comm, traceback.format_exc(), int(getattr(error, "exit_code", 1)))
        raise


def launchers(process: int) -> Iterator[int]:
    """A process and its ancestors as far as they start the ranks of a job; none if the system tells nothing of them."""
    name, parent = _name_and_parent(process)
    while name.startswith(LAUNCHERS):
        yield process
        process = parent
        name, parent = _name_and_parent(process)


def find_launcher(process: int) -> int | None:
    """The process that starts the ranks of a job, among a process and its ancestors; None if there is none."""
    while process > 1:
        name, parent = _name_and_parent(process)
        if name.startswith(LAUNCHERS):
            return process
        process = parent
    return None


def _name_and_parent(process: int) -> tuple[str, int]:
    """The name of a process and the number of its parent; "" and 0 if the system gives no information on it."""
    try:
        with open(f"/proc/{process}/stat", encoding="utf-8", errors="replace") as file:
            before, _, after = file.read().rpartition(")")
        return before.partition("(")[2], int(after.split()[1])
    except (OSError, ValueError, IndexError):
        return "", 0


def sum_over_ranks(comm: MPI.Comm, values: npt.ArrayLike) -> npt.NDArray[Any]:
    """Sum over the ranks, element by element."""
    if comm.size == 1:
        return np.array(values, ndmin=1)
    local = np.atleast_1d(np.asarray(values))
    result = np.empty_like(local)
    comm.Allreduce(local, result, op=MPI.SUM)
    return result


def max_over_ranks[Number: (int, float)](comm: MPI.Intracomm, value: Number) -> Number:
    """Maximum over the ranks."""
    result: Number = value if comm.size == 1 else comm.allreduce(value, op=MPI.MAX)
    return result


def concatenate_over_ranks(comm: MPI.Intracomm, rows: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """The rows of all ranks, in the order of the ranks (collective)."""
    return rows if comm.size == 1 else np.concatenate(allgather(comm, rows))


def rank_offset(comm: MPI.Intracomm, count: int) -> int:
    """Sum of `count` over the lower ranks."""
    before = comm.exscan(count)
    return int(before or 0)


# --- messages of any size -------------------------------------------------------------------------------------------
#
# MPI before version 4 has 32-bit counts and displacements, and mpi4py counts pickled objects in bytes. The functions
# below count rows of an array, or blocks of a pickled object, by an MPI datatype of the size of a row or block.

# Bytes of a block: with 32-bit counts of blocks the limit is 550 GB of pickled objects on all ranks together.
BLOCK = 256


@cache
def _bytes(count: int) -> MPI.Datatype:
    """MPI datatype of `count` contiguous bytes."""
    return MPI.BYTE.Create_contiguous(count).Commit()


def _width(rows: npt.NDArray[Any]) -> int:
    return int(np.prod(rows.shape[1:], dtype=int)) * rows.itemsize


def _flat(rows: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    return rows.view(np.uint8).reshape(-1) if rows.size else np.empty(0, np.uint8)


def _sent(rows: npt.NDArray[Any]) -> Any:
    """Contiguous rows as a message of mpi4py."""
    return _flat(rows), len(rows) if rows.size else 0, _bytes(_width(rows))


def _received(rows: npt.NDArray[Any], counts: Sequence[int] | npt.NDArray[np.int64]) -> Any:
    """Contiguous rows as messages from, or to, all ranks; `counts` (ranks,) of rows."""
    return _flat(rows), (list(counts) if rows.size else [0] * len(counts), None), _bytes(_width(rows))


def exchange_rows(
    comm: MPI.Comm,
    rows: npt.NDArray[Any],
    sent: Sequence[int] | npt.NDArray[np.int64],
    received: Sequence[int] | npt.NDArray[np.int64],
) -> npt.NDArray[Any]:
    """The rows that other ranks send to this rank, in the order of the ranks (collective).

    `rows` (n, ...) are contiguous: `sent` (ranks,) of them go to each rank in turn, and `received` (ranks,) arrive.
    """
    arrived = np.empty((int(sum(received)), *rows.shape[1:]), rows.dtype)
    comm.Alltoallv(_received(rows, sent), _received(arrived, received))
    return arrived


class RowRouting:
    """Sends rows to ranks, and results for them back."""

    def __init__(self, comm: MPI.Comm, rank: npt.NDArray[np.integer[Any]]) -> None:
        """`rank`: (n,) rank that each row goes to (collective)."""
        self._comm = comm
        if comm.size == 1:
            return
        self._order = np.argsort(rank, kind="stable")
        self._sent, self._received = np.bincount(rank, minlength=comm.size), np.empty(comm.size, np.int64)
        comm.Alltoall(self._sent, self._received)

    def send(self, rows: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """(m, ...) rows that arrive at this rank, of the rows (n, ...) of all ranks in their order (collective).

        On one rank they are the same array.
        """
        if self._comm.size == 1:
            return rows
        return exchange_rows(self._comm, rows[self._order], self._sent, self._received)

    def send_back(self, results: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """(n, ...) results for the rows that were sent, of results (m, ...) for those that arrived (collective).

        On one rank they are the same array.
        """
        if self._comm.size == 1:
            return results
        arrived = exchange_rows(self._comm, np.ascontiguousarray(results), self._received, self._sent)
        rows = np.empty_like(arrived)
        rows[self._order] = arrived
        return rows


class RemoteRows:
    """Exchange of the rows of arrays that ranks request from those which have them.

    Attributes:
        requested: (m,) rows of this rank that any rank requests, ascending; on one rank in the order of the request.
    """

    def __init__(self, comm: MPI.Comm, rank: npt.NDArray[np.int64], index: npt.NDArray[np.int64]) -> None:
        """Request rows (collective); `rank`, `index`: (n,) the rank that has each row, and its number there."""
        self.requested: npt.NDArray[np.int64] = index
        self._routing: RowRouting | None = None
        if comm.size > 1:
            self._routing = RowRouting(comm, rank)
            self.requested, self._position = np.unique(self._routing.send(index), return_inverse=True)

    def __call__(self, *fields: npt.NDArray[Any]) -> list[npt.NDArray[Any]]:
        """Return the rows (n, ...) that this rank requests, from rows (m, ...) of `requested` (collective).

        All fields are one message. Rows of other ranks have each component contiguous in memory.
        """
        if self._routing is None:
            return list(fields)
        flat = [field.reshape(len(field), prod(field.shape[1:])) for field in fields]
        columns = self._routing.send_back(np.concatenate(flat, axis=1)[self._position]).T.copy()
        parts = np.split(columns, np.cumsum([part.shape[1] for part in flat])[:-1])
        shaped = [part.reshape(*field.shape[1:], columns.shape[1]) for part, field in zip(parts, fields, strict=True)]
        return [np.moveaxis(part, -1, 0) for part in shaped]


def _packed(value: object) -> npt.NDArray[np.uint8]:
    """(blocks, BLOCK) bytes of the pickled object."""
    data = pickle.dumps(value, protocol=pickle.HIGHEST_PROTOCOL)
    blocks: npt.NDArray[np.uint8] = np.zeros((-(-len(data) // BLOCK), BLOCK), np.uint8)
    blocks.reshape(-1)[: len(data)] = np.frombuffer(data, np.uint8)
    return blocks


def _unpacked(blocks: npt.NDArray[np.uint8], counts: Sequence[int] | npt.NDArray[np.int64]) -> list[Any]:
    """The object of each rank, of blocks (n, BLOCK) and their `counts` (ranks,)."""
    return [pickle.loads(part.reshape(-1).data) for part in np.split(blocks, np.cumsum(counts)[:-1])]


def _counts(comm: MPI.Comm, count: int) -> npt.NDArray[np.int64]:
    counts = np.empty(comm.size, np.int64)
    comm.Allgather(np.array([count], np.int64), counts)
    return counts


def allgather[T](comm: MPI.Comm, value: T) -> list[T]:
    """The objects of all ranks, on all of them (collective)."""
    if comm.size == 1:
        return [value]
    blocks = _packed(value)
    counts = _counts(comm, len(blocks))
    arrived = np.empty((int(counts.sum()), BLOCK), np.uint8)
    comm.Allgatherv(_sent(blocks), _received(arrived, counts))
    return _unpacked(arrived, counts)


def gather[T](comm: MPI.Comm, value: T) -> list[T] | None:
    """The objects of all ranks on rank 0, None elsewhere (collective)."""
    if comm.size == 1:
        return [value]
    blocks = _packed(value)
    counts = _counts(comm, len(blocks))
    if comm.rank:
        comm.Gatherv(_sent(blocks), None)
        return None
    arrived = np.empty((int(counts.sum()), BLOCK), np.uint8)
    comm.Gatherv(_sent(blocks), _received(arrived, counts))
    return _unpacked(arrived, counts)


def alltoall[T](comm: MPI.Comm, values: Sequence[T]) -> list[T]:
    """The objects that the ranks have for this rank, of `values` (ranks,) for each rank (collective)."""
    if comm.size == 1:
        return list(values)
    packed = [_packed(value) for value in values]
    sent, received = np.array([len(blocks) for blocks in packed], np.int64), np.empty(comm.size, np.int64)
    comm.Alltoall(sent, received)
    return _unpacked(exchange_rows(comm, np.concatenate(packed), sent, received), received)


def bcast(comm: MPI.Comm, value: Any) -> Any:
    """The object of rank 0 on every rank (collective)."""
    if comm.size == 1:
        return value
    if comm.rank == 0:
        blocks = _packed(value)
        comm.Bcast(np.array([len(blocks)], np.int64))
        comm.Bcast(_sent(blocks))
        return value
    count = np.zeros(1, np.int64)
    comm.Bcast(count)
    received = np.empty((int(count[0]), BLOCK), np.uint8)
    comm.Bcast(_sent(received))
    return _unpacked(received, count)[0]


# --- in the order of the input mesh ---------------------------------------------------------------------------------


# Rows of an array of the whole mesh that rank 0 holds at a time: 3 MB of vectors
MAX_GATHERED_ROWS = 1 << 17


class Gather:
    """Gathers rows of owned entities on rank 0 in the order of the input mesh, at any partition.

    Rank 0 then holds all of them; of arrays as long as the mesh `BlockGather` gathers a block at a time.
    """

    def __init__(self, comm: MPI.Comm, input_index: npt.NDArray[np.int64]) -> None:
        """`input_index`: (n,) index in the input mesh of each entity that this rank owns."""
        self.comm = comm
        self.count = len(input_index)
        parts = gather(comm, np.ascontiguousarray(input_index))
        self._counts = [len(part) for part in parts] if parts is not None else None
        self._order = np.concatenate(parts) if parts is not None else None

    def __call__(self, values: npt.NDArray[Any]) -> npt.NDArray[Any] | None:
        """(N, ...) rows of all ranks in input order on rank 0, None elsewhere; `values` (n, ...) of owned entities."""
        rows = np.ascontiguousarray(values[: self.count])
        if self.comm.size == 1:
            result = np.empty_like(rows)
            result[self._order] = rows
            return result
        return self._gather(rows)

    def _gather(self, rows: npt.NDArray[Any]) -> npt.NDArray[Any] | None:
        send = _sent(rows)
        if self._counts is None or self._order is None:
            self.comm.Gatherv(send, None)
            return None
        arrived = np.empty((sum(self._counts), *rows.shape[1:]), rows.dtype)
        self.comm.Gatherv(send, _received(arrived, self._counts))
        result = np.empty_like(arrived)
        result[self._order] = arrived
        return result

    def scatter(self, values: npt.NDArray[Any] | None) -> npt.NDArray[Any]:
        """(n, ...) rows that this rank owns, of `values` (N, ...) in input order on rank 0."""
        if self.comm.size == 1:
            assert values is not None and self._order is not None
            return np.asarray(values[self._order])
        kind = None if values is None else (values.dtype.str, values.shape[1:])
        dtype, tail = self.comm.bcast(kind)
        result = np.empty((self.count, *tail), dtype)
        if self._counts is None or self._order is None or values is None:
            self.comm.Scatterv(None, _sent(result))
        else:
            self.comm.Scatterv(_received(values[self._order], self._counts), _sent(result))
        return result


class GatherSubset(Gather):
    """Gathers a subset of the owned rows; the other rows are 0 when scattered."""

    def __init__(self, comm: MPI.Comm, input_index: npt.NDArray[np.int64], which: npt.NDArray[np.bool_]) -> None:
        """`which`: (n,) flags of the subset; `input_index`: (n,) of all owned entities, from 0 in the subset."""
        super().__init__(comm, input_index[which])
        self._which = which

    def __call__(self, values: npt.NDArray[Any]) -> npt.NDArray[Any] | None:
        """(N, ...) rows of the subset over all ranks in input order on rank 0, None elsewhere."""
        return super().__call__(values[: len(self._which)][self._which])

    def scatter(self, values: npt.NDArray[Any] | None) -> npt.NDArray[Any]:
        """(n, ...) rows of the owned entities, 0 outside the subset, of `values` (N, ...) on rank 0."""
        return self._spread(super().scatter(values))

    def _spread(self, rows: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """(entities, ...) rows of the subset among zeros."""
        result = np.zeros((len(self._which), *rows.shape[1:]), rows.dtype)
        result[self._which] = rows
        return result


class BlockGather:
    """Gathers rows of owned entities on rank 0 in the order of the input mesh, a block at a time, and scatters them.

    Rank 0 alone reads and writes files, so that they are the same at any rank count, and parallel HDF5 is not needed.

    Attributes:
        count: number of rows on all ranks.
    """

    def __init__(self, comm: MPI.Comm, input_index: npt.NDArray[np.int64]) -> None:
        """`input_index`: (n,) index in the input mesh of each entity that this rank owns (collective)."""
        self._comm, self._order = comm, np.argsort(input_index)
        self._sorted = input_index[self._order]
        self.count = int(sum_over_ranks(comm, len(input_index))[0])

    def _blocks(self) -> Iterator[tuple[slice, npt.NDArray[np.int64], Gather]]:
        """Rows of each block, the owned entities in it, and what gathers their rows (collective)."""
        for start in range(0, self.count, MAX_GATHERED_ROWS):
            end = min(start + MAX_GATHERED_ROWS, self.count)
            own_rows = slice(*np.searchsorted(self._sorted, [start, end]))
            yield slice(start, end), self._order[own_rows], Gather(self._comm, self._sorted[own_rows] - start)

    def __call__(self, values: npt.NDArray[Any]) -> Iterator[npt.NDArray[Any] | None]:
        """Blocks of the rows of all ranks in input order on rank 0, None elsewhere (collective).

        `values`: (n, ...) rows of owned entities.
        """
        for _, owned, gather in self._blocks():
            yield gather(values[owned])

    def scatter(self, read: Callable[[slice], npt.NDArray[Any] | None]) -> npt.NDArray[Any]:
        """(n, ...) rows that this rank owns (collective).

        `read` (collective) returns the given rows, in input order, on rank 0, and None elsewhere.
        """
        result = np.empty(0)
        for rows, owned, gather in self._blocks():
            block = gather.scatter(read(rows))
            if rows.start == 0:
                result = np.empty((len(self._order), *block.shape[1:]), block.dtype)
            result[owned] = block
        return result


class RankHalo:
    """Exchanges rows of the cells of other ranks that lie within a distance of the cells of this rank."""

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
        """(cells + halo, n) rows of `values` (cells, n): those of this rank first (collective)."""
        if self.comm.size == 1:
            return values
        send = np.ascontiguousarray(values[self._rows], float)
        return np.concatenate([values, exchange_rows(self.comm, send, self._sent, self._received)])
