"""Single-edge notched tension by PhaseFieldX and by us, on the triangles of one lattice.

    python3 -m venv --system-site-packages DIR && DIR/bin/pip install "phasefieldx==0.1.4" "scifem<0.5" pandas
    export PHASEFIELDX_PYTHON=DIR/bin/python
    python -m fracsim.studies.evidence.peers.phase_field --n 40 -o figures.json

PhaseFieldX is a library on DOLFINx; 0.1.4 goes with DOLFINx 0.9, 0.4 does not. Its notch is a slit, along a row of
nodes that are there twice; ours cuts the row of cells above it, since a node at the tip is a hinge (METHOD section 12).
Its length scale is two cells, the least that is taken for resolved.
"""

from __future__ import annotations

import json
import subprocess
import tempfile
import time
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..section import Cell, Section, Table
from ..trial import Trial
from . import write_of_size
from .interpreters import able

VARIABLE = "PHASEFIELDX_PYTHON"
ABSENT = f"PhaseFieldX is not installed here ({VARIABLE} names no Python that can import it)."
WORKER = Path(__file__).with_name("phase_field_worker.py")
SIZES = (40, 80)  # cells along a side: 3,200 and 12,800 triangles
SIDE, YOUNG, POISSON, ENERGY = 1e-3, 2.1e11, 0.3, 2700.0  # m, Pa, J/m^2 (Miehe et al. 2010)
WAY, STEPS = 6.5e-6, 65  # m
SCALE = 2.0  # length scale over h
GRIFFITH = 645.0  # N, of a sharp crack (experiments)
MM = 1e3
Values = npt.NDArray[np.float64]


@cache
def interpreter() -> str | None:
    """A Python that can import PhaseFieldX, where there is one."""
    return able(VARIABLE, "from phasefieldx.Element.Phase_Field_Fracture.solver.solver import solve")


def study(n: int) -> dict[str, Any]:
    """Ours, with n cells along a side."""
    at = SIDE * (0.5 + 0.5 / n)
    return {
        "title": f"a notched plate of {2 * n * n} triangles",
        "mesh": {"builder": "box", "size": [SIDE, SIDE], "h": SIDE / n},
        "material": {"energy": "linear", "young": YOUNG, "poisson": POISSON, "density": 7850.0, "thickness": SIDE},
        "fracture": {"strength": 2e10, "energy": ENERGY},
        "crack": [{"segment": [[-SIDE, at], [SIDE / 2, at]]}],
        "boundary": [
            {"on": "bottom", "fix": "xy"},
            {"on": "top", "displacement": {"time": [0.0, 1.0], "value": [[0.0, 0.0], [0.0, WAY]]}},
        ],
        "time": {"scheme": "quasi-static", "step": 1 / STEPS, "end": 1.0},
        "probe": [{"name": "grip", "on": "top"}],
        "output": {"every": 1_000_000, "fields": [], "picture": False},
    }


def slit(points: Values, cells: npt.NDArray[np.int64]) -> tuple[Values, npt.NDArray[np.int64]]:
    """A square of side 1 whose nodes from the left to the middle of its middle row are there twice."""
    parted = np.flatnonzero((np.abs(points[:, 1] - 0.5) < 1e-9) & (points[:, 0] < 0.5 - 1e-9))
    other = np.arange(len(points))
    other[parted] = len(points) + np.arange(len(parted))
    above = points[cells].mean(axis=1)[:, 1] > 0.5
    return np.concatenate([points, points[parted]]), np.where(above[:, None], other[cells], cells)


def trials() -> list[Trial]:
    """Both sizes; none where PhaseFieldX is not there."""
    return [] if interpreter() is None else [_trial(n) for n in SIZES]


def _trial(n: int) -> Trial:
    script = ("fracsim.studies.evidence.peers.phase_field", "--n", str(n))
    settings: dict[str, Any] = {"n": n, "peer": "PhaseFieldX"}
    return Trial("peers", "notched-plate", f"n-{n}", script=script, settings=settings, limit=10.0 * n)


def beside(n: int) -> dict[str, Any]:
    """Peak load, N, motion there, m, and processor time of both. RuntimeError where PhaseFieldX is not installed."""
    return {"cells": 2 * n * n, "ours": _ours(n), "theirs": _theirs(n)}


def _ours(n: int) -> dict[str, float]:
    from mpi4py import MPI

    from ....run import Run
    from ....scene import build_scene
    from ....study.file import validate

    with tempfile.TemporaryDirectory() as folder:
        run = Run(build_scene(MPI.COMM_WORLD, validate(study(n), "notched plate")), Path(folder, "ours"))
        column, began = run.scene.probes.names.index("reaction_grip_y"), time.process_time()
        load, solves = [], 0
        for _ in range(STEPS):
            solves += run.step().solve.newton
            load.append(abs(run.scene.probes()[column]))
        seconds = time.process_time() - began
    return _figures(np.array(load), seconds, solves)


def _theirs(n: int) -> dict[str, float]:
    from ....meshes.builders.box import Box

    python = interpreter()
    if python is None:
        raise RuntimeError(ABSENT)
    mesh = Box(size=(1.0, 1.0), h=1 / n).build()
    points, cells = slit(mesh.points, np.asarray(mesh.cells, np.int64))
    with tempfile.TemporaryDirectory() as folder:
        problem, result = Path(folder, "problem.npz"), Path(folder, "result.npz")
        np.savez(
            problem, points=points * SIDE * MM, cells=cells, course=_course() * MM, young=YOUNG * 1e-9, poisson=POISSON,
            energy=ENERGY * 1e-6, length=SCALE * SIDE * MM / n,
        )  # fmt: skip
        done = subprocess.run([python, str(WORKER), str(problem), str(result)], capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(f"PhaseFieldX ended with code {done.returncode}: {done.stderr[-500:]}")
        said = json.loads(done.stdout.splitlines()[-1])
        with np.load(result) as found:  # kN for a thickness of 1 mm
            return _figures(found["load"] * 1e3, said["cpu"], said["solves"])


def _course() -> Values:
    """(steps,) motion of the grip at the end of each, m."""
    return WAY * np.arange(1.0, STEPS + 1) / STEPS


def _figures(load: Values, seconds: float, solves: int) -> dict[str, float]:
    at = int(load.argmax())
    return {"peak": float(load[at]), "at": float(_course()[at]), "seconds": seconds, "solves": float(solves)}


def main() -> None:
    write_of_size(__doc__, SIZES[0], beside)


# --- the section ----------------------------------------------------------------------------------------------------

TITLE = "A notched plate beside a phase field's"
TEXT = (
    "Single-edge notched tension on one lattice: PhaseFieldX 0.1.4 (AT2, history field, length scale of two cells, "
    "each step solved in turn to a change of 1e-4) and this program, as many steps each, one process. A sharp crack "
    f"breaks at {GRIFFITH:g} N. Core-seconds are those of all steps, without reading the mesh and compiling."
)
COLUMNS = ("triangles", "program", "peak, N", "at, m", "over Griffith's load", "core-seconds", "solves of displacement")


def sections(records: list[dict[str, Any]]) -> list[Section]:
    """A table; a sentence where PhaseFieldX is not there."""
    found = [record for record in records if record["case"] == "notched-plate"]
    done = [record["figures"] for record in found if record["figures"]]
    if not done:
        return [Section(TITLE, found[0]["message"] if found else ABSENT)]
    rows = tuple(row for figures in done for row in _rows(figures))
    return [Section(TITLE, TEXT, tables=(Table("peers-notched-plate", TITLE, COLUMNS, rows),))]


def _rows(figures: dict[str, Any]) -> list[tuple[Cell, ...]]:
    programs = {"PhaseFieldX": figures["theirs"], "fracsim": figures["ours"]}
    return [
        (figures["cells"], name, each["peak"], each["at"], each["peak"] / GRIFFITH, each["seconds"], each["solves"])
        for name, each in programs.items()
    ]


if __name__ == "__main__":
    main()
