"""history.csv of a dozen scenes before and after a redesign, compared to the last digit that is written.

    git worktree add ../before HEAD
    (cd ../before && ./env python3 <this file> record ../recorded)      with the code as it was
    ./env python3 tests/histories.py compare ../recorded                with the code as it is

Scenes are run through the command line alone, so that one script serves any two layouts. Wall-clock columns do not
count. `compare` names, for every scene that differs, the first row and column that does; it ends with 1 where any does.
"""

from __future__ import annotations

import csv
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

CLOCK = "wall_step"
STRIP = """
title = "strip"
[mesh]
builder = "box"
size = [1.0, 0.25]
h = 0.0625
pattern = "unstructured"
[material]
energy = "neo-hookean"
young = 1e6
poisson = 0.3
density = 1000.0
[fracture]
strength = 2e4
[[boundary]]
on = "left"
fix = "xy"
[[boundary]]
on = "right"
velocity = [1.0, 0.0]
[time]
step = 0.005
end = 0.1
[[probe]]
name = "grip"
on = "right"
[[probe]]
name = "tip"
point = [1.0, 0.25]
[output]
every = 5
picture = false
"""
BLOCK = """
title = "block"
[mesh]
builder = "box"
size = [1.0, 0.5, 0.5]
h = 0.125
[material]
energy = "neo-hookean"
young = 1e6
poisson = 0.3
density = 1000.0
[damping]
mass = 2.0
stiffness = 1e-3
[[boundary]]
on = "left"
fix = "xyz"
[[boundary]]
on = "right"
pressure = { time = [0.0, 0.05, 0.1], value = [0.0, -8e4, -8e4] }
[[boundary]]
on = "top"
traction = [0.0, 1e3, 0.0]
[load]
gravity = [0.0, 0.0, -9.81]
[time]
scheme = "newmark"
mass = "consistent"
step = 0.004
end = 0.12
[[probe]]
name = "wall"
on = "left"
[output]
picture = false
"""
DUCTILE = ["plasticity.yield_stress=1.2e4", "plasticity.hardening=1e5", "plasticity.flow_rate=500.0"]

# name -> (study: packaged, or a text; overrides; ranks)
SCENES: dict[str, tuple[str, list[str], int]] = {
    "loaf": ("loaf", ["mesh.h=0.013", "time.end=0.3"], 1),
    "cylinder": ("cylinder", ["mesh.h=0.007", "time.end=5e-4"], 1),
    "doormat": ("doormat", ["mesh.h=0.03", "fracture.radius=0.05", "time.end=0.01"], 1),
    "struck-vase": ("struck-vase", ["mesh.h=0.012", "time.end=6e-5"], 1),
    "wall": ("wall", ["mesh.h=0.12", "time.end=0.06"], 1),
    "bar-edge": (
        "bar-2d",
        ["mesh.h=0.016", "material.energy=linear", "fracture.approach=edge", "time.end=0.2", "time.scheme=newmark"], 1,
    ),
    "strip-passes": (STRIP, ["fracture.passes=4", "fracture.cap=0.02", "time.scheme=generalized-alpha", *DUCTILE], 1),
    "strip-closing": (STRIP, ["fracture.unilateral=true", "time.scheme=explicit", "time.step=1e-3"], 1),
    "block-loads": (BLOCK, [], 1),
    "jelly-figure": ("jelly-figure", ["mesh.h=0.015", "time.end=0.1"], 1),
    "bar-chi": ("bar-2d", ["mesh.h=0.016", "time.end=0.2"], 1),
    "bar-quasi-static": ("notched-bar", ["mesh.h=2e-3", "mesh.h_notch=2e-4"], 1),
}  # fmt: skip


def run(name: str, out: Path) -> Path:
    """Run a scene into a folder of its own; returns its history.csv."""
    study, overrides, ranks = SCENES[name]
    folder = out / name
    shutil.rmtree(folder, ignore_errors=True)
    folder.parent.mkdir(parents=True, exist_ok=True)
    if "\n" in study:
        file = out / f"{name}.toml"
        file.write_text(study)
        study = str(file)
    command = ["fracsim", "run", study, "-o", str(folder)]
    for override in [*overrides, "output.picture=false"]:
        command += ["--set", override]
    if ranks > 1:
        command = ["env", "MPIEXEC_TIMEOUT=500", "mpirun", "-n", str(ranks), *command]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if not (folder / "history.csv").exists():
        sys.exit(f"{name}: {done.stderr}")
    return folder / "history.csv"


def difference(before: Path, after: Path) -> str:
    """The first place where two histories differ, in words; empty where they are equal."""
    rows = [list(csv.reader(path.open(newline=""))) for path in (before, after)]
    if rows[0][0] != rows[1][0]:
        return f"columns {sorted(set(rows[0][0]) ^ set(rows[1][0]))}"
    for old, new in zip(*rows, strict=False):
        for column, a, b in zip(rows[0][0], old, new, strict=True):
            if a != b and column != CLOCK:
                return f"step {old[0]}, {column}: {a} before, {b} after"
    return "" if len(rows[0]) == len(rows[1]) else f"{len(rows[0])} rows before, {len(rows[1])} after"


def main() -> int:
    """Record or compare all scenes, or those named."""
    verb, folder, *names = sys.argv[1:]
    names, reference = names or list(SCENES), Path(folder).resolve()
    with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(2) as pool:
        out = reference if verb == "record" else Path(scratch)
        found = dict(zip(names, pool.map(lambda name: run(name, out), names), strict=True))
        if verb == "record":
            print(f"recorded {len(found)} scenes in {reference}")
            return 0
        different = 0
        for name, history in found.items():
            words = difference(reference / name / "history.csv", history)
            different += bool(words)
            print(f"{name:18} {words or 'equal'}")
    return min(different, 1)


if __name__ == "__main__":
    sys.exit(main())
