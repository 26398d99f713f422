"""Summary of all cases: the cheapest setting for 5 % and for 1 %, its seconds, and those of other programs."""

from __future__ import annotations

from typing import Any

from ..peers import phase_field
from ..peers.akantu import ABSENT, akantu_python
from ..report_section import Plot, PlotGrid, ReportTable, Section, Series, TableCell, pareto_front
from .case_section import (
    ERROR_LIMITS,
    AccuracyCase,
    AccuracyRow,
    Records,
    case_rows,
    cheapest_row,
    describe_setting,
    is_comparable,
)

FINEST = 1e-4  # of errors that are told apart in the plot
OWN = "fracsim"
PEERS = {"quadratic": "DOLFINx alone, quadratic"}  # by the setting `elements` of their trials


def summary_sections(cases: list[AccuracyCase], records: Records) -> list[Section]:
    """Section with table and plot; empty if no case has rows."""
    results = [(case, rows) for case in cases if case.compare_cost and (rows := case_rows(case, records))]
    if not results:
        return []
    peers = sorted({peer for _, rows in results for row in rows if (peer := other_program(row.record))})
    seconds = [f"{peer}: s for {limit:.0%}" for peer in peers for limit in ERROR_LIMITS]
    own = [words for limit in ERROR_LIMITS for words in (f"cheapest setting for {limit:.0%}", f"s for {limit:.0%}")]
    table = ReportTable(
        "precision-short", "Core-seconds in the steps that an error takes. Empty: no setting that ran is that good.",
        ("case", "error of", *own, *seconds), tuple(_case_row(case, rows, peers) for case, rows in results),
    )  # fmt: skip
    panels = tuple(_panel(case, rows, peers) for case, rows in results)
    plot = PlotGrid(
        f"Relative error against core-seconds in the steps, a panel for each case: the best settings of each program. "
        f"Dotted: 5 % and 1 %. Errors below {FINEST:g} count as that.", panels,
    )  # fmt: skip
    without = "" if peers else " No other program has run beside them here."
    if "Akantu" not in peers and akantu_python() is None:
        without += f" {ABSENT}"
    if "PhaseFieldX" not in peers and phase_field.phasefieldx_python() is None:
        without += f" {phase_field.ABSENT}"
    text = f"What an error of 5 % and of 1 % costs.{without} What does not hold comes next, everything else below."
    return [Section("Error against run time", text, tables=(table,), plots=(plot,), first=True)]


def other_program(record: dict[str, Any]) -> str | None:
    """Name of the other program of a trial; None for fracsim."""
    elements = record["settings"].get("elements")
    return None if elements is None else PEERS.get(str(elements), str(elements))


def _case_row(case: AccuracyCase, rows: list[AccuracyRow], peers: list[str]) -> tuple[TableCell, ...]:
    """Row of a case: cheapest settings and seconds, and seconds of other programs."""
    ours = [row for row in rows if is_comparable(case, row)]
    cells: list[TableCell] = [case.title, case.errors[0]]
    for limit in ERROR_LIMITS:
        row = cheapest_row(case, ours, limit)
        cells += [None, None] if row is None else [_setting_name(row), row.core_seconds]
    for peer in peers:
        theirs = [row for row in rows if other_program(row.record) == peer and case.errors[0] in row.errors]
        cells += [
            None if row is None else row.core_seconds for row in (cheapest_row(case, theirs, x) for x in ERROR_LIMITS)
        ]
    return tuple(cells)


def _setting_name(row: AccuracyRow) -> str:
    """Setting as text; a solver by its name, since its options are listed with its case."""
    settings = row.record["settings"]
    return f"solver = {settings['solver']}" if "solver" in settings else describe_setting(row)


def _panel(case: AccuracyCase, rows: list[AccuracyRow], peers: list[str]) -> Plot:
    """Plot of a case: Pareto-optimal settings of fracsim and of other programs."""
    programs = {OWN: [row for row in rows if is_comparable(case, row)]}
    for peer in peers:
        programs[peer] = [
            row for row in rows if other_program(row.record) == peer and case.errors[0] in row.errors
            and row.record["outcome"] == "done"
        ]  # fmt: skip
    series = tuple(_pareto_series(name, case, own) for name, own in programs.items() if own)
    return Plot(case.title, "core-seconds", "relative error", series, "loglog", levels=ERROR_LIMITS)


def _pareto_series(label: str, case: AccuracyCase, rows: list[AccuracyRow]) -> Series:
    """Pareto-optimal settings in cost and error, the cheapest first."""
    points = [(row.core_seconds, max(row.errors[case.errors[0]], FINEST)) for row in rows]
    best = sorted(points[place] for place in pareto_front(points))
    return Series(label, tuple(x for x, _ in best), tuple(y for _, y in best))
