"""A process that has imported the libraries of the readers of meshes, and forks for each call with a time limit.

`call_with_time_limit` starts a Python for each file, which takes ten times as long as a small file. Limits, signals and
exit codes are those of a process of its own here, too.
"""

from __future__ import annotations

import io
import os
import pickle
import socket
import subprocess
import sys
import traceback
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

from fracsim.meshes import time_limit

VTK = ("util.numpy_support", "vtkFiltersCore", "vtkIOExodus", "vtkIOHDF", "vtkIOLegacy", "vtkIOXML")
LIBRARIES = ("h5py", "meshio", "gmsh", "pymeshfix", "manifold3d", *(f"vtkmodules.{name}" for name in VTK))


class ForkedReaders:
    """In the place of the module `subprocess` in `fracsim.meshes.time_limit`. The process starts when first asked."""

    def __init__(self) -> None:
        self._socket: socket.socket | None = None

    def run(self, command: list[str], *, input: bytes, pass_fds: list[int], **_: Any) -> Any:
        if self._socket is None:
            self._socket = self._started()
        socket.send_fds(self._socket, [b"+"], pass_fds)
        with self._socket.makefile("rwb") as stream:
            pickle.dump((os.getpid(), Path.cwd(), dict(os.environ), input), stream)
            stream.flush()
            code, output = pickle.load(stream)
        return subprocess.CompletedProcess(command, code, b"", output)

    def close(self) -> None:
        """The process ends with its socket."""
        if self._socket is not None:
            self._socket.close()
            self._process.wait()

    def _started(self) -> socket.socket:
        ours, its = socket.socketpair()
        with its:
            command = [sys.executable, "-m", __name__, str(its.fileno())]
            folder = Path(__file__).resolve().parents[1]
            self._process = subprocess.Popen(command, cwd=folder, pass_fds=[its.fileno()])
        return ours


def serve(number: int) -> None:
    """Fork for each request until the other end is closed."""
    for name in LIBRARIES:
        with suppress(ImportError):
            import_module(name)
    with socket.socket(fileno=number) as requests:
        while True:
            data, answers, _, _ = socket.recv_fds(requests, 1, 1)
            if not data:
                return
            with requests.makefile("rwb") as stream:
                request = pickle.load(stream)
                pickle.dump(forked(answers[0], *request), stream)
            os.close(answers[0])


def forked(answer: int, parent: int, folder: Path, environment: dict[str, str], task: bytes) -> tuple[int, bytes]:
    """Exit code and output of the task in a process of its own."""
    with open(os.memfd_create("output"), "w+b") as output:
        child = os.fork()
        if child == 0:
            os.dup2(output.fileno(), 1)
            os.dup2(output.fileno(), 2)
            os.chdir(folder)
            os.environ.clear()
            os.environ.update(environment)
            os.getppid = lambda: parent  # the parent of this process lives as long as the caller
            sys.stdin, sys.argv = io.TextIOWrapper(io.BytesIO(task)), ["", str(answer)]
            code = 1
            try:
                time_limit._serve()
                code = 0
            except BaseException:
                traceback.print_exc()
            finally:
                os._exit(code)
        _, status = os.waitpid(child, 0)
        output.seek(0)
        return os.waitstatus_to_exitcode(status), output.read()


if __name__ == "__main__":
    serve(int(sys.argv[1]))
