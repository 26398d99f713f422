"""Published computations and measurements beside fracsim's results.

Single-edge notched tension (Miehe, Hofacker and Welschinger 2010), which many have computed. A concrete panel that was
measured: Winkler (2001), fig. 7.12, series A, as github.com/PSAAPGroupLinder/lShapedPanelBenchmark has it.
"""

from __future__ import annotations

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
# displacement, mm, and load, N
PANEL_CURVE = (
    (0.0, 6.4), (0.0498, 2014.9), (0.0956, 4016.3), (0.1207, 5000.9), (0.1359, 5584.3), (0.1483, 5998.9),
    (0.1609, 6400.6), (0.1713, 6707.5), (0.1839, 6991.8), (0.1925, 7132.9), (0.2008, 7209.8), (0.2078, 7219.1),
    (0.2162, 7123.7), (0.2241, 6983.3), (0.2384, 6713.8), (0.2543, 6342.8), (0.2693, 5996.0), (0.2839, 5644.4),
    (0.3002, 5265.4), (0.3238, 4800.6), (0.3463, 4408.4), (0.3684, 4014.6), (0.3996, 3528.6), (0.4486, 3003.0),
    (0.4992, 2477.4), (0.5476, 2162.7), (0.5986, 1910.6), (0.6982, 1545.1), (0.7988, 1282.5), (0.8990, 1100.4),
    (1.0003, 1040.5),
)  # fmt: skip
MEASURED = {
    "l-panel": (tuple(displacement * 1e-3 for displacement, _ in PANEL_CURVE), tuple(load for _, load in PANEL_CURVE))
}


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
