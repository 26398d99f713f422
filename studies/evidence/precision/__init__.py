"""Error against run time: cases with a closed form or a converged solution, over mesh, step, scheme and solver."""

from __future__ import annotations

from typing import Any

from ..section import Section
from ..trial import Trial
from . import average, beam, brazilian, finite, fracture, plastic, solver, statics, wave
from .page import section

FAMILIES = (statics, beam, wave, finite, fracture, plastic, brazilian, average, solver)


def trials() -> list[Trial]:
    """Every trial of the group."""
    return [trial for family in FAMILIES for trial in family.trials()]


def sections(records: list[dict[str, Any]]) -> list[Section]:
    """A section for each case."""
    return [section(case, records) for family in FAMILIES for case in family.CASES]
