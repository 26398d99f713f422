"""Process of a command: standard streams, signals, and imports that ignore the working folder.

A command continues if a standard stream is closed or nobody reads it. A run responds to signals from its first moment.
A crash ends the process.
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
from contextlib import contextmanager
from types import FrameType, ModuleType
from typing import NoReturn, TextIO, cast

from .errors import STOP_SIGNALS, Exit, InputError

# Versions of DOLFINx that fracsim runs with.
DOLFINX = ("0.9", "0.10", "0.11")
# Exit code after SIGINT, as typer and shells have it.
INTERRUPTED = 130
# Errors of a stream without a reader; EIO: its terminal was closed.
_CLOSED_READER_ERRORS = (errno.EPIPE, errno.EIO)
# Control characters other than tabs and ends of lines, and those that change the direction of writing.
_CONTROL_CODES = {*range(0x20), *range(0x7F, 0xA0), 0x200E, 0x200F, *range(0x202A, 0x202F), *range(0x2066, 0x206A)}
_ESCAPES = {code: ascii(chr(code))[1:-1] for code in _CONTROL_CODES - {*map(ord, "\t\n\r")}}
# Seconds that other ranks wait before they end, since the launcher ends all ranks with the first one.
_FIRST_RANK_DELAY = 0.3


# --- start ---


def start_process() -> None:
    """Prepare streams, signals and the home folder of a command. Raises InputError."""
    global _is_own_process
    _is_own_process = True
    runs = sys.argv[1:2] == ["run"]
    _open_streams(None if runs else _CLOSED_READER_ERRORS)
    if runs:
        _handle_signals()
    _check_environment()


def _handle_signals() -> None:
    """Handle the signals that end a run, until the run does so itself."""
    for number in STOP_SIGNALS if sys.argv[1:2] == ["run"] else ():
        if signal.getsignal(number) is not signal.SIG_IGN:
            # others are ignored by nohup
            signal.signal(number, _end_before_run)


_PARENT_PID = os.getppid()
# Environment variables with the rank of a process.
_RANK_VARIABLES = ("OMPI_COMM_WORLD_RANK", "PMI_RANK", "PMIX_RANK")
# Those with the number of processes that a launcher started.
_SIZE_VARIABLES = ("OMPI_COMM_WORLD_SIZE", "PMI_SIZE")
# Whether this process was started as a command, and whether its run handles signals.
_is_own_process = False
_run_begun = False


def _open_streams(dropped: tuple[int, ...] | None) -> None:
    """Open closed standard streams on the null device, so that files of the run do not take their numbers.

    `dropped`: numbers of errors after which output is dropped; None: all, since a run is worth more than its messages.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            # this takes the lowest free number
            os.open(os.devnull, os.O_RDWR)
    sys.stdout = _open_stream(sys.stdout, 1, dropped)
    sys.stderr = _open_stream(sys.stderr, 2, None)


def _open_stream(stream: TextIO | None, number: int, dropped: tuple[int, ...] | None) -> TextIO:
    """Return a stream that drops text which cannot be written; the arguments are those of `_Stream`."""
    if stream is None:
        return open(os.devnull, "w", encoding="utf-8")
    return _Stream(stream, number, dropped) if isinstance(stream, io.TextIOWrapper) else stream


class _Stream(io.TextIOWrapper):
    """Standard stream that drops text once it cannot be written, so that a command without a reader continues.

    Control characters are written as escapes, since names and titles in files may have some that a terminal would obey.
    """

    def __init__(self, stream: io.TextIOWrapper, number: int, dropped: tuple[int, ...] | None) -> None:
        """Wrap a stream; `number`: descriptor; `dropped`: errors after which text is dropped, None: all."""
        buffered = stream.line_buffering
        super().__init__(stream.buffer, stream.encoding, "backslashreplace", line_buffering=buffered)
        self._number, self._dropped = number, dropped

    def write(self, text: str) -> int:
        """Write text and return its length."""
        try:
            super().write(text if text.isprintable() else text.translate(_ESCAPES))
            return len(text)
        except OSError as error:
            self._drop(error)
            return len(text)

    def flush(self) -> None:
        """Write the buffered text."""
        try:
            super().flush()
        except OSError as error:
            self._drop(error)

    def _drop(self, error: OSError) -> None:
        """Connect the descriptor with the null device, or raise the error if it is not to be dropped."""
        if self._dropped is not None and error.errno not in self._dropped:
            raise error
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, self._number)
        os.close(nothing)
        # the text that is still in the buffer
        super().flush()


def _check_environment() -> None:
    """Raise InputError if the working folder was deleted, or if there is no home folder for compiled kernels."""
    try:
        os.getcwd()
    except OSError:
        raise InputError("the working folder has been deleted: change to another one, for example with cd ~") from None
    # MPI does not start without it
    if not os.environ.get("HOME"):
        try:
            import pwd

            os.environ["HOME"] = pwd.getpwuid(os.getuid()).pw_dir
        except (ImportError, KeyError):
            raise InputError(
                "HOME is not set, and the system knows no home folder of this user: set HOME to a folder that the user "
                "may write to, for example HOME=$PWD; compiled kernels are kept there"
            ) from None


def _end_before_run(number: int, frame: FrameType | None) -> None:
    """End the process during imports, when nothing has been written; a signal handler."""
    if _run_begun:
        signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)
        return
    if is_first_rank():
        why = "interrupted" if number == signal.SIGINT else f"stopped by signal {signal.Signals(number).name}"
        os.write(2, f"fracsim: {why} before the first step; nothing was written\n".encode())
    else:
        time.sleep(_FIRST_RANK_DELAY)
    os._exit(INTERRUPTED if number == signal.SIGINT else Exit.STOPPED)


def is_first_rank() -> bool:
    """Return whether this process is rank 0, without starting MPI."""
    return all(os.environ.get(name, "0") == "0" for name in _RANK_VARIABLES)


def _is_rank() -> bool:
    """Return whether a launcher started this process as a rank of a job."""
    return any(name in os.environ for name in _RANK_VARIABLES)


def check_launcher(ranks: int) -> None:
    """Raise InputError if a launcher started several processes and MPI made each of them a job of its own.

    `ranks`: size of MPI.COMM_WORLD. Happens where the launcher and the MPI library have no protocol in common.
    """
    started = max(int(os.environ.get(name, "1")) for name in _SIZE_VARIABLES)
    if ranks == 1 and started > 1:
        raise InputError(
            f"{started} processes were started, but MPI joined none of them: each would be a run on one rank. Start "
            "them with the mpirun of Python's MPI library (`fracsim doctor` names it), or with Slurm by "
            "`srun --mpi=pmix` for Open MPI and by `srun --mpi=pmi2` for MPICH"
        )


def start_run() -> None:
    """Leave signals to the run; from here on a crash ends the process at once, with the place in the program."""
    global _run_begun
    if not _is_own_process:
        return
    import faulthandler

    from petsc4py import PETSc

    # it calls MPI_Abort, which may hang in a process that has crashed
    PETSc.Sys.popSignalHandler()
    for number in (signal.SIGABRT, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGSEGV):
        # the handler of Open MPI waits for ever if the heap is damaged
        signal.signal(number, signal.SIG_DFL)
    # as Python has it, but PETSc has not
    signal.signal(signal.SIGPIPE, signal.SIG_IGN)
    faulthandler.enable()
    from .mesh.parallel import find_launcher
    from .output.interrupt import end_with_launcher

    if _is_rank() and (process := find_launcher(_PARENT_PID)) is not None:
        end_with_launcher(process, parent=_PARENT_PID)
    # what imports have made stays, and is not searched for garbage
    gc.freeze()
    gc.enable()
    _run_begun = True


def end_process(code: str | int | None) -> NoReturn:
    """End the process as sys.exit(code) does, but without freeing its memory object by object (collective).

    Python's finalisation takes a quarter of a run of two steps (0.4 of 2.0 s), and a tenth of `list` and `check`.
    """
    if isinstance(code, str) or threading.active_count() > 1:
        sys.exit(code)
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    # called by Py_Finalize otherwise, in this order
    if "petsc4py.PETSc" in sys.modules:
        sys.modules["petsc4py.PETSc"]._finalize()
    if (mpi4py := sys.modules.get("mpi4py.MPI")) is not None and not mpi4py.Is_finalized():
        mpi4py.Finalize()
    os._exit(code or 0)


# --- imports ---


@contextmanager
def import_blocked(name: str) -> Iterator[None]:
    """Make imports of a module fail within the context, unless it has been imported before."""
    absent = name not in sys.modules
    if absent:
        # an entry of None makes an import fail
        cast("dict[str, ModuleType | None]", sys.modules)[name] = None
    try:
        yield
    finally:
        if absent:
            del sys.modules[name]


@contextmanager
def outside_working_folder() -> Iterator[None]:
    """Change to the root folder within the context, so that libraries read no settings of the working folder.

    PETSc (.petscrc), petsc4py (petsc.cfg) and UCX (ucx.conf, with Open MPI) load libraries that such a file names, or
    write files; DOLFINx, FFCx (*_options.json) and matplotlib (matplotlibrc) take paths from there. What is set in the
    environment or the home folder holds. Not for use in several threads.
    """
    before = os.open(".", os.O_PATH | os.O_DIRECTORY)
    try:
        os.chdir("/")
        yield
    finally:
        os.fchdir(before)
        os.close(before)


def import_outside(*names: str) -> None:
    """Import modules without settings of the working folder."""
    if not all(name in sys.modules for name in names):
        with outside_working_folder():
            for name in names:
                importlib.import_module(name)


def import_dolfinx() -> None:
    """Import DOLFINx without settings of the working folder.

    Raises InputError if it is another version, or if the user's settings are no JSON.
    """
    if "dolfinx" in sys.modules:
        return
    with outside_working_folder():
        # it loads the MPI library that wheels of PETSc and DOLFINx are linked with
        importlib.import_module("mpi4py.MPI")
        # the handlers of PETSc would answer SIGHUP and SIGQUIT by MPI_Abort
        if _is_own_process:
            importlib.import_module("petsc4py").init([sys.argv[0], "-no_signal_handler"])
        dolfinx = importlib.import_module("dolfinx")
        _check_dolfinx(str(dolfinx.__version__))
        _read_settings("dolfinx", "jit")
        _read_settings("ffcx", "options")
    # UCX, of Open MPI, has taken SIGHUP
    if _is_own_process:
        _handle_signals()


def _read_settings(library: str, module: str) -> None:
    """Read the settings for compiling, which the library keeps. Raises InputError if the user's file is no JSON."""
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
    """Raise InputError if it is a version that fracsim does not run with."""
    if ".".join(version.split(".")[:2]) not in DOLFINX:
        raise InputError(
            f"DOLFINx {version} is installed, and fracsim runs with {DOLFINX[0]} to {DOLFINX[-1]}: install one of "
            "these, for example by pip install fracsim[dolfinx], or start commands by ./env, which makes an environment"
        )
