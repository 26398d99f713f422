"""Calls with a time limit in another process: a library such as gmsh or VTK cannot be stopped otherwise."""

from __future__ import annotations

import ctypes
import mmap
import os
import pickle
import resource
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from typing import Any, BinaryIO

from .data import MeshError


@dataclass(frozen=True)
class ReaderLimits:
    """Time and memory that a process may take to read a file, beside what depends on the reader."""

    seconds: float = 60.0  # for the smallest file, on a machine with other work
    memory: int = 4 << 30  # bytes, for the reader with its libraries
    memory_per_byte: int = 64  # of the file: compressed data grow


READER_LIMITS = ReaderLimits()
_PR_SET_PDEATHSIG = 1  # <sys/prctl.h>


class ProcessDiedError(MeshError):
    """A process that ended before it returned.

    Attributes:
        how: "signal 11" or "exit code 1".
    """

    def __init__(self, how: str, output: str = "") -> None:
        super().__init__(f"gmsh died ({how}{': ' if output else ''}{output}); is there enough memory? Try a larger h.")
        self.how = how


def call_with_time_limit[T](seconds: float, work: Callable[..., T], *arguments: Any, memory: int | None = None) -> T:
    """The result of work(*arguments) in another Python process; its exceptions are raised here.

    Args:
        seconds: time limit.
        work: a function of a module.
        arguments: of the function; they and the result are pickled.
        memory: bytes that the process may address; None: no limit.

    Raises:
        TimeoutError: the function had not returned after `seconds`.
        ProcessDiedError: the process died of another cause, such as a fault within a library or lack of memory.
    """
    command = [sys.executable, "-P", "-m", __name__]  # -P: no module of the same name in the working folder
    task = pickle.dumps((max(1, ceil(seconds)), memory, os.getpid(), work, arguments))
    # the answer goes through memory that both processes map: arrays are not copied
    with open(os.memfd_create("answer"), "rb") as answer:
        command.append(str(answer.fileno()))
        done = subprocess.run(command, input=task, capture_output=True, check=False, pass_fds=[answer.fileno()])
        if done.returncode == -signal.SIGALRM:
            raise TimeoutError
        if done.returncode:
            output = done.stderr.decode(errors="replace").strip()[-300:]
            how = f"signal {-done.returncode}" if done.returncode < 0 else f"exit code {done.returncode}"
            raise ProcessDiedError(how, output)
        result, failure = _unpack(answer)
    if failure is not None:
        raise failure
    return result


def read_with_time_limit[T](
    path: Path,
    reader: Callable[[Path], T],
    program: str,
    *,
    seconds_per_megabyte: float = 1.0,
    limits: ReaderLimits = READER_LIMITS,
    advice: str = "Export it again.",
) -> T:
    """The result of reader(path) in another process, with limits of time and memory that grow with the file.

    Raises:
        MeshError: raised by the reader, or the process exceeded a limit or died; the message names `program`.
    """
    size = path.stat().st_size
    seconds = limits.seconds + seconds_per_megabyte * size / 1e6
    try:
        return call_with_time_limit(seconds, reader, path, memory=limits.memory + limits.memory_per_byte * size)
    except ProcessDiedError as died:
        reason = f"{program} died ({died.how}); the file is damaged, or there is not enough memory"
    except TimeoutError:
        reason = f"{program} did not end within {seconds:.0f} s; the file is damaged"
    raise MeshError(f"Mesh file '{path}' could not be read: {reason}. {advice}")


def _pack(answer: Any, file: BinaryIO) -> None:
    """Write an object: its arrays, each at the start of a page, then its pickle, then the offsets of all these."""
    arrays: list[pickle.PickleBuffer] = []
    stream = pickle.dumps(answer, protocol=5, buffer_callback=arrays.append)
    extents = []
    for array in arrays:
        file.seek(-file.tell() % mmap.PAGESIZE, os.SEEK_CUR)
        extents.append((file.tell(), file.write(array.raw())))
    begin = file.tell()
    file.write(stream)
    pickle.dump((begin, extents), file)
    file.write((file.tell() - begin - len(stream)).to_bytes(8))


def _unpack(file: BinaryIO) -> tuple[Any, Any]:
    """The object that `_pack` wrote; its arrays are the pages of the file, not copied, and writable."""
    pages = memoryview(mmap.mmap(file.fileno(), 0, mmap.MAP_PRIVATE, mmap.PROT_READ | mmap.PROT_WRITE))
    end = len(pages) - 8
    end -= int.from_bytes(pages[end:])
    begin, extents = pickle.loads(pages[end:])
    answer: tuple[Any, Any] = pickle.loads(
        pages[begin:end], buffers=[pages[point : point + size] for point, size in extents]
    )
    return answer


def _serve() -> None:
    """Run the task on standard input and write the answer into the file descriptor of the command line."""
    seconds, memory, parent, work, arguments = pickle.load(sys.stdin.buffer)
    signal.alarm(seconds)  # ends this process also within compiled code
    if memory is not None:
        resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)  # not to outlive the caller
    if os.getppid() != parent:
        return
    result, failure = None, None
    try:
        result = work(*arguments)
    except Exception as error:
        failure = error
    with open(int(sys.argv[1]), "wb") as answer:
        _pack((result, failure), answer)


if __name__ == "__main__":
    _serve()
