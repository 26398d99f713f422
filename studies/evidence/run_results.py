"""Read the output of a run: history.csv and other tables, frames of fields.h5, study.toml."""

from __future__ import annotations

import csv
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ...output.fields_file import read_field

Values = npt.NDArray[Any]


def history(run: Path) -> dict[str, Values]:
    """Columns of history.csv by name: (steps,) each."""
    return columns(run / "history.csv")


def columns(path: Path) -> dict[str, Values]:
    """Columns of a table of numbers by name: (rows,) each."""
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.reader(file))
    table = np.array(rows[1:], float).reshape(-1, len(rows[0]))
    return dict(zip(rows[0], table.T, strict=True))


def last_frame(run: Path) -> dict[str, Any]:
    """The last frame: time (s), points (nodes, 3) in m, cells, and every field by its name."""
    import h5py

    with h5py.File(run / "fields.h5") as file:
        frame = file["frames"][max(file["frames"])]
        results = {name: read_field(data) for name, data in frame.items()}
        return {"time": float(frame.attrs["time"]), "points": file["points"][()], "cells": file["cells"][()]} | results


def study(run: Path) -> dict[str, Any]:
    """The study of the run with all defaults."""
    return tomllib.loads((run / "study.toml").read_text(encoding="utf-8"))


def first_break(run: Path) -> float:
    """Time in s of the first step that broke an edge; NaN if none did."""
    rows = history(run)
    broken = np.flatnonzero(rows["broken_edges"] > 0)
    return float(rows["time"][broken[0]]) if len(broken) else float("nan")
