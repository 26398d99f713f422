"""A plane body in PhaseFieldX (Castillon 2025, JOSS 10, 7307), run by its Python; fracsim is not imported.

    PYTHON phase_field_worker.py problem.npz result.npz

History field of Miehe et al. (2010), AT2. With `split` the energy of positive principal strains drives the crack while
the whole stress degrades (hybrid: Ambati et al. 2015); without, the whole energy drives it. Lengths in mm and forces in
kN, as in its examples: its solvers stop at an absolute residual of 1e-9.
"""

from __future__ import annotations

import contextlib
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
from scipy.spatial import cKDTree

BROKEN_PHASE = 0.95  # phase
# relative change at which the alternate solves of a step end, and how many there may be
STAGGERED_TOLERANCE, MAX_STAGGERED_ITERATIONS = 1e-4, 500


class LoadHasFallen(Exception):
    """The load has lost its share of the peak, which ends the run."""


def main() -> None:
    """Read the problem, solve its steps until the load has fallen, and write load and crack."""
    problem = dict(np.load(sys.argv[1]))
    points, course, axis = problem["points"], problem["course"], int(problem["axis"])
    split = {"degradation": "hybrid", "split_energy": "spectral"} if problem["split"] else {}
    element = basix.ufl.element("Lagrange", "triangle", 1, shape=(2,))
    mesh = dolfinx.mesh.create_mesh(MPI.COMM_WORLD, problem["cells"], points, element)
    V, W = fem.functionspace(mesh, ("Lagrange", 1, (2,))), fem.functionspace(mesh, ("Lagrange", 1))
    node = cKDTree(points).query(V.tabulate_dof_coordinates()[:, :2])[1]
    moved = fem.Constant(mesh, np.float64(0.0))
    grip = _condition(V, moved, problem["driven"][node], axis)
    held = [_condition(V, fem.Constant(mesh, np.float64(0.0)), problem["fixed"][node, i], i) for i in (0, 1)]
    row = cKDTree(points).query(W.tabulate_dof_coordinates()[:, :2])[1]
    intact = fem.dirichletbc(
        fem.Constant(mesh, np.float64(0.0)), np.flatnonzero(problem["intact"][row]).astype(np.int32), W
    )
    phase: list[Any] = []

    with tempfile.TemporaryDirectory() as folder:
        reactions = Path(folder, "results", "grip.reaction")

        def pull(_: Any, t: float) -> tuple[float, float, float]:
            if t > 1.5:
                load = np.abs(np.loadtxt(reactions)[:, 1 + axis])
                if load[-1] < (1 - problem["drop"]) * load.max():
                    raise LoadHasFallen
            moved.value = course[round(t)]
            if not phase:
                phase.append(_find_field("phi"))
            return float(moved.value), 0.0, 0.0

        data = Input(
            E=float(problem["young"]), nu=float(problem["poisson"]), Gc=float(problem["energy"]),
            l=float(problem["length"]), irreversibility="miehe", k=1e-6, save_solution_vtu=False, **split,
            results_folder_name=str(Path(folder, "results")),
        )  # fmt: skip
        began = time.process_time()
        with contextlib.suppress(LoadHasFallen):
            solve(
                data, mesh, len(course) - 0.5, V, W, bc_list_u=[grip, *held], bc_list_phi=[intact],
                update_boundary_conditions=pull,
                path=folder, bcs_list_u_names=["grip", "held x", "held y"], max_stagger_iter=MAX_STAGGERED_ITERATIONS,
                stagger_error_tol=STAGGERED_TOLERANCE,
            )  # fmt: skip
        seconds = time.process_time() - began
        load = np.loadtxt(reactions)[:, 1 + axis]
        solves = np.loadtxt(Path(folder, "results", "phasefieldx.conv"))[:, 1]
    np.savez(sys.argv[2], load=np.abs(load), crack=_crack_points(W, phase[0]))
    print(json.dumps({"cpu": seconds, "solves": int(solves.sum())}))


def _condition(V: Any, value: Any, nodes: Any, axis: int) -> Any:
    """Condition on one component of the displacement at nodes (n,), in the order of the space."""
    return fem.dirichletbc(value, (2 * np.flatnonzero(nodes) + axis).astype(np.int32), V.sub(axis))


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


if __name__ == "__main__":
    main()
