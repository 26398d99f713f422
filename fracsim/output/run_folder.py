"""The output folder: what is in it, when a frame is due, and what ran.

What may change on a restart: how long, in what steps and with which solver a study runs, and what it writes.

Everything else is the body, its load or the law it follows, of which half a run would be of one kind and half of
another. The mesh is compared by its nodes, cells and groups, not by its keys: a file may have moved.
"""

from __future__ import annotations

import platform
import tomllib
from collections.abc import Callable, Iterable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

from .. import __version__
from ..errors import InputError
from ..timestepping.stepper import count_intervals
from .atomic_write import reason, replace_text
from .checkpoint_file import checkpoint_path, read_notes
from .fields_file import check_whole, read_times
from .file_ownership import STUDY, check_not_resumable, check_owner, check_plain, clear
from .history import read_earlier

FREE = (
    "title", "time.step", "time.end", "time.adapt", "time.smallest", "time.breaking_step", "time.until", "solver",
    "output", "mesh",
)  # fmt: skip
# tables that may come or go while nothing has broken or flowed, which the checkpoint is asked for; with the key of a
# region that comes and goes with them
LATE = {"fracture": "strength", "plasticity": "yield_stress", "brittle": ""}
_SAID = 4  # keys that a message names


def check_same_study(path: Path, then: dict[str, Any], now: dict[str, Any]) -> None:
    """InputError where the study of a checkpoint (`then`, at `path`) is not the one that is to go on.

    Both as they stand in study.toml, every default written out.
    """
    found = list(differences(then, now))
    if not found:
        return
    more = f"; and {len(found) - _SAID} more" if len(found) > _SAID else ""
    raise InputError(
        f"--restart: {path} is of another study: {'; '.join(found[:_SAID])}{more}. Only time.step, time.end, "
        "time.adapt, time.smallest, time.breaking_step, time.until, [solver], [output] and the title may change; put "
        "the others back, or run without --restart in another folder"
    )


def differences(then: dict[str, Any], now: dict[str, Any]) -> Iterator[str]:
    """A phrase for each key that may not differ and does."""
    old, new = dict(_leaves(then)), dict(_leaves(now))
    moved = _moved(then, now)
    orders = [each["mesh"].get("order", 1) for each in (then, now)]  # all else of it is compared by what it makes
    if orders[0] != orders[1]:
        yield f"mesh.order was {orders[0]}, is {orders[1]}"
    for key in dict.fromkeys([*old, *new]):
        if old.get(key) != new.get(key) and not _within(key, FREE) and not _of_moved(key, moved):
            yield f"{key} was {_said(old, key)}, is {_said(new, key)}"


def _moved(then: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """Tables of LATE that only one of the studies has; brittle surfaces come and go with [fracture] alone."""
    moved = [name for name in LATE if (name in then) != (name in now)]
    return [name for name in moved if name != "brittle" or "fracture" in moved]


def _of_moved(key: str, moved: list[str]) -> bool:
    table, _, last = key.rpartition(".")
    return _within(key, moved) or (table.startswith("material.") and last in [LATE[name] for name in moved])


def _within(key: str, names: list[str] | tuple[str, ...]) -> bool:
    return any(key == name or key.startswith(f"{name}.") for name in names)


def _leaves(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """(dotted key, value) of a TOML document; entries of lists of tables by their number. An empty list is no key:
    tables that an earlier version did not know are empty."""
    if value == []:
        return
    if isinstance(value, list) and value and isinstance(value[0], dict):
        value = dict(enumerate(value))
    if not isinstance(value, dict):
        yield key, value
        return
    for name, inner in value.items():
        yield from _leaves(inner, f"{key}.{name}" if key else str(name))


def _said(values: dict[str, Any], key: str) -> str:
    if key not in values:
        return "absent"
    value = values[key]
    return f'"{value}"' if isinstance(value, str) else str(value)


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
        return count_intervals(t, self._interval) > self._passed

    def wrote(self, t: float) -> None:
        """A frame was written at time t, s. A late one does not push back the others, which are at whole intervals."""
        if self._every is None:
            self._passed = count_intervals(t, self._interval)
