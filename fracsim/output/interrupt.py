"""Early end of a run by a signal or at the wall-time limit, on all ranks in the same step."""

from __future__ import annotations

import signal
import threading
import time
from ctypes import CDLL
from functools import cache
from pathlib import Path
from types import FrameType

import numpy as np
from mpi4py import MPI

from ..errors import REPEATED_SIGNAL_INTERVAL, STOP_SIGNALS, FracsimError, Stopped

# a step that has taken no longer is finished before the run stops
MAX_UNINTERRUPTED_SECONDS = 0.5
_SOURCE = Path(__file__).with_name("signals.c")


class InterruptHandler:
    """Handler of stop signals and of the wall-time limit. The ranks agree on the reason to stop.

    The handler is a context manager that can be entered again inside. A second signal ends the process at once if it
    comes `REPEATED_SIGNAL_INTERVAL` seconds after the first or later. Signals that were ignored before stay ignored.

    Attributes:
        comm: the ranks of the run.
        has_output: True once the run has written something. Before that Ctrl-C ends the program at once, and on a
            single rank other signals do too: there is nothing to save.
    """

    def __init__(self, comm: MPI.Comm, wall_limit: float | None, *, alone: bool | None = None) -> None:
        """Start the clock of the wall-time limit.

        Args:
            comm: the ranks of the run.
            wall_limit: wall-time limit from now, s; None: no limit.
            alone: the run has a single rank; None: as `comm` says.
        """
        self.comm = comm
        self.has_output = False
        self._alone = comm.size == 1 if alone is None else alone
        self._deadline = np.inf if wall_limit is None else time.monotonic() + wall_limit
        self._signal = 0
        self._step_began = -np.inf
        # how often the context is entered
        self._depth = 0
        self._previous_handlers: dict[int, object] = {}

    def __enter__(self) -> InterruptHandler:
        self._depth += 1
        if self._depth > 1:
            return self
        if threading.current_thread() is not threading.main_thread():
            return self  # Python takes signals in the main thread alone
        code = _signal_library()
        for number in STOP_SIGNALS:
            if signal.getsignal(number) is signal.SIG_IGN:
                # PETSc may have installed a handler since
                signal.signal(number, signal.SIG_IGN)
                continue
            self._previous_handlers[number] = signal.signal(number, self._on_signal)
            if code is not None:
                code.watch_signal(int(number), REPEATED_SIGNAL_INTERVAL)
        return self

    def __exit__(self, *_: object) -> None:
        self._depth -= 1
        if not self._depth:
            for number, handler in self._previous_handlers.items():
                # None: one that a library had installed before Python began, which Python cannot install again
                signal.signal(number, signal.SIG_DFL if handler is None else handler)  # type: ignore[arg-type]

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if number == signal.SIGINT and not self.has_output:
            raise KeyboardInterrupt
        self._signal = self._signal or number
        if self._alone and not self.has_output:
            raise self.setup_stop_error(signal.Signals(number).name)

    @staticmethod
    def setup_stop_error(name: str) -> Stopped:
        """Error that ends a run before it has written anything; `name` is the name of the signal."""
        return Stopped(f"stopped by signal {name} while the run was set up; nothing was written")

    def check_setup_signals(self) -> None:
        """Raise Stopped if any rank received a signal while the run was set up (collective)."""
        if name := self.received_signal():
            raise self.setup_stop_error(name.removeprefix("signal "))

    def received_signal(self) -> str:
        """Name of a signal that any rank received, as in "signal SIGTERM"; empty if there is none (collective)."""
        number, _ = self._agree(False)
        return f"signal {signal.Signals(number).name}" if number else ""

    def stop_reason(self) -> str:
        """Reason to stop now, empty to continue (collective)."""
        number, late = self._agree(time.monotonic() > self._deadline)
        if number:
            return f"signal {signal.Signals(number).name}"
        return "the wall-time limit" if late else ""

    def _agree(self, late: bool) -> tuple[int, bool]:
        """Number of a signal that any rank received (0: none), and True if any rank is late (collective)."""
        if self.comm.size == 1:
            return self._signal, late
        local, largest = np.array([self._signal, late], np.int32), np.empty(2, np.int32)
        self.comm.Allreduce(local, largest, op=MPI.MAX)
        return int(largest[0]), bool(largest[1])

    # --- inside a step ---

    def begin_step(self) -> None:
        """Record that a step begins now."""
        self._step_began = time.monotonic()

    def must_abandon_step(self) -> bool:
        """True if there is a reason to stop and the present step has taken long (collective)."""
        clock = time.monotonic()
        number, late = self._agree(clock > self._deadline)
        return (number > 0 or late) and self._is_long(clock)

    def _is_long(self, clock: float) -> bool:
        """True if, by the clock of rank 0, the step is longer than `MAX_UNINTERRUPTED_SECONDS` (collective)."""
        long = clock - self._step_began > MAX_UNINTERRUPTED_SECONDS
        return long if self.comm.size == 1 else bool(self.comm.bcast(long))


def end_with_launcher(launcher: int, *, parent: int) -> None:
    """End this process as soon as the launcher of the ranks ends (Linux). Otherwise ranks could wait forever.

    Args:
        launcher: process id of the launcher, which is the parent or an ancestor.
        parent: process id of the parent.
    """
    if (code := _signal_library()) is None:
        return
    if launcher == parent:
        code.end_with_parent(parent, int(signal.SIGRTMAX) - 1)
    else:
        # a shell stands between the two and outlives the launcher
        code.end_with_process(launcher)


@cache
def _signal_library() -> CDLL | None:
    """Compiled signal handlers, which act at once; None without a compiler.

    Without them a second signal is handled only when Python executes its next instruction.
    """
    from ..mesh.c_library import load_library

    try:
        return load_library(_SOURCE)
    except (FracsimError, OSError):
        return None
