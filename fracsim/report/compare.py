"""Sections about run folders: what ran, curves, energies, cost, curves of experiments, error against run time."""

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
from .pareto import pareto_front
from .runs import PHASES, RunData, Values, differing_settings

ENERGY_LABELS = {
    "external_work": "external work", "elastic": "elastic", "kinetic": "kinetic", "dissipated": "dissipated",
}  # fmt: skip
MAX_CURVE_POINTS = 600  # of a curve on the page: more cannot be told apart


@dataclass(frozen=True)
class ReferenceCurve:
    """A curve to compare with: the first column of a CSV against the others, named as columns of history.csv."""

    name: str
    x: str
    columns: dict[str, Values]


def run_sections(
    runs: list[RunData], references: list[ReferenceCurve], *, quantity: str | None, exact: float | None
) -> list[Section]:
    """The whole report on some runs."""
    parts = [overview_section(runs)]
    if quantity is not None:
        parts.append(work_precision_section(runs, quantity, exact))
    if references:
        parts.append(reference_section(runs, references))
    return [*parts, *picture_sections(runs), curve_section(runs), energy_section(runs), cost_section(runs)]


def overview_section(runs: list[RunData]) -> Section:
    """The table of the runs, with the settings in which they differ."""
    keys = differing_settings(runs)
    peaks = list(dict.fromkeys(key for run in runs for key in run.summary.get("peak_reactions", {})))
    columns = (
        "run", *keys, "outcome", "pieces", "broken edges", "split cells", *(f"peak {key} N" for key in peaks),
        "external work J", "dissipated J", "cells", "nodes", "ranks", "steps", "failed attempts", "time s", "wall s",
        *(f"{phase} s" for phase in PHASES), "memory MiB",
    )  # fmt: skip
    rows = tuple(_row(run, keys, peaks) for run in runs)
    titles = dict.fromkeys(str(run.settings.get("title", "")) for run in runs)
    text = f"{'; '.join(titles)}. Each run again: fracsim run study.toml, in its folder."
    caption = "Settings that differ, and what came out" if keys else "What came out"
    return Section("Runs", text, tables=(ReportTable("runs", caption, columns, rows),))


def _row(run: RunData, keys: list[str], peaks: list[str]) -> tuple[TableCell, ...]:
    get, history = run.summary.get, run.history
    seconds, reactions = get("seconds", {}), get("peak_reactions", {})
    last: Any = {key: values[-1] if len(values) else None for key, values in history.items()}
    return (
        run.name, *(_cell(run.settings.get(key)) for key in keys), run.outcome,
        get("pieces"), get("broken_edges"), get("split_cells"), *(reactions.get(key) for key in peaks),
        get("external_work"), get("dissipated"), get("cells"), get("nodes"), get("ranks"),
        get("steps", len(history["step"])), get("steps_failed"), get("time", last["time"]), run.wall,
        *(seconds.get(phase) for phase in PHASES), get("peak_memory_MiB"),
    )  # fmt: skip


def _cell(value: Any) -> TableCell:
    return value if value is None or isinstance(value, str | int | float | bool) else str(value)


def history_series(run: RunData, x: str, y: str, label: str) -> Series:
    """A curve of a run, thinned where it has more points than a page can show; its extremes are kept."""
    a, b = run.history[x], run.history[y]
    chosen = np.arange(len(a))
    if len(a) > MAX_CURVE_POINTS:
        ends = [int(np.argmin(b)), int(np.argmax(b))]
        chosen = np.unique([*np.linspace(0, len(a) - 1, MAX_CURVE_POINTS).astype(int), *ends])
    return Series(label, tuple(a[chosen].tolist()), tuple(b[chosen].tolist()), style="line")


def curve_section(runs: list[RunData]) -> Section:
    """Reactions and forces of contact over the motion of their group or obstacle (where it moves) and over time, and
    probes over time."""
    kinds = ("reaction_", "contact_", "probe_")
    columns = list(dict.fromkeys(key for run in runs for key in run.history if key.startswith(kinds)))
    plots = []
    for column in columns:
        having = [run for run in runs if column in run.history]
        if not _worth_showing(having, column):
            continue
        for x in (*_motions_of(column, having), "time"):
            lines = tuple(history_series(run, x, column, run.name if len(runs) > 1 else "") for run in having)
            plots.append(Plot(f"{column} over {x}", _axis(x), _axis(column), lines))
    text = "" if plots else "These runs record no reaction and no probe ([[probe]] in the study)."
    return Section("Reactions and probes", text, plots=tuple(plots))


def _worth_showing(runs: list[RunData], column: str) -> bool:
    """Not a component that is round-off beside the others of its probe."""
    probe = column.rpartition("_")[0]

    def largest(name: str) -> float:
        return max(float(np.max(np.abs(run.history.get(name, np.zeros(1))), initial=0.0)) for run in runs)

    siblings = {name for run in runs for name in run.history if name.rpartition("_")[0] == probe}
    return largest(column) > 1e-6 * max(map(largest, siblings))


def _motions_of(column: str, runs: list[RunData]) -> Iterator[str]:
    """The motion of the same probe or obstacle along the same axis, where it moves in all the runs."""
    kind, _, place = column.partition("_")
    motion = f"motion_{place}"
    if kind != "probe" and all(np.any(run.history.get(motion, np.zeros(1))) for run in runs):
        yield motion


def _axis(column: str) -> str:
    units = {"time": "s", "reaction": "N", "contact": "N", "probe": "m", "motion": "m"}
    kind = column.partition("_")[0]
    return f"{column}, {units[kind]}" if kind in units else column


def energy_section(runs: list[RunData]) -> Section:
    """One plot of all energies for a single run, else one plot an energy."""
    if len(runs) == 1:
        lines = tuple(history_series(runs[0], "time", key, label) for key, label in ENERGY_LABELS.items())
        return Section("Energies", plots=(Plot("Energies over time", "time, s", "J", lines),))
    plots = tuple(
        Plot(
            f"{label} over time",
            "time, s",
            f"{label}, J",
            tuple(history_series(run, "time", key, run.name) for run in runs),
        )
        for key, label in ENERGY_LABELS.items()
    )
    return Section("Energies", plots=plots)


def cost_section(runs: list[RunData]) -> Section:
    """Wall time a step over what has broken: it should not grow."""
    plots = [_steps(runs)]
    if any(np.any(run.history["broken_edges"] > 0) for run in runs):
        lines = tuple(
            Series(run.name if len(runs) > 1 else "", *_thin(run, "broken_edges", "wall_step"), style="points")
            for run in runs
        )
        plots.insert(0, Plot("Wall time of each step over the edges broken so far", "broken edges", "s a step", lines))
        pieces = tuple(history_series(run, "time", "pieces", run.name if len(runs) > 1 else "") for run in runs)
        plots.append(Plot("Pieces over time", "time, s", "pieces", pieces))
    return Section("Cost of a step", plots=tuple(plots))


def _steps(runs: list[RunData]) -> Plot:
    lines = tuple(history_series(run, "time", "wall_step", run.name if len(runs) > 1 else "") for run in runs)
    return Plot("Wall time of each step", "time, s", "s a step", lines, kind="logy")


def _thin(run: RunData, x: str, y: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
    thinned = history_series(run, x, y, "")
    return thinned.x, thinned.y  # type: ignore[return-value]


def picture_sections(runs: list[RunData]) -> list[Section]:
    """The last frames, where runs drew them. Paths are absolute: the runs may lie anywhere."""
    drawn = [run for run in runs if (run.folder / "last.png").is_file()]
    shown = tuple(Picture(f"{run.name}: the last frame", str(run.folder.resolve() / "last.png")) for run in drawn)
    return [Section("Pictures", pictures=shown)] if shown else []


# --- curves of references -------------------------------------------------------------------------------------------


def read_reference(path: Path) -> ReferenceCurve:
    """A CSV with a header: the x column first, then one or more y columns. InputError where it is not that."""
    try:
        check_readable(path)
        with path.open(newline="", encoding="utf-8") as file:
            header, *rows = [row for row in csv.reader(file) if row]
        table = np.array(rows, float)
        if len(header) < 2 or table.ndim != 2 or table.shape[1] != len(header) or not np.isfinite(table).all():
            raise ValueError("every row must have a number for each of two or more columns")
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        raise InputError(
            f"--reference {path}: {why}. Give a CSV whose first line names columns of history.csv, x first: "
            "motion_grip_x,reaction_grip_x"
        ) from None
    order = np.argsort(table[:, 0], kind="stable")
    columns = dict(zip(header, table[order].T, strict=True))
    return ReferenceCurve(path.stem, header[0].strip(), {name.strip(): values for name, values in columns.items()})


def reference_section(runs: list[RunData], references: list[ReferenceCurve]) -> Section:
    """Plots of the runs with the references, and how far they are apart."""
    plots, rows = [], []
    for reference in references:
        for y in (name for name in reference.columns if name != reference.x):
            plots.append(_compared(runs, reference, y))
            rows += [(reference.name, y, run.name, *_apart(run, reference, y)) for run in runs]
    columns = ("reference", "quantity", "run", "peak", "peak of the reference", "peak, relative", "rms, relative")
    caption = "Runs beside references: rms over the range that both cover, relative to the largest reference value"
    return Section("References", tables=(ReportTable("references", caption, columns, tuple(rows)),), plots=tuple(plots))


def _compared(runs: list[RunData], reference: ReferenceCurve, y: str) -> Plot:
    option = f"--reference {reference.name}"
    for run in runs:
        run.history_column(reference.x, option), run.history_column(y, option)
    x, wanted = (tuple(map(float, reference.columns[name])) for name in (reference.x, y))
    given = Series(reference.name, x, wanted, style="reference")
    lines = tuple(history_series(run, reference.x, y, run.name) for run in runs)
    return Plot(f"{y} beside {reference.name}", _axis(reference.x), _axis(y), (*lines, given))


def _apart(run: RunData, reference: ReferenceCurve, y: str) -> tuple[TableCell, ...]:
    a, b = run.history[reference.x], run.history[y]
    x, wanted = reference.columns[reference.x], reference.columns[y]
    peak, most = float(np.max(np.abs(b), initial=0.0)), float(np.max(np.abs(wanted)))
    order = np.argsort(a, kind="stable")
    inside = (x >= a.min(initial=math.inf)) & (x <= a.max(initial=-math.inf))
    gap = None
    if inside.any() and most > 0:
        gap = float(np.sqrt(np.mean((np.interp(x[inside], a[order], b[order]) - wanted[inside]) ** 2))) / most
    return peak, most, peak / most - 1 if most > 0 else None, gap


# --- error against run time -----------------------------------------------------------------------------------------


def work_precision_section(runs: list[RunData], quantity: str, exact: float | None) -> Section:
    """Error of a quantity against wall time and core-seconds; without `exact` against the finest run that was done."""
    done = [run for run in runs if run.outcome == "done"]
    if not done:
        raise InputError(f"--quantity {quantity}: none of the runs ended well")
    finest = max(done, key=lambda run: (run.summary.get("cells", 0), run.summary.get("steps", 0)))
    reference = exact if exact is not None else finest.quantity(quantity)
    if reference == 0 or not math.isfinite(reference):
        raise InputError(f"--quantity {quantity}: its reference is {reference:g}, which no error can be relative to")
    shown = [run for run in done if exact is not None or run is not finest]
    errors = {run.name: abs(run.quantity(quantity) / reference - 1) for run in shown}
    keys = differing_settings(runs)
    front = {shown[i].name for i in pareto_front([(run.wall, errors[run.name]) for run in shown])}
    rows = tuple(
        (run.name, *(_cell(run.settings.get(key)) for key in keys), run.outcome, _figure(run, quantity),
         errors.get(run.name), run.wall, run.wall * run.ranks, run.name in front)
        for run in runs
    )  # fmt: skip
    columns = ("run", *keys, "outcome", quantity, "error, relative", "wall s", "core s", "on the Pareto front")
    source = f"{exact:g}, as given" if exact is not None else f"{reference:.6g}, that of the finest run, {finest.name}"
    plots = tuple(_work_precision(shown, errors, cores) for cores in (False, True)) if shown else ()
    table = ReportTable("precision", f"{quantity}: reference {source}", columns, rows)
    return Section(f"Error of {quantity}", tables=(table,), plots=plots)


def _figure(run: RunData, quantity: str) -> float | None:
    return run.quantity(quantity) if run.outcome == "done" else None


def _work_precision(runs: list[RunData], errors: dict[str, float], cores: bool) -> Plot:
    points = sorted((run.wall * (run.ranks if cores else 1), errors[run.name], run.name) for run in runs)
    x, y, names = zip(*points, strict=True)
    label = "core-seconds" if cores else "wall time, s"
    cloud = Series("", x, y, style="points", names=names)
    return Plot(f"Error against {label}", label, "relative error", (cloud,), "loglog", pareto=True, levels=(0.01, 0.05))
