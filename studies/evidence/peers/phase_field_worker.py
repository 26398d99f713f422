"""A notched plate by PhaseFieldX (Castillon 2025, JOSS 10, 7307), run by the Python that has it; nothing of fracsim is
imported.

    PYTHON phase_field_worker.py problem.npz result.npz

The history field of Miehe et al. (2010), AT2, without a split of the energy: under tension all of it opens the crack.
Lengths in mm and forces in kN, as its examples have them: its solvers stop at a residual of 1e-9.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import basix.ufl
import dolfinx
import numpy as np
from dolfinx import fem
from mpi4py import MPI
from phasefieldx.Element.Phase_Field_Fracture.Input import Input
from phasefieldx.Element.Phase_Field_Fracture.solver.solver import solve

ENOUGH, MOST = 1e-4, 500  # relative change at which a step's alternate solves end, and how many there may be


def main() -> None:
    problem = dict(np.load(sys.argv[1]))
    points, cells, course = problem["points"], problem["cells"], problem["course"]
    element = basix.ufl.element("Lagrange", "triangle", 1, shape=(2,))
    mesh = dolfinx.mesh.create_mesh(MPI.COMM_WORLD, cells, points, element)
    V, W = fem.functionspace(mesh, ("Lagrange", 1, (2,))), fem.functionspace(mesh, ("Lagrange", 1))
    height, moved = points[:, 1].max(), fem.Constant(mesh, np.zeros(2))
    foot = fem.dirichletbc(fem.Constant(mesh, np.zeros(2)), _nodes(V, 0.0), V)
    grip = fem.dirichletbc(moved, _nodes(V, height), V)

    def pull(_: Any, t: float) -> tuple[float, float, float]:
        moved.value[1] = course[round(t)]
        return 0.0, float(moved.value[1]), 0.0

    with tempfile.TemporaryDirectory() as folder:
        data = Input(
            E=float(problem["young"]), nu=float(problem["poisson"]), Gc=float(problem["energy"]),
            l=float(problem["length"]), irreversibility="miehe", k=1e-6, save_solution_vtu=False,
            results_folder_name=str(Path(folder, "results")),
        )  # fmt: skip
        began = time.process_time()
        solve(
            data, mesh, len(course) - 0.5, V, W, bc_list_u=[foot, grip], update_boundary_conditions=pull, path=folder,
            bcs_list_u_names=["foot", "grip"], max_stagger_iter=MOST, stagger_error_tol=ENOUGH,
        )  # fmt: skip
        seconds = time.process_time() - began
        load = np.loadtxt(Path(folder, "results", "grip.reaction"))[:, 2]
        solves = np.loadtxt(Path(folder, "results", "phasefieldx.conv"))[:, 1]
    np.savez(sys.argv[2], load=np.abs(load))
    print(json.dumps({"cpu": seconds, "solves": int(solves.sum())}))


def _nodes(V: Any, y: float) -> Any:
    return fem.locate_dofs_geometrical(V, lambda x: np.isclose(x[1], y))


if __name__ == "__main__":
    main()
