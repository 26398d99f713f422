"""A lock on an output folder: one run at a time writes there.

The kernel keeps the lock (flock on a file in the folder) and releases it when the process ends, in whatever way. So a
lock file that a killed run left behind means nothing. Rank 0 alone takes the lock.
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

LOCK = ".fracsim.lock"
PATIENCE = 0.3  # s that a lock is tried for: who asks whether a run goes on holds it for a moment
# a file system without locks, such as NFS or Lustre mounted without them
_UNSUPPORTED = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL)


class _Handle:
    """A lock that this process holds; it goes with the last reference."""

    def __init__(self, path: Path, descriptor: int) -> None:
        self._path, self._descriptor, self._process = path, descriptor, os.getpid()

    def __del__(self) -> None:
        self.close()

    def close(self) -> None:
        """Give the lock back."""
        if self._descriptor < 0:
            return
        if os.getpid() == self._process:  # a child shares the lock, and must not end it
            with contextlib.suppress(OSError):
                os.unlink(self._path)  # while the lock is held: nobody else can hold this very file
        with contextlib.suppress(OSError):
            os.close(self._descriptor)
        self._descriptor = -1


_of_process: WeakValueDictionary[Path, _Handle] = WeakValueDictionary()  # by folder


@atexit.register
def _close_all() -> None:
    """No lock file stays behind a process that ends by itself."""
    for handle in list(_of_process.values()):
        handle.close()


class FolderLock:
    """The lock on a folder. Several in one process share it.

    Attributes:
        folder: that is locked.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._handle: _Handle | None = None

    def acquire(self, *, make: bool = False) -> bool:
        """Take the lock; returns whether this object has not held it before. `make`: the folder, where it is missing.

        A folder that is not there is not locked, without `make`; one whose file system has no locks is not either, with
        a note. InputError where another process holds the lock, or where nothing can be written.
        """
        if self._handle is not None:
            return False
        try:
            if make:
                self.folder.mkdir(parents=True, exist_ok=True)
            elif not self.folder.is_dir():
                return False
            self._handle = _locked(self.folder.resolve(), self.folder)
        except OSError as error:
            raise InputError(f"--out {self.folder}: cannot write there: {error.strerror}") from None
        return True

    def release(self) -> None:
        """Give the lock back; nothing where it is not held."""
        self._handle = None

    def __enter__(self) -> FolderLock:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


def claim(lock: FolderLock, check: Callable[[], object], *, make: bool = False) -> None:
    """Take a lock on a folder that passes a check, and passes it still once the lock is held. Raises InputError."""
    if not make:
        if os.path.lexists(lock.folder / LOCK):  # a run that goes on is to be told of before what it has written
            lock.acquire()
        check()
    if lock.acquire(make=make):
        check()


def holder(folder: Path) -> str | None:
    """Who else holds the lock on a folder, in words; None: nobody."""
    if folder.resolve() in _of_process:
        return None
    try:
        descriptor = os.open(folder / LOCK, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError as error:
        return _words(descriptor) if error.errno == errno.EWOULDBLOCK else None
    finally:
        os.close(descriptor)
    return None


def _locked(folder: Path, name: Path) -> _Handle:
    """The lock on a folder that users call `name`."""
    if (held := _of_process.get(folder)) is not None:
        return held
    path, until = folder / LOCK, time.monotonic() + PATIENCE
    while True:
        descriptor = _opened(path, name)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if _is_at(descriptor, path):
                break
        except OSError as error:
            if error.errno in _UNSUPPORTED:
                print(
                    f"fracsim: note: the file system of {name} has no locks ({error.strerror}): see to it that no "
                    "other run writes there",
                    file=sys.stderr,
                )
                break
            if error.errno != errno.EWOULDBLOCK or time.monotonic() > until:
                words = _words(descriptor)
                os.close(descriptor)
                raise InputError(
                    f"--out {name}: a run is going on there ({words}); wait for its end, or give another folder"
                ) from None
        os.close(descriptor)  # of a file that its holder has deleted since, or of one that is held
        time.sleep(0.02)
    with contextlib.suppress(OSError):  # on a full disk nobody is told who holds it
        os.ftruncate(descriptor, 0)
        since = time.strftime("%Y-%m-%d %H:%M:%S")
        os.pwrite(descriptor, f"process {os.getpid()} on {socket.gethostname()}, since {since}\n".encode(), 0)
    _of_process[folder] = handle = _Handle(path, descriptor)
    return handle


def _opened(path: Path, name: Path) -> int:
    """A descriptor of the lock file, which is a plain file. Raises OSError, InputError."""
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


def _is_at(descriptor: int, path: Path) -> bool:
    """Whether a path still leads to the file of a descriptor."""
    try:
        return os.path.samestat(os.fstat(descriptor), os.lstat(path))
    except FileNotFoundError:
        return False


def _words(descriptor: int) -> str:
    """What the holder has written of itself."""
    text = os.pread(descriptor, 200, 0).decode(errors="replace").strip()
    return text or "of a process that did not say which"
