"""Atomic writing: a file is replaced as a whole or not at all, and an error names the file and the reason."""

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
from ..meshes.plain_files import MISSING, NotAPlainFileError, atomic_replacement, unreadable_reason

# Bytes that HDF5 may need beside the values of one array. A text attribute and the index of chunks take most.
HDF5_OVERHEAD_BYTES = 12 << 10


def replace_text(path: Path, text: str) -> None:
    """Write a text file (UTF-8) as a whole in place of the old one. Raises OSError."""
    with atomic_replacement(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="")


def write_on_root[T](comm: MPI.Comm, path: Path, work: Callable[[], T]) -> T | None:
    """Return what `work` returns on rank 0, None on the other ranks (collective).

    Args:
        comm: the ranks that call.
        path: the file that `work` writes, named in the error.
        work: called on rank 0 only.

    Raises:
        CannotWrite: on all ranks, if `work` raised OSError.
    """

    def guarded_work() -> T:
        try:
            return work()
        except OSError as error:
            raise CannotWrite(f"could not write {path}: {error_reason(error)}") from error

    return on_root(comm, guarded_work)


def error_reason(error: Exception) -> str:
    """Reason of a failed file operation, in the words of the operating system."""
    if isinstance(error, NotAPlainFileError):
        return str(error.strerror)
    number = getattr(error, "errno", None)
    return os.strerror(number) if number else str(error)


def append_bytes(path: Path, data: bytes, over: int = 0) -> None:
    """Append `data` to a file, in place of its last `over` bytes. If that fails (OSError), the file is unchanged."""
    with open(path, "r+b", buffering=0, opener=_open_without_link) as file:
        start = file.seek(-over, os.SEEK_END)
        tail = file.read()
        file.seek(start)
        try:
            write_all(file, data)
        except OSError:
            file.seek(start)
            file.write(tail)
            file.truncate(start + over)
            raise


def open_to_append(path: Path) -> RawIOBase:
    """Unbuffered regular file, opened for writing at its end. Raises OSError, also for a symbolic link."""
    return open(path, "ab", buffering=0, opener=_open_without_link)


def _open_without_link(path: str, flags: int) -> int:
    """File descriptor of a path that is not a symbolic link. Raises OSError."""
    return os.open(path, flags | os.O_NOFOLLOW, 0o666)


def write_all(file: RawIOBase, data: bytes) -> None:
    """Write all bytes to an unbuffered file. Raises OSError on a full disk."""
    # a raw write may accept part of the data; the next call then raises
    unwritten = memoryview(data)
    while unwritten:
        unwritten = unwritten[file.write(unwritten) :]


def open_hdf5(path: Path) -> Any:
    """HDF5 file, opened for reading."""
    # imported here, so that only the rank that reads or writes such files loads h5py
    import h5py

    return h5py.File(path)


@contextlib.contextmanager
def writable_hdf5(path: Path, size: int, *, new: bool = False) -> Iterator[Any]:
    """HDF5 file, opened for adding `size` bytes.

    Args:
        path: the file; a symbolic link is refused.
        size: bytes that will be added; the disk must have room for them.
        new: create an empty file first.

    Raises:
        OSError: the file cannot be written, or not be closed.
    """
    import h5py

    if (problem := "is a link, not a file" if path.is_symlink() else unreadable_reason(path)) not in ("", MISSING):
        raise NotAPlainFileError(path, problem)
    try:
        if new:
            h5py.File(path, "w").close()
        # HDF5 cannot close its file on a full disk, and all data in it would be lost
        _check_disk_space(path, size)
        with h5py.File(path, "r+") as file:
            yield file
    # raised by h5py if closing fails
    except RuntimeError as error:
        raise OSError(str(error)) from error


def _check_disk_space(path: Path, size: int) -> None:
    """Raise OSError if the disk has no room to extend the file by `size` bytes. The file stays unchanged."""
    with path.open("r+b") as file:
        length = file.seek(0, os.SEEK_END)
        try:
            os.posix_fallocate(file.fileno(), length, size)
        except OSError as error:
            # these errors mean that the file system does not support the request
            if error.errno not in (errno.EOPNOTSUPP, errno.EINVAL, errno.ENOSYS):
                raise
        finally:
            # The space is released at once. HDF5 would truncate the file between two of its writes, and the longer
            # that takes, the likelier a killed process leaves an unreadable file.
            os.ftruncate(file.fileno(), length)
