"""Other programs beside this one, on the same mesh and the same machine, in turn; each is left out where it is not
installed, and the page says so."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from ..section import Section
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


def write_of_size(words: str | None, n: int, beside: Callable[[int], dict[str, Any]]) -> None:
    """What a script of a peer does: `beside` of --n (or `n`) cells a side goes to --out; `words` are its help."""
    parser = argparse.ArgumentParser(description=words)
    parser.add_argument("--n", type=int, default=n)
    parser.add_argument("-o", "--out", type=Path, required=True)
    given = parser.parse_args()
    given.out.write_text(json.dumps(beside(given.n), indent=1) + "\n")
