"""Running a module of checks on several ranks, in a process group of its own with a time limit."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import numpy as np
import numpy.typing as npt

TESTS = Path(__file__).resolve().parents[1]
Arrays = dict[str, npt.NDArray[np.generic]]
OnRanks = Callable[[int], tuple[Arrays, Path]]
Results = Callable[[int], Arrays]


def run_on_ranks(module: str, ranks: int, folder: Path, seconds: int = 600) -> Arrays:
    """Run `main(path)` of a module on ranks, one in this process; returns the arrays that its rank 0 saved.
    AssertionError with its output where it fails.

    mpi4py's runner ends all ranks where one raises. `timeout` ends mpirun in a way that lets it end its children.
    """
    target = folder / f"{module.rpartition('.')[2]}-{ranks}.npz"
    if ranks == 1:
        import_module(module).main(str(target))
        return loaded(target)
    command = [
        "timeout", "--kill-after=10", str(seconds), "mpirun", "-n", str(ranks),
        sys.executable, "-m", "mpi4py", "-m", module, str(target),
    ]  # fmt: skip
    # os.environ is what this process was started with: variables that MPI has set since then stay behind
    done = subprocess.run(command, cwd=TESTS, env=dict(os.environ), capture_output=True, text=True)
    output = (done.stdout + done.stderr)[-4000:]
    assert done.returncode == 0, f"{module} on {ranks} ranks ended with {done.returncode}:\n{output}"
    return loaded(target)


def loaded(target: Path) -> Arrays:
    with np.load(target) as arrays:
        return dict(arrays)


def starting(prefix: str, on_ranks: OnRanks) -> Results:
    """Arrays of a rank count whose names start with a prefix, without it."""

    def results(ranks: int) -> Arrays:
        return {key.removeprefix(prefix): each for key, each in on_ranks(ranks)[0].items() if key.startswith(prefix)}

    return results
