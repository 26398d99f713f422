"""A failure on one rank is a failure of all: raised everywhere, or told once, and never waited for."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from cases import BAR, write_study
from fracsim.errors import Exit
from support.ranks import TESTS, run_on_ranks


def test_what_one_rank_raises_every_rank_raises(tmp_path: Path) -> None:
    """Work of rank 0 that fails in any way, and a kernel that only the last rank cannot load."""
    root, other = run_on_ranks("support.together", 2, tmp_path, seconds=40)["caught"].tolist()
    assert root[:3] == ["OSError: [Errno 28] No space left on device", "KeyError: 'gone'", "SystemExit: 4"]
    assert root[3:] == ["Unsendable: has a lock", "RuntimeError: the library cannot be loaded"]
    assert other == [*root[:3], "RuntimeError: Unsendable: has a lock", root[4]]


@pytest.mark.parametrize(
    ("rank", "kind", "code", "message"),
    [
        (1, "input", Exit.BAD_INPUT, "fracsim: only here"),
        (1, "not-converged", Exit.NOT_CONVERGED, "fracsim: only here"),
        (1, "exit", 7, "fracsim: rank 1 ended alone"),
        (0, "disk", Exit.CANNOT_WRITE, "fracsim: cannot write only-here.h5: No space left on device; make room"),
        (1, "fault", 1, "ValueError: only here"),
        (1, "fault, plain", 1, "ValueError: only here"),
    ],
)
def test_a_rank_that_fails_alone_ends_all(tmp_path: Path, rank: int, kind: str, code: int, message: str) -> None:
    """In the middle of a step, while the other rank waits for it within a collective operation.

    Objects of PETSc's plain solver can be destroyed by all ranks alone; the failed rank waited there.
    """
    kind, _, solver = kind.partition(", ")
    study = write_study(tmp_path / "bar.toml", BAR, output={"picture": False}, solver={"plain": bool(solver)})
    command = ["timeout", "--kill-after=5", "40", "mpirun", "-n", "2", sys.executable]
    script = [str(TESTS / "support" / "fails_alone.py"), str(rank), kind, str(study), "-o", str(tmp_path / "out")]
    done = subprocess.run([*command, *script], capture_output=True, text=True, check=False)
    assert done.returncode == code, done.stderr
    assert done.stderr.count(message) == 1
    assert "Segmentation" not in done.stderr
    assert ("Traceback" in done.stderr) == (kind == "fault")


def test_a_mesh_is_parted_alike_each_time(tmp_path: Path) -> None:
    """Or equal runs would differ in their last digits, and where much breaks at once in more than these."""
    cells = run_on_ranks("support.parted", 2, tmp_path, seconds=60)["cells"]
    assert len(cells) == 5 and (cells == cells[0]).all()
