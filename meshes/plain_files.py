"""Files that a user names, and files that those name: which of them may be opened.

A named pipe would be waited for without end, and a device or a link within a file leads to data that is not the
user's. So a file is read where it is a plain one; what it names where it is a plain one in the same folder; HDF5 where
all of it is in the file itself.
"""

from __future__ import annotations

import os
import stat
from os import PathLike
from pathlib import Path
from typing import Any

_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)
MISSING = "does not exist"
HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"


def wrong_with(path: str | PathLike[str]) -> str:
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


def wrong_beside(path: Path, name: str) -> str:
    """Why a file that the file `path` names cannot be read: it lies in another folder, or as of `wrong_with`."""
    folder = os.path.abspath(path.parent)
    inside = os.path.normpath(os.path.join(folder, name))
    if os.path.commonpath([folder, inside]) != folder:
        return f"lies outside the folder {folder}; put it beside {path.name}"
    return wrong_with(inside)


def is_hdf5(path: Path) -> bool:
    """Whether a plain file begins as HDF5 does."""
    with path.open("rb") as file:
        return file.read(len(HDF5_SIGNATURE)) == HDF5_SIGNATURE


def data_elsewhere(file: Any) -> str:
    """The first name in an open h5py.File whose data lie in another file; "" where there is none.

    External links, data sets in external files, and virtual data sets. No other file is opened.
    """
    import h5py

    todo, seen = [file], set()
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
            if isinstance(entry, h5py.Group) and (address := h5py.h5o.get_info(entry.id).addr) not in seen:
                seen.add(address)
                todo.append(entry)
    return ""
