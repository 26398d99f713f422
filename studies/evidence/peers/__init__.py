"""Other programs beside fracsim on the same mesh and machine, in turn.

A program that is not installed is left out, and the page says so.
"""

from __future__ import annotations

import os
import subprocess
from importlib import import_module
from typing import Any

from ..report_section import Section
from ..trial import Trial

# by name: they are scripts as well, which must not be imported before they run
FAMILIES = ("linear_step", "start_up")


def _families() -> list[Any]:
    """Modules of the group."""
    return [import_module(f".{name}", __package__) for name in FAMILIES]


def trials() -> list[Trial]:
    """Trials of the group whose other program is installed."""
    return [trial for family in _families() for trial in family.trials()]


def sections(records: list[dict[str, Any]]) -> list[Section]:
    """Section for each program, even if it is not installed."""
    return [section for family in _families() for section in family.sections(records)]


def working_python(variable: str, code: str) -> str | None:
    """Python that an environment variable names, if it runs `code` without error; else None."""
    given = os.environ.get(variable)
    if not given:
        return None
    try:
        done = subprocess.run([given, "-I", "-c", code], capture_output=True, timeout=120)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return given if done.returncode == 0 else None
