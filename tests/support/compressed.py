"""Rows that ranks own in a random order, compressed for fields.h5."""

from __future__ import annotations

import sys

import numpy as np
from mpi4py import MPI

from fracsim.output.compressed_rows import RowCompressor

ROWS, CHUNK_ROWS = 1000, 64


def fields() -> dict[str, np.ndarray]:
    """Noise, smooth values, constants and whole numbers, in the order of the input mesh."""
    rng = np.random.default_rng(3)
    x = np.linspace(0, 3, ROWS)
    return {
        "noise": rng.normal(size=(ROWS, 3)), "smooth": np.sin(x).astype(np.float32),
        "constant": np.full((ROWS, 6), 2.0, np.float32), "whole": np.arange(ROWS, dtype=np.int32) // 7,
    }  # fmt: skip


def main(path: str) -> None:
    """Save the chunks of each field, one after another, and their lengths."""
    comm = MPI.COMM_WORLD
    # the last of several ranks owns nothing
    owner = np.random.default_rng(5).integers(max(comm.size - 1, 1), size=ROWS)
    index = np.random.default_rng(comm.rank).permutation(np.flatnonzero(owner == comm.rank))
    compressor = RowCompressor(comm, index, CHUNK_ROWS)
    saved = {}
    for name, values in fields().items():
        chunks = compressor(values[index])
        if chunks is not None:
            saved[name] = np.frombuffer(b"".join(chunks), np.uint8)
            saved[f"{name}_lengths"] = np.array([len(chunk) for chunk in chunks])
    if comm.rank == 0:
        np.savez(path, **saved)


if __name__ == "__main__":
    main(sys.argv[1])
