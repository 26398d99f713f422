"""Page: sections written to one self-contained HTML file, with a CSV file beside it for each table."""

from __future__ import annotations

import base64
import csv
import re
from importlib.resources import files
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..meshes.plain_files import atomic_replacement_of_all, check_replaceable
from .content import Picture, PlotGrid, ReportTable, Section, TableCell
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
    links: dict[str, str] | None = None,
) -> Path:
    """Write a page and the CSV files, in the folder of the same name without suffix. Returns the path of the page.

    Args:
        target: the .html file.
        sections: content.
        pictures: folder to which the paths of pictures are relative.
        title: title.
        subtitle: line below the title.
        about: names and values at the end of the page.
        shown: number of sections that are open; the others show their titles only. None: all are open.
        links: address, relative to the page, of other pages by name.

    Raises:
        InputError: the files cannot be written.
    """
    import jinja2

    csv_folder = target.with_suffix("")
    parts = [_section_data(section, number, pictures, csv_folder.name) for number, section in enumerate(sections)]
    template = jinja2.Environment(autoescape=True, trim_blocks=True, undefined=jinja2.StrictUndefined).from_string(
        files(__package__).joinpath("template.html").read_text(encoding="utf-8")
    )
    text = template.render(
        title=title, subtitle=subtitle, sections=parts, about=about, links=links,
        shown=len(parts) if shown is None else shown,
    )  # fmt: skip
    try:
        check_replaceable(target)
        if csv_folder.is_symlink():
            raise InputError(
                f"-o {target}: the folder {csv_folder} for its tables is a link; delete it, or give another name"
            )
        csv_folder.mkdir(parents=True, exist_ok=True)
        for table in (table for section in sections for table in section.tables):
            write_table_csv(csv_folder / f"{table.name}.csv", table)
        with atomic_replacement_of_all(target) as temporary:
            temporary.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"-o {target}: cannot write there: {error.strerror}") from None
    return target


def write_table_csv(path: Path, table: ReportTable) -> None:
    """Write a table as CSV with all digits."""
    with atomic_replacement_of_all(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(table.columns)
        writer.writerows([["" if cell is None else cell for cell in row] for row in table.rows])


def _section_data(section: Section, number: int, pictures: Path, csv_folder: str) -> dict[str, Any]:
    """Data of a section for the template."""
    return {
        "number": number,
        "title": section.title,
        "open": [claim for claim in section.claims if claim.holds is False],
        "unknown": [claim for claim in section.claims if claim.holds is None],
        "holding": [claim for claim in section.claims if claim.holds],
        "paragraphs": [part for part in re.split(r"\n\s*\n", section.text.strip()) if part],
        "tables": [_table_data(table, csv_folder) for table in section.tables],
        "plots": [
            {
                "svg": draw_plot(plot, f"{number}-{index}"),
                "caption": plot.caption,
                "command": plot.command,
                "wide": isinstance(plot, PlotGrid),
            }
            for index, plot in enumerate(section.plots)
        ],
        "pictures": [_picture_data(picture, pictures) for picture in section.pictures],
    }


def _table_data(table: ReportTable, csv_folder: str) -> dict[str, Any]:
    """Data of a table for the template."""
    rows = [
        {
            "cells": [{"text": format_cell(cell), "number": _is_number(cell)} for cell in row],
            "marked": index in table.marked,
        }
        for index, row in enumerate(table.rows)
    ]
    return {
        "caption": table.caption, "columns": table.columns, "rows": rows, "command": table.command,
        "csv": f"{csv_folder}/{table.name}.csv",
    }  # fmt: skip


def format_cell(cell: TableCell) -> str:
    """Text of a cell: four digits of a floating-point number, empty for None."""
    if cell is None:
        return ""
    if isinstance(cell, bool):
        return "yes" if cell else "no"
    if isinstance(cell, float):
        return f"{cell:.4g}"
    return f"{cell:,}" if isinstance(cell, int) else cell


def _is_number(cell: TableCell) -> bool:
    return isinstance(cell, int | float) and not isinstance(cell, bool)


def _picture_data(picture: Picture, folder: Path) -> dict[str, Any]:
    """Data of a picture for the template; `data` is None if the file is missing."""
    path = folder / picture.path
    data = base64.b64encode(path.read_bytes()).decode() if path.is_file() else None
    return {"caption": picture.caption, "data": data, "command": picture.command}
