"""Messages of more than 2^31 bytes: counted in rows and blocks, in whatever MPI counts 32 bits of."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from support.ranks import TESTS, run_on_ranks


@pytest.mark.ranks
@pytest.mark.parametrize("ranks", [2, 3])
def test_collectives_count_rows_not_bytes(ranks: int, tmp_path: Path) -> None:
    """Each gives what was sent, with a communicator that refuses messages of more than 1,500 elements."""
    results = run_on_ranks("support.large", ranks, tmp_path, seconds=60)
    assert len(results) > 10
    assert [name for name, good in results.items() if not good] == []


@pytest.mark.slow
@pytest.mark.ranks
def test_a_field_of_more_than_2_to_31_bytes_is_gathered() -> None:
    """2.1 GB from one rank, some 7 GB of memory in all."""
    command = [
        "timeout",
        "250",
        "mpirun",
        "-n",
        "2",
        sys.executable,
        "-m",
        "support.large",
        "beyond",
    ]
    done = subprocess.run(command, cwd=TESTS, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert "all there" in done.stdout
