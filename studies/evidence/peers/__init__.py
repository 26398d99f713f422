"""Other programs beside fracsim on the same mesh and machine, in turn.

A program that is not installed is left out, and the page says so.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

from ..report_section import Section
from ..trial import Trial

FAMILIES = (
    "linear_step",
    "phase_field",
    "start_up",
)  # by name: they are scripts as well, which are not to be imported before they run


def _families() -> list[Any]:
    """Modules of the group."""
    return [import_module(f".{name}", __package__) for name in FAMILIES]


def trials() -> list[Trial]:
    """Trials of the group whose other program is installed."""
    return [trial for family in _families() for trial in family.trials()]


def sections(records: list[dict[str, Any]]) -> list[Section]:
    """Section for each program, even if it is not installed."""
    return [section for family in _families() for section in family.sections(records)]
