"""A notched plate in PhaseFieldX (Castillon 2025, JOSS 10, 7307), run by its Python; fracsim is not imported.

    PYTHON phase_field_worker.py problem.npz result.npz

History field of Miehe et al. (2010), AT2. With `split` the energy of positive principal strains drives the crack while
the whole stress degrades (hybrid: Ambati et al. 2015); without, the whole energy drives it. Lengths in mm and forces in
kN, as in its examples: its solvers stop at an absolute residual of 1e-9.
"""

from __future__ import annotations

import gc
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

BROKEN_PHASE = 0.95  # phase
STAGGERED_TOLERANCE, MAX_STAGGERED_ITERATIONS = (
    1e-4,
    500,
)  # relative change at which a step's alternate solves end, and how many there may be


def main() -> None:
    """Read the problem, solve all steps, and write load and crack."""
    problem = dict(np.load(sys.argv[1]))
    points, cells, course, axis = problem["points"], problem["cells"], problem["course"], int(problem["axis"])
    split = {"degradation": "hybrid", "split_energy": "spectral"} if problem["split"] else {}
    element = basix.ufl.element("Lagrange", "triangle", 1, shape=(2,))
    mesh = dolfinx.mesh.create_mesh(MPI.COMM_WORLD, cells, points, element)
    V, W = fem.functionspace(mesh, ("Lagrange", 1, (2,))), fem.functionspace(mesh, ("Lagrange", 1))
    phase: list[Any] = []
    height, moved = points[:, 1].max(), fem.Constant(mesh, np.zeros(2))
    foot = fem.dirichletbc(fem.Constant(mesh, np.zeros(2)), _dofs_at_height(V, 0.0), V)
    grip = fem.dirichletbc(moved, _dofs_at_height(V, height), V)

    def pull(_: Any, t: float) -> tuple[float, float, float]:
        moved.value[axis] = course[round(t)]
        if not phase:
            phase.append(_find_field("phi"))
        return float(moved.value[0]), float(moved.value[1]), 0.0

    with tempfile.TemporaryDirectory() as folder:
        data = Input(
            E=float(problem["young"]), nu=float(problem["poisson"]), Gc=float(problem["energy"]),
            l=float(problem["length"]), irreversibility="miehe", k=1e-6, save_solution_vtu=False, **split,
            results_folder_name=str(Path(folder, "results")),
        )  # fmt: skip
        began = time.process_time()
        solve(
            data, mesh, len(course) - 0.5, V, W, bc_list_u=[foot, grip], update_boundary_conditions=pull, path=folder,
            bcs_list_u_names=["foot", "grip"], max_stagger_iter=MAX_STAGGERED_ITERATIONS,
            stagger_error_tol=STAGGERED_TOLERANCE,
        )  # fmt: skip
        seconds = time.process_time() - began
        load = np.loadtxt(Path(folder, "results", "grip.reaction"))[:, 1 + axis]
        solves = np.loadtxt(Path(folder, "results", "phasefieldx.conv"))[:, 1]
    np.savez(sys.argv[2], load=np.abs(load), crack=_crack_points(W, phase[0]))
    print(json.dumps({"cpu": seconds, "solves": int(solves.sum())}))


def _find_field(name: str) -> Any:
    """Field of the running solver, which offers no access to it."""
    return next(
        get_object
        for get_object in gc.get_objects()
        if isinstance(get_object, fem.Function) and get_object.name == name
    )


def _crack_points(W: Any, phase: Any) -> Any:
    """Points (n, 2), mm, where the phase is almost 1."""
    return W.tabulate_dof_coordinates()[phase.x.array > BROKEN_PHASE, :2]


def _dofs_at_height(V: Any, y: float) -> Any:
    """Dofs at height y."""
    return fem.locate_dofs_geometrical(V, lambda x: np.isclose(x[1], y))


if __name__ == "__main__":
    main()
