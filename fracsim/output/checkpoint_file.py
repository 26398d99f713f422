"""The file of a checkpoint: arrays, numbers and notes by name, and at its end the SHA-256 of all bytes before.

The digest is looked at before HDF5 is: a file that is cut, or of which one bit is another, is refused as a whole.
Rank 0 writes and reads it, in the order of the input mesh: the ranks of a run do not matter to it. What a run goes on
from is then checked by name, shape and value: files can be made by other programs, and programs have faults.
"""

from __future__ import annotations

import hashlib
import json
import os
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import InputError
from ..meshes.data import MeshData
from ..meshes.plain_files import replacing
from .atomic_write import ROOM, hdf5_file, hdf5_there
from .file_ownership import CHECKPOINT

Arrays = dict[str, npt.NDArray[Any]]

MARK = b"\nfracsim checkpoint, SHA-256 "  # of the last line, before the digest
DIGITS = 64
SEAL = len(MARK) + DIGITS + 1  # bytes of that line
LARGEST = 1e150  # a number whose square overflows is as good as infinite
MOST_STEPS = 10**8  # of a run
_NOTES = ("study", "monitors")
_UNREADABLE = (OSError, KeyError, ValueError, TypeError, AttributeError, RuntimeError, MemoryError, OverflowError)


@dataclass(frozen=True)
class Notes:
    """What a checkpoint says beside the state: the `study`, as in study.toml, and the `monitors` of the run so far."""

    study: str
    monitors: dict[str, Any]

    def values(self) -> dict[str, Any]:
        """The study's tables."""
        return tomllib.loads(self.study)


@dataclass(frozen=True)
class Stored:
    """What a checkpoint at `path` holds: arrays and numbers by name, the fingerprint of its mesh, and notes."""

    path: Path
    arrays: Arrays
    clock: dict[str, Any]
    mesh: str
    notes: Notes


def checkpoint_path(folder: Path) -> Path:
    """Where the checkpoint of a run is."""
    return folder / CHECKPOINT


def last_checkpoint(folder: Path, t: float | None) -> str:
    """A sentence that names the last good checkpoint of a run, of the time t, s; None: it has written none."""
    if t is None:
        return "There is no checkpoint"
    return f"The last good checkpoint: {checkpoint_path(folder)} at t = {t:g} s; go on with --restart"


# --- writing ----------------------------------------------------------------------------------------------------------


def write_arrays(
    path: Path, arrays: dict[str, Any], clock: dict[str, Any], mesh: MeshData | None, notes: Notes
) -> None:
    """A checkpoint of arrays and numbers by name, of a state on a mesh, the old one in place until the new one is whole
    (rank 0). Raises OSError."""
    path.parent.mkdir(exist_ok=True)  # not its parents: a folder that is gone is to be told of
    with replacing(path) as new:
        with hdf5_file(new, _size(arrays, notes), begin=True) as file:
            for name, values in arrays.items():
                file[name] = values
            for name, value in clock.items():
                file.attrs[name] = value
            file.attrs["mesh"] = fingerprint(mesh)
            file["notes/study"], file["notes/monitors"] = notes.study, json.dumps(notes.monitors)
        seal(new)


def _size(arrays: dict[str, Any], notes: Notes) -> int:
    """Bytes, a little more than the file will have."""
    whole = sum(values.nbytes for values in arrays.values() if values is not None)
    return whole + len(notes.study) + 2 * ROOM + (1 << 10) * (len(arrays) + len(_NOTES))


def seal(path: Path) -> None:
    """Add the line with the digest of a file to its end; HDF5 does not look there. Raises OSError."""
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    with path.open("ab") as file:
        file.write(MARK + digest.encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())  # before it takes the place of the last good one, which a loss of power would take


def fingerprint(mesh: MeshData | None) -> str:
    """A short name of a mesh's nodes, cells, groups and regions (rank 0, where the mesh is)."""
    assert mesh is not None
    digest = hashlib.sha256()
    for values in (mesh.points, mesh.cells, *([] if mesh.middles is None else [mesh.middles])):
        digest.update(np.ascontiguousarray(values).tobytes())
    for name, members in sorted([*mesh.facet_groups.items(), *mesh.regions.items()], key=lambda each: each[0]):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(members).tobytes())
    return digest.hexdigest()[:16]


# --- reading ----------------------------------------------------------------------------------------------------------


def read_notes(folder: Path) -> Notes:
    """The notes of a checkpoint that is as it was written (rank 0). InputError where there is none."""
    path = _there(folder)
    with _refusing(path):
        _check_seal(path)
        with hdf5_there(path) as file:
            return _notes(file)


def read_stored(folder: Path) -> Stored:
    """All that a checkpoint holds (rank 0). InputError where there is none, or one that is not as it was written."""
    path = _there(folder)
    with _refusing(path):
        _check_seal(path)
        with hdf5_there(path) as file:
            arrays = {name: _array(file, name) for name in file if name != "notes"}
            clock = {name: _number(name, value) for name, value in file.attrs.items() if name != "mesh"}
            mesh, notes = str(file.attrs["mesh"]), _notes(file)
        _check_clock(clock)
    return Stored(path, arrays, clock, mesh, notes)


def _there(folder: Path) -> Path:
    """Where the checkpoint is. InputError where there is none."""
    path = checkpoint_path(folder)
    if not path.is_file():
        raise InputError(f"--restart: there is no checkpoint {path}; run without --restart")
    return path


def _notes(file: Any) -> Notes:
    """The notes, which are TOML and JSON."""
    study, monitors = (_text(file, f"notes/{name}") for name in _NOTES)
    notes = Notes(study, json.loads(monitors))
    if not isinstance(notes.monitors, dict):
        raise ValueError("notes/monitors is no table")
    notes.values()
    return notes


def check_mesh(stored: Stored, mesh: MeshData | None) -> None:
    """InputError where a checkpoint is not of this mesh (rank 0)."""
    if stored.mesh != fingerprint(mesh):
        raise InputError(f"--restart: {stored.path} belongs to another mesh; run without --restart in another folder")


@contextmanager
def _refusing(path: Path) -> Iterator[None]:
    """InputError for whatever is wrong with a file."""
    try:
        yield
    except _UNREADABLE as error:
        said = str(error).strip("'\"") or type(error).__name__
        raise refusal(path, said) from None


def refusal(path: Path, why: str) -> InputError:
    """What to say of a checkpoint that cannot be gone on from; nothing has been changed."""
    return InputError(
        f"--restart: cannot read {path}: {why}. Nothing was changed; put a copy of a whole checkpoint there, or run "
        "without --restart"
    )


def _check_seal(path: Path) -> None:
    """ValueError where the last line is not the digest of what is before it."""
    left = path.stat().st_size - SEAL
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while left > 0 and (part := file.read(min(left, 1 << 20))):
            digest.update(part)
            left -= len(part)
        last = file.read()
    if not last.startswith(MARK):
        raise ValueError("it has no digest at its end: it is cut, or not of this version of fracsim")
    if last != MARK + digest.hexdigest().encode() + b"\n":
        raise ValueError("it is damaged: its digest (SHA-256) is not that of its contents")


def _array(file: Any, name: str) -> npt.NDArray[Any]:
    """Of numbers that lie in the file itself, in one piece."""
    import h5py

    if not isinstance(file.get(name, getlink=True), h5py.HardLink):
        raise ValueError(f"{name} is a link to somewhere else")
    data = file[name]
    if not isinstance(data, h5py.Dataset) or data.shape is None or data.dtype.kind not in "fiub":
        raise ValueError(f"{name} is no array of numbers")
    if data.external or data.is_virtual or data.chunks or data.id.get_storage_size() != data.size * data.dtype.itemsize:
        raise ValueError(f"{name} does not lie in the file in one piece")
    return np.asarray(data[()])


def _text(file: Any, name: str) -> str:
    """A text that lies in the file itself."""
    import h5py

    for part in ("notes", name):
        if not isinstance(file.get(part, getlink=True), h5py.HardLink):
            raise ValueError(f"{part} is missing, or a link to somewhere else")
    data = file[name]
    if not isinstance(data, h5py.Dataset) or data.external or data.is_virtual:
        raise ValueError(f"{name} is no text")
    return str(data.asstr()[()])


def _number(name: str, value: Any) -> int | float:
    if np.ndim(value) or np.asarray(value).dtype.kind not in "fiu":
        raise ValueError(f"{name} is no number")
    return value.item() if isinstance(value, np.generic) else value


def _check_clock(clock: dict[str, Any]) -> None:
    """ValueError where a number of those that every run counts is missing, or cannot be."""
    for name, value in clock.items():
        if not abs(value) < LARGEST:
            raise ValueError(f"{name} is {value}, which is not finite")
    for name in ("t", "step"):
        if name not in clock:
            raise ValueError(f"{name} is missing")
        if clock[name] < 0:
            raise ValueError(f"{name} is {clock[name]}, less than 0")
    if not isinstance(clock["step"], int) or clock["step"] > MOST_STEPS:
        raise ValueError(f"step is {clock['step']}, not a whole number up to {MOST_STEPS}")
    if (clock["step"] > 0) != (clock["t"] > 0):
        raise ValueError(f"step is {clock['step']:g} at t = {clock['t']:g} s")


def require(found: dict[str, Any], names: set[str], known: set[str], path: Path) -> None:
    """InputError where arrays or numbers by name are not all there, or there are others than those `known`."""
    if missing := sorted(names - found.keys()):
        raise refusal(path, f"{missing[0]} is missing")
    if unknown := sorted(found.keys() - known):
        raise refusal(path, f"it holds {unknown[0]}, which no run of this study writes")
