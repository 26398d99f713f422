"""Error against run time: cases with a closed form or a converged solution, over mesh, step, scheme and solver."""

from __future__ import annotations

from typing import Any

from ..report_section import Section
from ..trial import Trial
from . import (
    averaging_error,
    bar_fracture,
    bar_wave,
    brazilian_disk,
    convergence_orders,
    finite_strain,
    linear_statics,
    plastic_bar,
    solver_settings,
    vibrating_beam,
)
from .accuracy_summary import summary_sections
from .case_section import doubtful_trials, section

FAMILIES = (
    linear_statics,
    convergence_orders,
    vibrating_beam,
    bar_wave,
    finite_strain,
    bar_fracture,
    plastic_bar,
    brazilian_disk,
    averaging_error,
    solver_settings,
)


def trials() -> list[Trial]:
    """All trials of the group."""
    return [trial for family in FAMILIES for trial in family.trials()]


def trials_to_repeat(records: list[dict[str, Any]]) -> set[tuple[str, str]]:
    """(case, name) of trials whose timing decides a claim by more than noise and was measured once or twice."""
    return {
        (case.name, name) for family in FAMILIES for case in family.CASES for name in doubtful_trials(case, records)
    }


def sections(records: list[dict[str, Any]]) -> list[Section]:
    """Sections: the summary, and one for each case."""
    cases = [case for family in FAMILIES for case in family.CASES]
    return [*summary_sections(cases, records), *(section(case, records) for case in cases)]
