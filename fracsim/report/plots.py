"""Plots as SVG inside the page: no fonts, styles or files from elsewhere; lines and text take the page's colour."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from .content import Plot, Series
from .labels import label_points
from .pareto import pareto_front

# Colours that colour-blind readers can tell apart (Okabe and Ito), for light and for dark pages.
SERIES_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c6bb1", "#a6761d")
MARKERS = "osD^vP*X"
INK, FAINT = "#010203", "#888889"  # INK becomes the text colour of the page
STYLE: dict[str, Any] = {
    "svg.fonttype": "none", "font.family": "sans-serif", "font.size": 10, "figure.constrained_layout.use": True,
    "text.color": INK, "axes.edgecolor": INK, "axes.labelcolor": INK, "xtick.color": INK, "ytick.color": INK,
    "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True, "grid.color": FAINT, "grid.alpha": 0.25,
    "legend.frameon": False, "legend.fontsize": 8.5, "lines.markersize": 5,
    "text.parse_math": False,
}  # fmt: skip
MAX_LEGEND_ENTRIES = 12


def draw_plot(plot: Plot, name: str) -> str:
    """The plot as an <svg> element; `name` keeps its inner ids apart from those of other plots."""
    with _figure(name) as figure:
        axes = figure.add_subplot()
        for number, series in enumerate(plot.series):
            _add(axes, series, number)
        _scale(axes, plot)
        if plot.pareto:
            _mark_front(axes, plot)
        for level in plot.levels:
            axes.axhline(level, color=FAINT, linestyle=":", linewidth=1)
        if plot.kind == "loglog":
            for slope in plot.slopes:
                _add_slope(axes, plot, slope)
        axes.set(xlabel=plot.x, ylabel=plot.y)
        if axes.get_legend_handles_labels()[1]:
            many = len(plot.series) > MAX_LEGEND_ENTRIES // 2
            axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0)) if many else axes.legend()
        if named := _named(plot):
            label_points(axes, named, _points(plot))
        return _svg(figure)


@contextmanager
def _figure(name: str) -> Iterator[Any]:
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE | {"svg.hashsalt": name}):
        figure = Figure(figsize=(6.4, 3.8))
        FigureCanvasSVG(figure)
        yield figure


def gapped_array(numbers: Any) -> Any:
    """Numbers as an array, None as a gap."""
    return np.array([np.nan if number is None else number for number in numbers], float)


def _add(axes: Any, series: Series, number: int) -> None:
    x, y = gapped_array(series.x), gapped_array(series.y)
    label = series.label or None
    if series.style == "reference":
        axes.plot(x, y, color=FAINT, linestyle="--", linewidth=1.5, label=label, zorder=1)
        return
    colour, turn = (
        SERIES_COLOURS[number % len(SERIES_COLOURS)],
        number + number // len(SERIES_COLOURS),
    )  # another marker with each round
    line = "" if series.style == "points" else "-"
    marker = "" if series.style == "line" else MARKERS[turn % len(MARKERS)]
    if series.spread:
        axes.errorbar(x, y, list(series.spread), color=colour, linestyle=line, marker=marker, capsize=2, label=label)
    else:
        axes.plot(x, y, color=colour, linestyle=line, marker=marker, linewidth=1.4, label=label)


def _scale(axes: Any, plot: Plot) -> None:
    """Logarithmic axes, where there is anything above 0 to show on them."""
    every = [
        np.concatenate([gapped_array(getattr(series, axis)) for series in plot.series] or [[]]) for axis in ("x", "y")
    ]
    for axis, kinds, numbers in (("x", ("loglog", "logx"), every[0]), ("y", ("loglog", "logy"), every[1])):
        if plot.kind in kinds and np.any(numbers > 0):
            getattr(axes, f"set_{axis}scale")("log", nonpositive="mask")
            _label_decades(getattr(axes, f"{axis}axis"), numbers[numbers > 0])


def _label_decades(axis: Any, shown: Any) -> None:
    """Plain numbers at the decades, and between them where there are few."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    few = shown.max() < 100 * shown.min()
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if few else (1.0,)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _points(plot: Plot) -> list[tuple[float, float]]:
    return [
        (float(a), float(b))
        for series in plot.series
        if series.style != "reference"
        for a, b in zip(gapped_array(series.x), gapped_array(series.y), strict=True)
    ]


def _named(plot: Plot) -> list[tuple[float, float, str]]:
    """Points that have a name."""
    return [
        (float(x), float(y), name)
        for series in plot.series
        for x, y, name in zip(gapped_array(series.x), gapped_array(series.y), series.names, strict=False)
        if name
    ]


def _mark_front(axes: Any, plot: Plot) -> None:
    points = _points(plot)
    front = [points[i] for i in pareto_front(points)]
    if front:
        x, y = zip(*front, strict=True)
        axes.plot(x, y, color=INK, linewidth=0.8, linestyle="-", alpha=0.6, label="Pareto front", zorder=1)
        axes.plot(x, y, color=INK, linestyle="", marker="o", fillstyle="none", markersize=10, alpha=0.8)


def _add_slope(axes: Any, plot: Plot, slope: float) -> None:
    """A line of the order `slope` below the points, over the middle of their range."""
    points = np.array([point for point in _points(plot) if min(point) > 0 and np.isfinite(point).all()])
    if not len(points):
        return
    low, high = np.log(points.min(axis=0)), np.log(points.max(axis=0))
    x = np.exp([low[0] + 0.3 * (high[0] - low[0]), low[0] + 0.7 * (high[0] - low[0])])
    y = np.exp(low[1]) * (x / x[-1 if slope > 0 else 0]) ** slope
    y = y * np.exp(0.1 * (high[1] - low[1]))
    axes.plot(x, y, color=FAINT, linewidth=1.2)
    axes.annotate(f"order {slope:g}", (x[-1], y[-1]), fontsize=8, color=FAINT)


def _svg(figure: Any) -> str:
    """The drawing without what only a file of its own needs, its ink the colour of the page's text."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.S)
    text = re.sub(r'\sxmlns(:\w+)?="[^"]*"', "", text)
    text = re.sub(r'<svg([^>]*?)\swidth="[^"]*"', r"<svg\1", text, count=1)
    text = re.sub(r'<svg([^>]*?)\sheight="[^"]*"', r"<svg\1", text, count=1)
    return text.replace(INK, "currentColor")
