"""Sections about runs: settings and results, curves, energies, cost, references, and error against run time."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..meshes.plain_files import check_readable
from .content import Picture, Plot, ReportTable, Section, Series, TableCell
from .plots import pareto_front
from .runs import PHASES, RunData, Values, differing_settings

# columns of history.csv -> labels
ENERGY_LABELS = {
    "external_work": "external work", "elastic": "elastic", "kinetic": "kinetic", "dissipated": "dissipated",
}  # fmt: skip
# columns of history.csv, or the first words of their names -> units
_UNITS = {
    "time": "s", "dt": "s", "wall": "s", "reaction": "N", "onset": "N", "contact": "N", "probe": "m", "motion": "m",
    "work": "J", "kinetic": "J", "crack_length": "m", "crack_area": "m²", "tip": "m",
}  # fmt: skip


@dataclass(frozen=True)
class ReferenceCurve:
    """Curves to compare with.

    Attributes:
        name: name of the file without suffix.
        x: column of history.csv on the x axis.
        columns: values of all columns, in the order of the file.
    """

    name: str
    x: str
    columns: dict[str, Values]


def run_sections(
    runs: list[RunData], references: list[ReferenceCurve], *, quantity: str | None, exact: float | None
) -> list[Section]:
    """All sections of the report on runs.

    Args:
        runs: the runs.
        references: curves to compare with.
        quantity: quantity whose error is compared, see `RunData.quantity`; None: no such section.
        exact: exact value of the quantity; None: that of the finest run.
    """
    parts = [overview_section(runs)]
    if quantity is not None:
        parts.append(work_precision_section(runs, quantity, exact))
    if references:
        parts.append(reference_section(runs, references))
    return [*parts, *picture_sections(runs), curve_section(runs), energy_section(runs), cost_section(runs)]


def overview_section(runs: list[RunData]) -> Section:
    """Table of the runs with the settings that differ and the results."""
    keys = differing_settings(runs)
    peaks = list(dict.fromkeys(key for run in runs for key in run.summary.get("peak_reactions", {})))
    columns = (
        "run", *keys, "outcome", "pieces", "broken edges", "split cells", *(f"peak {key} N" for key in peaks),
        "external work J", "dissipated J", "cells", "nodes", "ranks", "steps", "failed attempts", "time s", "wall s",
        *(f"{phase} s" for phase in PHASES), "memory MiB",
    )  # fmt: skip
    rows = tuple(_overview_row(run, keys, peaks) for run in runs)
    titles = dict.fromkeys(str(run.settings.get("title", "")) for run in runs)
    text = f"{'; '.join(titles)}. Each run again: fracsim run study.toml, in its folder."
    caption = "Settings that differ, and what came out" if keys else "What came out"
    return Section("Runs", text, tables=(ReportTable("runs", caption, columns, rows),))


def _overview_row(run: RunData, keys: list[str], peaks: list[str]) -> tuple[TableCell, ...]:
    """Row of the overview; `keys`: settings that differ; `peaks`: columns of reactions."""
    get, history = run.summary.get, run.history
    seconds, reactions = get("seconds", {}), get("peak_reactions", {})
    last: Any = {key: values[-1] if len(values) else None for key, values in history.items()}
    return (
        run.name, *(_to_cell(run.settings.get(key)) for key in keys), run.outcome,
        get("pieces"), get("broken_edges"), get("split_cells"), *(reactions.get(key) for key in peaks),
        get("external_work"), get("dissipated"), get("cells"), get("nodes"), get("ranks"),
        get("steps", len(history["step"])), get("steps_failed"), get("time", last["time"]), run.wall,
        *(seconds.get(phase) for phase in PHASES), get("peak_memory_MiB"),
    )  # fmt: skip


def _to_cell(value: Any) -> TableCell:
    return value if value is None or isinstance(value, str | int | float | bool) else str(value)


def history_series(run: RunData, x: str, y: str, label: str) -> Series:
    """Curve of two columns of a run. A long curve is thinned, but keeps its extrema."""
    max_points = 600  # more cannot be distinguished on the page
    x_values, y_values = run.history[x], run.history[y]
    chosen = np.arange(len(x_values))
    if len(x_values) > max_points:
        extrema = [int(np.argmin(y_values)), int(np.argmax(y_values))]
        chosen = np.unique([*np.linspace(0, len(x_values) - 1, max_points).astype(int), *extrema])
    return Series(label, tuple(x_values[chosen].tolist()), tuple(y_values[chosen].tolist()), style="line")


def _run_curves(runs: list[RunData], x: str, y: str) -> tuple[Series, ...]:
    """Curve of each run; a single run needs no label."""
    return tuple(history_series(run, x, y, run.name if len(runs) > 1 else "") for run in runs)


def curve_section(runs: list[RunData]) -> Section:
    """Plots of reactions, contact forces and probes over time; forces also over the motion of their group."""
    kinds = ("reaction_", "contact_", "probe_")
    columns = list(dict.fromkeys(key for run in runs for key in run.history if key.startswith(kinds)))
    plots = []
    for column in columns:
        having = [run for run in runs if column in run.history]
        if not _is_significant(having, column):
            continue
        for x in (*_motion_columns(column, having), "time"):
            curves = tuple(history_series(run, x, column, run.name if len(runs) > 1 else "") for run in having)
            plots.append(Plot(f"{column} over {x}", _axis_label(x), _axis_label(column), curves))
    text = "" if plots else "These runs record no reaction and no probe ([[probe]] in the study)."
    return Section("Reactions and probes", text, plots=tuple(plots))


def _is_significant(runs: list[RunData], column: str) -> bool:
    """False for a component that is round-off compared with the others of its probe."""
    probe = column.rpartition("_")[0]

    def largest(name: str) -> float:
        return max(float(np.max(np.abs(run.history.get(name, np.zeros(1))), initial=0.0)) for run in runs)

    components = {name for run in runs for name in run.history if name.rpartition("_")[0] == probe}
    return largest(column) > 1e-6 * max(map(largest, components))


def _motion_columns(column: str, runs: list[RunData]) -> Iterator[str]:
    """Column with the motion of the same group or obstacle along the same axis, if it moves in all runs."""
    kind, _, group = column.partition("_")
    motion = f"motion_{group}"
    if kind != "probe" and all(np.any(run.history.get(motion, np.zeros(1))) for run in runs):
        yield motion


def column_unit(column: str) -> str:
    """Unit of a column of history.csv; "" for numbers and for columns without a known unit."""
    kind = column.partition("_")[0]
    return "J" if column in ENERGY_LABELS else _UNITS.get(column, _UNITS.get(kind, ""))


def _axis_label(column: str) -> str:
    """Name of a column with its unit."""
    unit = column_unit(column)
    return f"{column}, {unit}" if unit else column


def energy_section(runs: list[RunData]) -> Section:
    """Plots of the energies over time: one plot for a single run, otherwise one plot per energy."""
    if len(runs) == 1:
        curves = tuple(history_series(runs[0], "time", key, label) for key, label in ENERGY_LABELS.items())
        return Section("Energies", plots=(Plot("Energies over time", "time, s", "J", curves),))
    plots = tuple(
        Plot(f"{label} over time", "time, s", f"{label}, J", _run_curves(runs, "time", key))
        for key, label in ENERGY_LABELS.items()
    )
    return Section("Energies", plots=plots)


def cost_section(runs: list[RunData]) -> Section:
    """Plots of the wall time per step over time and over broken edges, and of the fragments over time."""
    plots = [Plot("Wall time of each step", "time, s", "s a step", _run_curves(runs, "time", "wall_step"), kind="logy")]
    if any(np.any(run.history["broken_edges"] > 0) for run in runs):
        curves = _run_curves(runs, "broken_edges", "wall_step")
        points = tuple(Series(curve.label, curve.x, curve.y, style="points") for curve in curves)
        plots.insert(0, Plot("Wall time of each step over the edges broken so far", "broken edges", "s a step", points))
        plots.append(Plot("Pieces over time", "time, s", "pieces", _run_curves(runs, "time", "pieces")))
    return Section("Cost of a step", plots=tuple(plots))


def picture_sections(runs: list[RunData]) -> list[Section]:
    """Section with the last frames of the runs that drew them, if there are any."""
    drawn = [run for run in runs if (run.folder / "last.png").is_file()]
    # absolute paths: runs may be in any folder
    pictures = tuple(Picture(f"{run.name}: the last frame", str(run.folder.resolve() / "last.png")) for run in drawn)
    return [Section("Pictures", pictures=pictures)] if pictures else []


# --- references -----------------------------------------------------------------------------------------------------


def read_reference(path: Path) -> ReferenceCurve:
    """Reference curves of a CSV file with a header: the x column first, then one or more y columns.

    Raises:
        InputError: the file is not such a table.
    """
    try:
        check_readable(path)
        with path.open(newline="", encoding="utf-8") as file:
            header, *rows = [row for row in csv.reader(file) if row]
        if wrong := next((row for row in rows if len(row) != len(header)), None):
            raise ValueError(f"the first line has {len(header)} columns, the line '{','.join(wrong)}' {len(wrong)}")
        if all(map(_reads_as_number, header)):
            raise ValueError("the first line has numbers, where the names of the columns belong")
        table = np.array(rows, float)
        if len(header) < 2 or table.ndim != 2 or table.shape[1] != len(header) or not np.isfinite(table).all():
            raise ValueError("every row must have a number for each of two or more columns")
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        raise InputError(
            f"--reference {path}: {why}. Give a CSV whose first line names columns of history.csv, x first: "
            "motion_grip_x,reaction_grip_x"
        ) from None
    columns = dict(zip(header, table.T, strict=True))
    return ReferenceCurve(path.stem, header[0].strip(), {name.strip(): values for name, values in columns.items()})


def _reads_as_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def reference_section(runs: list[RunData], references: list[ReferenceCurve]) -> Section:
    """Plots of the runs with the references, and a table of their deviations."""
    plots, rows = [], []
    for reference in references:
        for y in (name for name in reference.columns if name != reference.x):
            plots.append(_reference_plot(runs, reference, y))
            rows += [(reference.name, y, run.name, *_deviation(run, reference, y)) for run in runs]
    columns = ("reference", "quantity", "run", "peak", "peak of the reference", "peak, relative", "rms, relative")
    caption = "Runs beside references: rms over the range that both cover, relative to the largest reference value"
    table = ReportTable("references", caption, columns, tuple(rows))
    return Section("References", tables=(table,), plots=tuple(plots))


def _reference_plot(runs: list[RunData], reference: ReferenceCurve, y: str) -> Plot:
    """Plot of a column of the runs and of the reference. Raises InputError if a run lacks a column."""
    option = f"--reference {reference.name}"
    for run in runs:
        run.history_column(reference.x, option), run.history_column(y, option)
    x_values, y_values = (tuple(map(float, reference.columns[name])) for name in (reference.x, y))
    curve = Series(reference.name, x_values, y_values, style="reference")
    curves = tuple(history_series(run, reference.x, y, run.name) for run in runs)
    return Plot(f"{y} beside {reference.name}", _axis_label(reference.x), _axis_label(y), (*curves, curve))


def _deviation(run: RunData, reference: ReferenceCurve, y: str) -> tuple[TableCell, ...]:
    """Peak of the run, peak of the reference, relative deviation of the peak, relative rms deviation."""
    run_x, run_y = run.history[reference.x], run.history[y]
    x, expected = reference.columns[reference.x], reference.columns[y]
    peak, reference_peak = run.peak(y), float(np.max(np.abs(expected)))
    order, by_x = (np.argsort(values, kind="stable") for values in (run_x, x))
    x, expected = x[by_x], expected[by_x]
    common = (x >= run_x.min(initial=math.inf)) & (x <= run_x.max(initial=-math.inf))
    rms = None
    if common.any() and reference_peak > 0:
        difference = np.interp(x[common], run_x[order], run_y[order]) - expected[common]
        rms = float(np.sqrt(np.mean(difference**2))) / reference_peak
    return peak, reference_peak, peak / reference_peak - 1 if reference_peak > 0 else None, rms


# --- error against run time -----------------------------------------------------------------------------------------


def work_precision_section(runs: list[RunData], quantity: str, exact: float | None) -> Section:
    """Error of a quantity against wall time and core-seconds.

    Args:
        runs: the runs.
        quantity: see `RunData.quantity`.
        exact: exact value; None: that of the finest run that reached its end.

    Raises:
        InputError: no run reached its end, or the reference is 0 or not finite.
    """
    done = [run for run in runs if run.outcome == "done"]
    if not done:
        raise InputError(f"--quantity {quantity}: none of the runs ended well")
    finest = max(done, key=lambda run: (run.summary.get("cells", 0), run.summary.get("steps", 0)))
    reference = exact if exact is not None else finest.quantity(quantity)
    if reference == 0 or not math.isfinite(reference):
        raise InputError(f"--quantity {quantity}: its reference is {reference:g}, which no error can be relative to")
    compared = [run for run in done if exact is not None or run is not finest]
    errors = {run.name: abs(run.quantity(quantity) / reference - 1) for run in compared}
    keys = differing_settings(runs)
    front = {compared[index].name for index in pareto_front([(run.wall, errors[run.name]) for run in compared])}
    rows = tuple(
        (run.name, *(_to_cell(run.settings.get(key)) for key in keys), run.outcome,
         run.quantity(quantity) if run.outcome == "done" else None,
         errors.get(run.name), run.wall, run.wall * run.ranks, run.name in front)
        for run in runs
    )  # fmt: skip
    columns = ("run", *keys, "outcome", quantity, "error, relative", "wall s", "core s", "on the Pareto front")
    source = f"{exact:g}, as given" if exact is not None else f"{reference:.6g}, that of the finest run, {finest.name}"
    plots = tuple(_work_precision_plot(compared, errors, by_cores) for by_cores in (False, True)) if compared else ()
    table = ReportTable("precision", f"{quantity}: reference {source}", columns, rows)
    return Section(f"Error of {quantity}", tables=(table,), plots=plots)


def _work_precision_plot(runs: list[RunData], errors: dict[str, float], by_cores: bool) -> Plot:
    """Plot of errors against wall time in s, or against core-seconds."""
    points = sorted((run.wall * (run.ranks if by_cores else 1), errors[run.name], run.name) for run in runs)
    x, y, names = zip(*points, strict=True)
    label = "core-seconds" if by_cores else "wall time, s"
    series = Series("", x, y, style="points", names=names)
    return Plot(
        f"Error against {label}", label, "relative error", (series,), "loglog", pareto=True, levels=(0.01, 0.05)
    )
