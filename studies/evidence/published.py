"""A plate that many have computed, beside ours: single-edge notched tension (Miehe, Hofacker and Welschinger 2010)."""

from __future__ import annotations

from typing import Any

import numpy as np

from .section import Cell, Table

Record = dict[str, Any]

CASE = "notched-tension"
COLUMNS = ("single-edge notched tension, 1 mm, 2.7 kJ/m2", "h, m", "peak, N", "at, m", "stiffness, N/m")
# figures that were collected for this project beforehand; the paper's curve itself was not laid beside
OTHERS: tuple[tuple[Cell, ...], ...] = (
    ("phase field (Miehe et al. 2010)", None, 701.0, 5.55e-6, "1.37e8 to 1.42e8"),
    ("Griffith, sharp crack", None, 645.0, 4.56e-6, None),
)


def table(records: list[Record]) -> tuple[Table, ...]:
    """Peak, the grip's motion there and the stiffness before it; none where the plate was not run."""
    done = [r for r in records if r["case"] == CASE and r["outcome"] == "done" and "curve" in r["figures"]]
    ours = [(f"{CASE}, {r['name']}", r["settings"]["h"], *read(*r["figures"]["curve"])) for r in done]
    return (Table("published", "The notched plate beside others' results", COLUMNS, (*ours, *OTHERS)),) if ours else ()


def read(way: list[float], load: list[float]) -> tuple[float, float, float]:
    """Peak in N, the motion there in m, from where the line through the rise to half of it starts, whose slope in N/m
    is the stiffness."""
    moved, borne = np.array(way), np.array(load)
    rise = np.flatnonzero((np.arange(len(borne)) < borne.argmax()) & (borne < borne.max() / 2))
    slope, offset = np.polyfit(moved[rise], borne[rise], 1)
    return float(borne.max()), float(moved[borne.argmax()] + offset / slope), float(slope)
