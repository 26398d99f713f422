"""Trials of M22's table 2 beside the paper's seconds (studies.paper_table), with the paper's scenes and cells.

python -m fracsim.studies.evidence.paper_table_rows ROW [--limit 600] -o figures.json
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from ..paper_table import COLUMNS, NOTES, SCENES, run_row
from .report_section import Claim, ReportTable, Section, TableCell, rerun_hint
from .trial import Trial

LONG_LIMITS = {  # s of steps, of rows that are left to `make report-full`
    "loaf": 600.0, "doormat-0": 600.0, "doormat-5": 600.0, "jelly-figure": 300.0, "brittle-izod": 150.0,
    "ductile-charpy": 300.0, "ductile-izod": 300.0,
}  # fmt: skip
TIME_LIMIT = 30.0  # s of steps, of the others
TEXT = (
    "The paper's scenes at its cells (within a tenth; the loaf has 13 % more) and materials, with its platens, anvils "
    "and hammers as obstacles, on one rank; the paper has 12 threads at 2.6 GHz. Medians over the steps of a run, "
    "which ends with its scene or at a limit. What differs from the paper, by letter: "
    + "; ".join(f"{letter}: {note}" for letter, note in NOTES.items())
    + "."
)


def trials() -> list[Trial]:
    """One trial for each row; the long ones are left to the full report."""
    return [
        Trial(
            "rows", "paper", name, script=("fracsim.studies.evidence.paper_table_rows", name, "--limit", f"{limit:g}"),
            settings={"ranks": 1}, limit=limit + 180.0, full=name in LONG_LIMITS,
        )
        for name, limit in ((name, LONG_LIMITS.get(name, TIME_LIMIT)) for name in SCENES)
    ]  # fmt: skip


def sections(records: list[dict[str, Any]]) -> list[Section]:
    """Section with the table and its claims."""
    done = {record["name"]: record["figures"] for record in records if record["outcome"] == "done"}
    rows = tuple(_row(record) for record in records)
    table = ReportTable("paper-rows", "M22's table 2; s: of a step", (*COLUMNS, "outcome"), rows)
    return [
        Section(
            "The paper's table",
            TEXT + rerun_hint(records),
            (_paper_claim(done, len(records)),),
            (table,),
        )
    ]


def _row(record: dict[str, Any]) -> tuple[TableCell, ...]:
    """Row of the table."""
    figures = record["figures"] if record["outcome"] == "done" else {"scene": record["name"]}
    return (*(figures.get(column) for column in COLUMNS), record["outcome"])


def _paper_claim(done: dict[str, dict[str, Any]], tried: int) -> Claim:
    """Claim that no row takes longer than the paper's, with the rows that do and those that do not."""
    shares = {name: figures["median / paper's"] for name, figures in done.items()}
    parts = [
        f"{kind} {', '.join(rows)}"
        for kind, rows in (
            ("beyond:", [f"{name} {share:.2f}" for name, share in shares.items() if share > 1]),
            ("within:", [f"{name} {share:.2f}" for name, share in shares.items() if share <= 1]),
        )
        if rows
    ]
    holds = len(done) == tried and max(shares.values()) <= 1 if shares else None
    return Claim("Every row takes at most the paper's seconds a step (median)", "; ".join(parts) or "nothing", holds)


def main() -> None:
    """Run one row and write its figures."""
    parser = argparse.ArgumentParser(prog="python -m fracsim.studies.evidence.paper_table_rows", description=__doc__)
    parser.add_argument("row", choices=SCENES)
    parser.add_argument("--limit", type=float, default=600.0, help="seconds of the steps of the run")
    parser.add_argument("-o", "--out", type=Path, required=True)
    given = parser.parse_args()
    results = run_row(given.row, given.out.parent, small=False, ranks=1, limit=given.limit)
    if "failed" in results:
        raise SystemExit(f"{given.row}: {' '.join(results['failed'])}")
    given.out.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
