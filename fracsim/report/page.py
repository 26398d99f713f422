"""Sections to one HTML file that needs nothing else, and a CSV beside it for every table."""

from __future__ import annotations

import base64
import csv
import re
from importlib.resources import files
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..meshes.plain_files import check_replaceable, replacing_all
from .content import Picture, ReportTable, Section, TableCell
from .plots import draw_plot


def write_page(
    target: Path,
    sections: list[Section],
    pictures: Path,
    *,
    title: str,
    subtitle: str,
    about: dict[str, str],
    shown: int | None = None,
) -> Path:
    """Write `target` and, in the folder of the same name without its suffix, the CSVs.

    `pictures`: the folder that paths of pictures start from. `shown`: so many sections lie open, the others are folded
    away under their titles; None: all are open.
    """
    import jinja2

    csvs = target.with_suffix("")
    made = [_section(section, number, pictures, csvs.name) for number, section in enumerate(sections)]
    template = jinja2.Environment(autoescape=True, trim_blocks=True, undefined=jinja2.StrictUndefined).from_string(
        files(__package__).joinpath("template.html").read_text(encoding="utf-8")
    )
    text = template.render(
        title=title, subtitle=subtitle, sections=made, about=about, shown=len(made) if shown is None else shown
    )
    try:
        check_replaceable(target)
        if csvs.is_symlink():
            raise InputError(
                f"-o {target}: the folder {csvs} for its tables is a link; delete it, or give another name"
            )
        csvs.mkdir(parents=True, exist_ok=True)
        for table in (table for section in sections for table in section.tables):
            write_table_csv(csvs / f"{table.name}.csv", table)
        with replacing_all(target) as new:
            new.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"-o {target}: cannot write there: {error.strerror}") from None
    return target


def write_table_csv(path: Path, table: ReportTable) -> None:
    """All digits of a table."""
    with replacing_all(path) as new, new.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(table.columns)
        writer.writerows([["" if cell is None else cell for cell in row] for row in table.rows])


def _section(section: Section, number: int, pictures: Path, csvs: str) -> dict[str, Any]:
    return {
        "title": section.title,
        "open": [claim for claim in section.claims if claim.holds is False],
        "unknown": [claim for claim in section.claims if claim.holds is None],
        "holding": [claim for claim in section.claims if claim.holds],
        "paragraphs": [part for part in re.split(r"\n\s*\n", section.text.strip()) if part],
        "tables": [_table(table, csvs) for table in section.tables],
        "plots": [
            {"svg": draw_plot(plot, f"{number}-{i}"), "caption": plot.caption, "command": plot.command}
            for i, plot in enumerate(section.plots)
        ],
        "pictures": [_picture(picture, pictures) for picture in section.pictures],
    }


def _table(table: ReportTable, csvs: str) -> dict[str, Any]:
    rows = [
        {
            "cells": [{"text": format_cell(cell), "number": _is_number(cell)} for cell in row],
            "marked": i in table.marked,
        }
        for i, row in enumerate(table.rows)
    ]
    return {
        "caption": table.caption, "columns": table.columns, "rows": rows, "command": table.command,
        "csv": f"{csvs}/{table.name}.csv",
    }  # fmt: skip


def format_cell(cell: TableCell) -> str:
    """A cell as the page shows it: four digits of a number, nothing for None."""
    if cell is None:
        return ""
    if isinstance(cell, bool):
        return "yes" if cell else "no"
    if isinstance(cell, float):
        return f"{cell:.4g}"
    return f"{cell:,}" if isinstance(cell, int) else cell


def _is_number(cell: TableCell) -> bool:
    return isinstance(cell, int | float) and not isinstance(cell, bool)


def _picture(picture: Picture, folder: Path) -> dict[str, Any]:
    path = folder / picture.path
    data = base64.b64encode(path.read_bytes()).decode() if path.is_file() else None
    return {"caption": picture.caption, "data": data, "command": picture.command}
