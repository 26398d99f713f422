"""Runs as a report sees them: settings, history and summary of output folders, and how a run ended."""

from __future__ import annotations

import csv
import json
import re
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import Exit, InputError
from ..meshes.plain_files import check_readable

Values = npt.NDArray[np.float64]
PHASES = ("setup", "solve", "plasticity", "fracture", "energies", "output")
OUTCOMES: dict[int, str] = {
    Exit.DONE: "done",
    Exit.BAD_INPUT: "refused",
    Exit.NOT_CONVERGED: "not converged",
    Exit.STOPPED: "stopped",
    Exit.CANNOT_WRITE: "could not write",
}
# begins each message of the program in a log
MESSAGE_PREFIX = "fracsim: "


class Columns(dict[str, Values]):
    """Columns of a file by name; the KeyError of a name that is none lists the names."""

    def __init__(self, file: str, columns: Iterable[tuple[str, Values]]) -> None:
        """`file`: name of the file; `columns`: pairs of name and values."""
        super().__init__(columns)
        self._file = file

    def __missing__(self, name: str) -> Values:
        """Raise KeyError."""
        raise KeyError(f"{self._file} has no column {name!r}; it has: {', '.join(self)}")


@dataclass(frozen=True)
class RunData:
    """Files of one run.

    Attributes:
        name: name of the run on the page.
        folder: output folder.
        settings: values of the study by "table.key".
        history: columns of history.csv, a value per step.
        summary: values of summary.json; empty if the run was killed.
    """

    name: str
    folder: Path
    settings: dict[str, Any]
    history: dict[str, Values]
    summary: dict[str, Any] = field(default_factory=dict)

    @property
    def outcome(self) -> str:
        """Outcome of the run; "unfinished" if it was killed."""
        return str(self.summary.get("outcome", "unfinished"))

    @property
    def ranks(self) -> int:
        """Number of MPI ranks."""
        return int(self.summary.get("ranks", 1))

    @property
    def wall(self) -> float:
        """Wall time, s; of an unfinished run the sum over its steps."""
        return float(self.summary.get("wall", self.history["wall_step"].sum()))

    def quantity(self, name: str) -> float:
        """Quantity by name: peak_COLUMN, final_COLUMN, or a number of summary.json. Raises InputError if unknown."""
        kind, _, column = name.partition("_")
        if column in self.history and kind in ("peak", "final"):
            values = self.history[column]
            return float("nan") if not len(values) else self.peak(column) if kind == "peak" else float(values[-1])
        if _is_number(self.summary.get(name)):
            return float(self.summary[name])
        columns, figures = ", ".join(self.history), ", ".join(k for k, v in self.summary.items() if _is_number(v))
        raise InputError(
            f"--quantity {name}: {self.name} has no such figure. Give peak_COLUMN or final_COLUMN with one of the "
            f"columns {columns}; or one of {figures or 'the figures of summary.json, which it does not have'}"
        )

    def peak(self, column: str) -> float:
        """Largest absolute value of a column; of a reaction also as edges broke in a step, as in `peak_reactions`."""
        onset = column.replace("reaction_", "onset_", 1)
        columns = {column, onset} & {*self.history}
        return max(float(np.max(np.abs(self.history[name]), initial=0.0)) for name in columns)

    def history_column(self, name: str, option: str) -> Values:
        """Column of the history. Raises InputError, naming the command-line option, if there is none."""
        if name not in self.history:
            raise InputError(f"{option}: {self.name} has no column {name}; it has: {', '.join(self.history)}")
        return self.history[name]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def is_run(folder: Path) -> bool:
    """True if a folder has the study and the history of a run."""
    return (folder / "study.toml").is_file() and (folder / "history.csv").is_file()


def find_runs(folders: list[Path]) -> list[RunData]:
    """Runs in folders: output folders, or folders of sweeps and job arrays.

    Raises:
        InputError: a folder has no run.
    """
    paths: list[Path] = []
    for folder in folders:
        cases = [path for path in _case_folders(folder) if is_run(path)]
        if not cases and not is_run(folder):
            missing = "it has no study.toml with a history.csv, and no folder in it has"
            problem = missing if folder.is_dir() else "there is no such folder"
            raise InputError(f"{folder} is not the output folder of a run, a sweep or of evidence: {problem}")
        paths += cases or [folder]
    return [read_run(path, name) for path, name in zip(paths, _distinct_names(paths), strict=True)]


def _case_folders(folder: Path) -> list[Path]:
    """Folders of the runs of a sweep, in its order; of a job array, which has no table, in the order of their names."""
    table = folder / "sweep.csv"
    if table.is_file():
        with table.open(newline="", encoding="utf-8") as file:
            return [folder / row["case"] for row in csv.DictReader(file) if row.get("case")]
    if is_run(folder) or not folder.is_dir():
        return []
    return sorted((path for path in folder.iterdir() if path.is_dir()), key=_numeric_order)


def _numeric_order(path: Path) -> list[tuple[float, str]]:
    """Sort key of a name in which numbers count by value: h-0.02 before h-0.1, step-1e-3 before step-0.01."""
    parts = re.split(r"(\d+(?:\.\d*)?(?:e[+-]?\d+)?)", path.name)
    return [(float(part), "") if part[:1].isdigit() else (0.0, part) for part in parts]


def _distinct_names(folders: list[Path]) -> list[str]:
    """Last parts of the paths, as few as distinguish the folders. Raises InputError for equal folders."""
    parts = [folder.resolve().parts for folder in folders]
    for depth in range(1, max(map(len, parts), default=1) + 1):
        names = ["/".join(part[-depth:]) for part in parts]
        if len(set(names)) == len(names):
            return names
    raise InputError("the same folder is given twice")


def read_run(folder: Path, name: str) -> RunData:
    """Files of a run in an output folder. Raises InputError if they are not those of a run."""
    try:
        for file in ("study.toml", "history.csv", "summary.json"):
            check_readable(folder / file)
        study = tomllib.loads((folder / "study.toml").read_text(encoding="utf-8"))
        history = _read_history(folder / "history.csv")
        path = folder / "summary.json"
        summary = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{folder}: its files are not those of a run: {error}") from None
    return RunData(name, folder, flatten_tables(study), history, summary)


def _read_history(path: Path) -> dict[str, Values]:
    """Columns of history.csv; incomplete rows are left out. Raises ValueError."""
    with path.open(newline="", encoding="utf-8") as file:
        header, *rows = list(csv.reader(file)) or [[]]
    if not {"time", "step", "wall_step"} <= set(header):
        raise ValueError("history.csv has no columns step, time and wall_step")
    table = np.array([row for row in rows if len(row) == len(header)], float).reshape(-1, len(header))
    return Columns(path.name, zip(header, table.T, strict=True))


def flatten_tables(data: Any, prefix: str = "") -> dict[str, Any]:
    """Values of nested tables by "a.b.0.c"; lists of plain values are one value."""
    if isinstance(data, list) and any(isinstance(item, dict) for item in data):
        data = dict(enumerate(data))
    if not isinstance(data, dict):
        return {prefix: data}
    parts = [flatten_tables(value, f"{prefix}.{key}" if prefix else str(key)) for key, value in data.items()]
    return {key: value for part in parts for key, value in part.items()}


def differing_settings(runs: list[RunData]) -> list[str]:
    """Settings, except the title, that differ between runs, in the order of the study."""
    keys = list(dict.fromkeys(key for run in runs for key in run.settings))
    return [key for key in keys if key != "title" and len({repr(run.settings.get(key)) for run in runs}) > 1]


# --- logs -------------------------------------------------------------------------------------------------------------


def read_log_messages(log: Path) -> str:
    """All messages of the program in a log, joined to one; "" if there are none."""
    messages = [
        line
        for line in log.read_text(encoding="utf-8", errors="replace").splitlines()
        if line.startswith(MESSAGE_PREFIX)
    ]
    return MESSAGE_PREFIX + "; ".join(line.removeprefix(MESSAGE_PREFIX) for line in messages) if messages else ""


def read_log_notes(log: Path) -> list[str]:
    """Notes of the program in a log, each once; none if there is no log."""
    if not log.is_file():
        return []
    prefix = f"{MESSAGE_PREFIX}note: "
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    return list(dict.fromkeys(line.removeprefix(prefix) for line in lines if line.startswith(prefix)))


def read_last_message(log: Path) -> str:
    """Last message of the program in a log, or else the last line; "" if the log is empty."""
    lines = [line for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    messages = [line for line in lines if line.startswith(MESSAGE_PREFIX)]
    return (messages or lines or [""])[-1]
