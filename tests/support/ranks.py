"""Running a module of checks on several ranks, in a process group of its own with a time limit."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterable
from importlib import import_module
from pathlib import Path

import numpy as np
import numpy.typing as npt

TESTS = Path(__file__).resolve().parents[1]
Arrays = dict[str, npt.NDArray[np.generic]]
OnRanks = Callable[[int], tuple[Arrays, Path]]
Results = Callable[[int], Arrays]


# file of tests -> what it runs on ranks; where tests of several files run, one start of each rank count is for all
SHARING = {
    "test_balancing": "balancing", "test_block_matrix": "coupled", "test_changed_nodes": "changed_nodes",
    "test_checkpoint_blocks": "written_checkpoint", "test_clearance": "approached",
    "test_drawn_contact": "drawn_contact", "test_large": "large", "test_mesh_shares": "shared",
    "test_obstacle_patch": "pushed_nodes", "test_python": "given", "test_rolling_ball": "rolling",
    "test_self_contact": "pushed", "test_surface_keys": "surface_keys",
}  # fmt: skip
_sharing: list[str] = []
_shared: dict[tuple[str, int], Arrays] = {}


def share_starts(files: Iterable[str]) -> None:
    """Tests of these files ask for several ranks in this session."""
    _sharing[:] = [f"support.{SHARING[file]}" for file in sorted(set(files) & SHARING.keys())]


def run_on_ranks(module: str, ranks: int, folder: Path, seconds: int = 600) -> Arrays:
    """Run `main(path)` of a module on ranks, one in this process; returns the arrays that its rank 0 saved.
    AssertionError with its output where it fails.
    """
    if module in _sharing and ranks > 1:
        if (module, ranks) not in _shared:
            _run_shared(ranks, folder)
        if (module, ranks) in _shared:
            return _shared[module, ranks]
    target = target_of(module, ranks, folder)
    if ranks == 1:
        import_module(module).main(str(target))
    else:
        done = started(ranks, [module, str(target)], seconds)
        output = (done.stdout + done.stderr)[-4000:]
        assert done.returncode == 0, f"{module} on {ranks} ranks ended with {done.returncode}:\n{output}"
    return loaded(target)


def _run_shared(ranks: int, folder: Path) -> None:
    """One start for the modules of all files that share them; where it fails, each has its own."""
    modules = list(_sharing)
    if started(ranks, ["support.joint", str(folder), *modules], 600).returncode:
        warnings.warn(f"{', '.join(modules)} failed together on {ranks} ranks, and are run one by one", stacklevel=2)
        _sharing.clear()
        return
    _shared.update({(each, ranks): loaded(target_of(each, ranks, folder)) for each in modules})


def started(ranks: int, module_and_arguments: list[str], seconds: int) -> subprocess.CompletedProcess[str]:
    """mpi4py's runner ends all ranks where one raises. `timeout` ends mpirun in a way that lets it end its children."""
    command = [
        "timeout", "--kill-after=10", str(seconds), "mpirun", "-n", str(ranks),
        sys.executable, "-m", "mpi4py", "-m", *module_and_arguments,
    ]  # fmt: skip
    # os.environ is what this process was started with: variables that MPI has set since then stay behind
    return subprocess.run(command, cwd=TESTS, env=dict(os.environ), capture_output=True, text=True)


def target_of(module: str, ranks: int, folder: Path) -> Path:
    return folder / f"{module.rpartition('.')[2]}-{ranks}.npz"


def loaded(target: Path) -> Arrays:
    with np.load(target) as arrays:
        return dict(arrays)


def starting(prefix: str, on_ranks: OnRanks) -> Results:
    """Arrays of a rank count whose names start with a prefix, without it."""

    def results(ranks: int) -> Arrays:
        return {key.removeprefix(prefix): each for key, each in on_ranks(ranks)[0].items() if key.startswith(prefix)}

    return results
