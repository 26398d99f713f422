"""The folder of compiled libraries, FFCx's and ours: which it is, who may write there, and which files are whole.

A library is code, and whoever may write it decides what a run does: one that others may write is refused. A machine
that loses power, or a disk that is full, leaves libraries that are cut or empty, and to load a cut one may end the
process by SIGBUS. So a library is looked at before it is loaded: its digest stands in a file beside it, and without one
the table at the end of an ELF file is to be there. What is damaged is removed and compiled once more.
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

OTHERS = stat.S_IWGRP | stat.S_IWOTH


def library_folder() -> Path:
    """Where libraries are kept: DOLFINx's folder, or a private one where that cannot be written, with a note.

    Raises InputError where others may write there.
    """
    return _usable(Path(get_options()["cache_dir"]))


@cache
def _usable(folder: Path) -> Path:
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
    note(f"compiled kernels are kept in {temporary}: {folder} cannot be written; XDG_CACHE_HOME names another folder")
    return temporary


def _can_be_written(folder: Path) -> bool:
    """Whether files can be made there, or the folder itself."""
    existing = next(path for path in (folder, *folder.parents) if os.path.lexists(path))
    return existing.is_dir() and os.access(existing, os.W_OK | os.X_OK)


def _make_private(folder: Path) -> None:
    """Make the folder; InputError where others may write in it."""
    try:
        with not_for_others():
            folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CannotWrite(f"the folder of compiled kernels {folder} cannot be made: {error.strerror}") from None
    _refuse(folder)


def _refuse(path: Path) -> None:
    """InputError where someone else than this user (or root) owns a path, or may write it."""
    status = path.stat()
    if status.st_uid not in (os.getuid(), 0):
        who = f"belongs to user {status.st_uid}"
    elif status.st_mode & OTHERS:
        who = f"may be written by others (mode {stat.S_IMODE(status.st_mode):o})"
    else:
        return
    folder = path if path.is_dir() else path.parent
    raise InputError(
        f"{path} {who}, and what is compiled there is run; `chmod -R go-w {folder}` if you trust what is in it, remove "
        f"it, or name a folder of your own, such as XDG_CACHE_HOME=~/.cache"
    )


@contextmanager
def not_for_others() -> Iterator[None]:
    """While it lasts, what is made cannot be written by others."""
    before = os.umask(0o077)
    os.umask(before | 0o022)
    try:
        yield
    finally:
        os.umask(before)


def no_room(folder: Path) -> bool:
    """Whether a file system is full."""
    status = os.statvfs(folder)
    # bytes of free space below which a compiler's failure is taken for that of a full disk
    return status.f_bavail * status.f_frsize < 1 << 20


def note(text: str) -> None:
    """Say it once a job."""
    if MPI.COMM_WORLD.rank == 0:
        print(f"fracsim: note: {text}", file=sys.stderr, flush=True)


# --- whether files are whole ----------------------------------------------------------------------------------------


def is_whole(library: Path, *sources: Path) -> bool:
    """Whether a library, and sources that are read beside it, are as they were compiled; False where one is missing.

    Raises InputError where others may write one.
    """
    contents = []
    for path in (library, *sources):
        if not path.is_file():
            return False
        _refuse(path)
        contents.append(path.read_bytes())
    seal = _seal(library)
    if seal.is_file():
        return seal.read_bytes() == _digest(contents)
    if not _is_elf(contents[0]) or not all(contents):
        return False
    _write_seal(seal, contents)
    return True


def put_seal(library: Path, *sources: Path) -> None:
    """Keep the digest of what has just been compiled."""
    _write_seal(_seal(library), [path.read_bytes() for path in (library, *sources)])


def _seal(library: Path) -> Path:
    return library.with_name(library.name.split(".")[0] + ".sha256")


def _write_seal(seal: Path, contents: Sequence[bytes]) -> None:
    """Whole or not at all; a folder without room does without."""
    fresh = seal.with_suffix(f".{os.getpid()}")
    with suppress(OSError), not_for_others():
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
    """Whether a file of 64 bits reaches to the end of its section headers, which linkers write last."""
    if len(content) < 64 or content[:5] != b"\x7fELF\x02":
        return False
    order = "<" if content[5] == 1 else ">"
    (section_offset,) = struct.unpack_from(f"{order}Q", content, 0x28)
    size, count = struct.unpack_from(f"{order}HH", content, 0x3A)
    return section_offset > 0 and len(content) >= section_offset + size * count


# --- processes that compile at the same time ------------------------------------------------------------------------


@contextmanager
def alone(folder: Path, name: str) -> Iterator[None]:
    """One process at a time, of all ranks and jobs, has the library of a name to itself.

    A file system without locks, and a process that holds one for more than a minute, stop nobody: two compilations do
    no harm, they only take longer.
    """
    position = int(hashlib.sha256(name.encode()).hexdigest()[:12], 16)
    try:
        with not_for_others():
            lock = os.open(folder / "fracsim.lock", os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    except OSError:
        yield
        return
    try:
        deadline = time.monotonic() + 60.0  # s
        while not _locked(lock, position) and time.monotonic() < deadline:
            time.sleep(0.02)
        yield
    finally:
        os.close(lock)


def _locked(lock: int, place: int) -> bool:
    """Whether the lock is ours now, or there are none on this file system."""
    try:
        fcntl.lockf(lock, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, place)
    except (BlockingIOError, PermissionError):
        return False
    except OSError:
        pass
    return True


# --- FFCx's libraries -----------------------------------------------------------------------------------------------


def load_whole[Module](look_up: Callable[[], tuple[Any, Module]], folder: Path, name: str) -> tuple[Any, Module]:
    """What FFCx's `look_up` of a kernel in a folder returns; a damaged one is removed before, so that FFCx compiles it
    once more."""
    if remove_damaged(folder, name):
        note(f"the library {folder / name}.* was damaged; it is compiled once more")
    try:
        return look_up()
    except (ImportError, AttributeError) as error:  # whole, and not to be loaded: of another machine or Python
        with alone(folder, name):
            remove_kernel(folder, name)
        note(f"the library {folder / name}.* cannot be loaded ({error}); it is compiled once more")
        return look_up()


def remove_damaged(folder: Path, name: str) -> bool:
    """Remove a kernel of FFCx's that was compiled and is not whole; whether it did."""
    ready = folder / f"{name}.c.cached"
    if not ready.exists() or _kernel_is_whole(folder, name):
        return False
    with alone(folder, name):
        if not ready.exists() or _kernel_is_whole(folder, name):
            return False
        remove_kernel(folder, name)
    return True


def _kernel_is_whole(folder: Path, name: str) -> bool:
    library = kernel_file(folder, name)
    return library is not None and is_whole(library, folder / f"{name}.c")


def kernel_file(folder: Path, name: str) -> Path | None:
    """The library of one of FFCx's kernels, None where there is none."""
    files = (folder / f"{name}{suffix}" for suffix in EXTENSION_SUFFIXES)
    return next((path for path in files if path.exists()), None)


def remove_kernel(folder: Path, name: str) -> None:
    """Remove all files of one of FFCx's kernels; the C file, by which others know that one is compiled, last."""
    for path in sorted(folder.glob(f"{name}.*"), key=lambda path: path.suffix == ".c"):
        path.unlink(missing_ok=True)
