"""What a page shows: sections of text, claims, tables, plots and pictures. Plain data, to JSON and back."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

TableCell = str | float | int | bool | None


@dataclass(frozen=True)
class Claim:
    """Something that must hold, and what was measured; `holds` None: not run."""

    text: str
    measured: str
    holds: bool | None


@dataclass(frozen=True)
class ReportTable:
    """Rows under named columns, also written as NAME.csv. Numbers stay numbers: the page rounds them, the CSV does not.

    Attributes:
        name: file name of the CSV: letters, digits, hyphens; unique in a page.
        command: what reproduces it, run inside the folder of the trial; "" where every row is its own run.
        marked: numbers of rows to be shown strongly (a recommended setting).
    """

    name: str
    caption: str
    columns: tuple[str, ...]
    rows: tuple[tuple[TableCell, ...], ...]
    command: str = ""
    marked: tuple[int, ...] = ()


@dataclass(frozen=True)
class Series:
    """Points of one line of a plot; NaN and None leave a gap.

    Attributes:
        label: in the legend; "" for none.
        style: "line", "points", "both" or "reference" (dashed and grey, for theory and experiments).
        names: text beside each point, or empty.
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
    """Series in one frame.

    Attributes:
        kind: "line" (both axes linear), "loglog", "logx" or "logy".
        pareto: mark the points of all series that no other beats in both x and y (less is better).
        slopes: orders of reference triangles, log-log only.
        levels: horizontal lines, such as 0.01 and 0.05 for errors of 1 % and 5 %.
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
class Picture:
    """A PNG, by its path inside the folder of the evidence or run; left out with a remark where it does not exist."""

    caption: str
    path: str
    command: str = ""


@dataclass(frozen=True)
class Section:
    """A part of the page, in the order claims, text, tables, plots, pictures. Blank lines part paragraphs of `text`.

    Attributes:
        first: on the first screen of the page, whichever group it is of.
    """

    title: str
    text: str = ""
    claims: tuple[Claim, ...] = ()
    tables: tuple[ReportTable, ...] = ()
    plots: tuple[Plot, ...] = ()
    pictures: tuple[Picture, ...] = ()
    first: bool = False


def to_data(sections: list[Section]) -> list[dict[str, Any]]:
    """Sections as JSON data."""
    return [asdict(section) for section in sections]


def from_data(data: list[dict[str, Any]]) -> list[Section]:
    """Sections from `to_data`, after JSON has made lists of the tuples."""
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


def _plot(data: dict[str, Any]) -> Plot:
    series = tuple(
        Series(**part | {key: tuple(part[key]) for key in ("x", "y", "names", "spread")}) for part in data["series"]
    )
    return Plot(**data | {"series": series, "slopes": tuple(data["slopes"]), "levels": tuple(data["levels"])})
