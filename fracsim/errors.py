"""Failures that a user can mend: one message, one exit code, no traceback."""

from __future__ import annotations

import signal
from enum import IntEnum

MAX_MESSAGE_LENGTH = 1000  # characters of a message

# What ends a run with a checkpoint. SIGHUP: its terminal was closed; SIGXCPU: its limit of processor time is reached.
STOP_SIGNALS = (
    signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2, signal.SIGHUP, signal.SIGQUIT, signal.SIGXCPU,
)  # fmt: skip
REPEATED_SIGNAL_INTERVAL = (
    1.0  # s after such a signal in which another one is no second request: some senders send it twice
)


class Exit(IntEnum):
    """Exit codes of every command."""

    DONE = 0
    FALSE_CLAIM = 1
    BAD_INPUT = 2
    NOT_CONVERGED = 3
    STOPPED = 4
    CANNOT_WRITE = 5


def one_line(text: str) -> str:
    """A text of a user's file as a terminal may have it: one line of at most LONGEST characters, without control
    characters."""
    line = text if text.isprintable() else "".join(each if each.isprintable() else ascii(each)[1:-1] for each in text)
    return (
        line
        if len(line) <= MAX_MESSAGE_LENGTH
        else f"{line[: MAX_MESSAGE_LENGTH // 2]} ... {line[-MAX_MESSAGE_LENGTH // 2 :]}"
    )


class FracsimError(Exception):
    """The message says what is wrong, where, what is allowed and what to do. Raised on all ranks alike."""

    exit_code = Exit.BAD_INPUT

    def __init__(self, message: str) -> None:
        """`message` becomes one line of bearable length: values of a file may hold line breaks, or a million digits."""
        super().__init__(one_line(message))


class InputError(FracsimError):
    """A study, a mesh or a command line that cannot be run."""


class NotConverged(FracsimError):
    """The smallest allowed step failed; the message has the reason, the last good time and the checkpoint."""

    exit_code = Exit.NOT_CONVERGED


class Stopped(FracsimError):
    """A signal or the wall-time limit ended the run, with a checkpoint."""

    exit_code = Exit.STOPPED


class StepAborted(Exception):
    """A step was given up since the run is to stop; the body is as at the start of the step (on all ranks)."""


class CannotWrite(FracsimError):
    """Output could not be written in the middle of a run (disk full, folder gone); the message has what, and why."""

    exit_code = Exit.CANNOT_WRITE


class FalseClaim(FracsimError):
    """A report of the evidence was written, and a claim in it does not hold."""

    exit_code = Exit.FALSE_CLAIM
