"""Output folder of a run: who may write there, what may change on a restart, and when a frame is due.

On a restart the duration, the time steps, the solver and the output may change. All other keys define the body, its
loads and its laws, which must be the same throughout a run. The mesh is compared by its nodes, cells and groups and not
by its keys, since a mesh file may have moved.
"""

from __future__ import annotations

import platform
import tomllib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

from .. import __version__
from ..errors import InputError
from ..mesh.dolfinx_compat import VERSION as DOLFINX_VERSION
from ..timestepping.step_sizes import count_intervals
from .atomic_write import error_reason, replace_text
from .checkpoint_file import checkpoint_path, read_notes
from .fields_file import check_self_contained, read_frame_times
from .file_ownership import (
    STUDY_FILE,
    check_file_types,
    check_not_resumable,
    check_ownership,
    delete_own_files,
    recorded_file_lines,
)
from .history import read_earlier_rows

CHANGEABLE_KEYS = (
    "title", "time.step", "time.end", "time.adapt", "time.smallest", "time.breaking_step", "time.until", "solver",
    "output", "mesh",
)  # fmt: skip
# Tables that a restart may add or remove while nothing has broken or yielded; the checkpoint is asked for that. Each
# with the key of a material that is added or removed with it.
OPTIONAL_TABLES = {"fracture": "strength", "plasticity": "yield_stress", "brittle": ""}
# differing keys listed in a message
_MAX_NAMED_KEYS = 4


def check_same_study(path: Path, earlier: dict[str, Any], present: dict[str, Any]) -> None:
    """Raise InputError if the study of a checkpoint is not the one that is to continue.

    Args:
        path: the checkpoint, named in the error.
        earlier: tables of the study in the checkpoint, with all defaults.
        present: tables of the study to continue, with all defaults.
    """
    differences = list(study_differences(earlier, present))
    if not differences:
        return
    unnamed = f"; and {len(differences) - _MAX_NAMED_KEYS} more" if len(differences) > _MAX_NAMED_KEYS else ""
    raise InputError(
        f"--restart: {path} is of another study: {'; '.join(differences[:_MAX_NAMED_KEYS])}{unnamed}. Only time.step, "
        "time.end, time.adapt, time.smallest, time.breaking_step, time.until, [solver], [output] and the title may "
        "change; put the others back, or run without --restart in another folder"
    )


def check_same_obstacle_files(path: Path, study: str, present: Iterable[str]) -> None:
    """Raise InputError if an obstacle file has another content than when a checkpoint was written.

    Args:
        path: the checkpoint, named in the error.
        study: text of study.toml in the checkpoint.
        present: lines `file KEY: SHA-256` of the study to continue. Those of the mesh are not compared.
    """
    earlier = recorded_file_lines(study)
    for line in [line for line in present if earlier and line not in earlier]:
        key = line.removeprefix("file ").rpartition(": ")[0]
        if key.startswith("obstacle."):
            raise InputError(
                f"--restart: the file of {key} has changed since {path} was written: put the earlier file back, or run "
                "without --restart in another folder"
            )


def study_differences(earlier: dict[str, Any], present: dict[str, Any]) -> Iterator[str]:
    """Phrases about the keys that differ and must not; arguments of `check_same_study`."""
    old, new = dict(_dotted_keys(earlier)), dict(_dotted_keys(present))
    changed_tables = _changed_tables(earlier, present)
    # the only key of [mesh] that is compared: all others are compared by the mesh that they make
    orders = [study["mesh"].get("order", 1) for study in (earlier, present)]
    if orders[0] != orders[1]:
        yield f"mesh.order was {orders[0]}, is {orders[1]}"
    for key in dict.fromkeys([*old, *new]):
        fixed = not _is_within(key, CHANGEABLE_KEYS) and not _belongs_to(key, changed_tables)
        if fixed and old.get(key) != new.get(key):
            yield f"{key} was {_format_value(old, key)}, is {_format_value(new, key)}"


def _changed_tables(earlier: dict[str, Any], present: dict[str, Any]) -> list[str]:
    """Optional tables that only one of the studies has; [brittle] counts only together with [fracture]."""
    changed = [name for name in OPTIONAL_TABLES if (name in earlier) != (name in present)]
    return [name for name in changed if name != "brittle" or "fracture" in changed]


def _belongs_to(key: str, tables: list[str]) -> bool:
    """True if a key is in one of the tables or is the key of a material that goes with one of them."""
    table, _, last = key.rpartition(".")
    in_material = table.startswith("material.") and last in [OPTIONAL_TABLES[name] for name in tables]
    return _is_within(key, tables) or in_material


def _is_within(key: str, names: list[str] | tuple[str, ...]) -> bool:
    """True if a dotted key is one of the names or lies in a table of that name."""
    return any(key == name or key.startswith(f"{name}.") for name in names)


def _dotted_keys(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Pairs (dotted key, value) of a TOML document; entries of arrays of tables by their number.

    Empty lists are left out: an earlier version did not write the tables that it did not know.
    """
    if value == []:
        return
    if isinstance(value, list) and value and isinstance(value[0], dict):
        value = dict(enumerate(value))
    if not isinstance(value, dict):
        yield key, value
        return
    for name, inner in value.items():
        yield from _dotted_keys(inner, f"{key}.{name}" if key else str(name))


def _format_value(values: dict[str, Any], key: str) -> str:
    """Value of a key for a message; "absent" if there is none."""
    if key not in values:
        return "absent"
    value = values[key]
    return f'"{value}"' if isinstance(value, str) else str(value)


def check_output_folder(
    folder: Path,
    study: str,
    *,
    restart: bool,
    overwrite: bool,
    inputs: Iterable[Path | None],
    completed: Callable[[dict[str, Any]], dict[str, Any]],
    file_lines: Callable[[], Iterable[str]],
) -> None:
    """Raise InputError if a run may not write to a folder or cannot continue there. Nothing is changed (rank 0).

    Args:
        folder: output folder.
        study: text of study.toml.
        restart: continue the run in the folder.
        overwrite: an unfinished run in the folder may be deleted.
        inputs: files from which the study is read.
        completed: returns the tables of an earlier version's study with the defaults of keys added since.
        file_lines: returns lines about the contents of the input files; called on a restart.
    """
    check_file_types(folder)
    if restart:
        notes = read_notes(folder)
        check_same_study(checkpoint_path(folder), completed(notes.study_tables()), tomllib.loads(study))
        check_same_obstacle_files(checkpoint_path(folder), notes.study, file_lines())
        # a restart may read study.toml of the run itself
        inputs = ()
    check_ownership(folder, inputs)
    if not restart and not overwrite:
        check_not_resumable(folder)


def make_output_folder(folder: Path, study: str, *, restart: bool) -> None:
    """Create the output folder and write study.toml; files of an earlier run are deleted unless it continues (rank 0).

    Args:
        folder: output folder.
        study: text of study.toml.
        restart: continue the run in the folder.

    Raises:
        InputError: the folder cannot be written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not restart:
            delete_own_files(folder)
        replace_text(folder / STUDY_FILE, study)
    except OSError as error:
        raise InputError(f"--out {folder}: cannot write there: {error_reason(error)}") from None


def check_continuable(folder: Path, columns: list[str], step: int) -> None:
    """Raise InputError if the files of a run cannot be continued. Nothing is changed (rank 0).

    Args:
        folder: output folder.
        columns: columns of history.csv.
        step: step of the checkpoint.
    """
    read_earlier_rows(folder / "history.csv", columns, step)
    if (h5 := folder / "fields.h5").exists():
        check_self_contained(h5)
        read_frame_times(h5)
    check_text_files(folder)


def check_text_files(folder: Path) -> None:
    """Raise InputError if surface.pvd or pieces.csv is not a text file. Nothing is changed (rank 0)."""
    for path in (folder / "surface.pvd", folder / "pieces.csv"):
        try:
            if path.exists():
                path.read_text(encoding="utf-8")
        except (OSError, ValueError) as error:
            raise InputError(
                f"--restart: cannot read {path} ({error}); move it away to go on without its frames"
            ) from None


def missing_frame_notes(folder: Path, expected: dict[str, int], present: dict[str, int]) -> list[str]:
    """Sentences about files with fewer frames than when the checkpoint was written.

    Args:
        folder: output folder.
        expected: numbers of frames by file name, from the checkpoint.
        present: numbers of frames by file name, after the restart.
    """
    return [
        f"{folder / name} has {present[name]} of the {count} frames that the run had written: the others are missing"
        for name, count in expected.items()
        if present.get(name, count) < count
    ]


def early_end_notes(earlier: dict[str, Any], end: float, t: float) -> list[str]:
    """Sentence about an end that was moved to before the time of the checkpoint.

    Args:
        earlier: tables of the study in the checkpoint.
        end: time.end of the study to continue, s.
        t: time of the checkpoint, s.
    """
    if end >= min(t, float(earlier["time"]["end"])):
        return []
    return [
        f"time.end = {end:g} s lies before the checkpoint, at t = {t:g} s: no step is taken, and the run ends there"
    ]


def software_versions(comm: MPI.Comm) -> dict[str, str]:
    """Versions of the programs and the number of ranks, by `STUDY_HEADER_WORDS`."""
    return {
        "fracsim": __version__,
        "dolfinx": DOLFINX_VERSION,
        "petsc": ".".join(map(str, PETSc.Sys.getVersion())),
        "python": platform.python_version(),
        "ranks": str(comm.size),
    }


class FrameSchedule:
    """Schedule of the frames of a run."""

    def __init__(self, every: int | None, interval: float) -> None:
        """Start without a frame.

        Args:
            every: number of steps between frames; None: frames are due by time.
            interval: simulated time between frames, s.
        """
        self._every, self._interval = every, interval
        # whole intervals at the last frame
        self._intervals_done = 0

    def is_due(self, t: float, step: int) -> bool:
        """True if a frame is due at the end of a step, at time t in s."""
        if self._every is not None:
            return step % self._every == 0
        return count_intervals(t, self._interval) > self._intervals_done

    def record_frame(self, t: float) -> None:
        """Record a frame at time t in s. A late frame does not delay the next, which are due at whole intervals."""
        if self._every is None:
            self._intervals_done = count_intervals(t, self._interval)
