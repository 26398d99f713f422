"""Writing so that nothing is lost: whole files take the place of old ones, and a failure says what, why and where."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Callable, Iterator
from io import RawIOBase
from pathlib import Path
from typing import Any

from mpi4py import MPI

from ..errors import CannotWrite
from ..mesh.parallel import on_root
from ..meshes.plain_files import MISSING, NotAFile, replacing, wrong_with

ROOM = 6 << 10  # bytes that HDF5 may need beside the values of one array, most of it for an attribute that is text


def replace_text(path: Path, text: str) -> None:
    """Write a text file in one go."""
    with replacing(path) as new:
        new.write_text(text, encoding="utf-8", newline="")


def written[T](comm: MPI.Comm, path: Path, work: Callable[[], T]) -> T | None:
    """`work` on rank 0, which writes `path`. Raises CannotWrite on all ranks alike (collective)."""

    def guarded() -> T:
        try:
            return work()
        except OSError as error:
            raise CannotWrite(f"could not write {path}: {reason(error)}") from error

    return on_root(comm, guarded)


def reason(error: Exception) -> str:
    """Why a file could not be written, in the words of the system."""
    if isinstance(error, NotAFile):
        return str(error.strerror)
    number = getattr(error, "errno", None)
    return os.strerror(number) if number else str(error)


def append(path: Path, text: bytes, over: int = 0) -> None:
    """Write `text` in place of the last `over` bytes; where that fails (OSError) the file is as it was."""
    with open(path, "r+b", buffering=0, opener=_no_link) as file:
        at = file.seek(-over, os.SEEK_END)
        tail = file.read()
        file.seek(at)
        try:
            write_all(file, text)
        except OSError:
            file.seek(at)
            file.write(tail)
            file.truncate(at + over)
            raise


def open_to_append(path: Path) -> RawIOBase:
    """A plain file, to be written at its end. Raises OSError."""
    return open(path, "ab", buffering=0, opener=_no_link)


def _no_link(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NOFOLLOW, 0o666)


def write_all(file: RawIOBase, text: bytes) -> None:
    """A raw file takes what there is room for, and refuses the next piece."""
    rest = memoryview(text)
    while rest:
        rest = rest[file.write(rest) :]


def hdf5_there(path: Path) -> Any:
    """An HDF5 file, to be read. h5py is imported by the rank that reads or writes one."""
    import h5py

    return h5py.File(path)


@contextlib.contextmanager
def hdf5_file(path: Path, size: int, *, begin: bool = False) -> Iterator[Any]:
    """An HDF5 file that is to take `size` more bytes; `begin`: a new one. OSError where it cannot, on closing too.

    HDF5 that meets a full disk cannot close its file, and all that was in it is lost; so room is looked for before.
    """
    import h5py

    if (wrong := "is a link, not a file" if path.is_symlink() else wrong_with(path)) not in ("", MISSING):
        raise NotAFile(path, wrong)
    try:
        if begin:
            h5py.File(path, "w").close()
        _find_room(path, size)
        with h5py.File(path, "r+") as file:
            yield file
    except RuntimeError as error:  # h5py's, where closing fails
        raise OSError(str(error)) from error


def _find_room(path: Path, size: int) -> None:
    """OSError where the file has no room for `size` more bytes; it stays as it is.

    The room is given back at once: HDF5 would cut the file to size between two of its writes, and the longer it takes
    for these the likelier is a file that cannot be read after a kill.
    """
    with path.open("r+b") as file:
        before = file.seek(0, os.SEEK_END)
        try:
            os.posix_fallocate(file.fileno(), before, size)
        except OSError as error:
            if error.errno not in (errno.EOPNOTSUPP, errno.EINVAL, errno.ENOSYS):  # a file system that cannot tell
                raise
        finally:
            os.ftruncate(file.fileno(), before)
