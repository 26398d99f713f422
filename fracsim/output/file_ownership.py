"""Ownership of an output folder: the files that a run may overwrite or delete.

A folder belongs to fracsim if its study.toml begins with the header that every run writes. The header is written first
and deleted last, so that the folder of a run killed at any time is recognised. Only files with the names below are
changed there; notes and pictures of the user stay.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from ..errors import InputError
from ..meshes.plain_files import MISSING, NEW, unreadable_reason

# first words of the comments in study.toml
STUDY_HEADER_WORDS = ("fracsim", "dolfinx", "petsc", "python", "ranks")
STUDY_FILE, CHECKPOINT_FILE = "study.toml", "checkpoint/state.h5"
OUTPUT_FOLDERS = ("surface", "checkpoint")
OUTPUT_FILES = (
    "history.csv", "tips.csv", "fields.xdmf", "fields.h5", "surface.pvd", "pieces.csv", "summary.json", "last.png",
    CHECKPOINT_FILE,
)  # fmt: skip
FRAME_FILE_PATTERN = re.compile(r"(?:surface|obstacle_[A-Za-z][A-Za-z0-9-]*)_\d{6,}\.vtu")
# Files that may exist before study.toml does: the log of a sweep, and a temporary file of a run killed at its start.
ALLOWED_FOREIGN_FILES = ("log.txt", STUDY_FILE + NEW)
# foreign files listed in a message
_MAX_NAMED_FILES = 3


def recorded_file_lines(study: str) -> list[str]:
    """Lines `file KEY: SHA-256` of the text of a study.toml, one for each input file; earlier versions wrote none."""
    return [line.removeprefix("# ") for line in study.splitlines() if line.startswith("# file ")]


def own_files(folder: Path) -> Iterator[Path]:
    """Files that runs have written in a folder of fracsim, without study.toml."""
    for name in OUTPUT_FILES:
        paths = (folder / name, folder / (name + NEW))
        yield from (path for path in paths if path.is_symlink() or path.is_file())
    frames = sorted((folder / "surface").glob("*.vtu"))
    yield from (path for path in frames if FRAME_FILE_PATTERN.fullmatch(path.name))


def delete_own_files(folder: Path) -> None:
    """Delete the files of an earlier run, without study.toml, and empty subfolders. Raises OSError."""
    for path in list(own_files(folder)):
        path.unlink()
    for name in OUTPUT_FOLDERS:
        if (folder / name).is_dir() and not any((folder / name).iterdir()):
            (folder / name).rmdir()


def check_file_types(folder: Path) -> None:
    """Raise InputError if an output file is not a regular file, or if a subfolder is a link.

    No file is opened. A link to a regular file is accepted: the run replaces it.
    """
    for name in OUTPUT_FOLDERS:
        path = folder / name
        kind = "a link" if path.is_symlink() else "no folder" if path.exists() and not path.is_dir() else ""
        if kind:
            raise InputError(
                f"--out {folder}: {path} is {kind}; a run has a folder of its "
                "own there: delete it, or give another folder"
            )
    for name in (STUDY_FILE, *OUTPUT_FILES):
        if (problem := unreadable_reason(folder / name)) not in ("", MISSING):
            raise InputError(f"--out {folder}: {folder / name} {problem}; delete it, or give another folder")
    for name in (STUDY_FILE + NEW, *(file + NEW for file in OUTPUT_FILES)):
        if (folder / name).is_dir() and not (folder / name).is_symlink():
            raise InputError(f"--out {folder}: {folder / name} is a folder; delete it, or give another folder")


def check_ownership(folder: Path, inputs: Iterable[Path | None] = ()) -> None:
    """Raise InputError if a folder holds foreign files, or if the run would replace one of its inputs.

    Args:
        folder: output folder; it need not exist.
        inputs: files from which the study is read.
    """
    check_file_types(folder)
    names = sorted(path.name for path in folder.iterdir() if not path.name.startswith(".")) if folder.is_dir() else []
    if not is_fracsim_folder(folder) and (foreign := [name for name in names if name not in ALLOWED_FOREIGN_FILES]):
        unnamed = len(foreign) - _MAX_NAMED_FILES
        listed = ", ".join(foreign[:_MAX_NAMED_FILES]) + (f" and {unnamed} more" if unnamed > 0 else "")
        raise InputError(
            f"--out {folder}: the folder holds what fracsim did not write ({listed}); give an empty or a new folder"
        )
    written = {path.resolve() for path in (folder / STUDY_FILE, *own_files(folder))}
    for path in inputs:
        if path is not None and path.resolve() in written:
            raise InputError(f"--out {folder}: the run would replace its own input {path}; give another folder")


def check_not_resumable(folder: Path) -> None:
    """Raise InputError if an unfinished run left a checkpoint in the folder."""
    if has_resumable_run(folder):
        raise InputError(
            f"--out {folder}: a run that has not ended left a checkpoint there ({CHECKPOINT_FILE}); go on with "
            "--restart, throw it away with --overwrite, or give another folder"
        )


def is_fracsim_folder(folder: Path) -> bool:
    """True if the folder has the study.toml of a run."""
    try:
        with (folder / STUDY_FILE).open(encoding="utf-8") as file:
            return all(file.readline().startswith(f"# {word}: ") for word in STUDY_HEADER_WORDS)
    except (OSError, UnicodeDecodeError):
        return False


def has_resumable_run(folder: Path) -> bool:
    """True if the folder has the checkpoint of an unfinished run."""
    if not (folder / CHECKPOINT_FILE).is_file():
        return False
    try:
        return bool(json.loads((folder / "summary.json").read_text(encoding="utf-8"))["outcome"] != "done")
    except (OSError, ValueError, KeyError, TypeError):
        return True
