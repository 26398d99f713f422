"""Compression of the rows of fields.h5 on all ranks: the filters shuffle and deflate of HDF5, a chunk at a time.

Chunk k holds rows k n to (k + 1) n of the input mesh and is compressed on rank k mod (number of ranks). Rank 0 receives
compressed bytes only, and writes them. Chunks do not depend on the number of ranks.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..mesh.parallel import alltoall, exchange_rows, gather

Ints = npt.NDArray[np.int64]
ROWS_PER_CHUNK = 1 << 15
# of zlib; higher levels take longer and save 3 %
COMPRESSION_LEVEL = 1


@dataclass(frozen=True)
class CompressedField:
    """One field of a frame, as it stands in fields.h5.

    Attributes:
        name: name of the field.
        centre: "Node" or "Cell".
        shape: rows and columns.
        dtype: of its numbers.
        chunks: compressed chunks in the order of their rows.
    """

    name: str
    centre: str
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    chunks: list[bytes] = field(default_factory=list)


class RowCompressor:
    """Compresses rows of owned entities in the order of the input mesh.

    Attributes:
        rows: rows of all ranks.
        chunk_rows: rows of a chunk.
    """

    def __init__(self, comm: MPI.Intracomm, input_index: Ints, chunk_rows: int = ROWS_PER_CHUNK) -> None:
        """`input_index`: (n,) index in the input mesh of each entity that this rank owns (collective)."""
        self._comm, self.rows = comm, int(comm.allreduce(len(input_index)))
        self.chunk_rows = max(min(self.rows, chunk_rows), 1)
        chunk = input_index // self.chunk_rows
        rank = chunk % comm.size
        self._order = np.argsort(rank, kind="stable")
        self._sent = np.bincount(rank, minlength=comm.size)
        # row in the chunks of the rank that compresses it
        position = (chunk // comm.size * self.chunk_rows + input_index % self.chunk_rows)[self._order]
        arrived = alltoall(comm, np.split(position, np.cumsum(self._sent)[:-1]))
        self._received, self._position = np.array([len(rows) for rows in arrived]), np.concatenate(arrived)
        count = -(-self.rows // self.chunk_rows)
        self._chunks = len(range(comm.rank, count, comm.size))

    def __call__(self, values: npt.NDArray[Any]) -> list[bytes] | None:
        """Compressed chunks on rank 0, None elsewhere; `values` (n, ...) of owned entities (collective)."""
        rows = np.ascontiguousarray(values[self._order])
        if self._comm.size > 1:
            rows = exchange_rows(self._comm, rows, self._sent, self._received)
        chunks = np.zeros((self._chunks, self.chunk_rows, *rows.shape[1:]), rows.dtype)
        chunks.reshape(-1, *rows.shape[1:])[self._position] = rows
        parts = gather(self._comm, [compress_chunk(chunk) for chunk in chunks])
        if parts is None:
            return None
        return [part[k] for k in range(max(map(len, parts))) for part in parts if k < len(part)]


def compress_chunk(values: npt.NDArray[Any]) -> bytes:
    """Bytes of a chunk after the filters shuffle and deflate: a zlib stream of its byte planes."""
    planes = values.reshape(-1).view(np.uint8).reshape(-1, values.itemsize).T
    return zlib.compress(np.ascontiguousarray(planes), COMPRESSION_LEVEL)
