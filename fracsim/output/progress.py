"""What a run tells of how far it is, on rank 0 and to stderr: a line that rewrites itself, or a line a minute.

Under Open MPI the stdout of a rank is a pseudo-terminal and its stderr a pipe, whoever watches. So under a launcher it
is the launcher's stderr that says whether a terminal is there.
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
from ..mesh.parallel import starts_ranks

VARIABLE = "FRACSIM_PROGRESS"
FIRST, PERIOD = 5.0, 60.0  # s until the first line of a log, and from one line to the next
REWRITTEN = 0.2  # s that a line on a terminal stays at least
COLUMNS = 110  # of a terminal that does not say


@dataclass(frozen=True)
class Done:
    """What is done of a run.

    Attributes:
        t, dt: time reached, and size of the last step, s.    step: its number.    broken, pieces: edges, and pieces.
        more: of the last step, in words.
    """

    t: float
    dt: float
    step: int
    broken: int
    pieces: int
    more: str = ""


class Progress:
    """Tells how far a run is while it is entered, as often as one likes; a log has no control characters.

    FRACSIM_PROGRESS: "live" a line that rewrites itself; a number a line each so many seconds; "off" nothing. Without
    it: live on a terminal, a line a minute elsewhere, the first after five seconds.
    """

    def __init__(self, *, first: bool, end: float) -> None:
        """`first`: on rank 0, the others are silent; `end`: of the run, s."""
        self._end, self._began = end, time.monotonic()
        self._stage, self._done = "", None  # type: tuple[str, Done | None]
        self._from, self._stepping = 0.0, self._began  # time of the run, and when, as the first step began
        self._shown = -math.inf
        self._live, self._period, columns = _wanted() if first else (False, math.inf, 0)
        self._columns = columns - 1
        self._over = threading.Event()
        self._thread: threading.Thread | None = None
        self._entered = 0

    def __enter__(self) -> Progress:
        self._entered += 1
        if self._entered == 1 and not self._live and self._period < math.inf:
            self._thread = threading.Thread(target=self._tell_a_log, name="progress", daemon=True)
            before = signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)  # they are for the thread of the run
            self._thread.start()
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        return self

    def __exit__(self, *_: object) -> None:
        self._entered -= 1
        if self._entered:
            return
        self._over.set()
        if self._thread is not None:
            self._thread.join()
        self.end_line()

    def end_line(self) -> None:
        """Other words come next: they begin on a line of their own."""
        if self._live and self._shown > -math.inf:
            self._rewrite(self._line())
            _write("\n")
            self._shown = -math.inf

    # --- what the run tells ---

    def stage(self, name: str) -> None:
        """What the run does now, beside steps: "building the mesh"."""
        self._stage = name
        if self._live:
            self._rewrite(self._line())

    def update(self, done: Done) -> None:
        """A step is done."""
        if self._stage or self._done is None:
            self._stage = ""
            if self._done is None:
                self._from, self._stepping = done.t - done.dt, time.monotonic()
        self._done = done
        if self._live and time.monotonic() - self._shown > REWRITTEN:
            self._rewrite(self._line())

    # --- how it is shown ---

    def _line(self) -> str:
        elapsed, done, stage = _clock(time.monotonic() - self._began), self._done, self._stage
        if done is None:
            return f"[{elapsed}] {stage}"
        words = (
            f"[{elapsed}] {done.t / self._end:6.1%}  t = {done.t:.4g} s  step {done.step}  broken edges {done.broken}  "
            f"pieces {done.pieces}"
        )
        return f"{words}  {stage}" if stage else f"{words}  {self._left(done)}  {done.more}".rstrip()

    def _left(self, done: Done) -> str:
        """The time left, as the steps so far have taken."""
        share = (done.t - self._from) / max(self._end - self._from, done.dt)
        seconds = time.monotonic() - self._stepping
        return f"left {_clock(seconds * (1 - share) / share)}" if share > 0 and seconds > 0 else ""

    def _rewrite(self, line: str) -> None:
        _write("\r" + line[: self._columns].ljust(self._columns))
        self._shown = time.monotonic()

    def _tell_a_log(self) -> None:
        wait = min(FIRST, self._period)
        while not self._over.wait(wait):
            _write(self._line() + "\n")
            wait = self._period


def _write(text: str) -> None:
    sys.stderr.write(text)
    sys.stderr.flush()


def _wanted() -> tuple[bool, float, int]:
    """(a line that rewrites itself, else s between lines, columns of the terminal): as the variable says, or as
    somebody watches."""
    columns = _terminal()
    wish = os.environ.get(VARIABLE, "").strip()
    if wish == "off":
        return False, math.inf, 0
    if wish == "live":
        return True, math.inf, columns or COLUMNS
    if wish:
        try:
            if 0 < (seconds := float(wish)) < math.inf:
                return False, seconds, 0
        except ValueError:
            pass
        _write(f'fracsim: note: {VARIABLE}={wish} is none of "live", "off" or a number of seconds: it is ignored\n')
    return columns > 0, PERIOD, columns


def _terminal() -> int:
    """Columns of the terminal that stderr comes out at; 0: it does not."""
    try:
        if sys.stderr.isatty():
            return os.get_terminal_size(sys.stderr.fileno()).columns or COLUMNS
        if not starts_ranks(parent := os.getppid()):
            return 0
        descriptor = os.open(f"/proc/{parent}/fd/2", os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK)
    except (OSError, ValueError):
        return 0
    try:
        return (os.get_terminal_size(descriptor).columns or COLUMNS) if os.isatty(descriptor) else 0
    except OSError:
        return COLUMNS
    finally:
        os.close(descriptor)


def _clock(seconds: float) -> str:
    minutes, rest = divmod(int(seconds + 0.5), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
