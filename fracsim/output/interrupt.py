"""Ending early on a signal or at the wall-time limit, on all ranks in the same step."""

from __future__ import annotations

import signal
import time
from ctypes import CDLL
from functools import cache
from pathlib import Path
from types import FrameType

import numpy as np
from mpi4py import MPI

from ..errors import SAME_REQUEST, STOP_SIGNALS, FracsimError, Stopped

SHORT = 0.5  # s: a step that has taken no longer is not abandoned
_SOURCE = Path(__file__).with_name("signals.c")


class Interrupt:
    """Catches signals while it is entered, as often as one likes; `reason` agrees over the ranks.

    A second signal ends the process at once, whatever it does (SAME_REQUEST s after the first or later). Signals that
    were ignored before stay so.

    Attributes:
        writing: something has been written. Before that Ctrl-C ends the program at once, there is nothing to save; so
        do other signals on a single rank.
    """

    def __init__(self, comm: MPI.Comm, wall_limit: float | None, *, alone: bool | None = None) -> None:
        """`wall_limit`: s from now; `alone`: whether the run is on one rank; None: as `comm` is."""
        self.comm = comm
        self.writing = False
        self._alone = comm.size == 1 if alone is None else alone
        self._deadline = np.inf if wall_limit is None else time.monotonic() + wall_limit
        self._signal = 0
        self._step_began = -np.inf
        self._entered = 0
        self._before: dict[int, object] = {}

    def __enter__(self) -> Interrupt:
        self._entered += 1
        if self._entered > 1:
            return self
        code = _code()
        for number in STOP_SIGNALS:
            if signal.getsignal(number) is signal.SIG_IGN:
                signal.signal(number, signal.SIG_IGN)  # PETSc may have taken it since
                continue
            self._before[number] = signal.signal(number, self._note)
            if code is not None:
                code.watch_signal(int(number), SAME_REQUEST)
        return self

    def __exit__(self, *_: object) -> None:
        self._entered -= 1
        if not self._entered:
            for number, handler in self._before.items():
                signal.signal(number, handler)  # type: ignore[arg-type]

    def _note(self, number: int, frame: FrameType | None) -> None:
        if number == signal.SIGINT and not self.writing:
            raise KeyboardInterrupt
        self._signal = self._signal or number
        if self._alone and not self.writing:
            raise self.stopped_in_setup(signal.Signals(number).name)

    @staticmethod
    def stopped_in_setup(name: str) -> Stopped:
        """What ends a run on the signal of a name, before it has written anything."""
        return Stopped(f"stopped by signal {name} while the run was set up; nothing was written")

    def check_setup(self) -> None:
        """Raises Stopped where a signal has come to any rank while the run was set up (collective)."""
        if name := self.signalled():
            raise self.stopped_in_setup(name.removeprefix("signal "))

    def signalled(self) -> str:
        """The name of a signal that has come to any rank, empty where there is none (collective)."""
        number, _ = self._agreed(False)
        return f"signal {signal.Signals(number).name}" if number else ""

    def reason(self) -> str:
        """Why to stop now, empty to go on (collective)."""
        number, late = self._agreed(time.monotonic() > self._deadline)
        if number:
            return f"signal {signal.Signals(number).name}"
        return "the wall-time limit" if late else ""

    def _agreed(self, late: bool) -> tuple[int, bool]:
        """The signal that has come to any rank, 0: none; and whether it is `late` on any (collective)."""
        if self.comm.size == 1:
            return self._signal, late
        own, worst = np.array([self._signal, late], np.int32), np.empty(2, np.int32)
        self.comm.Allreduce(own, worst, op=MPI.MAX)
        return int(worst[0]), bool(worst[1])

    # --- inside a step ---

    def begin_step(self) -> None:
        """A step begins now."""
        self._step_began = time.monotonic()

    def abandons(self) -> bool:
        """Whether the step is to be abandoned: there is a reason to stop, and the step is not short (collective)."""
        now = time.monotonic()
        number, late = self._agreed(now > self._deadline)
        return (number > 0 or late) and self._is_long(now)

    def _is_long(self, now: float) -> bool:
        """Whether the step has taken longer than SHORT s, as rank 0 says (collective)."""
        long = now - self._step_began > SHORT
        return long if self.comm.size == 1 else bool(self.comm.bcast(long))


def end_with(launcher: int, *, parent: int) -> None:
    """Have this process end with the launcher of ranks, its `parent` or an ancestor, in whatever way that ends: the
    ranks would wait for ever (Linux)."""
    if (code := _code()) is None:
        return
    if launcher == parent:
        code.end_with_parent(parent, int(signal.SIGRTMAX) - 1)
    else:  # a shell is between them, which goes on
        code.end_with_process(launcher)


@cache
def _code() -> CDLL | None:
    """What signals do at once; None where there is no compiler: then a second signal waits for Python, too."""
    from ..mesh.c_library import load_library

    try:
        return load_library(_SOURCE)
    except (FracsimError, OSError):
        return None
