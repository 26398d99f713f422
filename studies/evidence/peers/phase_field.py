"""Notched plates and a notched beam by PhaseFieldX, as trials beside fracsim's of the same problems (peak_loads.py).

    python3 -m venv --system-site-packages DIR && DIR/bin/pip install "phasefieldx==0.1.4" "scifem<0.5" pandas
    export PHASEFIELDX_PYTHON=DIR/bin/python
    python -m fracsim.studies.evidence.peers.phase_field --problem tension --h 2.5e-5 --reference 644.9 -o figures.json

PhaseFieldX is a library on DOLFINx; 0.1.4 works with DOLFINx 0.9, 0.4 does not. The notch of the plate is a slit
along a row of doubled nodes; that of the beam is cut out of the mesh, which is fracsim's. The length scale is two
cells, the smallest that counts as resolved. In tension the whole energy drives the crack. In shear and bending only the
energy of positive principal strains does (hybrid: Ambati et al. 2015); otherwise cracks grow in both directions, and
under the load. Around the supports and the load of the beam the phase is held at 0: the stress is singular there.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..fracture_specimens import PLATE_COURSES, PLATE_SIDE, V_BEAM_COURSE, Course, notched_beam, notched_plate
from ..trial import Trial
from . import working_python

VARIABLE = "PHASEFIELDX_PYTHON"
ABSENT = f"PhaseFieldX is not installed here ({VARIABLE} names no Python that can import it)."
WORKER = Path(__file__).with_name("phase_field_worker.py")
LENGTH_SCALE = 2.0  # length scale over h
INTACT_LENGTHS = 3.0  # length scales around loaded nodes of the beam in which the phase stays 0
MM_PER_M = 1e3
DIRECTION_RADII = 0.08e-3, 0.25e-3  # m from the notch: where the crack direction is measured
PROBLEMS = (*PLATE_COURSES, "beam")
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class PhaseFieldProblem:
    """A plane strain body that a part of its boundary moves.

    Attributes:
        points: nodes (n, 2), m.
        cells: nodes of triangles (m, 3).
        fixed: components (n, 2) that are held at zero.
        driven: nodes (n,) whose component `axis` is prescribed.
        axis: 0 or 1.
        course: displacement at the end of each step (steps,), m; with its sign.
        material: [material] of the study.
        energy: fracture energy, J/m^2.
        length: length scale, m.
        split: only the energy of positive principal strains drives the crack.
        intact: nodes (n,) whose phase stays 0: around single nodes that carry a load, where stress is singular.
        drop: share of the peak load at whose loss the run ends.
    """

    points: Values
    cells: npt.NDArray[np.int64]
    fixed: npt.NDArray[np.bool_]
    driven: npt.NDArray[np.bool_]
    axis: int
    course: Values
    material: dict[str, Any]
    energy: float
    length: float
    split: bool
    intact: npt.NDArray[np.bool_]
    drop: float


@cache
def phasefieldx_python() -> str | None:
    """Python that can import PhaseFieldX; None if there is none."""
    return working_python(VARIABLE, "from phasefieldx.Element.Phase_Field_Fracture.solver.solver import solve")


def course_steps(course: Course, end: float = 1.0) -> Values:
    """Displacement at the end of each step of a course, m."""
    shares = np.arange(course.start, end + 1e-9, course.step)
    return np.asarray(course.travel * shares)


def plate_problem(load: str, h: float) -> PhaseFieldProblem:
    """Notched plate under a load of PLATE_COURSES, on a lattice with a slit."""
    from ....meshes.builders.box import Box

    (along, _), course = PLATE_COURSES[load]
    mesh = Box(size=(1.0, 1.0), h=h / PLATE_SIDE).build()
    points, cells = double_slit_nodes(mesh.points, np.asarray(mesh.cells, np.int64))
    x, y = points.T
    bottom, top, sides = np.isclose(y, 0.0), np.isclose(y, 1.0), np.isclose(x, 0.0) | np.isclose(x, 1.0)
    axis = 0 if along else 1
    fixed = np.repeat(bottom[:, None], 2, axis=1)
    fixed[top, 1 - axis] = True
    if load == "held-shear":
        fixed[sides, 1] = True
    study = notched_plate(load, {"h": h})
    return PhaseFieldProblem(
        points * PLATE_SIDE, cells, fixed, top, axis, course_steps(course), study["material"],
        study["fracture"]["energy"], LENGTH_SCALE * h, axis == 0, np.zeros(len(points), bool), course.drop,
    )  # fmt: skip


def beam_problem(h: float, folder: Path) -> PhaseFieldProblem:
    """Beam with a V notch, on a mesh of fracsim."""
    from ....study.check import build_checked_mesh
    from ....study.reader import validate

    study = notched_beam(folder, h, 1, 2e8) | {"time": V_BEAM_COURSE.time_table}
    mesh = build_checked_mesh(validate(study, "beam"))
    fixed = np.zeros(mesh.points.shape, bool)
    for entry in study["boundary"][:2]:
        low, high = np.array(entry["on"]["box"])
        at = np.all((mesh.points >= low) & (mesh.points <= high), axis=1)
        fixed[at] |= [axis in entry["fix"] for axis in "xy"]
    driven = np.isin(np.arange(len(mesh.points)), mesh.facet_groups["load"])
    loaded = mesh.points[driven | fixed.any(axis=1)]
    apart = np.linalg.norm(mesh.points[:, None] - loaded, axis=2).min(axis=1)
    return PhaseFieldProblem(
        mesh.points, np.asarray(mesh.cells, np.int64), fixed, driven, 1, -course_steps(V_BEAM_COURSE),
        study["material"], study["fracture"]["energy"], LENGTH_SCALE * h, split=True,
        intact=apart < INTACT_LENGTHS * LENGTH_SCALE * h, drop=V_BEAM_COURSE.drop,
    )  # fmt: skip


def double_slit_nodes(points: Values, cells: npt.NDArray[np.int64]) -> tuple[Values, npt.NDArray[np.int64]]:
    """Mesh of a unit square with doubled nodes on its middle row, from the left side to the centre."""
    parted = np.flatnonzero((np.abs(points[:, 1] - 0.5) < 1e-9) & (points[:, 0] < 0.5 - 1e-9))
    other = np.arange(len(points))
    other[parted] = len(points) + np.arange(len(parted))
    above = points[cells].mean(axis=1)[:, 1] > 0.5
    return np.concatenate([points, points[parted]]), np.where(above[:, None], other[cells], cells)


def trials(case: str, problem: str, reference: float, sizes: dict[float, bool]) -> list[Trial]:
    """Trials of a problem in a case of the group precision; empty if PhaseFieldX is not installed.

    Args:
        case: name of the case.
        problem: one of PROBLEMS.
        reference: peak load, N.
        sizes: h, m -> whether the full report alone runs it.
    """
    if phasefieldx_python() is None:
        return []
    module = "fracsim.studies.evidence.peers.phase_field"
    return [
        Trial("precision", case, f"phasefieldx-h-{h:g}", settings={"h": h, "elements": "PhaseFieldX"}, limit=600.0,
              script=(module, "--problem", problem, "--h", f"{h:g}", "--reference", f"{reference:g}"), full=full)
        for h, full in sizes.items()
    ]  # fmt: skip


def solve_problem(problem: PhaseFieldProblem) -> tuple[Values, Values, dict[str, float]]:
    """Load at each step (N), points of the crack (n, 2) in m, and processor time and number of solves.

    Raises:
        RuntimeError: PhaseFieldX is not installed, or failed.
    """
    python = phasefieldx_python()
    if python is None:
        raise RuntimeError(ABSENT)
    material = problem.material
    with tempfile.TemporaryDirectory() as folder:
        path, result = Path(folder, "problem.npz"), Path(folder, "result.npz")
        np.savez(
            path, points=problem.points * MM_PER_M, cells=problem.cells, fixed=problem.fixed, driven=problem.driven,
            axis=problem.axis, course=problem.course * MM_PER_M, young=material["young"] * 1e-9,
            poisson=material["poisson"], energy=problem.energy * 1e-6, length=problem.length * MM_PER_M,
            split=problem.split, drop=problem.drop, intact=problem.intact,
        )  # fmt: skip
        done = subprocess.run([python, str(WORKER), str(path), str(result)], capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(f"PhaseFieldX ended with code {done.returncode}: {done.stderr[-500:]}")
        totals = json.loads(done.stdout.splitlines()[-1])
        with np.load(result) as results:  # kN for a thickness of 1 mm
            load = results["load"] * 1e3 * material["thickness"] * MM_PER_M
            return load, results["crack"] / MM_PER_M, totals


def crack_direction(crack: Values) -> float:
    """Angle (degrees) below straight ahead of crack points (n, 2), m, relative to the end of the notch.

    Points count at distances within DIRECTION_RADII; NaN without any.
    """
    apart = np.linalg.norm(crack, axis=1)
    near = crack[(apart > DIRECTION_RADII[0]) & (apart < DIRECTION_RADII[1]) & (crack[:, 0] > 0)]
    return float(np.degrees(np.arctan2(-near[:, 1].mean(), near[:, 0].mean()))) if len(near) else float("nan")


def measure(name: str, h: float, reference: float) -> dict[str, float]:
    """Error of the peak load, peak (N), displacement there (m), direction of the crack, seconds and solves."""
    with tempfile.TemporaryDirectory() as folder:
        problem = beam_problem(h, Path(folder)) if name == "beam" else plate_problem(name, h)
    load, crack, totals = solve_problem(problem)
    at = int(load.argmax())
    figures = {
        "peak load": abs(float(load[at]) / reference - 1), "peak": float(load[at]),
        "at": abs(float(problem.course[at])), "seconds": totals["cpu"], "solves": float(totals["solves"]),
    }  # fmt: skip
    if problem.axis == 0:
        figures["direction"] = crack_direction(crack - PLATE_SIDE / 2)
    return {key: value for key, value in figures.items() if np.isfinite(value)}


def main() -> None:
    """Measure and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problem", choices=PROBLEMS, default="tension")
    parser.add_argument("--h", type=float, required=True, help="cell size, m")
    parser.add_argument("--reference", type=float, required=True, help="peak load, N")
    parser.add_argument("-o", "--out", type=Path, required=True)
    given = parser.parse_args()
    figures = measure(given.problem, given.h, given.reference)
    given.out.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
