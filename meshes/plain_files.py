"""Files that a user names, and files that those name: which of them may be opened, and how files are written.

A named pipe would be waited for without end, and a device or a link within a file leads to data that is not the
user's. So a file is read where it is a plain one; what it names where it is a plain one in the same folder; HDF5 where
all of it is in the file itself. What is written is a new file: a link at its place is replaced, not followed.
"""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from collections.abc import Iterator
from os import PathLike
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO

_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)
MISSING = "does not exist"
NEW = ".new"  # ends the name of a file that is not whole yet
HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"


def unreadable_reason(path: str | PathLike[str]) -> str:
    """Why a file cannot be read, without opening it: "is a named pipe, not a file"; "" of a plain file."""
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        return MISSING
    except (OSError, ValueError) as error:  # no permission, too long a name, a null character
        return f"cannot be read: {getattr(error, 'strerror', None) or error}"
    if stat.S_ISREG(mode):
        return ""
    return f"is {next((kind for is_kind, kind in _KINDS if is_kind(mode)), 'something else')}, not a file"


class NotAPlainFileError(OSError):
    """What has the name of a file is something else."""

    def __init__(self, path: Path, wrong: str) -> None:
        """`wrong`: as of `unreadable_reason`."""
        super().__init__(errno.EPERM, wrong, str(path))

    def __str__(self) -> str:
        return f"{self.filename} {self.strerror}"

    def __reduce__(self) -> tuple[Any, ...]:
        return NotAPlainFileError, (Path(self.filename), self.strerror)


def check_readable(path: Path) -> None:
    """Raise NotAPlainFileError where a folder, a pipe or a device has the name of a file to be read."""
    if (wrong := unreadable_reason(path)) not in ("", MISSING):
        raise NotAPlainFileError(path, wrong)


def unreadable_reason_beside(path: Path, name: str) -> str:
    """Why a file that the file `path` names cannot be read: it lies in another folder, or as of `unreadable_reason`."""
    folder = os.path.abspath(path.parent)
    inside = os.path.normpath(os.path.join(folder, name))
    if os.path.commonpath([folder, inside]) != folder:
        return f"lies outside the folder {folder}; put it beside {path.name}"
    return unreadable_reason(inside)


def is_hdf5(path: Path) -> bool:
    """Whether a plain file begins as HDF5 does."""
    with path.open("rb") as file:
        return file.read(len(HDF5_SIGNATURE)) == HDF5_SIGNATURE


def find_external_data(file: Any) -> str:
    """The first name in an open h5py.File whose data lie in another file; "" where there is none.

    External links, data sets in external files, and virtual data sets. No other file is opened.
    """
    import h5py

    todo, visited = [file], set()
    while todo:
        group = todo.pop()
        for name in group:
            link = group.get(name, getlink=True)
            where = f"{group.name.rstrip('/')}/{name}"
            if isinstance(link, h5py.ExternalLink):
                return where
            if not isinstance(link, h5py.HardLink):
                continue  # a soft link: what it leads to has a link of its own
            entry = group[name]
            if isinstance(entry, h5py.Dataset) and (entry.is_virtual or entry.external):
                return where
            if isinstance(entry, h5py.Group) and (address := h5py.h5o.get_info(entry.id).addr) not in visited:
                visited.add(address)
                todo.append(entry)
    return ""


# --- writing --------------------------------------------------------------------------------------------------------


def check_replaceable(path: Path) -> None:
    """Raise NotAPlainFileError where a folder, a pipe or a device has the name of a file to be written."""
    if not path.is_symlink():
        check_readable(path)


def create(path: Path) -> BinaryIO:
    """A new file, to be written, in place of the file, link or pipe that has its name. Raises OSError."""
    if path.is_dir() and not path.is_symlink():
        raise NotAPlainFileError(path, "is a folder, not a file")
    path.unlink(missing_ok=True)
    return os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666), "wb")


@contextlib.contextmanager
def atomic_replacement(path: Path) -> Iterator[Path]:
    """A new file beside `path` that takes its place once it is whole; where that fails the old file stays. For one
    process at a time. Raises OSError."""
    check_replaceable(path)
    new = path.with_name(path.name + NEW)
    create(new).close()
    try:
        yield new
        os.replace(new, path)
    except BaseException:
        with contextlib.suppress(OSError):
            new.unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def atomic_replacement_of_all(path: Path) -> Iterator[Path]:
    """The same name in a new folder beside `path`: all files that are made there come to lie beside `path`, once they
    are whole. For programs that go by the ending of a name, or make several files of it. Raises OSError."""
    check_replaceable(path)
    with TemporaryDirectory(prefix=f".{path.name[:50]}-", dir=path.parent) as folder:
        yield Path(folder) / path.name
        for result in sorted(Path(folder).iterdir()):
            check_replaceable(path.parent / result.name)
        for result in sorted(Path(folder).iterdir()):
            os.replace(result, path.parent / result.name)
