"""Checks of files before they are opened, and replacement of files that are written.

A file is read if it is a plain one: reading a named pipe would never end. A file that another file names is read if it
is a plain one in the same folder or below, HDF5 if all its data are in the file itself: devices and links lead to other
data. A written file is a new one: a link at its place is replaced, not followed.
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
NEW = ".new"  # ending of a file that is being written
HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"


def unreadable_reason(path: str | PathLike[str]) -> str:
    """Why a file cannot be read, found without opening it: "is a named pipe, not a file"; "" of a plain file."""
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
    """A folder, pipe or device has the name of a file.

    `wrong`: the result of `unreadable_reason`.
    """

    def __init__(self, path: Path, wrong: str) -> None:
        super().__init__(errno.EPERM, wrong, str(path))

    def __str__(self) -> str:
        return f"{self.filename} {self.strerror}"

    def __reduce__(self) -> tuple[Any, ...]:
        return NotAPlainFileError, (Path(self.filename), self.strerror)


def check_readable(path: Path) -> None:
    """Raise NotAPlainFileError if a file to be read is a folder, pipe or device."""
    if (wrong := unreadable_reason(path)) not in ("", MISSING):
        raise NotAPlainFileError(path, wrong)


def unreadable_reason_beside(path: Path, name: str) -> str:
    """Why a file `name` that the file `path` names cannot be read: outside its folder, or see `unreadable_reason`."""
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
    """The first name in an open h5py.File whose data lie in another file; "" if there is none.

    That is an external link, a data set in an external file, or a virtual data set. No other file is opened.
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
                continue  # the target of a soft link has a hard link of its own
            entry = group[name]
            if isinstance(entry, h5py.Dataset) and (entry.is_virtual or entry.external):
                return where
            if isinstance(entry, h5py.Group) and (address := h5py.h5o.get_info(entry.id).addr) not in visited:
                visited.add(address)
                todo.append(entry)
    return ""


# --- writing --------------------------------------------------------------------------------------------------------


def check_replaceable(path: Path) -> None:
    """Raise NotAPlainFileError if a folder, pipe or device is at the place of a file to be written."""
    if not path.is_symlink():
        check_readable(path)


def create(path: Path) -> BinaryIO:
    """A new file for writing, in place of a file, link or pipe of that name; raises OSError."""
    if path.is_dir() and not path.is_symlink():
        raise NotAPlainFileError(path, "is a folder, not a file")
    path.unlink(missing_ok=True)
    return os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666), "wb")


@contextlib.contextmanager
def atomic_replacement(path: Path) -> Iterator[Path]:
    """The path of a new file beside `path`, which replaces it when the context ends; after an error the old file stays.

    For one process at a time. Raises OSError.
    """
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
    """The same name in a new folder beside `path`; all files written there move to the folder of `path` at the end.

    For programs that choose the format by the ending of a name, or write several files. Raises OSError.
    """
    check_replaceable(path)
    with TemporaryDirectory(prefix=f".{path.name[:50]}-", dir=path.parent) as folder:
        yield Path(folder) / path.name
        written = sorted(Path(folder).iterdir())
        for file in written:
            check_replaceable(path.parent / file.name)
        for file in written:
            os.replace(file, path.parent / file.name)
