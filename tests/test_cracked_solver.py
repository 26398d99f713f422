"""The linear solver on a cracked body."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import csr_matrix

from cases import BAR, study
from fracsim.mechanics.block_matrix import TieMatrix
from fracsim.mechanics.matrix_assembly import TangentAssembler
from fracsim.scene import Scene, build_scene
from fracsim.solvers.nonlinear_solver import NonlinearSolver
from fracsim.solvers.policy import DEFAULT_POLICY
from fracsim.studies.evidence.crack_count_cost import random_planes
from support.scenes import Walk
from support.solver_policy import set_policy

pytestmark = pytest.mark.fast_solver_only("multigrid of another kind for a body in pieces, blocks")

SOLVER: dict[str, Any] = {"snes_type": "ksponly", "ksp_rtol": 1e-6}


@pytest.mark.parametrize("scheme", ("backward-euler", "generalized-alpha"))
def test_a_crack_does_not_slow_the_linear_solver(scheme: str) -> None:
    """A plane of broken edges through 2k tetrahedra: multigrid's aggregates do not reach across the crack. Where they
    do (PETSc's own threshold) CG takes twice the iterations of the whole body; less than half of that remains."""
    more = []
    for given in ({}, {"pc_gamg_threshold": -1.0}):
        data = study(
            BAR,
            mesh={"size": [0.6, 0.2, 0.2], "h": 0.04},
            fracture={"strength": 1e12},
            time={"end": 1.0, "scheme": scheme},
            solver=SOLVER | given,
        )
        scene = build_scene(MPI.COMM_SELF, data)
        state = Walk(scene)
        before = [state.advance().solve.krylov_iterations for _ in range(2)][-1]
        cut(scene, [(np.array([1.0, 0.0, 0.0]), np.array([0.31, 0.0, 0.0]))])
        more.append([state.advance().solve.krylov_iterations for _ in range(3)][-1] - before)
        assert scene.fracture.graph.split.any()
    assert more[0] < more[1] / 2, f"{more[0]} iterations more than before the crack, {more[1]} with such aggregates"


def test_a_set_up_that_failed_does_not_spoil_the_next() -> None:
    """PETSc keeps the reason of a failure on the preconditioner, whatever is set up after it."""
    data = study(BAR, mesh={"size": [0.6, 0.2, 0.2], "h": 0.05}, time={"end": 1.0, "scheme": "backward-euler"})
    scene = build_scene(MPI.COMM_SELF, data)
    Walk(scene).advance()
    linear = scene.stepper.solver.linear
    applied, operators = linear.preconditioner.applied, linear.operators
    applied.pc.setFailedReason(PETSc.PC.FailedReason.SUBPC_ERROR)
    applied.set_up(operators, rebuild=True)
    linear.balance.work_vector.set(1.0)
    linear.ksp.solve(linear.balance.work_vector, linear.correction)
    assert linear.ksp.reason > 0


def test_a_thin_body_has_aggregates_of_strong_links(monkeypatch: pytest.MonkeyPatch) -> None:
    """A sheet of two cells that is bent takes at most 0.8 of the iterations that it takes with all links; a cube, which
    takes more of them with strong links, has all of them again. A user who asks for some keeps them."""
    set_policy(
        monkeypatch, slow_iterations=5, min_block_dofs=10**9
    )  # or what nobody asked for is smoothed otherwise, too
    sheet, cube = ((0.15, 0.1, 0.01), 0.0048), ((0.1, 0.1, 0.1), 0.02)
    assert bent_its(*sheet, {}) < 0.8 * bent_its(*sheet, {"pc_gamg_threshold": 0.0})
    assert bent_its(*cube, {}) == bent_its(*cube, {"pc_gamg_threshold": 0.0})


def bent_its(size: tuple[float, ...], h: float, given: dict[str, Any]) -> int:
    """Iterations of a solve once a block that is held on the right and lifted on the left has taken a few steps."""
    data = study(
        BAR,
        mesh={"size": list(size), "h": h, "pattern": "unstructured"},
        material={"energy": "neo-hookean", "young": 1e8, "poisson": 0.3, "density": 1000.0},
        fracture={"strength": 1e12},
        time={"end": 1.0, "scheme": "backward-euler", "step": 5e-3},
        boundary=[{"on": "right", "fix": "xyz"}, {"on": "left", "velocity": ["free", 0.0, 0.04]}],
        solver={"snes_type": "ksponly", "ksp_rtol": 1e-5} | given,
    )
    state = Walk(build_scene(MPI.COMM_SELF, data))
    return [state.advance().solve.krylov_iterations for _ in range(4)][-1]


def smoothers(scene: Scene) -> list[tuple[str, int]]:
    """What each level is smoothed with, and how many times, from the coarsest but one on."""
    pc = scene.solver.linear.preconditioner.pc  # type: ignore[union-attr]
    levels = [pc.getMGSmoother(level) for level in range(1, pc.getMGLevels())]
    return [(level.pc.getType(), level.max_it) for level in levels]


def test_sweeps_do_for_what_is_in_pieces_in_short_steps() -> None:
    """Ten planes through a bar: SSOR takes over, to the same motion as by a user's own preconditioner, and multigrid
    again once inertia holds less."""
    scene, its = shattered(0.04, 10, {"ksp_rtol": 1e-9}, 6, step=5e-3)
    asked, _ = shattered(0.04, 10, {"ksp_rtol": 1e-9, "pc_type": "jacobi"}, 6, step=5e-3)
    solver, u, v = scene.solver, scene.balance.u.x.array, asked.balance.u.x.array
    assert isinstance(solver, NonlinearSolver) and solver.snes.ksp.pc.getType() == "sor" and its[-1] > 5
    np.testing.assert_allclose(u, v, atol=1e-6 * np.abs(v).max())
    solver.linear.preconditioner._policy = replace(DEFAULT_POLICY, min_ssor_inertia=1.0)  # type: ignore[union-attr]
    solver.linear_response(np.ones(scene.balance.owned_dof_count))
    assert set(smoothers(scene)) == {("jacobi", 2)}


def shattered(
    h: float, planes: int, given: dict[str, Any], steps: int, step: float | None = None, energy: str = "neo-hookean"
) -> tuple[Scene, list[int]]:
    """A bar after a step as a whole and some in pieces, and the iterations of these."""
    data = study(
        BAR,
        mesh={"size": [0.6, 0.2, 0.2], "h": h},
        material={"energy": energy},
        fracture={"strength": 1e12},
        time={"end": 1.0, "scheme": "backward-euler"} if step is None else {"end": 100 * step, "step": step},
        solver=SOLVER | given,
    )
    scene = build_scene(MPI.COMM_SELF, data)
    state = Walk(scene)
    state.advance()
    cut(scene, random_planes(planes, scene.domain.bounds.lower, scene.domain.bounds.upper))
    return scene, [state.advance().solve.krylov_iterations for _ in range(steps)]


def cut(scene: Scene, planes: list[Any]) -> None:
    """Break all edges across the planes, and the cells that they come apart."""
    graph = scene.fracture.graph
    ends = scene.domain.nodes[graph.edge_nodes]
    for normal, point in planes:
        side = (ends - point) @ normal >= 0
        graph.break_edges(side[:, 0] != side[:, 1])
    graph.break_unloaded_edges()
    assert scene.balance.stress.chi is not None and scene.solver is not None
    scene.balance.stress.chi.x.array[: scene.domain.cell_count][graph.split] = 0.0
    scene.solver.edges_broke(None)


@pytest.mark.parametrize("first", [True, False])
def test_rows_of_the_tangent_are_those_of_its_products(first: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """A bar in pieces: rows of some nodes, of blocks with ties beside them or of the matrix, against products with unit
    vectors."""
    if first:
        set_policy(monkeypatch, min_block_dofs=0)
    scene, _ = shattered(0.06, 10, {}, 2)
    solver, nodes = scene.solver, np.array([5, 0, 17, 40])
    assert isinstance(solver, NonlinearSolver) and (solver.linear.operators.block_operator is not None) is first
    K, d = solver.linear.operators.operator, scene.domain.dim
    if first:
        random, tied = np.random.default_rng(1), np.array([17, 3, 5])
        ties = csr_matrix(random.normal(size=(3, 3)))
        free = random.uniform(size=(3, d)) > 0.3
        products = scene.balance.tangent._assembler.blocks
        assert products is not None
        products.couplings = [TieMatrix(scene.domain.comm, ties + ties.T, np.arange(3), tied, free.astype(float))]
    x, y = scene.balance.work_vector.duplicate(), scene.balance.work_vector.duplicate()
    rows = scene.balance.tangent.owned_rows(nodes).toarray()
    for row, dof in zip(rows, (d * nodes[:, None] + np.arange(d)).reshape(-1), strict=True):
        x.array_w[:] = 0.0
        x.array_w[dof] = 1.0
        K.mult(x, y)
        np.testing.assert_allclose(row, y.array_r, atol=1e-12 * np.abs(rows).max())


def test_products_in_blocks_are_those_of_single_entries(monkeypatch: pytest.MonkeyPatch) -> None:
    """A bar in pieces, whose matrices are made anew on the way: CG and the finest level of multigrid multiply with
    blocks, to the last digits as with the tangent."""
    set_policy(monkeypatch, min_block_dofs=0)
    scene, _ = shattered(0.04, 10, {}, 6)
    solver = scene.solver
    assert isinstance(solver, NonlinearSolver) and solver.linear.operators.block_operator is not None
    pc = solver.linear.preconditioner.pc
    assert pc.getMGSmoother(pc.getMGLevels() - 1).getOperators()[0].getType() == "python"
    x, alone = scene.balance.tangent.matrix.createVecs()
    x.setRandom()
    by_blocks, u = alone.duplicate(), scene.balance.u.x.array.copy()
    for factor in (1.0, 3.0):
        scene.balance.set_displacement(factor * u)
        scene.balance.tangent.assemble(blocks_only=True)
        tangent = single_entries(scene)
        tangent.mult(x, alone)
        solver.linear.operators.block_operator.mult(tangent, x, by_blocks)
        by_blocks.axpy(-1.0, alone)
        assert by_blocks.norm() < 1e-13 * alone.norm()


def single_entries(scene: Scene) -> PETSc.Mat:
    """The tangent at the present displacement, assembled without blocks."""
    balance = scene.balance
    other = TangentAssembler(balance.tangent.form)
    other(balance.motion.bcs)
    balance.mass.add_to(other.matrix, balance.level.c_a)
    return other.matrix
