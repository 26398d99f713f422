"""Plots as SVG elements of a page, drawn by matplotlib. Lines and text take the colour of the page's text.

matplotlib places no labels beside points. `label_points` does, and leaves out a label without room.
"""

from __future__ import annotations

import io
import math
import re
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .content import Plot, PlotGrid, Series

Values = npt.NDArray[np.float64]
# left, bottom, right, top, pixels
Box = tuple[float, float, float, float]

# Colours that colour-blind readers can distinguish (Okabe and Ito), for light and for dark pages.
SERIES_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c6bb1", "#a6761d")
MARKERS = "osD^vP*X"
# _INK is replaced by the text colour of the page
_INK, _FAINT = "#010203", "#888889"
_STYLE: dict[str, Any] = {
    "svg.fonttype": "none", "font.family": "sans-serif", "font.size": 10, "figure.constrained_layout.use": True,
    "text.color": _INK, "axes.edgecolor": _INK, "axes.labelcolor": _INK, "xtick.color": _INK, "ytick.color": _INK,
    "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True, "grid.color": _FAINT, "grid.alpha": 0.25,
    "legend.frameon": False, "legend.fontsize": 8.5, "lines.markersize": 5,
    "text.parse_math": False,
}  # fmt: skip
# series whose legend is inside the axes; a longer legend stands beside them
_MAX_INSIDE_LEGEND = 6
# of pictures in pixels
_PIXELS_PER_INCH = 160
# metadata by format: the same curves give the same file
_WITHOUT_DATE = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}


@dataclass(frozen=True)
class LabelStyle:
    """Size and positions of the labels beside points.

    Attributes:
        size: height of the font, points.
        letter_width: width of a letter, as a share of the height; wider than most letters.
        offset: horizontal distance from the point, points.
        heights: vertical distances from the point, points, in order of preference.
        point_radius: half the side of the square around a point that labels leave free, points.
    """

    size: float = 7.5
    letter_width: float = 0.6
    offset: float = 4.0
    heights: tuple[float, ...] = (4.0, -10.0, 14.0, -20.0, 24.0, -30.0)
    point_radius: float = 2.5


LABEL_STYLE = LabelStyle()


@dataclass(frozen=True)
class GridStyle:
    """Sizes of small multiples.

    Attributes:
        width, height: of a panel, inches.
        legend_height: height of the common legend, inches.
        font: size of titles and labels, points.
        title_letters: letters in a line of a title.
    """

    width: float = 2.6
    height: float = 2.15
    legend_height: float = 0.35
    font: float = 8.5
    title_letters: int = 34


GRID_STYLE = GridStyle()


def draw_plot(plot: Plot | PlotGrid, name: str) -> str:
    """SVG element of a plot or of small multiples; `name` makes the ids inside it unique on the page."""
    if isinstance(plot, PlotGrid):
        return _draw_grid(plot, name)
    with _figure(name) as figure:
        _draw_axes(figure, plot)
        return _to_svg(figure)


def save_plot(plot: Plot, path: Path) -> None:
    """Write a plot to a file, on a white ground; its suffix is the format of matplotlib."""
    with _figure(path.stem) as figure:
        _draw_axes(figure, plot)
        figure.savefig(path, dpi=_PIXELS_PER_INCH, facecolor="white", metadata=_WITHOUT_DATE.get(path.suffix))


def _draw_axes(figure: Any, plot: Plot) -> None:
    """Draw a plot on the whole figure, with labels and legend."""
    axes = figure.add_subplot()
    _fill_axes(axes, plot, range(len(plot.series)))
    axes.set(xlabel=plot.x, ylabel=plot.y)
    if axes.get_legend_handles_labels()[1]:
        is_long = len(plot.series) > _MAX_INSIDE_LEGEND
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0)) if is_long else axes.legend()
    if labelled := _labelled_points(plot):
        label_points(axes, labelled, _points(plot))


def _draw_grid(grid: PlotGrid, name: str) -> str:
    """SVG element of small multiples."""
    style = GRID_STYLE
    labels = list(dict.fromkeys(series.label for panel in grid.panels for series in panel.series))
    columns = min(grid.columns, len(grid.panels))
    rows = -(-len(grid.panels) // columns)
    with _figure(name, (style.width * columns, style.height * rows + style.legend_height)) as figure:
        figure.get_layout_engine().set(rect=(0, 0, 1, 1 - style.legend_height / figure.get_figheight()))
        handles: dict[str, Any] = {}
        for index, panel in enumerate(grid.panels):
            axes = figure.add_subplot(rows, columns, index + 1)
            _fill_axes(axes, panel, [labels.index(series.label) for series in panel.series])
            _widen_log_axes(axes)
            axes.set_title(textwrap.fill(panel.caption, style.title_letters), fontsize=style.font)
            axes.tick_params(labelsize=style.font - 1)
            axes.set_xlabel(panel.x if index + columns >= len(grid.panels) else "", fontsize=style.font)
            axes.set_ylabel(panel.y if index % columns == 0 else "", fontsize=style.font)
            handles |= {label: line for line, label in zip(*axes.get_legend_handles_labels(), strict=True)}
        figure.legend(handles.values(), handles.keys(), loc="upper center", ncols=len(handles))
        return _to_svg(figure)


def _fill_axes(axes: Any, plot: Plot, numbers: Sequence[int]) -> None:
    """Draw all series of a plot; numbers choose their colours and markers."""
    for number, series in zip(numbers, plot.series, strict=True):
        _draw_series(axes, series, number)
    _set_scales(axes, plot)
    if plot.pareto:
        _draw_pareto_front(axes, plot)
    for level in plot.levels:
        axes.axhline(level, color=_FAINT, linestyle=":", linewidth=1)
    if plot.kind == "loglog":
        for slope in plot.slopes:
            _draw_slope(axes, plot, slope)


@contextmanager
def _figure(name: str, size: tuple[float, float] = (6.4, 3.8)) -> Iterator[Any]:
    """Figure of matplotlib of a size in inches with the style of the page."""
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    with matplotlib.rc_context(_STYLE | {"svg.hashsalt": name}):
        figure = Figure(figsize=size)
        FigureCanvasSVG(figure)
        yield figure


def gapped_array(numbers: Iterable[float | None]) -> Values:
    """Numbers as an array, with NaN, a gap in a line, for None."""
    return np.array([np.nan if number is None else number for number in numbers], float)


def _draw_series(axes: Any, series: Series, number: int) -> None:
    """Draw a series; colour and marker depend on its number."""
    x, y = gapped_array(series.x), gapped_array(series.y)
    label = series.label or None
    if series.style == "reference":
        axes.plot(x, y, color=_FAINT, linestyle="--", linewidth=1.5, label=label, zorder=1)
        return
    # with each cycle of the colours the markers are shifted by one
    cycle, index = divmod(number, len(SERIES_COLOURS))
    colour = SERIES_COLOURS[index]
    line = "" if series.style == "points" else "-"
    marker = "" if series.style == "line" else MARKERS[(number + cycle) % len(MARKERS)]
    if series.spread:
        axes.errorbar(x, y, list(series.spread), color=colour, linestyle=line, marker=marker, capsize=2, label=label)
    else:
        axes.plot(x, y, color=colour, linestyle=line, marker=marker, linewidth=1.4, label=label)


def _set_scales(axes: Any, plot: Plot) -> None:
    """Make axes logarithmic as the plot asks for, if there is a positive value to show."""
    x, y = (
        np.concatenate([np.empty(0), *(gapped_array(getattr(series, axis)) for series in plot.series)])
        for axis in ("x", "y")
    )
    for axis, kinds, numbers in (("x", ("loglog", "logx"), x), ("y", ("loglog", "logy"), y)):
        if plot.kind in kinds and np.any(numbers > 0):
            getattr(axes, f"set_{axis}scale")("log", nonpositive="mask")
            _label_decades(getattr(axes, f"{axis}axis"), numbers[numbers > 0])


def _label_decades(axis: Any, numbers: Values) -> None:
    """Label the decades of a logarithmic axis with plain numbers; over a short range 2 and 5 as well."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    is_short = numbers.max() < 100 * numbers.min()
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if is_short else (1.0,)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _widen_log_axes(axes: Any) -> None:
    """Let logarithmic axes span a decade at least: over less, matplotlib labels more numbers than fit."""
    for axis in ("x", "y"):
        low, high = getattr(axes, f"get_{axis}lim")()
        if getattr(axes, f"get_{axis}scale")() == "log" and high < 10 * low:
            middle = math.sqrt(low * high)
            getattr(axes, f"set_{axis}lim")(middle / math.sqrt(10), middle * math.sqrt(10))


def _points(plot: Plot) -> list[tuple[float, float]]:
    """Points of all series except references."""
    return [
        (float(x), float(y))
        for series in plot.series
        if series.style != "reference"
        for x, y in zip(gapped_array(series.x), gapped_array(series.y), strict=True)
    ]


def _labelled_points(plot: Plot) -> list[tuple[float, float, str]]:
    """Points (x, y, label) that have a label."""
    return [
        (float(x), float(y), name)
        for series in plot.series
        for x, y, name in zip(gapped_array(series.x), gapped_array(series.y), series.names, strict=False)
        if name
    ]


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Indices of the points (cost, error) on the Pareto front, ordered by cost.

    A point is on the front if no other point is at least as good in both and better in one. Points that are not finite
    are never on it; equal points are on it together.
    """
    finite = [index for index, point in enumerate(points) if all(map(math.isfinite, point))]
    front: list[int] = []
    for index in sorted(finite, key=lambda index: points[index]):
        if not front or points[index][1] < points[front[-1]][1] or points[index] == points[front[-1]]:
            front.append(index)
    return front


def _draw_pareto_front(axes: Any, plot: Plot) -> None:
    points = _points(plot)
    front = [points[index] for index in pareto_front(points)]
    if front:
        x, y = zip(*front, strict=True)
        axes.plot(x, y, color=_INK, linewidth=0.8, linestyle="-", alpha=0.6, label="Pareto front", zorder=1)
        axes.plot(x, y, color=_INK, linestyle="", marker="o", fillstyle="none", markersize=10, alpha=0.8)


def _draw_slope(axes: Any, plot: Plot, slope: float) -> None:
    """Draw a line of the order `slope` below the points, over the central part of their range."""
    points = np.array([point for point in _points(plot) if min(point) > 0 and np.isfinite(point).all()])
    if not len(points):
        return
    low, high = np.log(points.min(axis=0)), np.log(points.max(axis=0))
    x = np.exp([low[0] + 0.3 * (high[0] - low[0]), low[0] + 0.7 * (high[0] - low[0])])
    y = np.exp(low[1]) * (x / x[-1 if slope > 0 else 0]) ** slope
    y = y * np.exp(0.1 * (high[1] - low[1]))
    axes.plot(x, y, color=_FAINT, linewidth=1.2)
    axes.annotate(f"order {slope:g}", (x[-1], y[-1]), fontsize=8, color=_FAINT)


def _to_svg(figure: Any) -> str:
    """SVG element of a figure, without XML that only a separate file needs, in the text colour of the page."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.S)
    text = re.sub(r'\sxmlns(:\w+)?="[^"]*"', "", text)
    # without width and height the element fills its figure; the viewBox keeps its proportions
    text = re.sub(r'<svg([^>]*?)\swidth="[^"]*"', r"<svg\1", text, count=1)
    text = re.sub(r'<svg([^>]*?)\sheight="[^"]*"', r"<svg\1", text, count=1)
    return text.replace(_INK, "currentColor")


# --- labels -----------------------------------------------------------------------------------------------------------


def label_points(
    axes: Any, labelled: Iterable[tuple[float, float, str]], points: Iterable[tuple[float, float]]
) -> None:
    """Write labels beside their points, free of each other, of all points and of the frame.

    A label without room is left out; the tables of the page have its value.

    Args:
        axes: axes of matplotlib with final scales and legend.
        labelled: points (x, y, label).
        points: all points of the plot.
    """
    style = LABEL_STYLE
    # drawing computes the layout
    axes.figure.draw_without_rendering()
    scale = axes.figure.dpi / 72
    frame: Box = tuple(axes.bbox.extents)
    radius = style.point_radius * scale
    occupied = [_square(axes.transData.transform(point), radius) for point in points if np.isfinite(point).all()]
    for x, y, name in labelled:
        if not (np.isfinite(x) and np.isfinite(y)):
            continue
        position = axes.transData.transform((x, y))
        for side, height in ((side, height) for height in style.heights for side in (1, -1)):
            box = _label_box(position, name, side, height, scale)
            if _is_inside(box, frame) and not any(_overlap(box, second) for second in occupied):
                occupied.append(box)
                axes.annotate(
                    name, (x, y), textcoords="offset points", xytext=(style.offset * side, height),
                    fontsize=style.size, ha="left" if side > 0 else "right",
                )  # fmt: skip
                break


def _label_box(position: Any, name: str, side: int, height: float, scale: float) -> Box:
    """Box of a label, pixels.

    Args:
        position: point (2,), pixels.
        name: text of the label.
        side: 1 to the right of the point, -1 to the left.
        height: vertical distance from the point, points.
        scale: pixels per point.
    """
    style = LABEL_STYLE
    near, far = sorted((style.offset * side, (style.offset + style.letter_width * style.size * len(name)) * side))
    left, bottom = position[0] + near * scale, position[1] + (height - 0.25 * style.size) * scale
    return left, bottom, position[0] + far * scale, bottom + 1.25 * style.size * scale


def _square(centre: Any, radius: float) -> Box:
    """Square around a point, pixels."""
    return centre[0] - radius, centre[1] - radius, centre[0] + radius, centre[1] + radius


def _overlap(first: Box, second: Box) -> bool:
    return first[0] < second[2] and second[0] < first[2] and first[1] < second[3] and second[1] < first[3]


def _is_inside(box: Box, frame: Box) -> bool:
    return box[0] >= frame[0] and box[2] <= frame[2] and box[1] >= frame[1] and box[3] <= frame[3]


# prefixes by their power of 1,000
_PREFIXES = {-4: "p", -3: "n", -2: "µ", -1: "m", 0: "", 1: "k", 2: "M", 3: "G"}


def readable_unit(unit: str, largest: float) -> tuple[str, float]:
    """Unit whose numbers have one to three digits before the point at a value, and the SI value of one such unit.

    Args:
        unit: SI unit; "" for numbers without a unit, which have no prefix.
        largest: the value, in SI units.
    """
    if not unit or not 0 < largest < math.inf:
        return unit, 1.0
    power = min(max(math.floor(math.log10(largest) / 3 + 1e-9), min(_PREFIXES)), max(_PREFIXES))
    return _PREFIXES[power] + unit, 1000.0**power
