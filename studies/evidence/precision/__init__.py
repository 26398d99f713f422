"""Error against run time: cases with a closed form or a converged solution, over mesh, step, scheme and solver."""

from __future__ import annotations

from typing import Any

from ..section import Section
from ..trial import Trial
from . import average, beam, brazilian, finite, fracture, plastic, smooth, solver, statics, wave
from .page import in_doubt, section
from .short import summary

FAMILIES = (statics, smooth, beam, wave, finite, fracture, plastic, brazilian, average, solver)


def trials() -> list[Trial]:
    """Every trial of the group."""
    return [trial for family in FAMILIES for trial in family.trials()]


def to_time_again(records: list[dict[str, Any]]) -> set[tuple[str, str]]:
    """(case, name) of trials whose seconds decide something by more than noise, and were measured but once or twice."""
    return {(case.name, name) for family in FAMILIES for case in family.CASES for name in in_doubt(case, records)}


def sections(records: list[dict[str, Any]]) -> list[Section]:
    """The first screen, and a section for each case."""
    cases = [case for family in FAMILIES for case in family.CASES]
    return [*summary(cases, records), *(section(case, records) for case in cases)]
