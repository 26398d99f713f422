"""Errors that a user can correct: one message, one exit code, no traceback."""

from __future__ import annotations

import signal
from enum import IntEnum

# Signals that end a run with a checkpoint. SIGHUP: the terminal was closed; SIGXCPU: the limit of processor time.
STOP_SIGNALS = (
    signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2, signal.SIGHUP, signal.SIGQUIT, signal.SIGXCPU,
)  # fmt: skip
# Seconds after a signal in which another one is the same request, since some senders send it twice.
REPEATED_SIGNAL_INTERVAL = 1.0


class Exit(IntEnum):
    """Exit codes of every command."""

    DONE = 0
    FALSE_CLAIM = 1
    BAD_INPUT = 2
    NOT_CONVERGED = 3
    STOPPED = 4
    CANNOT_WRITE = 5


def one_line(text: str) -> str:
    """Return a text of a user's file as one line for a terminal, without control characters and of limited length."""
    line = text
    if not text.isprintable():
        line = "".join(char if char.isprintable() else ascii(char)[1:-1] for char in text)
    # the middle of a long text is left out
    return line if len(line) <= 1000 else f"{line[:500]} ... {line[-500:]}"


class FracsimError(Exception):
    """Error with a message that says what is wrong, where, what is allowed and what to do.

    It is raised on all ranks alike.
    """

    exit_code = Exit.BAD_INPUT

    def __init__(self, message: str) -> None:
        """Keep the message as one line; values of a file may have line breaks, or a million digits."""
        super().__init__(one_line(message))


class InputError(FracsimError):
    """Study, mesh or command line that cannot be run."""


class NotConverged(FracsimError):
    """Failure of the smallest allowed step; the message has the reason, the last good time and the checkpoint."""

    exit_code = Exit.NOT_CONVERGED


class Stopped(FracsimError):
    """End of a run by a signal or the limit of wall time, with a checkpoint."""

    exit_code = Exit.STOPPED


class StepAborted(Exception):
    """A step was given up since the run is to stop; the body is as at the start of the step (on all ranks)."""


class CannotWrite(FracsimError):
    """Failure to write output during a run, such as a full disk; the message has what, and why."""

    exit_code = Exit.CANNOT_WRITE


class FalseClaim(FracsimError):
    """Claim in a report of the evidence that does not hold; the report was written."""

    exit_code = Exit.FALSE_CLAIM
