"""Progress of a run on stderr, on rank 0: a line that rewrites itself, or a line per minute in a log.

Under Open MPI the stdout of a rank is always a pseudo-terminal and its stderr a pipe. Therefore under a launcher the
stderr of the launcher decides whether there is a terminal.
"""

from __future__ import annotations

import math
import os
import signal
import sys
import threading
import time
from dataclasses import dataclass

from ..errors import STOP_SIGNALS
from ..mesh.parallel import launchers

PROGRESS_VARIABLE = "FRACSIM_PROGRESS"


@dataclass(frozen=True)
class ProgressTiming:
    """Times between lines, and the width of a line.

    Attributes:
        first_line: time until the first line of a log, s. Short runs leave no line.
        line_period: time between lines of a log, s.
        min_rewrite: least time between two states of the line on a terminal, s.
        terminal_columns: width of a terminal that does not report its own.
    """

    first_line: float = 5.0
    line_period: float = 60.0
    min_rewrite: float = 0.2
    terminal_columns: int = 110


PROGRESS_TIMING = ProgressTiming()


@dataclass(frozen=True)
class ProgressState:
    """State of a run after a step.

    Attributes:
        t: time reached, s.
        dt: size of the last step, s.
        step: number of the last step.
        broken_edges: number of broken edges.
        fragments: number of fragments.
        details: further text about the last step.
    """

    t: float
    dt: float
    step: int
    broken_edges: int
    fragments: int
    details: str = ""


class ProgressReporter:
    """Reporter of progress while its context is entered; the context can be entered again inside.

    The environment variable FRACSIM_PROGRESS selects the form: "live" for a line that rewrites itself, a number for a
    line every so many seconds, "off" for nothing. Without it the line is live on a terminal; elsewhere there is a line
    per minute, the first after five seconds. A log has no control characters.
    """

    def __init__(self, *, first: bool, end: float) -> None:
        """Start the clock.

        Args:
            first: this is rank 0; the other ranks print nothing.
            end: end time of the run, s.
        """
        self._end, self._began = end, time.monotonic()
        self._stage = ""
        self._state: ProgressState | None = None
        # simulated and wall time, start of first step
        self._first_step_t, self._first_step_clock = 0.0, self._began
        self._last_write = -math.inf
        self._is_live, self._period, columns = _chosen_form() if first else (False, math.inf, 0)
        self._columns = columns - 1
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        # how often the context is entered
        self._depth = 0

    def __enter__(self) -> ProgressReporter:
        self._depth += 1
        if self._depth == 1 and not self._is_live and self._period < math.inf:
            self._thread = threading.Thread(target=self._write_log, name="progress", daemon=True)
            # the new thread inherits the mask: signals must go to the thread of the run
            mask = signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
            self._thread.start()
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        return self

    def __exit__(self, *_: object) -> None:
        self._depth -= 1
        if self._depth:
            return
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
        self.end_line()

    def end_line(self) -> None:
        """End the line, so that other output begins on a new one."""
        if self._is_live and self._last_write > -math.inf:
            self._rewrite(self._line())
            _write("\n")
            self._last_write = -math.inf

    # --- called by the run ---

    def set_stage(self, name: str) -> None:
        """Set what the run does outside steps, as in "building the mesh"."""
        self._stage = name
        if self._is_live:
            self._rewrite(self._line())

    def update(self, state: ProgressState) -> None:
        """Set the state after a step."""
        if self._stage or self._state is None:
            self._stage = ""
            if self._state is None:
                self._first_step_t, self._first_step_clock = state.t - state.dt, time.monotonic()
        self._state = state
        if self._is_live and time.monotonic() - self._last_write > PROGRESS_TIMING.min_rewrite:
            self._rewrite(self._line())

    # --- text ---

    def _line(self) -> str:
        elapsed, state, stage = _format_clock(time.monotonic() - self._began), self._state, self._stage
        if state is None:
            return f"[{elapsed}] {stage}"
        text = (
            f"[{elapsed}] {state.t / self._end:6.1%}  t = {state.t:.4g} s  step {state.step}  "
            f"broken edges {state.broken_edges}  pieces {state.fragments}"
        )
        return f"{text}  {stage}" if stage else f"{text}  {self._time_left(state)}  {state.details}".rstrip()

    def _time_left(self, state: ProgressState) -> str:
        """Estimate of the remaining wall time, in proportion to the simulated time so far."""
        share = (state.t - self._first_step_t) / max(self._end - self._first_step_t, state.dt)
        seconds = time.monotonic() - self._first_step_clock
        return f"left {_format_clock(seconds * (1 - share) / share)}" if share > 0 and seconds > 0 else ""

    def _rewrite(self, line: str) -> None:
        _write("\r" + line[: self._columns].ljust(self._columns))
        self._last_write = time.monotonic()

    def _write_log(self) -> None:
        """Write a line per period until the context is left (thread)."""
        wait = min(PROGRESS_TIMING.first_line, self._period)
        while not self._stop.wait(wait):
            _write(self._line() + "\n")
            wait = self._period


def _write(text: str) -> None:
    sys.stderr.write(text)
    sys.stderr.flush()


def _chosen_form() -> tuple[bool, float, int]:
    """Form of the report, from the environment variable or the terminal.

    Returns:
        True for a line that rewrites itself; otherwise the time between lines in s; columns of the terminal.
    """
    columns = _terminal_columns()
    setting = os.environ.get(PROGRESS_VARIABLE, "").strip()
    if setting == "off":
        return False, math.inf, 0
    if setting == "live":
        return True, math.inf, columns or PROGRESS_TIMING.terminal_columns
    if setting:
        try:
            if 0 < (seconds := float(setting)) < math.inf:
                return False, seconds, 0
        except ValueError:
            pass
        _write(
            f'fracsim: note: {PROGRESS_VARIABLE}={setting} is none of "live", "off" or a number of seconds: '
            "it is ignored\n"
        )
    return columns > 0, PROGRESS_TIMING.line_period, columns


def _terminal_columns() -> int:
    """Columns of the terminal, or of the output of a notebook, that shows stderr; 0 if there is none."""
    if type(sys.stderr).__module__.startswith("ipykernel."):
        return PROGRESS_TIMING.terminal_columns
    try:
        if sys.stderr.isatty():
            return os.get_terminal_size(sys.stderr.fileno()).columns or PROGRESS_TIMING.terminal_columns
    except (OSError, ValueError):
        return 0
    # MPICH has a process between mpirun and the ranks
    return next((columns for process in launchers(os.getppid()) if (columns := _columns_of_stderr(process))), 0)


def _columns_of_stderr(process: int) -> int:
    """Columns of the terminal that a process has as its stderr; 0 if it has none."""
    try:
        descriptor = os.open(f"/proc/{process}/fd/2", os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError:
        return 0
    try:
        if not os.isatty(descriptor):
            return 0
        return os.get_terminal_size(descriptor).columns or PROGRESS_TIMING.terminal_columns
    except OSError:
        return PROGRESS_TIMING.terminal_columns
    finally:
        os.close(descriptor)


def _format_clock(seconds: float) -> str:
    """Duration as H:MM:SS or M:SS."""
    minutes, seconds_left = divmod(int(seconds + 0.5), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds_left:02d}" if hours else f"{minutes}:{seconds_left:02d}"
