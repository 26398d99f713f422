"""Seconds per step of table 2 of Mandal et al. (2022): the paper's cells, materials and steps, beside its seconds.

    python -m fracsim.studies.paper_table [-o OUT] [--rows jade-figure ...] [--small] [--ranks 2] [--limit 600]

The paper's seconds are of 12 threads at 2.6 GHz. Steps are the paper's, 5e-3 s, with loads slow enough for them. Bodies
under impact have shorter steps, since a contact of microseconds has to be resolved. Averaging radii are smaller than
the paper's where those would need billions of weights (see the comments in the studies).

A run that reaches its time limit reports the steps it has taken. --small: cells larger by half, a third as many.
"""

from __future__ import annotations

import argparse
import csv
import json
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any


@dataclass(frozen=True)
class PaperScene:
    """A row of the table: a packaged study with its changes, and the paper's figures.

    Attributes:
        study: name of the packaged study.
        h: key -> cell size, m.
        options: other keys of the study that change.
        cells: thousands of tetrahedra in the paper.
        seconds: seconds per step in the paper.
    """

    study: str
    h: dict[str, float]
    options: dict[str, Any]
    cells: float
    seconds: float


LONG_STEP = {"time.step": 5e-3}
STEEL = LONG_STEP | {
    "mesh.thickness": 0.01, "boundary.0.fix": "xyz", "time.scheme": "backward-euler",
    "boundary.2.displacement.value": [["free", 0.0, "free"], ["free", -8e-5, "free"]],
}  # fmt: skip
SCENES = {
    "loaf": PaperScene("loaf", {"mesh.h": 3.3e-3}, LONG_STEP | {
        "material.young": 1e7, "material.density": 1e3, "fracture.strength": 4e6, "plasticity.yield_stress": 1e6,
        "plasticity.flow_rate": 10.0}, 620.6, 4.38),
    "doormat": PaperScene("doormat", {"mesh.h": 4.8e-3}, LONG_STEP | {
        "time.end": 1.25, "boundary.1.velocity": ["free", -0.012, 0.04],
        "boundary.2.velocity": ["free", 0.012, -0.04], "plasticity.flow_rate": 2.0}, 234.4, 1.62),
    "jelly-figure": PaperScene("jelly-figure", {"mesh.h": 4.5e-3, "fracture.radius": 9e-3}, LONG_STEP, 159.1, 1.09),
    "jade-figure": PaperScene("struck-figure", {"mesh.h": 0.0145}, {}, 4.7, 0.04),
    "porcelain-figure": PaperScene("struck-figure", {"mesh.h": 4.9e-3}, {"mesh.wall": 5e-3, "brittle.spacing": 8e-3},
                              41.1, 0.33),
    "glass-vase": PaperScene("struck-vase", {"mesh.h": 0.0105}, {"mesh.wall": 0.0, "material.poisson": 0.45}, 23.7,
                             0.18),
    "porcelain-vase": PaperScene("struck-vase", {"mesh.h": 5.7e-3}, {"material.poisson": 0.45}, 38.8, 0.29),
    "granite-cylinder": PaperScene("cylinder", {"mesh.h": 3.82e-3}, LONG_STEP | {
        "time.end": 0.35, "boundary.1.velocity": [0.0, 0.0, 1e-4]}, 45.8, 0.39),
    "steel-bar": PaperScene("notched-bar", {"mesh.h": 1.4e-3, "mesh.h_notch": 4e-4}, STEEL, 27.8, 0.24),
}  # fmt: skip
COLUMNS = ("scene", "cells", "paper's cells", "step s", "steps", "median s", "worst s", "paper's s", "median / paper's")


def overrides(scene: PaperScene, *, small: bool) -> list[str]:
    """Arguments of --set for a row."""
    factor = 1.5 if small and scene.cells > 10 else 1.0  # the jade figure has no cell to spare
    given = {key: factor * size for key, size in scene.h.items()} | scene.options
    return [f"{key}={json.dumps(value)}" for key, value in given.items()] + ["output.picture=false"]


def run_row(name: str, out: Path, *, small: bool, ranks: int, limit: float) -> dict[str, Any]:
    """Row of the table, from a run in separate processes."""
    scene, folder = SCENES[name], out / name
    sets = [word for override in overrides(scene, small=small) for word in ("--set", override)]
    command = [shutil.which("fracsim") or "fracsim", "run", scene.study, *sets, "-o", str(folder), "--overwrite",
               "--wall-limit", f"{limit:g}"]  # fmt: skip
    if ranks > 1:
        command = ["mpirun", "-n", str(ranks), *command]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode not in (0, 4):
        return {"scene": name, "failed": done.stderr.strip().splitlines()[-1:] or [f"exit code {done.returncode}"]}
    return read_row(name, folder)


def read_row(name: str, folder: Path) -> dict[str, Any]:
    """Figures of a finished run, in the order of COLUMNS."""
    with (folder / "history.csv").open(newline="", encoding="utf-8") as file:
        steps = list(csv.DictReader(file))
    seconds, paper = [float(step["wall_step"]) for step in steps], SCENES[name].seconds
    cells = json.loads((folder / "summary.json").read_text(encoding="utf-8"))["cells"]
    middle = median(seconds)
    figures = (name, cells, SCENES[name].cells * 1e3, float(steps[0]["dt"]), len(steps), middle, max(seconds), paper,
               middle / paper)  # fmt: skip
    return dict(zip(COLUMNS, figures, strict=True))


def format_table(rows: list[dict[str, Any]]) -> str:
    """Table as text."""
    lines = [list(COLUMNS)]
    ran = [item for item in rows if "failed" not in item]
    lines += [[item["scene"], *(f"{item[key]:.4g}" for key in COLUMNS[1:])] for item in ran]
    widths = [max(len(line[column]) for line in lines) for column in range(len(COLUMNS))]
    failed = [f"{item['scene']}: {' '.join(item['failed'])}" for item in rows if "failed" in item]
    return "\n".join([*(" ".join(map(str.rjust, line, widths)) for line in lines), *failed])


def main() -> None:
    """Run the rows, print the table and write table.json."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, default=Path("out/table"))
    parser.add_argument("--rows", nargs="+", choices=SCENES, default=[*SCENES], metavar="ROW", help=", ".join(SCENES))
    parser.add_argument("--small", action="store_true")
    parser.add_argument("--ranks", type=int, default=1)
    parser.add_argument("--limit", type=float, default=600.0, help="seconds of a run")
    given = parser.parse_args()
    how = {"small": given.small, "ranks": given.ranks, "limit": given.limit}
    rows = []
    for name in given.rows:
        rows.append(run_row(name, given.out, **how))
        print(format_table(rows[-1:]), flush=True)
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / "table.json").write_text(json.dumps({"how": how, "rows": rows}, indent=1) + "\n")
    print(f"\n{format_table(rows)}\n(in {given.out}/table.json)")


if __name__ == "__main__":
    main()
