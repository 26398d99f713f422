"""Error against run time: cases with a closed form or a converged solution, over mesh, step, scheme and solver."""

from __future__ import annotations

from typing import Any

from ..report_section import Section
from ..trial import Trial
from . import (
    averaging_error,
    bar_fracture,
    bar_wave,
    bouncing_block,
    brazilian_disk,
    convergence_orders,
    finite_strain,
    linear_statics,
    peak_loads,
    plastic_bar,
    rigid_blow,
    solver_settings,
    spalled_bar,
    sphere_contact,
    torn_strip,
    vibrating_beam,
    wave_loaded_crack,
)
from .accuracy_summary import summary_sections
from .case_section import AccuracyCase, doubtful_trials, section

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
FRACTURE_CASES = (
    *peak_loads.CASES,
    wave_loaded_crack.CASE,
    torn_strip.CASE,
    spalled_bar.CASE,
    sphere_contact.CASE,
    bouncing_block.CASE,
    rigid_blow.CASE,
)


def trials() -> list[Trial]:
    """All trials of the group."""
    return [trial for part in (*FRACTURE_CASES, *FAMILIES) for trial in part.trials()]


def trials_to_repeat(records: list[dict[str, Any]]) -> set[tuple[str, str]]:
    """(case, name) of trials whose timing decides a claim by more than noise and was measured once or twice."""
    return {(case.name, name) for case in accuracy_cases() for name in doubtful_trials(case, records)}


def accuracy_cases() -> list[AccuracyCase]:
    """All cases, in the order of the report."""
    others = [case for family in FAMILIES for case in family.CASES]
    return [*others, *(case.accuracy_case() for case in FRACTURE_CASES)]


def sections(records: list[dict[str, Any]]) -> list[Section]:
    """Sections: the summary, and one for each case."""
    cases = accuracy_cases()
    return [*summary_sections(cases, records), *(section(case, records) for case in cases)]
