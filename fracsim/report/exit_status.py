"""How a run ended, told from outside: by its exit code and the log of what it said."""

from __future__ import annotations

from pathlib import Path

from ..errors import Exit

OUTCOMES: dict[int, str] = {
    Exit.DONE: "done",
    Exit.BAD_INPUT: "refused",
    Exit.NOT_CONVERGED: "not converged",
    Exit.STOPPED: "stopped",
    Exit.CANNOT_WRITE: "could not write",
}
MESSAGE_PREFIX = "fracsim: "  # before every message of the program's own


def read_log_messages(log: Path) -> str:
    """All lines that are the program's own, in one that begins as they do; "" where there are none."""
    own = [
        line
        for line in log.read_text(encoding="utf-8", errors="replace").splitlines()
        if line.startswith(MESSAGE_PREFIX)
    ]
    return MESSAGE_PREFIX + "; ".join(line.removeprefix(MESSAGE_PREFIX) for line in own) if own else ""


def read_last_message(log: Path) -> str:
    """The last line that is the program's own, else the last of all: what it said of its failure; "" where nothing."""
    said = [line for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    own = [line for line in said if line.startswith(MESSAGE_PREFIX)]
    return (own or said or [""])[-1]
