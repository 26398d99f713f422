"""Curves of runs and of experiments as a picture (`fracsim plot`)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from ..errors import InputError
from ..meshes.plain_files import atomic_replacement_of_all
from .compare import ReferenceCurve, column_unit, history_series, read_reference
from .content import Plot, Series
from .plots import gapped_array, readable_unit, save_plot
from .runs import find_runs

_FORMATS = (".svg", ".png", ".pdf")


def draw_curves(
    folders: list[Path],
    target: Path | None,
    *,
    x: str,
    y: str,
    references: list[Path],
    scale: tuple[float, float] = (1.0, 1.0),
) -> Path:
    """Draw a column of history.csv over another one, for one or several runs, and return the path of the picture.

    Args:
        folders: output folders of runs or sweeps.
        target: .svg, .png or .pdf; None: curve.svg in the first folder.
        x: column of history.csv on the horizontal axis.
        y: column on the vertical axis.
        references: CSV files of curves to compare with, see `reference_series`.
        scale: factors from the units of the references to SI units, of x and of y.

    Raises:
        InputError: a run has no such column, a reference is no table, or the picture has an unknown format.
    """
    target = target or folders[0] / "curve.svg"
    if target.suffix not in _FORMATS:
        raise InputError(f"-o {target}: a curve is drawn as {', '.join(_FORMATS)}: -o curve.svg")
    plot = curve_plot(folders, x, y, references, scale)
    target.parent.mkdir(parents=True, exist_ok=True)
    with atomic_replacement_of_all(target) as temporary:
        save_plot(plot, temporary)
    return target


def curve_plot(folders: list[Path], x: str, y: str, references: list[Path], scale: tuple[float, float]) -> Plot:
    """Plot of the curves, each axis in the unit whose prefix suits its largest value; see `draw_curves`."""
    runs = find_runs(folders)
    for run in runs:
        run.history_column(x, "--x"), run.history_column(y, "--y")
    curves = [history_series(run, x, y, run.name) for run in runs]
    curves += [reference_series(read_reference(path), x, y, scale) for path in references]
    x_label, x_size = _readable_axis(x, [value for curve in curves for value in curve.x])
    y_label, y_size = _readable_axis(y, [value for curve in curves for value in curve.y])
    scaled = (replace(curve, x=_divided(curve.x, x_size), y=_divided(curve.y, y_size)) for curve in curves)
    return Plot("", x_label, y_label, tuple(scaled))


def _readable_axis(column: str, values: list[float | None]) -> tuple[str, float]:
    """Return the label of an axis with a readable unit, and the SI value of one such unit."""
    unit, size = readable_unit(column_unit(column), max(map(abs, filter(None, values)), default=0.0))
    return f"{column}, {unit}" if unit else column, size


def reference_series(reference: ReferenceCurve, x: str, y: str, scale: tuple[float, float]) -> Series:
    """Curve of a reference in SI units: its columns `x` and `y`, or its only two columns in their order.

    Raises:
        InputError: the reference has more than two columns, of which none has the name `x` or `y`.
    """
    columns = reference.columns
    names = (x, y) if x in columns and y in columns else tuple(columns)
    if len(names) != 2:
        raise InputError(
            f"--reference {reference.name}: it has the columns {', '.join(columns)}, but not {x} and {y}. "
            f"Give a CSV with these two, or with two columns alone, {x} first"
        )
    x_values, y_values = (columns[name] * factor for name, factor in zip(names, scale, strict=True))
    return Series(reference.name, tuple(map(float, x_values)), tuple(map(float, y_values)), style="reference")


def parse_scale(text: str) -> tuple[float, float]:
    """Return the two factors of `--scale X,Y`. Raises InputError."""
    try:
        x, y = map(float, text.split(","))
    except ValueError:
        x = y = 0.0
    if not (0 < abs(x) < float("inf") and 0 < abs(y) < float("inf")):
        raise InputError(f"--scale {text}: must be two factors other than 0, of x and y; mm and kN: --scale 1e-3,1e3")
    return x, y


def _divided(values: Iterable[float | None], size: float) -> tuple[float, ...]:
    return tuple(map(float, gapped_array(values) / size))
