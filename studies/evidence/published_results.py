"""Published computations and measurements beside fracsim's results.

Single-edge notched tension (Miehe, Hofacker and Welschinger 2010), which many have computed. A concrete panel that was
measured: Winkler (2001), fig. 7.12, series A, as github.com/PSAAPGroupLinder/lShapedPanelBenchmark has it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .report_section import ReportTable, TableCell

Record = dict[str, Any]

CASE = "notched-tension"
COLUMNS = ("single-edge notched tension, 1 mm, 2.7 kJ/m2", "h, m", "peak, N", "at, m", "stiffness, N/m")
# published figures; the curve of the paper is not compared
PUBLISHED_ROWS: tuple[tuple[TableCell, ...], ...] = (
    ("phase field (Miehe et al. 2010)", None, 701.0, 5.55e-6, "1.37e8 to 1.42e8"),
    ("Griffith, sharp crack", None, 645.0, 4.56e-6, None),
)


def _measured_panel() -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return displacement, m, and load, N, of the measured panel."""
    rows = np.loadtxt(Path(__file__).with_name("winkler-2001.csv"), delimiter=",", skiprows=1)
    return tuple(float(mm) * 1e-3 for mm in rows[:, 0]), tuple(float(load) for load in rows[:, 1])


MEASURED = {"l-panel": _measured_panel()}


def table(records: list[Record]) -> tuple[ReportTable, ...]:
    """Table of peak, displacement at the peak and initial stiffness; empty if the plate was not run."""
    done = [r for r in records if r["case"] == CASE and r["outcome"] == "done" and "curve" in r["figures"]]
    ours = [(f"{CASE}, {r['name']}", r["settings"]["h"], *curve_figures(*r["figures"]["curve"])) for r in done]
    return (
        (ReportTable("published", "Notched plate: fracsim and published results", COLUMNS, (*ours, *PUBLISHED_ROWS)),)
        if ours
        else ()
    )


def curve_figures(displacement: list[float], load: list[float]) -> tuple[float, float, float]:
    """Peak (N), displacement at the peak (m) and stiffness (N/m) of a load curve.

    The stiffness is the slope of a line fitted up to half the peak. Displacements count from the zero of that line.
    """
    u, force = np.array(displacement), np.array(load)
    rise = np.flatnonzero((np.arange(len(force)) < force.argmax()) & (force < force.max() / 2))
    slope, offset = np.polyfit(u[rise], force[rise], 1)
    return float(force.max()), float(u[force.argmax()] + offset / slope), float(slope)
