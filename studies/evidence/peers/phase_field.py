"""Single-edge notched plates in tension and in shear by PhaseFieldX and by fracsim, on the triangles of one lattice.

    python3 -m venv --system-site-packages DIR && DIR/bin/pip install "phasefieldx==0.1.4" "scifem<0.5" pandas
    export PHASEFIELDX_PYTHON=DIR/bin/python
    python -m fracsim.studies.evidence.peers.phase_field --n 40 [--pull shear] -o figures.json

PhaseFieldX is a library on DOLFINx; 0.1.4 works with DOLFINx 0.9, 0.4 does not. Its notch is a slit along a row of
doubled nodes. fracsim's crack cuts the row of cells above it, since a node at the tip is a hinge
(docs/theory.md#cell-cutting).

The length scale is two cells, the smallest that counts as resolved. In tension the whole energy drives the crack. In
shear only the energy of positive principal strains does (hybrid: Ambati et al. 2015); otherwise cracks grow in both
directions.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
import time
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..report_section import ReportTable, Section, TableCell
from ..trial import Trial
from . import working_python

VARIABLE = "PHASEFIELDX_PYTHON"
ABSENT = f"PhaseFieldX is not installed here ({VARIABLE} names no Python that can import it)."
WORKER = Path(__file__).with_name("phase_field_worker.py")
SIZES = (40, 80)  # cells along a side: 3,200 and 12,800 triangles
SIDE, YOUNG, POISSON, FRACTURE_ENERGY = 1e-3, 2.1e11, 0.3, 2700.0  # m, Pa, J/m^2 (Miehe et al. 2010)
LENGTH_SCALE = 2.0  # length scale over h
GRIFFITH_LOAD = 645.0  # N, of a sharp crack (experiments)
MM_PER_M = 1e3
DIRECTION_RADII = 0.08e-3, 0.25e-3  # m from the notch: where the crack direction is measured
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class GripMotion:
    """Motion of the upper side.

    Attributes:
        axis: 0 tangential, 1 normal.
        displacement: final displacement, m.
        steps: number of steps.
    """

    axis: int
    displacement: float
    steps: int

    @property
    def course(self) -> Values:
        """Displacement of the grip at the end of each step (steps,), m."""
        return self.displacement * np.arange(1.0, self.steps + 1) / self.steps


GRIP_MOTIONS = {"tension": GripMotion(1, 6.5e-6, 65), "shear": GripMotion(0, 1.5e-5, 75)}


@cache
def phasefieldx_python() -> str | None:
    """Python that can import PhaseFieldX; None if there is none."""
    return working_python(VARIABLE, "from phasefieldx.Element.Phase_Field_Fracture.solver.solver import solve")


def plate_study(n: int, pull: GripMotion) -> dict[str, Any]:
    """Study for fracsim with n cells along a side."""
    moved = [0.0, 0.0]
    moved[pull.axis] = pull.displacement
    at = SIDE * (0.5 + 0.5 / n)
    return {
        "title": f"a notched plate of {2 * n * n} triangles",
        "mesh": {"builder": "box", "size": [SIDE, SIDE], "h": SIDE / n},
        "material": {"energy": "linear", "young": YOUNG, "poisson": POISSON, "density": 7850.0, "thickness": SIDE},
        "fracture": {"strength": 2e10, "energy": FRACTURE_ENERGY},
        "crack": [{"segment": [[-SIDE, at], [SIDE / 2, at]]}],
        "boundary": [
            {"on": "bottom", "fix": "xy"},
            {"on": "top", "displacement": {"time": [0.0, 1.0], "value": [[0.0, 0.0], moved]}},
        ],
        "time": {"scheme": "quasi-static", "step": 1 / pull.steps, "end": 1.0},
        "probe": [{"name": "grip", "on": "top"}],
        "output": {"every": 1_000_000, "fields": [], "picture": False},
    }


def double_slit_nodes(points: Values, cells: npt.NDArray[np.int64]) -> tuple[Values, npt.NDArray[np.int64]]:
    """Mesh of a unit square with doubled nodes on its middle row, from the left side to the centre."""
    parted = np.flatnonzero((np.abs(points[:, 1] - 0.5) < 1e-9) & (points[:, 0] < 0.5 - 1e-9))
    other = np.arange(len(points))
    other[parted] = len(points) + np.arange(len(parted))
    above = points[cells].mean(axis=1)[:, 1] > 0.5
    return np.concatenate([points, points[parted]]), np.where(above[:, None], other[cells], cells)


def trials() -> list[Trial]:
    """Trials of both sizes in tension and the larger one in shear; empty if PhaseFieldX is not installed."""
    cases = [*((n, "tension") for n in SIZES), (SIZES[-1], "shear")]
    return [] if phasefieldx_python() is None else [_trial(n, pull) for n, pull in cases]


def _trial(n: int, pull: str) -> Trial:
    """Trial with n cells along a side."""
    script = ("fracsim.studies.evidence.peers.phase_field", "--n", str(n), "--pull", pull)
    settings: dict[str, Any] = {"n": n, "pull": pull, "peer": "PhaseFieldX"}
    return Trial("peers", "notched-plate", f"{pull}-n-{n}", script=script, settings=settings, limit=15.0 * n)


def compare(n: int, pull: str) -> dict[str, Any]:
    """Peak load (N), displacement there (m), crack direction and processor time of both programs.

    Raises:
        RuntimeError: PhaseFieldX is not installed.
    """
    return {
        "cells": 2 * n * n,
        "pull": pull,
        "ours": _run_fracsim(n, GRIP_MOTIONS[pull]),
        "theirs": _run_phasefieldx(n, pull),
    }


def _run_fracsim(n: int, pull: GripMotion) -> dict[str, float]:
    """Figures of fracsim."""
    from mpi4py import MPI

    from ....fracture.energy.tip_criterion import TipCriterion
    from ....run import Run
    from ....scene import build_scene
    from ....study.reader import validate

    with tempfile.TemporaryDirectory() as folder:
        run = Run(build_scene(MPI.COMM_WORLD, validate(plate_study(n, pull), "notched plate")), Path(folder, "ours"))
        column, began = run.scene.probes.columns.index(f"onset_grip_{'xy'[pull.axis]}"), time.process_time()
        load, solves = [], 0
        for _ in range(pull.steps):
            solves += run.step().solve.newton_iterations
            load.append(abs(run.scene.probes()[column]))
        seconds = time.process_time() - began
        assert run.scene.fracture is not None
        criterion = run.scene.fracture.criterion
        assert isinstance(criterion, TipCriterion)
        criterion.find_tips()
        notch = np.array([SIDE / 2, SIDE * (0.5 + 0.5 / n)])
        crack = criterion.field_evaluator.cut_cells.cut_point - notch
    return _figures(np.array(load), pull.course, crack, seconds, solves)


def _run_phasefieldx(n: int, pull: str) -> dict[str, float]:
    """Figures of PhaseFieldX."""
    from ....meshes.builders.box import Box

    python, given = phasefieldx_python(), GRIP_MOTIONS[pull]
    if python is None:
        raise RuntimeError(ABSENT)
    mesh = Box(size=(1.0, 1.0), h=1 / n).build()
    points, cells = double_slit_nodes(mesh.points, np.asarray(mesh.cells, np.int64))
    with tempfile.TemporaryDirectory() as folder:
        problem, result = Path(folder, "problem.npz"), Path(folder, "result.npz")
        np.savez(
            problem, points=points * SIDE * MM_PER_M, cells=cells, course=given.course * MM_PER_M, young=YOUNG * 1e-9,
            poisson=POISSON, energy=FRACTURE_ENERGY * 1e-6, length=LENGTH_SCALE * SIDE * MM_PER_M / n, axis=given.axis,
            split=pull == "shear",
        )  # fmt: skip
        done = subprocess.run([python, str(WORKER), str(problem), str(result)], capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(f"PhaseFieldX ended with code {done.returncode}: {done.stderr[-500:]}")
        totals = json.loads(done.stdout.splitlines()[-1])
        with np.load(result) as results:  # kN for a thickness of 1 mm
            crack = results["crack"] / MM_PER_M - SIDE / 2
            return _figures(results["load"] * 1e3, given.course, crack, totals["cpu"], totals["solves"])


def crack_direction(crack: Values) -> float:
    """Angle (degrees) below straight ahead of crack points (n, 2), m, relative to the end of the notch.

    Points count at distances within DIRECTION_RADII; NaN without any.
    """
    apart = np.linalg.norm(crack, axis=1)
    near = crack[(apart > DIRECTION_RADII[0]) & (apart < DIRECTION_RADII[1]) & (crack[:, 0] > 0)]
    return float(np.degrees(np.arctan2(-near[:, 1].mean(), near[:, 0].mean()))) if len(near) else float("nan")


def _figures(load: Values, course: Values, crack: Values, seconds: float, solves: int) -> dict[str, float]:
    """Figures of one program."""
    at = int(load.argmax())
    return {
        "peak": float(load[at]), "at": float(course[at]), "turn": crack_direction(crack), "seconds": seconds,
        "solves": float(solves),
    }  # fmt: skip


def main() -> None:
    """Compare and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=SIZES[0])
    parser.add_argument("--pull", choices=GRIP_MOTIONS, default="tension")
    parser.add_argument("-o", "--out", type=Path, required=True)
    given = parser.parse_args()
    given.out.write_text(json.dumps(compare(given.n, given.pull), indent=1) + "\n")


# --- the section ----------------------------------------------------------------------------------------------------

TITLE = "Notched plate: fracsim and a phase field"
TEXT = (
    "Single-edge notched plates on one lattice: PhaseFieldX 0.1.4 (AT2, history field, length scale of two cells, each "
    "step solved in turn to a change of 1e-4; in shear hybrid, by positive principal strains) and this program, as "
    f"many steps each, one process. In tension a sharp crack breaks at {GRIFFITH_LOAD:g} N; in shear a kink starts "
    "at 388.7 N, at 75.8 degrees. Direction: of the crack 0.08 to 0.25 mm from the notch, below straight ahead. "
    "Core-seconds are those of all steps, without reading the mesh and compiling."
)
COLUMNS = (
    "pull", "triangles", "program", "peak, N", "at, m", "direction, degrees", "core-seconds", "solves of displacement",
)  # fmt: skip


def sections(records: list[dict[str, Any]]) -> list[Section]:
    """Section with a table; a sentence if PhaseFieldX is not installed."""
    results = [record for record in records if record["case"] == "notched-plate"]
    done = [record["figures"] for record in results if record["figures"]]
    if not done:
        return [Section(TITLE, results[0]["message"] if results else ABSENT)]
    rows = tuple(row for figures in done for row in _rows(figures))
    return [Section(TITLE, TEXT, tables=(ReportTable("peers-notched-plate", TITLE, COLUMNS, rows),))]


def _rows(figures: dict[str, Any]) -> list[tuple[TableCell, ...]]:
    """Rows of a comparison, one a program."""
    programs = {"PhaseFieldX": figures["theirs"], "fracsim": figures["ours"]}
    return [
        (figures["pull"], figures["cells"], name, *(item[key] for key in ("peak", "at", "turn", "seconds", "solves")))
        for name, item in programs.items()
    ]


if __name__ == "__main__":
    main()
