"""Checkpoint file: named arrays and numbers in HDF5, followed by one line with the SHA-256 digest of all bytes before.

The digest is verified before HDF5 opens the file, so a truncated or altered file is refused as a whole. Rank 0 reads
and writes, in the order of the input mesh and a block of rows at a time; the number of ranks of a run does not matter.
Names, shapes and ranges are checked after the digest, since other programs can write such files too.
"""

from __future__ import annotations

import hashlib
import json
import os
import tomllib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import InputError
from ..mesh.parallel import MAX_GATHERED_ROWS
from ..meshes.plain_files import atomic_replacement
from .atomic_write import HDF5_OVERHEAD_BYTES, open_hdf5, writable_hdf5
from .file_ownership import CHECKPOINT_FILE

# shape and type of the numbers of an array
type Layout = tuple[tuple[int, ...], np.dtype[Any]]

# the last line of the file before its digest
DIGEST_MARK = b"\nfracsim checkpoint, SHA-256 "
DIGEST_LINE_BYTES = len(DIGEST_MARK) + 2 * hashlib.sha256().digest_size + 1
_NOTES = ("study", "monitors")
# whatever h5py, NumPy, json and tomllib raise on a damaged file
_READ_ERRORS = (OSError, KeyError, ValueError, TypeError, AttributeError, RuntimeError, MemoryError, OverflowError)


@dataclass(frozen=True)
class CheckpointLimits:
    """Bounds of the numbers in a checkpoint.

    Attributes:
        magnitude: largest absolute value that counts as finite. The square of a larger number overflows.
        steps: largest number of steps of a run.
        chi_rounding: chi, in [0, 1], may exceed its bounds by this round-off.
    """

    magnitude: float = 1e150
    steps: int = 10**8
    chi_rounding: float = 1e-9


CHECKPOINT_LIMITS = CheckpointLimits()


@dataclass(frozen=True)
class CheckpointNotes:
    """Texts of a checkpoint beside the state.

    Attributes:
        study: text of study.toml.
        monitors: what the monitors of the run have recorded so far, by name.
    """

    study: str
    monitors: dict[str, Any]

    def study_tables(self) -> dict[str, Any]:
        """Tables of the study."""
        return tomllib.loads(self.study)


@dataclass(frozen=True)
class StoredCheckpoint:
    """Contents of a checkpoint file.

    Attributes:
        path: the file.
        arrays: arrays by name; data sets of HDF5 while the file is open.
        clock: numbers by name: time in s, step, and others of the time scheme.
        fingerprint: `mesh_fingerprint` of its mesh.
        notes: study and monitors.
    """

    path: Path
    arrays: dict[str, Any]
    clock: dict[str, Any]
    fingerprint: str
    notes: CheckpointNotes


def checkpoint_path(folder: Path) -> Path:
    """Path of the checkpoint in an output folder."""
    return folder / CHECKPOINT_FILE


def describe_last_checkpoint(folder: Path, t: float | None) -> str:
    """Sentence that names the last checkpoint of a run, written at time t in s; None: the run has written none."""
    if t is None:
        return "There is no checkpoint"
    return f"The last good checkpoint: {checkpoint_path(folder)} at t = {t:g} s; go on with --restart"


# --- writing ----------------------------------------------------------------------------------------------------------


class ArrayWriter:
    """Writes arrays into an open checkpoint file, whole or a block of rows after the other."""

    def __init__(self, file: Any, layouts: dict[str, Layout]) -> None:
        self._file, self._layouts = file, layouts
        self._written = dict.fromkeys(layouts, 0)

    def append_rows(self, name: str, rows: npt.NDArray[Any]) -> None:
        """Write the next rows of an array. Raises OSError."""
        start = self._written[name]
        if start == 0:
            self._file.create_dataset(name, *self._layouts[name])
        if rows.size:
            self._file[name][start : start + len(rows)] = rows
            self._written[name] += len(rows)


@contextmanager
def new_checkpoint_file(
    path: Path, layouts: dict[str, Layout], clock: dict[str, Any], fingerprint: str | None, notes: CheckpointNotes
) -> Iterator[ArrayWriter]:
    """Writer of the arrays of a checkpoint; the file replaces the previous one when the context ends (rank 0).

    Args:
        path: the file. The previous one stays until the new one is complete.
        layouts: of all arrays, by name.
        clock: numbers by name.
        fingerprint: `mesh_fingerprint` of the mesh of the study, which rank 0 has.
        notes: study and monitors.

    Raises:
        OSError: the file cannot be written.
    """
    assert fingerprint is not None
    # without parents: a deleted output folder is an error
    path.parent.mkdir(exist_ok=True)
    with atomic_replacement(path) as temporary:
        with writable_hdf5(temporary, _file_size(layouts, notes), new=True) as file:
            yield ArrayWriter(file, layouts)
            for name, value in clock.items():
                file.attrs[name] = value
            file.attrs["mesh"] = fingerprint
            file["notes/study"], file["notes/monitors"] = notes.study, json.dumps(notes.monitors)
        append_digest(temporary)


def layouts_of(arrays: dict[str, npt.NDArray[Any]]) -> dict[str, Layout]:
    """Layouts of whole arrays."""
    return {name: (values.shape, values.dtype) for name, values in arrays.items()}


def write_checkpoint_file(
    path: Path, arrays: dict[str, npt.NDArray[Any]], clock: dict[str, Any], fingerprint: str, notes: CheckpointNotes
) -> None:
    """Write a checkpoint of whole arrays; arguments and errors as for `new_checkpoint_file` (rank 0)."""
    with new_checkpoint_file(path, layouts_of(arrays), clock, fingerprint, notes) as writer:
        for name, values in arrays.items():
            writer.append_rows(name, values)


def _file_size(layouts: dict[str, Layout], notes: CheckpointNotes) -> int:
    """Upper bound of the size of a checkpoint file in bytes."""
    data = sum(prod(shape) * dtype.itemsize for shape, dtype in layouts.values())
    return data + len(notes.study) + 2 * HDF5_OVERHEAD_BYTES + (1 << 10) * (len(layouts) + len(_NOTES))


def append_digest(path: Path) -> None:
    """Append the line with the digest to a file. HDF5 ignores bytes after its own. Raises OSError."""
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    with path.open("ab") as file:
        file.write(DIGEST_MARK + digest.encode() + b"\n")
        file.flush()
        # on disk before the file replaces the previous checkpoint: a power failure must not destroy both
        os.fsync(file.fileno())


# --- reading ----------------------------------------------------------------------------------------------------------


def read_notes(folder: Path) -> CheckpointNotes:
    """Notes of the checkpoint in a folder (rank 0). Raises InputError if it is missing or damaged."""
    path = _existing_checkpoint(folder)
    with _input_errors(path):
        _check_digest(path)
        with open_hdf5(path) as file:
            return _read_notes(file)


def read_checkpoint_file(folder: Path) -> StoredCheckpoint:
    """Contents of the checkpoint in a folder (rank 0). Raises InputError if it is missing or damaged."""
    with open_checkpoint(folder) as stored:
        return replace(stored, arrays={name: read_rows(stored, name, slice(None)) for name in stored.arrays})


@contextmanager
def open_checkpoint(folder: Path) -> Iterator[StoredCheckpoint]:
    """The checkpoint in a folder, with its file open (rank 0). Raises InputError if it is missing or damaged."""
    path = _existing_checkpoint(folder)
    with ExitStack() as stack:
        with _input_errors(path):
            _check_digest(path)
            file = stack.enter_context(open_hdf5(path))
            arrays = {name: _find_array(file, name) for name in file if name != "notes"}
            clock = {name: _to_number(name, value) for name, value in file.attrs.items() if name != "mesh"}
            fingerprint, notes = str(file.attrs["mesh"]), _read_notes(file)
            _check_clock(clock)
        yield StoredCheckpoint(path, arrays, clock, fingerprint, notes)


def read_rows(stored: StoredCheckpoint, name: str, rows: slice) -> npt.NDArray[Any]:
    """Rows of an array of an open checkpoint. Raises InputError if they cannot be read."""
    data = stored.arrays[name]
    with _input_errors(stored.path):
        return np.asarray(data[rows] if data.shape else data[()])


def row_blocks(count: int = 0) -> Iterator[slice]:
    """Rows of an array, a block at a time; one block without rows if there are none."""
    for start in range(0, max(count, 1), MAX_GATHERED_ROWS):
        yield slice(start, min(start + MAX_GATHERED_ROWS, count))


def _existing_checkpoint(folder: Path) -> Path:
    """Path of the checkpoint. Raises InputError if there is no such file."""
    path = checkpoint_path(folder)
    if not path.is_file():
        raise InputError(f"--restart: there is no checkpoint {path}; run without --restart")
    return path


def _read_notes(file: Any) -> CheckpointNotes:
    """Notes of an open HDF5 file: TOML and JSON. Raises an error of `_READ_ERRORS` if they are neither."""
    study, monitors = (_read_text(file, f"notes/{name}") for name in _NOTES)
    notes = CheckpointNotes(study, json.loads(monitors))
    if not isinstance(notes.monitors, dict):
        raise ValueError("notes/monitors is no table")
    notes.study_tables()
    return notes


def check_mesh(stored: StoredCheckpoint, fingerprint: str | None) -> None:
    """Raise InputError if a checkpoint belongs to another mesh than that with a `mesh_fingerprint` (rank 0)."""
    if stored.fingerprint != fingerprint:
        raise InputError(f"--restart: {stored.path} belongs to another mesh; run without --restart in another folder")


@contextmanager
def _input_errors(path: Path) -> Iterator[None]:
    """Context that turns errors of reading a file into InputError."""
    try:
        yield
    except _READ_ERRORS as error:
        message = str(error).strip("'\"") or type(error).__name__
        raise restart_error(path, message) from None


def restart_error(path: Path, why: str) -> InputError:
    """Error for a checkpoint that cannot be used. The output folder has not been changed."""
    return InputError(
        f"--restart: cannot read {path}: {why}. Nothing was changed; put a copy of a whole checkpoint there, or run "
        "without --restart"
    )


def _check_digest(path: Path) -> None:
    """Raise ValueError if the last line is not the digest of the bytes before it."""
    unread = path.stat().st_size - DIGEST_LINE_BYTES
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while unread > 0 and (block := file.read(min(unread, 1 << 20))):
            digest.update(block)
            unread -= len(block)
        last_line = file.read()
    if not last_line.startswith(DIGEST_MARK):
        raise ValueError("it has no digest at its end: it is cut, or not of this version of fracsim")
    if last_line != DIGEST_MARK + digest.hexdigest().encode() + b"\n":
        raise ValueError("it is damaged: its digest (SHA-256) is not that of its contents")


def _find_array(file: Any, name: str) -> Any:
    """Data set of an open HDF5 file. Raises ValueError unless its numbers are stored contiguously in this file."""
    import h5py

    if not isinstance(file.get(name, getlink=True), h5py.HardLink):
        raise ValueError(f"{name} is a link to somewhere else")
    data = file[name]
    if not isinstance(data, h5py.Dataset) or data.shape is None or data.dtype.kind not in "fiub":
        raise ValueError(f"{name} is no array of numbers")
    if data.external or data.is_virtual or data.chunks or data.id.get_storage_size() != data.size * data.dtype.itemsize:
        raise ValueError(f"{name} does not lie in the file in one piece")
    return data


def _read_text(file: Any, name: str) -> str:
    """Text of an open HDF5 file. Raises ValueError unless it is stored in this file."""
    import h5py

    for part in ("notes", name):
        if not isinstance(file.get(part, getlink=True), h5py.HardLink):
            raise ValueError(f"{part} is missing, or a link to somewhere else")
    data = file[name]
    if not isinstance(data, h5py.Dataset) or data.external or data.is_virtual:
        raise ValueError(f"{name} is no text")
    return str(data.asstr()[()])


def _to_number(name: str, value: Any) -> int | float:
    """Python number of an HDF5 attribute. Raises ValueError if it is none."""
    if np.ndim(value) or np.asarray(value).dtype.kind not in "fiu":
        raise ValueError(f"{name} is no number")
    return value.item() if isinstance(value, np.generic) else value


def _check_clock(clock: dict[str, Any]) -> None:
    """Raise ValueError if time or step are missing, or if a number is out of its range."""
    for name, value in clock.items():
        if not abs(value) < CHECKPOINT_LIMITS.magnitude:
            raise ValueError(f"{name} is {value}, which is not finite")
    for name in ("t", "step"):
        if name not in clock:
            raise ValueError(f"{name} is missing")
        if clock[name] < 0:
            raise ValueError(f"{name} is {clock[name]}, less than 0")
    if not isinstance(clock["step"], int) or clock["step"] > CHECKPOINT_LIMITS.steps:
        raise ValueError(f"step is {clock['step']}, not a whole number up to {CHECKPOINT_LIMITS.steps}")
    if (clock["step"] > 0) != (clock["t"] > 0):
        raise ValueError(f"step is {clock['step']:g} at t = {clock['t']:g} s")


def check_names(values: dict[str, Any], required: set[str], allowed: set[str], path: Path) -> None:
    """Raise InputError if a required array or number is missing, or if one is not allowed.

    Args:
        values: arrays or numbers by name.
        required: names that must be there.
        allowed: names that may be there.
        path: the checkpoint, named in the error.
    """
    if missing := sorted(required - values.keys()):
        raise restart_error(path, f"{missing[0]} is missing")
    if unknown := sorted(values.keys() - allowed):
        raise restart_error(path, f"it holds {unknown[0]}, which no run of this study writes")
