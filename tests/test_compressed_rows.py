"""Rows of fields.h5, compressed on all ranks, as HDF5 reads them."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from support.compressed import CHUNK_ROWS, ROWS, fields
from support.ranks import run_on_ranks


@pytest.mark.parametrize("ranks", (1, 2, 3))
def test_hdf5_reads_the_chunks_of_all_ranks(ranks: int, tmp_path: Path) -> None:
    """In the order of the input mesh; the last chunk is shorter than the others."""
    saved = run_on_ranks("support.compressed", ranks, tmp_path)
    with h5py.File(tmp_path / "rows.h5", "w") as file:
        for name, values in fields().items():
            chunks = np.split(saved[name], np.cumsum(saved[f"{name}_lengths"])[:-1])
            assert len(chunks) == -(-ROWS // CHUNK_ROWS)
            data = file.create_dataset(
                name,
                values.shape,
                values.dtype,
                chunks=(CHUNK_ROWS, *values.shape[1:]),
                shuffle=True,
                compression="gzip",
            )
            for number, chunk in enumerate(chunks):
                data.id.write_direct_chunk((number * CHUNK_ROWS, *[0] * (values.ndim - 1)), chunk.tobytes())
    with h5py.File(tmp_path / "rows.h5") as file:
        for name, values in fields().items():
            np.testing.assert_array_equal(file[name][()], values)
    # byte planes without information are not compressed, runs are
    assert len(saved["noise"]) < 1.05 * fields()["noise"].nbytes and len(saved["constant"]) < 2500
