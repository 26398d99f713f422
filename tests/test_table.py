"""The paper's table: its rows are studies of the paper's sizes and steps, and a row says what history.csv says."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import pytest

from fracsim.studies.evidence import paper_table_rows
from fracsim.studies.paper_table import LONG_STEP, SCENES, format_table, overrides, read_row
from fracsim.study import Study
from fracsim.study.check import check_study
from fracsim.study.reader import load_study


def expected_cells(study: Study) -> int:
    found = re.search(r"about ([\d,]+) cells", check_study(study)[0])
    assert found is not None
    return int(found[1].replace(",", ""))


@pytest.mark.usefixtures("little_built")
@pytest.mark.parametrize("name", SCENES)
def test_rows_have_the_papers_cells_and_steps(name: str) -> None:
    """Cells within a tenth, 5e-3 s but for a blow of microseconds; small: a seventh to two thirds of the cells."""
    scene = SCENES[name]
    whole, small = (load_study(scene.study, overrides(scene, small=each)) for each in (False, True))
    counts = [expected_cells(each) for each in (whole, small)]
    assert counts[0] == pytest.approx(1e3 * scene.cells, rel=0.1)
    assert name == "jade-figure" or counts[0] / 7 < counts[1] < counts[0] * 2 / 3
    assert whole.time.step == 5e-3 or (not scene.options.keys() & LONG_STEP.keys() and whole.boundary[0].pressure)


def test_a_row_is_that_of_the_history(tmp_path: Path) -> None:
    """Steps of 0.02, 0.08 and 0.04 s where the paper has 0.04; and what failed is told below."""
    (tmp_path / "history.csv").write_text("step,dt,wall_step\n1,4e-6,0.02\n2,4e-6,0.08\n3,2e-6,0.04\n")
    (tmp_path / "summary.json").write_text(json.dumps({"cells": 4632}))
    found = read_row("jade-figure", tmp_path)
    assert [found[key] for key in ("cells", "paper's cells", "steps", "step s")] == [4632, 4700.0, 3, 4e-6]
    assert [found[key] for key in ("median s", "worst s", "paper's s")] == [0.04, 0.08, 0.04]
    assert found["median / paper's"] == pytest.approx(1.0)
    text = format_table([found, {"scene": "loaf", "failed": ["out of memory"]}])
    assert text.splitlines()[1].split()[0] == "jade-figure" and text.endswith("loaf: out of memory")


def record_of(name: str, seconds: float) -> dict[str, Any]:
    """Of a row in the report, with so many seconds a step; infinite: it failed."""
    figures = {"scene": name, "cells": 4632, "median s": seconds, "median / paper's": seconds / SCENES[name].seconds}
    failed = {"outcome": "failed", "message": "no room", "figures": {}}
    done = {"outcome": "done", "figures": figures}
    return {"group": "rows", "case": "paper", "name": name} | (done if seconds < math.inf else failed)


@pytest.mark.parametrize(
    ("jade", "vase", "holds"),
    [
        (0.010, 0.1, [True, True]),
        (0.020, 0.1, [True, False]),
        (0.010, 0.2, [False, True]),
        (0.010, math.inf, [False, True]),
        (math.inf, math.inf, [None, None]),
    ],
)
def test_the_report_claims_the_papers_seconds(jade: float, vase: float, holds: list[bool | None]) -> None:
    """0.04 s of the figure, of which 0.015 are asked for as it is small, and 0.18 s of the vase; a row that has not run
    holds nothing, and its place in the table says so."""
    [section] = paper_table_rows.sections([record_of("jade-figure", jade), record_of("glass-vase", vase)])
    assert [claim.holds for claim in section.claims] == holds
    assert [line[-1] for line in section.tables[0].rows] == ["done" if s < math.inf else "failed" for s in (jade, vase)]
    assert {trial.name for trial in paper_table_rows.trials()} == set(SCENES)
