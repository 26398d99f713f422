"""A line of progress with the time left, on rank 0 and only where someone watches."""

from __future__ import annotations

import sys
import time

from mpi4py import MPI

from ..stepping.state import State
from ..stepping.stepper import StepReport


class Progress:
    """One line that rewrites itself on a terminal; silent otherwise (batch logs stay short)."""

    def __init__(self, comm: MPI.Comm, end: float) -> None:
        """`end`: of the run, s."""
        self._on = comm.rank == 0 and sys.stderr.isatty()
        self._end = end
        self._began = time.monotonic()
        self._from: float | None = None

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        if self._on:
            sys.stderr.write("\n")

    def update(self, state: State, report: StepReport, figures: tuple[int, int, int]) -> None:
        """After each step."""
        if not self._on:
            return
        if self._from is None:
            self._from = state.t - report.dt
        done = (state.t - self._from) / (self._end - self._from)
        left = (time.monotonic() - self._began) * (1 - done) / done
        broken, _, pieces = figures
        line = (
            f"\r{state.t / self._end:6.1%}  t = {state.t:.4g} s  step {state.step}  {report.seconds:.2f} s/step  "
            f"Newton {report.solve.newton}  broken {broken}  pieces {pieces}  left {_clock(left)} "
        )
        sys.stderr.write(line.ljust(110))
        sys.stderr.flush()


def _clock(seconds: float) -> str:
    minutes, rest = divmod(int(seconds + 0.5), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
