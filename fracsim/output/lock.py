"""Lock on an output folder: one run at a time writes there.

The kernel keeps the lock (flock on a file in the folder) and releases it when the process ends, also if it is killed.
So a lock file without a living process has no effect. Only rank 0 takes the lock.
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import fcntl
import os
import socket
import stat
import sys
import time
from collections.abc import Callable
from pathlib import Path
from weakref import WeakValueDictionary

from ..errors import InputError

LOCK_FILE = ".fracsim.lock"
# error numbers of file systems without locks, such as NFS or Lustre mounted without them
_UNSUPPORTED = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL)


class _LockHandle:
    """Lock that this process holds. It is released with the last reference."""

    def __init__(self, path: Path, descriptor: int) -> None:
        self._path, self._descriptor, self._process = path, descriptor, os.getpid()

    def __del__(self) -> None:
        self.close()

    def close(self) -> None:
        """Release the lock and delete the lock file."""
        if self._descriptor < 0:
            return
        # a forked child shares the lock and must not end it
        if os.getpid() == self._process:
            with contextlib.suppress(OSError):
                # still locked here, so no other process can hold this very file
                os.unlink(self._path)
        with contextlib.suppress(OSError):
            os.close(self._descriptor)
        self._descriptor = -1


# locks of this process by folder
_handles: WeakValueDictionary[Path, _LockHandle] = WeakValueDictionary()


@atexit.register
def _close_all() -> None:
    """Delete the lock files of a process that ends normally."""
    for handle in list(_handles.values()):
        handle.close()


class FolderLock:
    """Lock on a folder. Several locks of one process on the same folder share it.

    Attributes:
        folder: the folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._handle: _LockHandle | None = None

    def acquire(self, *, make: bool = False) -> bool:
        """Take the lock; returns True unless this object holds it already.

        A missing folder is not locked. On a file system without locks a note is printed instead.

        Args:
            make: create the folder if it is missing.

        Raises:
            InputError: another process holds the lock, or the folder cannot be written to.
        """
        if self._handle is not None:
            return False
        try:
            if make:
                self.folder.mkdir(parents=True, exist_ok=True)
            elif not self.folder.is_dir():
                return False
            self._handle = _take_lock(self.folder.resolve(), self.folder)
        except OSError as error:
            raise InputError(f"--out {self.folder}: cannot write there: {error.strerror}") from None
        return True

    def release(self) -> None:
        """Release the lock if it is held."""
        self._handle = None

    def __enter__(self) -> FolderLock:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


def lock_checked_folder(lock: FolderLock, check: Callable[[], object], *, make: bool = False) -> None:
    """Take a lock on a folder that passes a check before and after locking.

    Args:
        lock: the lock.
        check: raises InputError if the folder must not be used.
        make: create the folder if it is missing; without the check before locking.

    Raises:
        InputError: the check failed, or another process holds the lock.
    """
    if not make:
        # an active run is reported before the files that it has written
        if os.path.lexists(lock.folder / LOCK_FILE):
            lock.acquire()
        check()
    if lock.acquire(make=make):
        check()


def describe_lock_holder(folder: Path) -> str | None:
    """Description of another process that holds the lock on a folder; None if there is none."""
    if folder.resolve() in _handles:
        return None
    try:
        descriptor = os.open(folder / LOCK_FILE, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError as error:
        return _read_holder(descriptor) if error.errno == errno.EWOULDBLOCK else None
    finally:
        os.close(descriptor)
    return None


def _take_lock(folder: Path, name: Path) -> _LockHandle:
    """Lock on a folder.

    Args:
        folder: resolved path.
        name: path as the user gave it, for messages.
    """
    if (shared := _handles.get(folder)) is not None:
        return shared
    # 0.3 s, since a process that only asks whether a run is active holds the lock for a moment
    path, deadline = folder / LOCK_FILE, time.monotonic() + 0.3
    while True:
        descriptor = _open_lock_file(path, name)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if _is_file_at(descriptor, path):
                break
        except OSError as error:
            if error.errno in _UNSUPPORTED:
                print(
                    f"fracsim: note: the file system of {name} has no locks ({error.strerror}): see to it that no "
                    "other run writes there",
                    file=sys.stderr,
                )
                break
            if error.errno != errno.EWOULDBLOCK or time.monotonic() > deadline:
                holder = _read_holder(descriptor)
                os.close(descriptor)
                raise InputError(
                    f"--out {name}: a run is going on there ({holder}); wait for its end, or give another folder"
                ) from None
        # the holder has deleted this file since, or holds it still
        os.close(descriptor)
        time.sleep(0.02)
    # on a full disk the holder cannot be written, and the lock holds all the same
    with contextlib.suppress(OSError):
        os.ftruncate(descriptor, 0)
        since = time.strftime("%Y-%m-%d %H:%M:%S")
        os.pwrite(descriptor, f"process {os.getpid()} on {socket.gethostname()}, since {since}\n".encode(), 0)
    _handles[folder] = handle = _LockHandle(path, descriptor)
    return handle


def _open_lock_file(path: Path, name: Path) -> int:
    """Descriptor of the lock file. Raises InputError if it is not a regular file, and OSError."""
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o644)
    except OSError as error:
        if error.errno not in (errno.ELOOP, errno.EISDIR, errno.ENXIO):
            raise
        descriptor = -1
    if descriptor < 0 or not stat.S_ISREG(os.fstat(descriptor).st_mode) or os.fstat(descriptor).st_nlink > 1:
        if descriptor >= 0:
            os.close(descriptor)
        raise InputError(f"--out {name}: {path} is not a plain file (a link?); delete it, or give another folder")
    return descriptor


def _is_file_at(descriptor: int, path: Path) -> bool:
    """True if the path still leads to the open file."""
    try:
        return os.path.samestat(os.fstat(descriptor), os.lstat(path))
    except FileNotFoundError:
        return False


def _read_holder(descriptor: int) -> str:
    """Description of the holder in the lock file."""
    text = os.pread(descriptor, 200, 0).decode(errors="replace").strip()
    return text or "of a process that did not say which"
