"""Cost of steps dominated by fracture: quasi-static collapse, explicit steps, and a stationary crack front.

    python -m fracsim.studies.evidence.fracture_step_cost NAME -o figures.json

Collapse: processor seconds of each step of a lattice of 5,280 triangles loaded until it separates. Explicit: as many
steps of a pane of 9,000 triangles, with and without [fracture], in turn in one process. Front: steps of a column of
192,000 tetrahedra with [fracture] energy, with and without a crack that does not advance.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

from .precision.precision_trials import MINIMAL_OUTPUT
from .report_section import Claim, ReportTable, Section, rerun_hint
from .trial import Trial

Data = dict[str, Any]
MAX_STEP_SECONDS = 5.0  # s: whole runs on random meshes took this long when one step of a lattice took 129 s
BLOCK_COUNT, BLOCK_STEPS, WARM_UP_STEPS = 10, 100, 4  # explicit steps: blocks, steps a block, and steps before them
PULLED = {"on": "right", "displacement": {"time": [0.0, 1.0], "value": [[0.0, 0.0], [6e-4, 0.0]]}}
SHEARED = {"on": "top", "displacement": {"time": [0.0, 1.0], "value": [[0.0, 0.0], [1e-3, 0.0]]}}
BENT = {"on": "right", "displacement": {"time": [0.0, 1.0], "value": [[0.0, 0.0], [0.0, 2e-3]]}}
HELD = {side: {"on": side, "fix": "xy"} for side in ("left", "bottom")}


def collapse_study(energy: str, load: Data, held: str, fracture: Data) -> Data:
    """Lattice of 66 x 40 squares of 1 mm in two triangles each, with a notch, under a load that grows in 20 steps."""
    return {
        "title": "a lattice that comes apart",
        "mesh": {"builder": "box", "size": [0.066, 0.04], "h": 1e-3, "pattern": "structured"},
        "material": {"energy": energy, "young": 3e9, "poisson": 0.35, "density": 1200.0},
        "fracture": {"strength": 2e7, **fracture},
        "crack": [{"segment": [[0.0332, -0.001], [0.0332, 0.0102]]}],
        "boundary": [HELD[held], load],
        "time": {"scheme": "quasi-static", "step": 0.05, "end": 1.0},
        "output": MINIMAL_OUTPUT,
    }


COLLAPSES = {
    "pulled": collapse_study("linear", PULLED, "left", {}),
    "pulled, averaged": collapse_study("linear", PULLED, "left", {"radius": 2e-3}),
    "pulled, until nothing breaks": collapse_study("neo-hookean", PULLED, "left", {"passes": 40}),
    "sheared": collapse_study("neo-hookean", SHEARED, "bottom", {}),
    "bent": collapse_study("neo-hookean", BENT, "left", {}),
}
PANE_STUDY: Data = {
    "title": "a pane that breaks",
    "mesh": {"builder": "box", "size": [0.1, 0.04], "h": 1.05e-3, "pattern": "unstructured"},
    "material": {"energy": "neo-hookean", "young": 3.2e10, "poisson": 0.2, "density": 2450.0},
    "boundary": [{"on": "top", "traction": [0.0, 1e6]}, {"on": "bottom", "traction": [0.0, -1e6]}],
    "time": {"scheme": "explicit", "step": 1e-7, "end": 1.0},
    "output": MINIMAL_OUTPUT,
}
PANE_FRACTURE: Data = {
    "fracture": {"strength": 1.2e6, "radius": 2e-3},
    "crack": [{"segment": [[-0.01, 0.02], [0.05, 0.02]]}],
}
EXPLICIT = "explicit"
COLUMN_STUDY: Data = {
    "title": "a column with a crack that stays as it is",
    "mesh": {"builder": "box", "size": [1.0, 1.0, 4.0], "h": 0.05},
    "material": {"energy": "linear", "young": 1e7, "poisson": 0.3, "density": 1000.0},
    "fracture": {"strength": 1e9, "energy": 1e3},
    "boundary": [{"on": "top", "traction": [0.0, 0.0, 100.0]}, {"on": "bottom", "traction": [0.0, 0.0, -100.0]}],
    "time": {"scheme": "explicit", "step": 1.0, "end": 100.0},
    "output": MINIMAL_OUTPUT,
}
CRACK_CORNERS = ((-1.0, -1.0), (0.513, -1.0), (0.513, 2.0), (-1.0, 2.0))
COLUMN_CRACK: Data = {"crack": [{"polygon": [[x, y, 2.013] for x, y in CRACK_CORNERS]}]}
FRONT, FRONT_STEPS = "front", 60
MAX_FRONT_SHARE = 0.05  # of a step


def trials() -> list[Trial]:
    """One trial for each name."""
    script = "fracsim.studies.evidence.fracture_step_cost"
    return [
        Trial("ladder", "steps", name.replace(", ", "-").replace(" ", "-"), script=(script, name),
              settings={"of": name}, limit=300.0)
        for name in (*COLLAPSES, EXPLICIT, FRONT)
    ]  # fmt: skip


def measure_collapse(name: str) -> Data:
    """Processor seconds of the steps, Newton iterations and broken edges."""
    with tempfile.TemporaryDirectory() as folder:
        run = _start_run(COLLAPSES[name], name, Path(folder))
        seconds, newton = [], 0
        while not run.scene.ended(run.state):
            spent, reports = _time_steps(run, 1)
            seconds.append(spent)
            newton += sum(report.solve.newton_iterations for report in reports)
        cells, broken = run.scene.domain.cell_count, run.breaks.counts[0]
        run.scene.destroy()
    return {"cells": cells, "steps": len(seconds), "worst": max(seconds), "all": sum(seconds), "newton": newton,
            "broken": broken}  # fmt: skip


def measure_explicit() -> Data:
    """Processor seconds of equal numbers of steps of the pane without and with fracture."""
    return _time_in_turn(PANE_STUDY, PANE_FRACTURE, BLOCK_COUNT, BLOCK_STEPS)


def measure_front() -> Data:
    """Processor seconds of equal numbers of steps of the column without and with a crack front."""
    return _time_in_turn(COLUMN_STUDY, COLUMN_CRACK, FRONT_STEPS, 1)


def _time_in_turn(study: Data, more: Data, turns: int, block: int) -> Data:
    """Time blocks of steps of a study, and of the same study with the tables `more`."""
    with tempfile.TemporaryDirectory() as folder:
        runs = [
            _start_run(item, "in turn", Path(folder) / name)
            for name, item in (("whole", study), ("more", study | more))
        ]
        seconds: list[list[float]] = [[], []]
        reports = []
        for run in runs:
            _time_steps(run, WARM_UP_STEPS)
        for _ in range(turns):
            for run, spent in zip(runs, seconds, strict=True):
                took, reports_of = _time_steps(run, block)
                spent.append(took)
            reports += reports_of
        cells, broken = runs[0].scene.domain.cell_count, runs[1].breaks.counts[0]
    share = median((b - w) / w for w, b in zip(*seconds, strict=True))
    breaking = sum(report.broken > 0 for report in reports)
    spent_whole, spent_more = map(sum, seconds)
    return {"cells": cells, "steps": turns * block, "breaking": breaking, "share": share, "whole": spent_whole,
            "all": spent_more, "broken": broken}  # fmt: skip


def _start_run(study: Data, name: str, folder: Path) -> Any:
    """Run of a study before its first step."""
    from mpi4py import MPI

    from ...deformable_run import Run
    from ...scene import build_scene
    from ...study.reader import validate

    return Run(build_scene(MPI.COMM_WORLD, validate(study, name)), folder)


def _time_steps(run: Any, count: int) -> tuple[float, list[Any]]:
    """Processor seconds of `count` steps, and their reports."""
    began = time.process_time()
    reports = [run.step() for _ in range(count)]
    return time.process_time() - began, reports


def main() -> None:
    """Measure one name and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", choices=(*COLLAPSES, EXPLICIT, FRONT))
    parser.add_argument("-o", "--out", type=Path, required=True)
    given = parser.parse_args()
    in_turn = {EXPLICIT: measure_explicit, FRONT: measure_front}
    figures = in_turn[given.name]() if given.name in in_turn else measure_collapse(given.name)
    given.out.write_text(json.dumps(figures, indent=1) + "\n")


# --- the section ----------------------------------------------------------------------------------------------------


def section(records: list[Data]) -> Section:
    """Section with table and claims."""
    done = {record["settings"]["of"]: record["figures"] for record in records if record["figures"]}
    results = {name: figures for name, figures in done.items() if name in COLLAPSES}
    text = (
        "Processor seconds. A lattice of 5,280 triangles with a notch under a load that grows in 20 steps until it "
        "comes apart: one step of such a collapse once took 129 s, whole runs on meshes of random points 5 s. "
        "Explicit steps in turn in one process: of a pane, with and without fracture, and of a column in 3D "
        "with `[fracture] energy`, with and without a front of 60 cells at a load far below its critical one."
        f"{rerun_hint(records)}"
    )
    worst = max(results, key=lambda name: results[name]["worst"], default="")
    measured, holds = "nothing", None
    if results:
        measured, holds = f"{results[worst]['worst']:.2g} s ({worst})", results[worst]["worst"] <= MAX_STEP_SECONDS
    pane, column = done.get(EXPLICIT), done.get(FRONT)
    claims = (
        Claim(f"No step of a collapse takes more than {MAX_STEP_SECONDS:g} s", measured, holds),
        Claim(
            "In explicit 2D steps fracture costs no more than mechanics",
            _ratio_text(pane) if pane else "nothing",
            pane["share"] <= 1 if pane else None,
        ),
        Claim(
            f"A stationary crack front costs at most {MAX_FRONT_SHARE:.0%} of an explicit step",
            f"{column['share']:.1%} of one of {column['cells']:,} tetrahedra" if column else "nothing",
            column["share"] <= MAX_FRONT_SHARE if column else None,
        ),
    )
    columns = (
        "scene", "cells", "steps", "worst step, s", "all steps, s", "without fracture, s",
        "Newton iterations", "broken edges", "outcome",
    )  # fmt: skip
    table = ReportTable("ladder-steps", "Steps with fracture", columns, tuple(map(_row, records)))
    return Section("Steps with fracture", text, claims, (table,))


def _ratio_text(pane: Data) -> str:
    """Cost of breaking relative to the unbroken pane, as text."""
    return (
        f"{pane['share']:.2f} of it: {pane['all']:.1f} s beside {pane['whole']:.1f} s of {pane['steps']:,} steps of "
        f"{pane['cells']:,} triangles, edges breaking in {pane['breaking']}"
    )


def _row(record: Data) -> tuple[Any, ...]:
    """Row of the table."""
    figures = record["figures"].get
    words = record["outcome"] if record["outcome"] == "done" else f"{record['outcome']}: {record['message']}"
    measured = (figures(key) for key in ("cells", "steps", "worst", "all", "whole", "newton", "broken"))
    return (record["settings"]["of"], *measured, words)


if __name__ == "__main__":
    main()
