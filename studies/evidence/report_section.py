"""Parts of the page that a group of trials returns, and arithmetic that groups share.

A group is a module with

    def trials() -> list[Trial]
    def sections(records: list[dict[str, Any]]) -> list[Section]

`sections` receives the records of its own group, including failed trials (`record["outcome"] != "done"`), which stay in
the tables. A record has group, case, name, settings, ranks, command, outcome, message, wall, stepping, cpu (lists of s,
one a run), summary (of the run, or None) and figures (of `Trial.measure` or the script). The folder of the trial is
OUT/group/case/name; `record_folder(record)` is its path inside OUT, as `Picture.path` expects it.

Section, Claim, ReportTable, Plot, PlotGrid, Series and Picture are frozen dataclasses of fracsim/report/content.py.
They are stored in evidence.json, from which `fracsim report` makes the page without importing a study.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from statistics import median
from typing import Any

import numpy as np

from ...report.content import Claim, Picture, Plot, PlotGrid, ReportTable, Section, Series, TableCell
from ...report.plots import pareto_front
from .trial import Setting

__all__ = [
    "Claim", "CostPoint", "Picture", "Plot", "PlotGrid", "ReportTable", "Section", "Series", "TableCell",
    "cheapest_point", "fitted_order", "median_and_half_range", "pareto_front", "record_folder", "rerun_hint",
]  # fmt: skip


@dataclass(frozen=True)
class CostPoint:
    """A setting with its cost (s, or core-seconds) and its relative error."""

    cost: float
    error: float
    settings: dict[str, Setting] = field(default_factory=dict)


def fitted_order(h: Sequence[float], error: Sequence[float]) -> float:
    """Exponent p of error = C h^p: least squares of log error over log h. Needs two different h; errors above 0."""
    x, y = np.log(np.asarray(h, float)), np.log(np.asarray(error, float))
    x = x - x.mean()
    return float(x @ (y - y.mean()) / (x @ x))


def cheapest_point(points: Sequence[CostPoint], limit: float) -> CostPoint | None:
    """The cheapest point with an error of at most `limit`; None if there is none."""
    good = sorted((point.cost, point.error, number) for number, point in enumerate(points) if point.error <= limit)
    return points[good[0][2]] if good else None


def rerun_hint(records: Sequence[dict[str, Any]]) -> str:
    """Sentence that says how to repeat the first trial: its command and folder. Empty if there is no trial."""
    commands = [(record["command"], record_folder(record)) for record in records if "command" in record]
    if not commands:
        return ""
    which = "it" if len(commands) == 1 else "the first trial"
    return f" `{commands[0][0]}`, in `{commands[0][1]}`, runs {which} again."


def median_and_half_range(seconds: Sequence[float]) -> tuple[float, float]:
    """(median, half of the range) of repeated timings, s: two columns of a table."""
    return median(seconds), (max(seconds) - min(seconds)) / 2


def record_folder(record: dict[str, Any]) -> str:
    """Folder of a trial inside OUT."""
    return f"{record['group']}/{record['case']}/{record['name']}"
