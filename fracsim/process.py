"""How the process of a command begins and ends.

What no run needs is not imported, and nothing is taken apart that goes with the process anyway: a tenth of what a small
job takes, or less. Standard streams that are closed, or that nobody reads any more, do not end a command. Signals are
heeded from the first moment of a run, and a crash ends the process.
"""

from __future__ import annotations

import atexit
import errno
import gc
import importlib
import io
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from types import FrameType, ModuleType
from typing import Any, NoReturn, TextIO

from .errors import STOP_SIGNALS, Exit, InputError

DOLFINX = "0.9"
INTERRUPTED = 130  # as typer and shells report SIGINT
_READER_GONE = (errno.EPIPE, errno.EIO)  # EIO: of a terminal that was closed
# control characters but for tabs and ends of lines, and those that turn the direction of writing
_CONTROLS = {*range(0x20), *range(0x7F, 0xA0), 0x200E, 0x200F, *range(0x202A, 0x202F), *range(0x2066, 0x206A)}
_ESCAPES = {code: ascii(chr(code))[1:-1] for code in _CONTROLS - {*map(ord, "\t\n\r")}}
_FIRST_RANK_SPEAKS = 0.3  # s that other ranks wait before they end: the launcher ends all ranks with the first


# --- its start ---


def start_process() -> None:
    """Prepare the process of a command line: streams, home folder, signals. Raises InputError."""
    global _own
    _own = True
    runs = sys.argv[1:2] == ["run"]
    _open_streams(None if runs else _READER_GONE)
    if runs:
        _heed_signals()
    _check_surroundings()


def _heed_signals() -> None:
    """Until the run takes over, of a process that runs."""
    for number in STOP_SIGNALS if sys.argv[1:2] == ["run"] else ():
        if signal.getsignal(number) is not signal.SIG_IGN:  # ignored: by nohup
            signal.signal(number, _end_before_the_run)


_PARENT = os.getppid()
_RANK = ("OMPI_COMM_WORLD_RANK", "PMI_RANK", "PMIX_RANK")  # variables that tell a process its rank
_own = False  # whether this process was started as a command line
_run_begun = False


def _open_streams(dropped: tuple[int, ...] | None) -> None:
    """Open standard streams that are closed, on nothing: files of the run would take their numbers. `dropped`: numbers
    of errors after which output is dropped; None: all, for a run is worth more than the words about it."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
    sys.stdout = _open_stream(sys.stdout, 1, dropped)
    sys.stderr = _open_stream(sys.stderr, 2, None)


def _open_stream(stream: TextIO | None, number: int, dropped: tuple[int, ...] | None) -> TextIO:
    if stream is None:
        return open(os.devnull, "w", encoding="utf-8")
    return _Stream(stream, number, dropped) if isinstance(stream, io.TextIOWrapper) else stream


class _Stream(io.TextIOWrapper):
    """A standard stream whose text is dropped once it cannot be written: a command whose reader has gone goes on.

    Control characters are written as escapes: a terminal would obey those in a name or title of a file, and in what a
    traceback or a library says of one.
    """

    def __init__(self, stream: io.TextIOWrapper, number: int, dropped: tuple[int, ...] | None) -> None:
        """`number`: of its descriptor; `dropped`: numbers of errors after which text is dropped; None: all."""
        buffered = stream.line_buffering
        super().__init__(stream.buffer, stream.encoding, "backslashreplace", line_buffering=buffered)
        self._number, self._dropped = number, dropped

    def write(self, text: str) -> int:
        """Write text; returns its length."""
        try:
            super().write(text if text.isprintable() else text.translate(_ESCAPES))
            return len(text)
        except OSError as error:
            self._drop(error)
            return len(text)

    def flush(self) -> None:
        """Hand on what is buffered."""
        try:
            super().flush()
        except OSError as error:
            self._drop(error)

    def _drop(self, error: OSError) -> None:
        if self._dropped is not None and error.errno not in self._dropped:
            raise error
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, self._number)
        os.close(nothing)
        super().flush()  # what is still buffered


def _check_surroundings() -> None:
    """Raises InputError where the working folder is gone, or where there is no home folder for compiled kernels."""
    try:
        os.getcwd()
    except OSError:
        raise InputError("the working folder has been deleted: change to another one, for example with cd ~") from None
    if not os.environ.get("HOME"):  # MPI refuses to start
        try:
            import pwd

            os.environ["HOME"] = pwd.getpwuid(os.getuid()).pw_dir
        except (ImportError, KeyError):
            raise InputError(
                "HOME is not set, and the system knows no home folder of this user: set HOME to a folder that the user "
                "may write to, for example HOME=$PWD; compiled kernels are kept there"
            ) from None


def _end_before_the_run(number: int, frame: FrameType | None) -> None:
    """Ends the process: imports are under way, and nothing has been written."""
    if _run_begun:
        signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)
        return
    if is_first_rank():
        why = "interrupted" if number == signal.SIGINT else f"stopped by signal {signal.Signals(number).name}"
        os.write(2, f"fracsim: {why} before the first step; nothing was written\n".encode())
    else:
        time.sleep(_FIRST_RANK_SPEAKS)
    os._exit(INTERRUPTED if number == signal.SIGINT else Exit.STOPPED)


def is_first_rank() -> bool:
    """Whether this process is rank 0, without starting MPI."""
    return all(os.environ.get(name, "0") == "0" for name in _RANK)


def _is_rank() -> bool:
    """Whether something started this process as a rank of a job."""
    return any(name in os.environ for name in _RANK)


def start_run() -> None:
    """The run takes over: it heeds signals itself, and a crash ends the process at once, telling where."""
    global _run_begun
    if not _own:
        return
    import faulthandler

    from petsc4py import PETSc

    PETSc.Sys.popSignalHandler()  # it calls MPI_Abort, which may hang in a process that has crashed
    for number in (signal.SIGABRT, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGSEGV):
        signal.signal(number, signal.SIG_DFL)  # Open MPI's own handler waits for ever where the heap is damaged
    signal.signal(signal.SIGPIPE, signal.SIG_IGN)  # as Python has it, but PETSc has not
    faulthandler.enable()
    from .mesh.parallel import launcher
    from .output.interrupt import end_with_launcher

    if _is_rank() and (process := launcher(_PARENT)) is not None:
        end_with_launcher(process, parent=_PARENT)
    _run_begun = True


# --- imports ---


@contextmanager
def import_blocked(name: str, stand_in: ModuleType | None = None) -> Iterator[None]:
    """While it lasts, importing a module finds nothing (or the stand-in), unless it is there already."""
    absent = name not in sys.modules
    if absent:
        sys.modules[name] = stand_in  # type: ignore[assignment]
    try:
        yield
    finally:
        if absent:
            del sys.modules[name]


@contextmanager
def outside_working_folder() -> Iterator[None]:
    """While it lasts, the process is in the root folder of the system, so that libraries read no settings of the
    working folder as they start.

    PETSc (.petscrc), petsc4py (petsc.cfg) and UCX (ucx.conf, with Open MPI) load libraries that such a file names, or
    write files; DOLFINx, FFCx (*_options.json) and matplotlib (matplotlibrc) take paths from there. What is set in the
    environment or the home folder holds. Not for several threads.
    """
    before = os.open(".", os.O_PATH | os.O_DIRECTORY)
    try:
        os.chdir("/")
        yield
    finally:
        os.fchdir(before)
        os.close(before)


def import_outside(*names: str) -> None:
    """Import modules that read settings of the working folder, without these."""
    if not all(name in sys.modules for name in names):
        with outside_working_folder():
            for name in names:
                importlib.import_module(name)


def import_dolfinx(*, whole: bool = False) -> None:
    """Import DOLFINx without settings of the working folder. InputError: another version, or its settings are no JSON.

    dolfinx.utils is left out unless `whole` asks for it: it is for callers of PETSc from Numba, and parses C
    declarations as it is imported, 0.04 s.
    """
    if "dolfinx" in sys.modules:
        return
    name = "dolfinx.utils"
    with outside_working_folder(), nullcontext() if whole else import_blocked(name, ModuleType(name)):
        if _own:  # PETSc's handlers would end what SIGHUP and SIGQUIT meet from here on by MPI_Abort
            importlib.import_module("petsc4py").init([sys.argv[0], "-no_signal_handler"])
        dolfinx = importlib.import_module("dolfinx")
        _check_dolfinx(str(dolfinx.__version__))
        _read_settings("dolfinx", "jit")
        _read_settings("ffcx", "options")
    if _own:
        _heed_signals()  # UCX, of Open MPI, has taken SIGHUP
    if not whole:
        del dolfinx.utils


def _read_settings(library: str, module: str) -> None:
    """Read the settings for compiling, which the library then keeps. InputError where the user's file is no JSON."""
    try:
        importlib.import_module(f"{library}.{module}").get_options()
    except (OSError, ValueError, TypeError) as error:
        folder = os.environ.get("XDG_CONFIG_HOME") or os.path.expanduser("~/.config")
        path = os.path.join(folder, library, "dolfinx_jit_options.json" if module == "jit" else "ffcx_options.json")
        raise InputError(
            f"the settings of {library} in {path} cannot be read: {error}; mend the file, which is a table in JSON, or "
            "delete it"
        ) from None


def _check_dolfinx(version: str) -> None:
    """InputError where it is another version than the one that fracsim runs with."""
    if version.split(".")[:2] != DOLFINX.split("."):
        raise InputError(
            f"DOLFINx {version} is installed, and fracsim runs with {DOLFINX} (0.10 and later: not yet): install "
            f"python3-dolfinx {DOLFINX}, as Debian 13 has it, or start commands by ./env, which finds or makes an "
            "environment with it"
        )


def start_work() -> None:
    """Look for garbage from here on where it has not been, but not in what imports made: it stays."""
    if not gc.isenabled():
        gc.freeze()
        gc.enable()


def exit_process(code: Any) -> NoReturn:
    """End the process as sys.exit does, but for taking apart all modules and objects, which frees their memory bit by
    bit (0.04 s of a small job)."""
    if not isinstance(code, int) or threading.active_count() > 1:
        sys.exit(code)
    atexit._run_exitfuncs()
    try:
        sys.stdout.flush()
        sys.stderr.flush()
    except (OSError, ValueError):  # no one reads any more: the interpreter has its own words for that
        sys.exit(code)
    _finalize()
    os._exit(code)


def _finalize() -> None:
    """What Py_Finalize has called for PETSc and MPI, in this order (collective)."""
    if "petsc4py.PETSc" in sys.modules:
        from petsc4py import PETSc

        PETSc._finalize()
    if "mpi4py.MPI" in sys.modules:
        from mpi4py import MPI

        if not MPI.Is_finalized():
            MPI.Finalize()
