"""The output folder: what is in it, when a frame is due, and what ran."""

from __future__ import annotations

import math
import platform
import shutil
from importlib.metadata import version
from pathlib import Path

from mpi4py import MPI
from petsc4py import PETSc

from .. import __version__
from ..errors import InputError
from ..stepping.state import State
from ..study import Output, Time
from .checkpoint import checkpoint_path

OWN_FILES = (
    "study.toml", "history.csv", "fields.xdmf", "fields.h5", "surface.pvd", "pieces.csv", "summary.json", "last.png",
)  # fmt: skip


def make_folder(folder: Path, study: str, restart: bool) -> None:
    """Make the output folder and write study.toml; an earlier run's files go, unless it is continued (rank 0)."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not restart:
            for path in (*(folder / name for name in OWN_FILES), checkpoint_path(folder)):
                path.unlink(missing_ok=True)
            shutil.rmtree(folder / "surface", ignore_errors=True)
        (folder / "study.toml").write_text(study)
    except OSError as error:
        raise InputError(f"--out {folder}: cannot write there: {error.strerror}") from None


def versions(comm: MPI.Comm) -> dict[str, str]:
    """What ran: programs, versions, ranks."""
    return {
        "fracsim": __version__,
        "dolfinx": version("fenics-dolfinx"),
        "petsc": ".".join(map(str, PETSc.Sys.getVersion())),
        "python": platform.python_version(),
        "ranks": str(comm.size),
    }


class OutputClock:
    """When a frame is due: every so many steps, or so many seconds of simulated time. Default: 50 frames a run."""

    def __init__(self, output: Output, timing: Time) -> None:
        self._every = output.every
        self._interval = output.interval or timing.end / 50
        self._last = 0.0

    def due(self, state: State) -> bool:
        if self._every is not None:
            return state.step % self._every == 0
        return state.t >= self._last + self._interval * (1 - 1e-9)

    def wrote(self, state: State) -> None:
        # the grid of intervals, not the time of the frame: late frames must not push the others back
        self._last = math.floor(state.t / self._interval * (1 + 1e-9)) * self._interval
