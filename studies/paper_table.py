"""Seconds per step of table 2 of Mandal et al. (2022): the paper's scenes and cells beside its seconds.

    python -m fracsim.studies.paper_table [-o OUT] [--rows jade-figure ...] [--small] [--ranks 1] [--limit 150]

Each row of the paper is a row here, or two where the paper has two averaging radii or two tests. Loads are those of
the paper: platens, anvils, hammers and tables are rigid obstacles. `NOTES` says what differs from the paper, and each
row names its notes. The paper's seconds are of 12 threads at 2.6 GHz.

Wall and processor seconds are of a step without output; medians leave out the steps before a hammer meets the body. A
run that reaches its time limit reports the steps it has taken and the share of its scene. --small: cells 1.45 times as
large, a third as many.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

from ..study.reader import load_study

if TYPE_CHECKING:
    from ..study import Study

PAPER_STEP = 5e-3  # s, of all scenes of the paper (section 5)
# Differences from the paper, by the letters of the column "differs".
NOTES = {
    "a": "another body: a figure in place of the armadillo, a vase in place of the bunny, a loaf and a mat of our own",
    "b": "shorter steps, since the paper's step is a thousand times the duration of the blow",
    "c": "the paper does not state this load: our speed, slow enough for the paper's step",
    "d": "the paper does not state mass, shape and speed of its hammer: a free one of steel, the body on a table",
    "e": "the paper gives its averaging radius without a unit: here centimetres",
    "f": "plastic flow takes time (flow_rate); with instantaneous flow the stress stays below the strength",
    "g": "corotated Hooke's law; the paper has the Saint Venant-Kirchhoff energy for brittle bodies",
    "h": "the stress is averaged over 3 cm; by the paper's R_d of 0 the crack starts where a platen presses",
    "i": "striker and anvils of ISO 148 (rounded), the vice of ISO 180 with jaws; the paper has blocks and fixed beams",
    "j": "contact forces are implicit; the paper adds impulses to an explicit contact",
    "k": "the speed of the striker is ours (ISO 148: 5 m/s, ISO 180: 3.5 m/s); the paper has a fast-moving block",
    "l": "the number of crack surfaces is ours; the paper does not state that of its brittle analysis",
    "m": "fragments touch each other; those of the paper meet obstacles alone",
    "n": "a step in which the body breaks is repeated with at most 0.25 ms",
}  # fmt: skip


@dataclass(frozen=True)
class PaperScene:
    """A row of the table: a packaged study with its changes, and the paper's figures.

    Attributes:
        study: name of the packaged study.
        cells: thousands of tetrahedra in the paper.
        seconds: seconds per step in the paper.
        differs: letters of `NOTES`.
        h: key -> cell size, m.
        options: other keys of the study that change.
    """

    study: str
    cells: float
    seconds: float
    differs: str
    h: dict[str, float]
    options: dict[str, Any] = field(default_factory=dict)


LONG_STEP = {"time.step": PAPER_STEP}
DOORMAT = LONG_STEP | {
    "time.end": 1.25, "boundary.1.velocity": ["free", -0.012, 0.04], "boundary.2.velocity": ["free", 0.012, -0.04],
    "plasticity.flow_rate": 2.0,
}  # fmt: skip
WITHOUT_SELF_CONTACT = {"contact": {"itself": False}}  # as in the paper, section 4.2
STRUCK_FIGURE = {"material.energy": "stvk"}
STRUCK_VASE = STRUCK_FIGURE | WITHOUT_SELF_CONTACT | {"material.poisson": 0.45, "obstacle.0.density": 7800.0}
GRANITE = LONG_STEP | {
    "material": {"energy": "corotated", "young": 4.5e10, "poisson": 0.33, "density": 2750.0},
    "fracture": {"strength": 9.56e6, "radius": 0.03, "crumbs": False}, "brittle": {"surfaces": 1},
    "contact": {"itself": "pieces", "distance": 1e-4},
    "obstacle.0.at": [0.0, -0.10011, 0.0], "obstacle.1.at": [0.0, 0.10011, 0.0],
    "obstacle.1.velocity": [0.0, -2e-3, 0.0], "time.breaking_step": 2.5e-4, "time.end": 0.5,
}  # fmt: skip
CROSS_BAR = {"shape": "cylinder", "length": 0.014, "axis": [0.0, 1.0, 0.0]}  # across a bar 10 mm wide
CHARPY = {
    "mesh.thickness": 0.01, "time": {"scheme": "backward-euler", "step": 4e-6, "end": 4e-4},
    "obstacle": [
        CROSS_BAR | {"name": "left", "radius": 1e-3, "at": [0.0075, 0.005, -0.0011]},
        CROSS_BAR | {"name": "right", "radius": 1e-3, "at": [0.0475, 0.005, -0.0011]},
        CROSS_BAR | {"name": "striker", "radius": 2e-3, "at": [0.0275, 0.005, 0.0121], "velocity": [0.0, 0.0, -5.0]},
    ],
}  # fmt: skip
IZOD = {
    "mesh.thickness": 0.01, "time": {"scheme": "backward-euler", "step": 1e-5, "end": 1e-3},
    "obstacle": [
        {"name": "upper-jaw", "shape": "box", "size": [0.0375, 0.014, 0.01], "at": [0.01875, 0.005, 0.01508]},
        {"name": "lower-jaw", "shape": "box", "size": [0.036, 0.014, 0.01], "at": [0.018, 0.005, -0.00508]},
        CROSS_BAR | {"name": "striker", "radius": 1e-3, "at": [0.0595, 0.005, -0.0011], "velocity": [0.0, 0.0, 3.5]},
    ],
}  # fmt: skip
BRITTLE_STEEL = {
    "material": {"energy": "corotated", "young": 2.2e11, "poisson": 0.28, "density": 7700.0},
    "fracture": {"strength": 6.55e8, "crumbs": False}, "brittle": {"surfaces": 1}, "contact": {"itself": "pieces"},
}  # fmt: skip
DUCTILE_STEEL = {
    "material": {"energy": "corotated", "young": 1.9e11, "poisson": 0.28, "density": 7700.0},
    "fracture": {"strength": 5.4e8, "crumbs": False}, "plasticity": {"yield_stress": 8.3e7, "update": "implicit"},
}  # fmt: skip
CHARPY_H, IZOD_H = {"mesh.h": 1.6e-3, "mesh.h_notch": 5e-4}, {"mesh.h": 1.8e-3, "mesh.h_notch": 5.2e-4}
# In the order of the paper's table.
SCENES = {
    "loaf": PaperScene("bread", 620.6, 4.38, "acef", {"mesh.h": 3.4e-3}, {"fracture.radius": 0.01}),
    "doormat-0": PaperScene("doormat", 234.4, 1.62, "acf", {"mesh.h": 4.8e-3}, DOORMAT),
    "doormat-5": PaperScene("doormat", 234.4, 1.62, "acef", {"mesh.h": 4.8e-3}, DOORMAT | {"fracture.radius": 0.05}),
    "jelly-figure": PaperScene("jelly-figure", 159.1, 1.09, "acef", {"mesh.h": 4.5e-3}, LONG_STEP),
    "jade-figure": PaperScene("hammered-figure", 4.7, 0.04, "abdjl", {"mesh.h": 0.0145}, STRUCK_FIGURE),
    "porcelain-figure": PaperScene("hammered-figure", 41.1, 0.33, "abdjl", {"mesh.h": 5.05e-3}, STRUCK_FIGURE | {
        "mesh.wall": 5e-3, "brittle.spacing": 8e-3}),
    "glass-vase": PaperScene("hammered-vase", 23.7, 0.18, "abdjl", {"mesh.h": 0.0105}, STRUCK_VASE | {
        "mesh.wall": 0.0}),
    "porcelain-vase": PaperScene("hammered-vase", 38.8, 0.29, "abdjl", {"mesh.h": 5.7e-3}, STRUCK_VASE),
    "granite-cylinder": PaperScene("granite-cylinder", 45.8, 0.39, "cghjlmn", {"mesh.h": 7.2e-3}, GRANITE),
    "brittle-charpy": PaperScene("charpy", 27.8, 0.24, "bgijklm", CHARPY_H, CHARPY | BRITTLE_STEEL),
    "brittle-izod": PaperScene("izod", 27.8, 0.24, "bgijklm", IZOD_H, IZOD | BRITTLE_STEEL),
    "ductile-charpy": PaperScene("charpy", 27.8, 0.24, "bgijk", CHARPY_H, CHARPY | DUCTILE_STEEL),
    "ductile-izod": PaperScene("izod", 27.8, 0.24, "bgijk", IZOD_H, IZOD | DUCTILE_STEEL),
}  # fmt: skip
COLUMNS = (
    "scene", "cells", "paper's cells", "step s", "steps", "share", "median s", "worst s", "median cpu s", "worst cpu s",
    "paper's s", "median / paper's", "differs",
)  # fmt: skip


def toml_value(value: Any) -> str:
    """Value as TOML on one line."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {toml_value(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml_value, value)) + "]"
    return json.dumps(value)


def overrides(scene: PaperScene, *, small: bool) -> list[str]:
    """Arguments of --set for a row."""
    factor = 1.45 if small and scene.cells > 10 else 1.0  # the jade figure has no cell to spare
    given = {key: factor * size for key, size in scene.h.items()} | scene.options
    return [f"{key}={toml_value(value)}" for key, value in given.items()] + ["output.picture=false"]


def row_study(name: str, *, small: bool) -> Study:
    """Study of a row, with frames at its start and end only."""
    scene = SCENES[name]
    sets = overrides(scene, small=small)
    return load_study(scene.study, [*sets, f"output.interval={load_study(scene.study, sets).time.end}"])


def run_row(name: str, out: Path, *, small: bool, ranks: int, limit: float) -> dict[str, Any]:
    """Row of the table, from a run in separate processes."""
    folder = out / name
    command = [sys.executable, "-m", "fracsim.studies.paper_table", "--record", "--rows", name, "-o", str(out),
               "--limit", f"{limit:g}", *(["--small"] if small else [])]  # fmt: skip
    if ranks > 1:
        command = [shutil.which("mpirun") or "mpirun", "-n", str(ranks), *command]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode or not (folder / "row.json").exists():
        return {"scene": name, "failed": done.stderr.strip().splitlines()[-1:] or [f"exit code {done.returncode}"]}
    return read_row(name, json.loads((folder / "row.json").read_text(encoding="utf-8")))


def record_row(name: str, out: Path, *, small: bool, limit: float) -> None:
    """Run a row in this process and write its figures to row.json in its folder (collective).

    Args:
        name: of the row.
        out: folder of the folder of the row.
        small: larger cells.
        limit: wall time of the steps, s.
    """
    from mpi4py import MPI

    from ..deformable_run import Run
    from ..errors import NotConverged, StepAborted
    from ..mesh.parallel import sum_over_ranks
    from ..scene import build_scene

    comm, folder, study = MPI.COMM_WORLD, out / name, row_study(name, small=small)
    (folder / "row.json").unlink(missing_ok=True)
    began = time.perf_counter()
    run = Run(build_scene(comm, study), folder, overwrite=True, wall_limit=limit)
    setup = time.perf_counter() - began
    run.scene.stepper.set_stop_request(run.interrupt.must_abandon_step)
    wall, cpu, sizes, newton, outcome = [], [], [], [], "done"
    with run.interrupt:
        run.write_frame()
        while not run.ended and outcome == "done":
            cpu_began = time.process_time()
            try:
                report = run.step()
            except (NotConverged, StepAborted) as error:
                outcome = f"stopped: {error}" if isinstance(error, NotConverged) else "at the limit of time"
                break
            cpu.append(float(sum_over_ranks(comm, [time.process_time() - cpu_began])[0]))
            wall.append(report.seconds)
            sizes.append(report.dt)
            newton.append(report.solve.newton_iterations)
            if not run.ended and run.interrupt.stop_reason():
                outcome = "at the limit of time"
        run.write_frame()
    run.history.close()
    share = 1.0 if outcome == "done" else run.state.t / study.time.end
    notes, counts = run.monitors.notes(done=outcome == "done"), run.breaks.counts
    cells = int(sum_over_ranks(comm, [run.scene.domain.cell_count])[0])
    record = {
        "cells": cells, "dt": sizes, "newton": newton, "wall": wall, "cpu": cpu, "setup": setup,
        "outcome": outcome, "share": share, "broken": int(counts[0]), "pieces": int(counts[2]), "notes": notes,
        "contact": run.monitors.summary(),
    }  # fmt: skip
    if comm.rank == 0:
        (folder / "row.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def read_row(name: str, record: dict[str, Any]) -> dict[str, Any]:
    """Figures of a run, in the order of COLUMNS, and how it ended.

    Medians are over the steps with Newton iterations: before a hammer meets the body there are none.
    """
    scene, cells, outcome = SCENES[name], record["cells"], record["outcome"]
    solved = [step for step, count in enumerate(record["newton"]) if count]
    if not solved:
        return {"scene": name, "failed": [f"no step was solved: {outcome}"]}
    wall, cpu = ([record[clock][step] for step in solved] for clock in ("wall", "cpu"))
    figures = (
        name, cells, scene.cells * 1e3, record["dt"][0], len(record["dt"]), record["share"], median(wall), max(wall),
        median(cpu), max(cpu), scene.seconds, median(wall) / scene.seconds, scene.differs,
    )  # fmt: skip
    ended = {key: record[key] for key in ("outcome", "broken", "pieces", "notes")}
    return dict(zip(COLUMNS, figures, strict=True)) | ended


def format_table(rows: list[dict[str, Any]]) -> str:
    """Table as text, with how each run ended, what failed and the notes of differences."""
    lines = [list(COLUMNS)]
    ran = [item for item in rows if "failed" not in item]
    lines += [[item["scene"], *(f"{item[key]:.4g}" for key in COLUMNS[1:-1]), item["differs"]] for item in ran]
    widths = [max(len(line[column]) for line in lines) for column in range(len(COLUMNS))]
    ends = [
        f"{item['scene']}: {item['outcome']}; {item['broken']} edges broken, {item['pieces']} pieces"
        + "".join(f"; {note}" for note in item["notes"])
        for item in ran
    ]
    failed = [f"{item['scene']}: {' '.join(item['failed'])}" for item in rows if "failed" in item]
    letters = sorted({letter for item in rows for letter in SCENES[item["scene"]].differs})
    notes = [f"{letter}: {NOTES[letter]}" for letter in letters]
    return "\n".join([*(" ".join(map(str.rjust, line, widths)) for line in lines), *ends, *failed, *notes])


def main() -> None:
    """Run the rows, print the table and write table.json."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, default=Path("out/table"))
    parser.add_argument("--rows", nargs="+", choices=SCENES, default=[*SCENES], metavar="ROW", help=", ".join(SCENES))
    parser.add_argument("--small", action="store_true")
    parser.add_argument("--ranks", type=int, default=1)
    parser.add_argument("--limit", type=float, default=150.0, help="seconds of the steps of a run")
    parser.add_argument("--record", action="store_true", help=argparse.SUPPRESS)  # a row, in this process
    given = parser.parse_args()
    if given.record:
        return record_row(given.rows[0], given.out, small=given.small, limit=given.limit)
    how = {"small": given.small, "ranks": given.ranks, "limit": given.limit}
    rows = []
    for name in given.rows:
        rows.append(run_row(name, given.out, **how))
        print(format_table(rows[-1:]), flush=True)
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / "table.json").write_text(json.dumps({"how": how, "rows": rows}, indent=1) + "\n")
    print(f"\n{format_table(rows)}\n(in {given.out}/table.json)")
    return None


if __name__ == "__main__":
    main()
