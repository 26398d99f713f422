"""The paper's table: its rows are the paper's scenes with its cells, materials and obstacles, and say what differs."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fracsim.studies.evidence import paper_table_rows
from fracsim.studies.paper_table import NOTES, PAPER_STEP, SCENES, format_table, read_row, record_row, row_study
from fracsim.study import Study
from fracsim.study.check import check_study


def expected_cells(study: Study) -> int:
    found = re.search(r"about ([\d,]+) cells", check_study(study)[0])
    assert found is not None
    return int(found[1].replace(",", ""))


# Table 2 of the paper: thousands of tetrahedra, s per frame, density, Young's modulus, Poisson's ratio, R_d, strength
# and yield stress; and the obstacles of its figures.
HAMMER, STEEL_BAR = {"hammer", "table"}, (27.8, 0.24, 7.7e3)
PAPER: dict[str, tuple[tuple[float | None, ...], set[str]]] = {
    "loaf": ((620.6, 4.38, 1e3, 1e7, 0.35, 1.0, 4e6, 1e6), set()),
    "doormat-0": ((234.4, 1.62, 1e3, 1e8, 0.45, 0.0, 2.5e6, 1.5e5), set()),
    "doormat-5": ((234.4, 1.62, 1e3, 1e8, 0.45, 5.0, 2.5e6, 1.5e5), set()),
    "jelly-figure": ((159.1, 1.09, 1e3, 1e6, 0.3, 2.0, 1.5e5, 5e3), set()),
    "jade-figure": ((4.7, 0.04, 1e3, 1e10, 0.4, 0.0, 5e7, None), HAMMER),
    "porcelain-figure": ((41.1, 0.33, 1e3, 1e10, 0.4, 0.0, 5e7, None), HAMMER),
    "glass-vase": ((23.7, 0.18, 1e3, 1e10, 0.45, 0.0, 5e7, None), HAMMER),
    "porcelain-vase": ((38.8, 0.29, 1e3, 1e10, 0.45, 0.0, 5e7, None), HAMMER),
    "granite-cylinder": ((45.8, 0.39, 2.75e3, 4.5e10, 0.33, 0.0, 9.56e6, None), {"lower", "upper"}),
    "brittle-charpy": ((*STEEL_BAR, 2.2e11, 0.28, 0.0, 6.55e8, None), {"left", "right", "striker"}),
    "brittle-izod": ((*STEEL_BAR, 2.2e11, 0.28, 0.0, 6.55e8, None), {"upper-jaw", "lower-jaw", "striker"}),
    "ductile-charpy": ((*STEEL_BAR, 1.9e11, 0.28, 0.0, 5.4e8, 8.3e7), {"left", "right", "striker"}),
    "ductile-izod": ((*STEEL_BAR, 1.9e11, 0.28, 0.0, 5.4e8, 8.3e7), {"upper-jaw", "lower-jaw", "striker"}),
}  # fmt: skip


def row_values(name: str) -> tuple[float | None, ...]:
    """Values of a row in the order of `PAPER`; R_d in cm."""
    scene, whole = SCENES[name], row_study(name, small=False)
    assert whole.fracture is not None
    material, flow = whole.material, whole.plasticity
    return (
        scene.cells, scene.seconds, material.density, material.young, material.poisson,
        round(100 * whole.fracture.radius, 9), whole.fracture.strength, flow and flow.yield_stress,
    )  # fmt: skip


def test_every_row_of_the_paper_is_a_row_with_its_values_and_obstacles() -> None:
    """No row of table 2 is left out, and no load of its figures is replaced by a prescribed motion or a pressure."""
    assert list(SCENES) == list(PAPER)
    for name, (values, obstacles) in PAPER.items():
        whole = row_study(name, small=False)
        radius = values[5] if "h" not in SCENES[name].differs else 3.0
        assert row_values(name) == (*values[:5], radius, *values[6:]), name
        assert {obstacle.name for obstacle in whole.obstacle} == obstacles, name
        assert bool(obstacles) != bool(whole.boundary), name
        touching = whole.contact is not None and whole.contact.itself is not False
        assert ("m" in SCENES[name].differs) == touching, name


def test_each_row_names_its_differences_from_the_paper() -> None:
    """Each letter has a note and each note a row; other steps, other bodies and other radii are among them."""
    assert set("".join(scene.differs for scene in SCENES.values())) == set(NOTES)
    for name, scene in SCENES.items():
        whole = row_study(name, small=False)
        assert scene.differs == "".join(sorted({*scene.differs})) and scene.differs
        assert ("b" in scene.differs) == (whole.time.step != PAPER_STEP), name
        assert bool({"e", "h"} & {*scene.differs}) == bool(whole.fracture and whole.fracture.radius), name
        assert ("f" in scene.differs) == bool(whole.plasticity and whole.plasticity.flow_rate < math.inf), name
        assert ("j" in scene.differs) == bool(whole.obstacle), name
        assert ("k" in scene.differs) == any(obstacle.name == "striker" for obstacle in whole.obstacle), name
        breaking_step = whole.time.breaking_step
        assert ("n" in scene.differs) == (breaking_step is not None and breaking_step < whole.time.step), name
        assert ("l" in scene.differs) == (whole.brittle is not None), name


@pytest.mark.usefixtures("little_built")
@pytest.mark.parametrize("name", SCENES)
def test_rows_have_the_papers_cells(name: str) -> None:
    """Cells within a tenth; small: a seventh to two thirds of the cells."""
    counts = [expected_cells(row_study(name, small=small)) for small in (False, True)]
    assert counts[0] == pytest.approx(1e3 * SCENES[name].cells, rel=0.1)
    assert name == "jade-figure" or counts[0] / 7 < counts[1] < counts[0] * 2 / 3


RECORD: dict[str, Any] = {
    "cells": 4632, "dt": [6e-6, 6e-6, 6e-6, 3e-6], "newton": [0, 3, 9, 4], "wall": [0.001, 0.02, 0.08, 0.04],
    "cpu": [0.001, 0.02, 0.06, 0.03], "setup": 1.0,
    "outcome": "at the limit of time", "share": 0.25, "broken": 7, "pieces": 2, "notes": ["a note"],
}  # fmt: skip


def test_a_row_has_the_figures_of_its_run_and_how_it_ended() -> None:
    """Steps of 0.02, 0.08 and 0.04 s after one without contact, where the paper has 0.04; what failed is told below."""
    found = read_row("jade-figure", RECORD)
    assert [found[key] for key in ("cells", "paper's cells", "steps")] == [4632, 4700.0, 4]
    assert [found[key] for key in ("step s", "share")] == [6e-6, 0.25]
    assert [found[key] for key in ("median s", "worst s", "paper's s")] == [0.04, 0.08, 0.04]
    assert [found[key] for key in ("median cpu s", "worst cpu s")] == [0.03, 0.06]
    assert found["median / paper's"] == pytest.approx(1.0)
    assert "failed" in read_row("jade-figure", RECORD | {"newton": [0, 0, 0, 0]})
    lines = format_table([found, {"scene": "loaf", "failed": ["out of memory"]}]).splitlines()
    assert lines[1].split()[0] == "jade-figure" and lines[1].split()[-1] == SCENES["jade-figure"].differs
    assert "jade-figure: at the limit of time; 7 edges broken, 2 pieces; a note" in lines
    assert "loaf: out of memory" in lines
    # the notes of both rows, and of no other
    letters = {*SCENES["jade-figure"].differs, *SCENES["loaf"].differs}
    assert [line for line in lines if line[1:2] == ":"] == [f"{letter}: {NOTES[letter]}" for letter in sorted(letters)]


@pytest.mark.usefixtures("little_built")
def test_a_recorded_row_counts_the_steps_of_its_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A hammer in front of the figure moves for three steps: seconds of each of them."""
    scene = SCENES["jade-figure"]
    short = scene.options | {"time.end": 1.8e-5, "obstacle.0.velocity": [0.0, 1.0, 0.0]}
    monkeypatch.setitem(SCENES, "jade-figure", replace(scene, options=short))
    record_row("jade-figure", tmp_path, small=False, limit=60.0)
    record = json.loads((tmp_path / "jade-figure" / "row.json").read_text())
    assert [len(record[key]) for key in ("dt", "wall", "cpu")] == [3, 3, 3] and min(record["cpu"]) > 0
    assert record["dt"] == pytest.approx([6e-6] * 3) and record["newton"] == [0, 0, 0]
    assert record["outcome"] == "done" and record["share"] == 1 and record["broken"] == 0


def record_of(name: str, seconds: float) -> dict[str, Any]:
    """Of a row in the report, with so many seconds a step; infinite: it failed."""
    figures = {"scene": name, "cells": 4632, "median s": seconds, "median / paper's": seconds / SCENES[name].seconds}
    failed = {"outcome": "failed", "message": "no room", "figures": {}}
    done = {"outcome": "done", "figures": figures}
    return {"group": "rows", "case": "paper", "name": name} | (done if seconds < math.inf else failed)


@pytest.mark.parametrize(
    ("jade", "vase", "holds", "measured"),
    [
        (0.010, 0.09, True, "within: jade-figure 0.25, glass-vase 0.50"),
        (0.080, 0.09, False, "beyond: jade-figure 2.00; within: glass-vase 0.50"),
        (0.010, math.inf, False, "within: jade-figure 0.25"),
        (math.inf, math.inf, None, "nothing"),
    ],
)
def test_the_report_claims_the_papers_seconds(jade: float, vase: float, holds: bool | None, measured: str) -> None:
    """0.04 s of the figure and 0.18 s of the vase; a row that has not run holds nothing, and the table says so."""
    [section] = paper_table_rows.sections([record_of("jade-figure", jade), record_of("glass-vase", vase)])
    [claim] = section.claims
    assert (claim.holds, claim.measured) == (holds, measured)
    assert [line[-1] for line in section.tables[0].rows] == ["done" if s < math.inf else "failed" for s in (jade, vase)]
    assert {trial.name for trial in paper_table_rows.trials()} == set(SCENES)
