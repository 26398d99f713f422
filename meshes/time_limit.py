"""Work with a time limit, in a process of its own: what runs inside gmsh's or VTK's library nothing else can stop."""

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
from math import ceil
from pathlib import Path
from typing import Any, BinaryIO

from .data import MeshError

MEMORY, MEMORY_PER_BYTE = 4 << 30, 64  # of a reader with its libraries; compressed files grow
_PR_SET_PDEATHSIG = 1  # <sys/prctl.h>


class ProcessDiedError(MeshError):
    """A process that ended before its work was done."""

    def __init__(self, how: str, said: str = "") -> None:
        """`how`: "signal 11" or "exit code 1"; `said`: the end of what it printed."""
        super().__init__(f"gmsh died ({how}{': ' if said else ''}{said}); is there enough memory? Try a larger h.")
        self.how = how


def within[T](seconds: float, work: Callable[..., T], *arguments: Any, memory: int | None = None) -> T:
    """work(*arguments), a function of a module, done by another Python process; its exceptions are raised here.

    `memory`: bytes that the process may address; None: any number.

    Raises:
        TimeoutError: it was not done after `seconds`.
        ProcessDiedError: the process died of something else, such as a fault within a library or want of memory.
    """
    command = [sys.executable, "-P", "-m", __name__]  # -P: not a folder of the same name that lies here
    task = pickle.dumps((max(1, ceil(seconds)), memory, os.getpid(), work, arguments))
    with open(os.memfd_create("answer"), "rb") as answer:
        command.append(str(answer.fileno()))
        done = subprocess.run(command, input=task, capture_output=True, check=False, pass_fds=[answer.fileno()])
        if done.returncode == -signal.SIGALRM:
            raise TimeoutError
        if done.returncode:
            said = done.stderr.decode(errors="replace").strip()[-300:]
            how = f"signal {-done.returncode}" if done.returncode < 0 else f"exit code {done.returncode}"
            raise ProcessDiedError(how, said)
        result, failure = _unpacked(answer)
    if failure is not None:
        raise failure
    return result


def read_with_time_limit[T](
    path: Path, reader: Callable[[Path], T], program: str, seconds: float, advice: str = "Export it again."
) -> T:
    """reader(path), done by another process for `seconds` at most; with 4 GiB and 64 times the file's size of memory.

    Raises:
        MeshError: of the reader, or the process did not come to an end, or died; the message names `program`.
    """
    try:
        return within(seconds, reader, path, memory=MEMORY + MEMORY_PER_BYTE * path.stat().st_size)
    except ProcessDiedError as died:
        why = f"{program} died ({died.how}); the file is damaged, or there is not enough memory"
    except TimeoutError:
        why = f"{program} did not end within {seconds:.0f} s; the file is damaged"
    raise MeshError(f"Mesh file '{path}' could not be read: {why}. {advice}")


def _pack(answer: Any, file: BinaryIO) -> None:
    """Write an object: its arrays, each from a whole page on, then its pickle, then where these begin."""
    arrays: list[pickle.PickleBuffer] = []
    stream = pickle.dumps(answer, protocol=5, buffer_callback=arrays.append)
    positions = []
    for item in arrays:
        file.seek(-file.tell() % mmap.PAGESIZE, os.SEEK_CUR)
        positions.append((file.tell(), file.write(item.raw())))
    begin = file.tell()
    file.write(stream)
    pickle.dump((begin, positions), file)
    file.write((file.tell() - begin - len(stream)).to_bytes(8))


def _unpacked(file: BinaryIO) -> tuple[Any, Any]:
    """The object in a file; its arrays lie in the pages of the file, without a copy, and can be written to."""
    pages = memoryview(mmap.mmap(file.fileno(), 0, mmap.MAP_PRIVATE, mmap.PROT_READ | mmap.PROT_WRITE))
    end = len(pages) - 8
    end -= int.from_bytes(pages[end:])
    begin, positions = pickle.loads(pages[end:])
    answer: tuple[Any, Any] = pickle.loads(
        pages[begin:end], buffers=[pages[point : point + size] for point, size in positions]
    )
    return answer


def _serve() -> None:
    """Do the task on standard input; the answer goes into the open file of the number on the command line.

    The kernel's alarm ends this process, also in the middle of compiled code.
    """
    seconds, memory, parent, work, arguments = pickle.load(sys.stdin.buffer)
    signal.alarm(seconds)
    if memory is not None:
        resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)  # nobody waits for the answer any more
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
