"""Ending early on a signal or at the wall-time limit, on all ranks in the same step."""

from __future__ import annotations

import signal
import time
from types import FrameType

from mpi4py import MPI

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2)


class Interrupt:
    """Catches signals while it is entered, as often as one likes; `reason` agrees over the ranks.

    Attributes:
        writing: something has been written. Before that Ctrl-C ends the program at once, there is nothing to save.
    """

    def __init__(self, comm: MPI.Comm, wall_limit: float | None) -> None:
        """`wall_limit`: s from now."""
        self.comm = comm
        self.writing = False
        self._deadline = None if wall_limit is None else time.monotonic() + wall_limit
        self._signal = 0
        self._entered = 0
        self._before: dict[int, object] = {}

    def __enter__(self) -> Interrupt:
        self._entered += 1
        if self._entered == 1:
            for number in SIGNALS:
                self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        self._entered -= 1
        if not self._entered:
            for number, handler in self._before.items():
                signal.signal(number, handler)  # type: ignore[arg-type]

    def _note(self, number: int, frame: FrameType | None) -> None:
        if number == signal.SIGINT and not self.writing:
            raise KeyboardInterrupt
        self._signal = number

    def signalled(self) -> str:
        """The name of a signal that has come to any rank, empty where there is none (collective)."""
        worst = self.comm.allreduce(self._signal, op=MPI.MAX)
        return f"signal {signal.Signals(worst).name}" if worst else ""

    def reason(self) -> str:
        """Why to stop now, empty to go on (collective)."""
        late = self._deadline is not None and time.monotonic() > self._deadline
        worst = self.comm.allreduce((self._signal, late), op=_WORST)
        if worst[0]:
            return f"signal {signal.Signals(worst[0]).name}"
        return "the wall-time limit" if worst[1] else ""


def _max_each(a: tuple[int, bool], b: tuple[int, bool], _: object = None) -> tuple[int, bool]:
    return max(a[0], b[0]), a[1] or b[1]


_WORST = MPI.Op.Create(_max_each, commute=True)  # type: ignore[arg-type]  # Python objects, not buffers
