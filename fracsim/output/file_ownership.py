"""Whose an output folder is: what a run may write over or delete there, and what it must leave alone.

A folder is fracsim's own where its study.toml has the head that every run gives it; the head is written first and goes
last, so that a run that was killed at any moment is recognised. There, only files under the names below are ever
touched; notes, logs and pictures that a user puts beside them stay.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from ..errors import InputError
from ..meshes.plain_files import MISSING, NEW, wrong_with

HEAD = ("fracsim", "dolfinx", "petsc", "python", "ranks")  # first words of the comments at the head of study.toml
STUDY, CHECKPOINT = "study.toml", "checkpoint/state.h5"
FOLDERS = ("surface", "checkpoint")
FILES = ("history.csv", "fields.xdmf", "fields.h5", "surface.pvd", "pieces.csv", "summary.json", "last.png", CHECKPOINT)
FRAME = re.compile(r"(?:surface|obstacle_[A-Za-z][A-Za-z0-9-]*)_\d{6,}\.vtu")
BESIDE = (
    "log.txt",
    STUDY + NEW,
)  # may be there before study.toml is: a sweep's log, and a run killed in its first moment
_NAMED = 3  # foreign files that a message names


def own_files(folder: Path) -> Iterator[Path]:
    """What runs have written in a folder that is fracsim's own, study.toml apart."""
    for name in FILES:
        both = (folder / name, folder / (name + NEW))
        yield from (path for path in both if path.is_symlink() or path.is_file())
    yield from (path for path in sorted((folder / "surface").glob("*.vtu")) if FRAME.fullmatch(path.name))


def clear(folder: Path) -> None:
    """Delete what an earlier run has written, study.toml apart. Raises OSError."""
    for path in list(own_files(folder)):
        path.unlink()
    for name in FOLDERS:
        if (folder / name).is_dir() and not any((folder / name).iterdir()):
            (folder / name).rmdir()


def check_plain(folder: Path) -> None:
    """InputError where what has the name of a file of a run is none, or where a folder in the folder is a link.

    Nothing there is opened. A link to a file passes: it is replaced.
    """
    for name in FOLDERS:
        path = folder / name
        kind = "a link" if path.is_symlink() else "no folder" if path.exists() and not path.is_dir() else ""
        if kind:
            raise InputError(
                f"--out {folder}: {path} is {kind}; a run has a folder of its "
                "own there: delete it, or give another folder"
            )
    for name in (STUDY, *FILES):
        if (wrong := wrong_with(folder / name)) not in ("", MISSING):
            raise InputError(f"--out {folder}: {folder / name} {wrong}; delete it, or give another folder")
    for name in (STUDY + NEW, *(each + NEW for each in FILES)):
        if (folder / name).is_dir() and not (folder / name).is_symlink():
            raise InputError(f"--out {folder}: {folder / name} is a folder; delete it, or give another folder")


def check_owner(folder: Path, inputs: Iterable[Path | None] = ()) -> None:
    """InputError where the folder holds what no run has written, or where the run would replace one of its inputs."""
    check_plain(folder)
    found = sorted(path.name for path in folder.iterdir() if not path.name.startswith(".")) if folder.is_dir() else []
    if not is_own(folder) and (foreign := [name for name in found if name not in BESIDE]):
        named = ", ".join(foreign[:_NAMED]) + (f" and {rest} more" if (rest := len(foreign) - _NAMED) > 0 else "")
        raise InputError(
            f"--out {folder}: the folder holds what fracsim did not write ({named}); give an empty or a new folder"
        )
    written = {path.resolve() for path in (folder / STUDY, *own_files(folder))}
    for path in inputs:
        if path is not None and path.resolve() in written:
            raise InputError(f"--out {folder}: the run would replace its own input {path}; give another folder")


def check_not_resumable(folder: Path) -> None:
    """InputError where a run that has not ended left a checkpoint."""
    if resumable(folder):
        raise InputError(
            f"--out {folder}: a run that has not ended left a checkpoint there ({CHECKPOINT}); go on with --restart, "
            "throw it away with --overwrite, or give another folder"
        )


def is_own(folder: Path) -> bool:
    """The study.toml of a run of fracsim is there."""
    try:
        with (folder / STUDY).open(encoding="utf-8") as file:
            return all(file.readline().startswith(f"# {word}: ") for word in HEAD)
    except (OSError, UnicodeDecodeError):
        return False


def resumable(folder: Path) -> bool:
    """There is a checkpoint of a run that has not ended."""
    if not (folder / CHECKPOINT).is_file():
        return False
    try:
        return bool(json.loads((folder / "summary.json").read_text())["outcome"] != "done")
    except (OSError, ValueError, KeyError, TypeError):
        return True
