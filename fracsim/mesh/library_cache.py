"""The folder of compiled libraries, those of FFCx and of fracsim: its place, its access rights, and undamaged files.

A library is code, so that whoever may write it decides what a run does: libraries that others may write are refused. A
loss of power or a full disk leaves incomplete libraries, and loading one may end the process by SIGBUS. Therefore a
library is checked before it is loaded: against the digest in a file beside it or, without one, by the table at the end
of an ELF file. Damaged files are removed and compiled again.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import stat
import struct
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path
from typing import Any

from dolfinx.jit import get_options
from mpi4py import MPI

from ..errors import CannotWrite, InputError

WRITABLE_BY_OTHERS = stat.S_IWGRP | stat.S_IWOTH


def library_folder() -> Path:
    """Folder of compiled libraries: DOLFINx's or, with a note, a private one if that cannot be written.

    Raises InputError if other users may write there.
    """
    return _checked_folder(Path(get_options()["cache_dir"]))


@cache
def _checked_folder(folder: Path) -> Path:
    folder = folder.absolute()
    if _can_be_written(folder):
        _make_private(folder)
        return folder
    temporary = Path(tempfile.gettempdir()) / f"fracsim-{os.getuid()}"
    if not _can_be_written(temporary):
        raise InputError(
            f"compiled kernels cannot be kept: neither {folder} nor {temporary} can be written; name a "
            f"folder that can, such as XDG_CACHE_HOME=/scratch/me"
        )
    _make_private(temporary)
    print_note(
        f"compiled kernels are kept in {temporary}: {folder} cannot be written; XDG_CACHE_HOME names another folder"
    )
    return temporary


def _can_be_written(folder: Path) -> bool:
    """Whether files can be created in a folder, or the folder itself."""
    existing = next(path for path in (folder, *folder.parents) if os.path.lexists(path))
    return existing.is_dir() and os.access(existing, os.W_OK | os.X_OK)


def _make_private(folder: Path) -> None:
    """Create the folder if it is missing; InputError if other users may write in it."""
    try:
        with private_umask():
            folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CannotWrite(f"the folder of compiled kernels {folder} cannot be made: {error.strerror}") from None
    _check_owner(folder)


def _check_owner(path: Path) -> None:
    """Raise InputError if a user other than this one and root owns a path, or may write it."""
    status = path.stat()
    if status.st_uid not in (os.getuid(), 0):
        who = f"belongs to user {status.st_uid}"
    elif status.st_mode & WRITABLE_BY_OTHERS:
        who = f"may be written by others (mode {stat.S_IMODE(status.st_mode):o})"
    else:
        return
    folder = path if path.is_dir() else path.parent
    raise InputError(
        f"{path} {who}, and what is compiled there is run; `chmod -R go-w {folder}` if you trust what is in it, remove "
        f"it, or name a folder of your own, such as XDG_CACHE_HOME=~/.cache"
    )


@contextmanager
def private_umask() -> Iterator[None]:
    """Context in which new files and folders cannot be written by other users."""
    before = os.umask(0o077)
    os.umask(before | 0o022)
    try:
        yield
    finally:
        os.umask(before)


def is_disk_full(folder: Path) -> bool:
    """Whether a file system is full."""
    status = os.statvfs(folder)
    # bytes of free space below which a compiler's failure is taken for that of a full disk
    return status.f_bavail * status.f_frsize < 1 << 20


def print_note(text: str) -> None:
    """Print a note on rank 0."""
    if MPI.COMM_WORLD.rank == 0:
        print(f"fracsim: note: {text}", file=sys.stderr, flush=True)


# --- whether files are whole ----------------------------------------------------------------------------------------


def is_complete(library: Path, *sources: Path) -> bool:
    """Whether a library, and sources that are read with it, are undamaged; False if one is missing.

    Raises InputError if other users may write one of them.
    """
    contents = []
    for path in (library, *sources):
        if not path.is_file():
            return False
        _check_owner(path)
        contents.append(path.read_bytes())
    seal = _digest_path(library)
    if seal.is_file():
        return seal.read_bytes() == _digest(contents)
    if not _is_elf(contents[0]) or not all(contents):
        return False
    _write_digests(seal, contents)
    return True


def write_digest(library: Path, *sources: Path) -> None:
    """Write the digest of a library, and of sources that are read with it, beside the library."""
    _write_digests(_digest_path(library), [path.read_bytes() for path in (library, *sources)])


def _digest_path(library: Path) -> Path:
    return library.with_name(library.name.split(".")[0] + ".sha256")


def _write_digests(seal: Path, contents: Sequence[bytes]) -> None:
    """Write a digest in one step; a full disk goes without."""
    fresh = seal.with_suffix(f".{os.getpid()}")
    with suppress(OSError), private_umask():
        fresh.write_bytes(_digest(contents))
        fresh.replace(seal)
    with suppress(OSError):
        fresh.unlink()


def _digest(contents: Sequence[bytes]) -> bytes:
    digest = hashlib.sha256()
    for content in contents:
        digest.update(content)
    return digest.hexdigest().encode()


def _is_elf(content: bytes) -> bool:
    """Whether a 64-bit ELF file is complete, that is, contains its section headers, which linkers write last."""
    if len(content) < 64 or content[:5] != b"\x7fELF\x02":
        return False
    order = "<" if content[5] == 1 else ">"
    (section_offset,) = struct.unpack_from(f"{order}Q", content, 0x28)
    size, count = struct.unpack_from(f"{order}HH", content, 0x3A)
    return section_offset > 0 and len(content) >= section_offset + size * count


# --- processes that compile at the same time ------------------------------------------------------------------------


@contextmanager
def exclusive_access(folder: Path, name: str) -> Iterator[None]:
    """Context that only one process at a time, of all ranks and jobs, enters for the library of a name.

    It is entered without a lock on a file system that has none, and after a minute of waiting: two compilations of one
    library do no harm.
    """
    position = int(hashlib.sha256(name.encode()).hexdigest()[:12], 16)
    try:
        with private_umask():
            lock = os.open(folder / "fracsim.lock", os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    except OSError:
        yield
        return
    try:
        # waits for 60 s at most
        deadline = time.monotonic() + 60.0
        while not _locked(lock, position) and time.monotonic() < deadline:
            time.sleep(0.02)
        yield
    finally:
        os.close(lock)


def _locked(lock: int, place: int) -> bool:
    """Whether this process has the lock now, or the file system has no locks."""
    try:
        fcntl.lockf(lock, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, place)
    except (BlockingIOError, PermissionError):
        return False
    except OSError:
        pass
    return True


# --- FFCx's libraries -----------------------------------------------------------------------------------------------


def load_kernel[Module](look_up: Callable[[], tuple[Any, Module]], folder: Path, name: str) -> tuple[Any, Module]:
    """Result of FFCx's `look_up` of a kernel in a folder, where damaged kernels have been removed."""
    if remove_damaged_kernel(folder, name):
        print_note(f"the library {folder / name}.* was damaged; it is compiled once more")
    try:
        return look_up()
    except (ImportError, AttributeError) as error:
        # undamaged, but of another machine or Python
        with exclusive_access(folder, name):
            remove_kernel(folder, name)
        print_note(f"the library {folder / name}.* cannot be loaded ({error}); it is compiled once more")
        return look_up()


def remove_damaged_kernel(folder: Path, name: str) -> bool:
    """Remove the files of a compiled kernel of FFCx if it is damaged; return whether they were removed."""
    ready = folder / f"{name}.c.cached"
    if not ready.exists() or _is_kernel_complete(folder, name):
        return False
    with exclusive_access(folder, name):
        if not ready.exists() or _is_kernel_complete(folder, name):
            return False
        remove_kernel(folder, name)
    return True


def _is_kernel_complete(folder: Path, name: str) -> bool:
    library = kernel_file(folder, name)
    return library is not None and is_complete(library, folder / f"{name}.c")


def kernel_file(folder: Path, name: str) -> Path | None:
    """Library of a kernel of FFCx; None if there is none."""
    files = (folder / f"{name}{suffix}" for suffix in EXTENSION_SUFFIXES)
    return next((path for path in files if path.exists()), None)


def remove_kernel(folder: Path, name: str) -> None:
    """Remove all files of a kernel of FFCx."""
    # the C file last: by it other processes know that the kernel is compiled
    for path in sorted(folder.glob(f"{name}.*"), key=lambda path: path.suffix == ".c"):
        path.unlink(missing_ok=True)
