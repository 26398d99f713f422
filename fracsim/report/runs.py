"""Run folders as the report sees them: settings, history and summary of each."""

from __future__ import annotations

import csv
import json
import re
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import InputError
from ..meshes.plain_files import check_readable

Values = npt.NDArray[np.float64]
PHASES = ("setup", "solve", "plasticity", "fracture", "energies", "output")


@dataclass(frozen=True)
class RunData:
    """What one run left behind.

    Attributes:
        name: how the page calls it.
        settings: "table.key" -> value of the study as run.
        history: column -> values, a number a step.
        summary: of summary.json; empty where the run was killed.
    """

    name: str
    folder: Path
    settings: dict[str, Any]
    history: dict[str, Values]
    summary: dict[str, Any] = field(default_factory=dict)

    @property
    def outcome(self) -> str:
        return str(self.summary.get("outcome", "unfinished"))

    @property
    def ranks(self) -> int:
        return int(self.summary.get("ranks", 1))

    @property
    def wall(self) -> float:
        """Seconds of wall time; of an unfinished run those of its steps."""
        return float(self.summary.get("wall", self.history["wall_step"].sum()))

    def quantity(self, name: str) -> float:
        """A quantity by its name: peak_COLUMN, final_COLUMN, or a number of summary.json. InputError where unknown."""
        kind, _, column = name.partition("_")
        if column in self.history and kind in ("peak", "final"):
            values = self.history[column]
            return float("nan") if not len(values) else float(np.max(np.abs(values)) if kind == "peak" else values[-1])
        if _is_number(self.summary.get(name)):
            return float(self.summary[name])
        columns, figures = ", ".join(self.history), ", ".join(k for k, v in self.summary.items() if _is_number(v))
        raise InputError(
            f"--quantity {name}: {self.name} has no such figure. Give peak_COLUMN or final_COLUMN with one of the "
            f"columns {columns}; or one of {figures or 'the figures of summary.json, which it does not have'}"
        )

    def history_column(self, name: str, option: str) -> Values:
        """A column of the history. InputError where there is none of that name."""
        if name not in self.history:
            raise InputError(f"{option}: {self.name} has no column {name}; it has: {', '.join(self.history)}")
        return self.history[name]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def is_run(folder: Path) -> bool:
    """Whether a run has begun there."""
    return (folder / "study.toml").is_file() and (folder / "history.csv").is_file()


def find_runs(folders: list[Path]) -> list[RunData]:
    """Runs of the folders given, those of a sweep's folder or of a job array's one by one. InputError for a folder
    without any."""
    found: list[Path] = []
    for folder in folders:
        inner = [path for path in _cases(folder) if is_run(path)]
        if not inner and not is_run(folder):
            missing = "it has no study.toml with a history.csv, and no folder in it has"
            problem = missing if folder.is_dir() else "there is no such folder"
            raise InputError(f"{folder} is not the output folder of a run, a sweep or of evidence: {problem}")
        found += inner or [folder]
    return [read_run(path, name) for path, name in zip(found, _names(found), strict=True)]


def _cases(folder: Path) -> list[Path]:
    """Folders of a sweep, in its order; where a job array ran it there is no table, and folders go by their names."""
    table = folder / "sweep.csv"
    if table.is_file():
        with table.open(newline="", encoding="utf-8") as file:
            return [folder / row["case"] for row in csv.DictReader(file) if row.get("case")]
    if is_run(folder) or not folder.is_dir():
        return []
    return sorted((path for path in folder.iterdir() if path.is_dir()), key=_by_number)


def _by_number(path: Path) -> list[tuple[float, str]]:
    """A name by its parts, numbers by their value: h-0.02 before h-0.1, step-1e-3 before step-0.01."""
    parts = re.split(r"(\d+(?:\.\d*)?(?:e[+-]?\d+)?)", path.name)
    return [(float(part), "") if part[:1].isdigit() else (0.0, part) for part in parts]


def _names(folders: list[Path]) -> list[str]:
    """The last parts of the paths, as many of them as tell the folders apart."""
    parts = [folder.resolve().parts for folder in folders]
    for depth in range(1, max(map(len, parts), default=1) + 1):
        names = ["/".join(part[-depth:]) for part in parts]
        if len(set(names)) == len(names):
            return names
    raise InputError("the same folder is given twice")


def read_run(folder: Path, name: str) -> RunData:
    """Read one run. InputError where its files are not what a run writes."""
    try:
        for each in ("study.toml", "history.csv", "summary.json"):
            check_readable(folder / each)
        study = tomllib.loads((folder / "study.toml").read_text(encoding="utf-8"))
        history = _read_history(folder / "history.csv")
        path = folder / "summary.json"
        summary = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{folder}: its files are not those of a run: {error}") from None
    return RunData(name, folder, flatten_tables(study), history, summary)


def _read_history(path: Path) -> dict[str, Values]:
    """Columns of history.csv; a last row that was cut short is left out."""
    with path.open(newline="", encoding="utf-8") as file:
        header, *rows = list(csv.reader(file)) or [[]]
    if not {"time", "step", "wall_step"} <= set(header):
        raise ValueError("history.csv has no columns step, time and wall_step")
    table = np.array([row for row in rows if len(row) == len(header)], float).reshape(-1, len(header))
    return dict(zip(header, table.T, strict=True))


def flatten_tables(data: Any, prefix: str = "") -> dict[str, Any]:
    """Nested tables as "a.b.0.c" -> value; lists of plain values stay whole."""
    if isinstance(data, list) and any(isinstance(item, dict) for item in data):
        data = dict(enumerate(data))
    if not isinstance(data, dict):
        return {prefix: data}
    parts = [flatten_tables(value, f"{prefix}.{key}" if prefix else str(key)) for key, value in data.items()]
    return {key: value for part in parts for key, value in part.items()}


def differing_settings(runs: list[RunData]) -> list[str]:
    """Settings that are not the same in all runs, in the order of the study; titles left out."""
    keys = list(dict.fromkeys(key for run in runs for key in run.settings))
    return [key for key in keys if key != "title" and len({repr(run.settings.get(key)) for run in runs}) > 1]
