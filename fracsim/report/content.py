"""Content of a page: sections of text, claims, tables, plots and pictures, as plain data with conversion to JSON."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

TableCell = str | float | int | bool | None


@dataclass(frozen=True)
class Claim:
    """Claim about the program, with the measured value.

    Attributes:
        text: what must hold.
        measured: measured value in words.
        holds: result; None: not measured.
    """

    text: str
    measured: str
    holds: bool | None


@dataclass(frozen=True)
class ReportTable:
    """Table of a page, also written as NAME.csv. The page rounds numbers, the CSV does not.

    Attributes:
        name: file name of the CSV: letters, digits, hyphens; unique in a page.
        caption: caption.
        columns: names of the columns.
        rows: cells of each row.
        command: command that reproduces the table, run in the folder of the trial; "" if each row is a run of its own.
        marked: indices of emphasised rows, such as recommended settings.
    """

    name: str
    caption: str
    columns: tuple[str, ...]
    rows: tuple[tuple[TableCell, ...], ...]
    command: str = ""
    marked: tuple[int, ...] = ()


@dataclass(frozen=True)
class Series:
    """Series of points of a plot; NaN and None leave a gap in the line.

    Attributes:
        label: text in the legend; "" for none.
        x, y: coordinates of the points.
        style: "line", "points", "both" or "reference" (dashed and grey, for theory and experiments).
        names: label beside each point, or empty.
        spread: half-widths of error bars in y, or empty.
    """

    label: str
    x: tuple[float | None, ...]
    y: tuple[float | None, ...]
    style: str = "both"
    names: tuple[str, ...] = ()
    spread: tuple[float, ...] = ()


@dataclass(frozen=True)
class Plot:
    """Plot of several series.

    Attributes:
        caption: caption.
        x, y: labels of the axes.
        series: the series.
        kind: "line" (both axes linear), "loglog", "logx" or "logy".
        pareto: mark the Pareto front of all points; less is better in both coordinates.
        slopes: orders of reference lines, for "loglog" only.
        levels: horizontal lines, such as 0.01 and 0.05 for errors of 1 % and 5 %.
        command: command that reproduces the plot.
    """

    caption: str
    x: str
    y: str
    series: tuple[Series, ...]
    kind: str = "line"
    pareto: bool = False
    slopes: tuple[float, ...] = ()
    levels: tuple[float, ...] = ()
    command: str = ""


@dataclass(frozen=True)
class PlotGrid:
    """Small multiples: plots side by side with one legend; series of the same label look the same in all of them.

    Attributes:
        caption: caption of the whole.
        panels: plots; the caption of each is its title, and axes are labelled at the left and at the bottom.
        columns: plots in a row.
        command: command that reproduces the grid.
    """

    caption: str
    panels: tuple[Plot, ...]
    columns: int = 4
    command: str = ""


@dataclass(frozen=True)
class Picture:
    """PNG of a page. A missing file is replaced by a remark.

    Attributes:
        caption: caption.
        path: path relative to the folder of the evidence or run.
        command: command that reproduces the picture.
    """

    caption: str
    path: str
    command: str = ""


@dataclass(frozen=True)
class Section:
    """Section of a page, in the order claims, text, tables, plots, pictures.

    Attributes:
        title: title.
        text: paragraphs, separated by blank lines.
        claims, tables, plots, pictures: content.
        first: show the section at the beginning of the page, whatever its group.
    """

    title: str
    text: str = ""
    claims: tuple[Claim, ...] = ()
    tables: tuple[ReportTable, ...] = ()
    plots: tuple[Plot | PlotGrid, ...] = ()
    pictures: tuple[Picture, ...] = ()
    first: bool = False


def to_data(sections: list[Section]) -> list[dict[str, Any]]:
    """Sections as data for JSON."""
    return [asdict(section) for section in sections]


def from_data(data: list[dict[str, Any]]) -> list[Section]:
    """Sections from the data of `to_data`, in which JSON has turned tuples into lists."""
    return [
        Section(
            part["title"],
            part["text"],
            tuple(Claim(**claim) for claim in part["claims"]),
            tuple(_table(table) for table in part["tables"]),
            tuple(_plot(plot) for plot in part["plots"]),
            tuple(Picture(**picture) for picture in part["pictures"]),
            bool(part.get("first", False)),
        )
        for part in data
    ]


def _table(data: dict[str, Any]) -> ReportTable:
    rows = tuple(tuple(row) for row in data["rows"])
    return ReportTable(**data | {"columns": tuple(data["columns"]), "rows": rows, "marked": tuple(data["marked"])})


def _plot(data: dict[str, Any]) -> Plot | PlotGrid:
    if "panels" in data:
        return PlotGrid(**data | {"panels": tuple(_single_plot(panel) for panel in data["panels"])})
    return _single_plot(data)


def _single_plot(data: dict[str, Any]) -> Plot:
    series = tuple(
        Series(**part | {key: tuple(part[key]) for key in ("x", "y", "names", "spread")}) for part in data["series"]
    )
    return Plot(**data | {"series": series, "slopes": tuple(data["slopes"]), "levels": tuple(data["levels"])})
