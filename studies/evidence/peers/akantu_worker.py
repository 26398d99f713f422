"""Time steps in Akantu (Richart et al. 2024, JOSS 9, 5253), run by its Python; nothing of fracsim is imported.

    PYTHON -I akantu_worker.py problem.npz result.npz

Reads shares of the load from stdin, one a line, and answers each with the seconds of a step: {"wall": s, "cpu": s}. The
stiffness of a linear body is constant: MUMPS factorises it in the first step, and Akantu keeps the factors.
Displacements are written to result.npz at the end.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import akantu
import numpy as np

ELEMENT_TYPES = {(2, 3): "_triangle_3", (2, 6): "_triangle_6", (3, 4): "_tetrahedron_4", (3, 10): "_tetrahedron_10"}


def main() -> None:
    """Read the problem, answer each share of the load with a step, and write the displacement."""
    problem = dict(np.load(sys.argv[1]))
    mesh = build_mesh(problem["points"], problem["cells"])
    model = build_model(mesh, problem)
    force, whole = model.getExternalForce(), problem["force"]
    solver = "" if problem["step"] else "linear"  # "" is that of the analysis
    for line in sys.stdin:
        force[:] = float(line) * whole
        wall, cpu = time.perf_counter(), time.process_time()
        model.solveStep(solver)
        cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
        print(json.dumps({"wall": wall, "cpu": cpu}), flush=True)
    np.savez(sys.argv[2], displacement=np.array(model.getDisplacement()))


def build_mesh(points: Any, cells: Any) -> Any:
    """Akantu mesh of points and cells."""
    kind = getattr(akantu, ELEMENT_TYPES[points.shape[1], cells.shape[1]])
    mesh = akantu.Mesh(points.shape[1])
    into = akantu.MeshAccessor(mesh)
    into.resizeNodes(len(points))
    mesh.getNodes()[:] = points
    mesh.addConnectivityType(kind)
    into.resizeConnectivity(len(cells), kind)
    mesh.getConnectivity(kind)[:] = cells
    into.makeReady()
    return mesh


def build_model(mesh: Any, problem: dict[str, Any]) -> Any:
    """Akantu model: statics for step 0, else the trapezoidal rule with a consistent mass."""
    young, poisson, density, step = (float(problem[key]) for key in ("young", "poisson", "density", "step"))
    words = f"material elastic [\n name = body\n rho = {density!r}\n E = {young!r}\n nu = {poisson!r}\n"
    words += " Plane_Stress = true\n]\n" if problem["plane_stress"] else "]\n"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "material.dat")
        path.write_text(words, encoding="utf-8")
        akantu.parseInput(str(path))
    model = akantu.SolidMechanicsModel(mesh)
    model.initFull(_analysis_method=akantu._implicit_dynamic if step else akantu._static)
    if step:
        model.setTimeStep(step)
    else:  # one solve, where by default Newton's method would look whether that was enough
        model.getNewSolver("linear", akantu.TimeStepSolverType.static, akantu.NonLinearSolverType.linear)
        model.setIntegrationScheme("linear", "displacement", akantu.IntegrationSchemeType.pseudo_time)
    model.getBlockedDOFs()[:] = problem["held"]
    return model


if __name__ == "__main__":
    main()
