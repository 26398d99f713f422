"""The output folder: what is in it, when a frame is due, and what ran."""

from __future__ import annotations

import platform
import tomllib
from collections.abc import Callable, Iterable
from importlib.metadata import version
from pathlib import Path
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

from .. import __version__
from ..errors import InputError
from ..stepping.stepper import intervals
from .checkpoint_file import checkpoint_path, read_notes
from .fields_file import check_whole, read_times
from .history import read_earlier
from .own_files import STUDY, check_not_resumable, check_owner, check_plain, clear
from .same_study import check_same_study
from .writing import reason, replace_text


def check_folder(
    folder: Path,
    study: str,
    *,
    restart: bool,
    overwrite: bool,
    inputs: Iterable[Path | None],
    completed: Callable[[dict[str, Any]], dict[str, Any]],
) -> None:
    """InputError where a run of this study may not write there, or cannot go on from there; changes nothing (rank 0).

    `study`: as it would stand in study.toml; `overwrite`: a run that may go on may be thrown away; `inputs`: files
    that the study is read from; `completed` gives an earlier version's study the defaults of keys that it did not know.
    """
    check_plain(folder)
    if restart:
        then = completed(read_notes(folder).values())
        check_same_study(checkpoint_path(folder), then, tomllib.loads(study))
        inputs = ()  # study.toml of the run itself is what one goes on with
    check_owner(folder, inputs)
    if not restart and not overwrite:
        check_not_resumable(folder)


def make_folder(folder: Path, study: str, *, restart: bool) -> None:
    """Make the output folder and write study.toml; an earlier run's files go, unless it is continued (rank 0)."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not restart:
            clear(folder)
        replace_text(folder / STUDY, study)
    except OSError as error:
        raise InputError(f"--out {folder}: cannot write there: {reason(error)}") from None


def check_readable(folder: Path, columns: list[str], step: int) -> None:
    """InputError where what a run has written so far cannot be continued; changes nothing (rank 0)."""
    read_earlier(folder / "history.csv", columns, step)
    if (h5 := folder / "fields.h5").exists():
        check_whole(h5)
        read_times(h5)
    check_text(folder)


def check_text(folder: Path) -> None:
    """InputError where what tells of frames of the surface is not text; changes nothing (rank 0)."""
    for path in (folder / "surface.pvd", folder / "pieces.csv"):
        try:
            if path.exists():
                path.read_text(encoding="utf-8")
        except (OSError, ValueError) as error:
            raise InputError(
                f"--restart: cannot read {path} ({error}); move it away to go on without its frames"
            ) from None


def missing_frames(folder: Path, had: dict[str, int], has: dict[str, int]) -> list[str]:
    """Notes on files by name that have fewer frames than they `had` as the run wrote its checkpoint."""
    return [
        f"{folder / name} has {has[name]} of the {count} frames that the run had written: the others are missing"
        for name, count in had.items()
        if has.get(name, count) < count
    ]


def versions(comm: MPI.Comm) -> dict[str, str]:
    """What ran: programs, versions, ranks; by the words of own_files.HEAD, which the head of study.toml has."""
    return {
        "fracsim": __version__,
        "dolfinx": version("fenics-dolfinx"),
        "petsc": ".".join(map(str, PETSc.Sys.getVersion())),
        "python": platform.python_version(),
        "ranks": str(comm.size),
    }


class OutputClock:
    """When a frame is due."""

    def __init__(self, every: int | None, interval: float) -> None:
        """Every so many steps; with None, every so many seconds of simulated time."""
        self._every, self._interval = every, interval
        self._passed = 0  # intervals, at the last frame

    def due(self, t: float, step: int) -> bool:
        """Whether it is, at the end of this step at time t, s."""
        if self._every is not None:
            return step % self._every == 0
        return intervals(t, self._interval) > self._passed

    def wrote(self, t: float) -> None:
        """A frame was written at time t, s. A late one does not push back the others, which are at whole intervals."""
        if self._every is None:
            self._passed = intervals(t, self._interval)
