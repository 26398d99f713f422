"""Other programs beside this one, on the same mesh and the same machine, in turn; each is left out where it is not
installed, and the page says so."""

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
    return [import_module(f".{name}", __package__) for name in FAMILIES]


def trials() -> list[Trial]:
    """Every trial of the group whose other program is there."""
    return [trial for family in _families() for trial in family.trials()]


def sections(records: list[dict[str, Any]]) -> list[Section]:
    """A section for each program, also where it is not installed."""
    return [section for family in _families() for section in family.sections(records)]
