"""Factors in place of iterations that are dearer: fewer of those, the same answer, and no balance that is unstable."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from petsc4py import PETSc

from fracsim.solvers.direct_solver import DirectSolver
from fracsim.studies.evidence import solver_comparison
from support.reference import dense_tangent
from support.scenes import displacement, make_scene
from support.solver_policy import set_policy

TABLES = ("mesh", "material", "boundary", "time")


def pressed(**more: Any) -> Any:
    """A slender column, a little aside of straight, pressed together by 0.3 of its length in one step."""
    return make_scene(
        mesh={"builder": "box", "size": [0.1, 1.0], "h": 0.05, "pattern": "structured"},
        material={"energy": "neo-hookean", "young": 1e4, "poisson": 0.3, "density": 1.0},
        load={"gravity": [1.0, 0.0]},
        boundary=[{"on": "bottom", "fix": "xy"}, {"on": "top", "displacement": [0.0, -0.3]}],
        time={"scheme": "quasi-static", "step": 1.0, "end": 1.0, "adapt": False},
        **more,
    )


def test_a_body_that_cg_is_dear_for_is_factorised() -> None:
    """Nearly incompressible, in the plane: the same displacement, after the first step a fifth of the iterations. Who
    asks for CG has it."""
    found = {}
    for way, solver in solver_comparison.SOLVERS.items():
        study = solver_comparison.loaded_box(
            [2.0, 1.0], 0.1, solver_comparison.RUBBER | {"poisson": 0.4999}, [1e5, -2e4], 2
        )
        tight = solver | {"snes_rtol": 1e-9}
        scene, walk = make_scene(**{key: study[key] for key in TABLES}, solver=tight)
        krylov = [walk.advance().solve.krylov_iterations for _ in range(2)][-1]
        found[way] = krylov, displacement(scene, walk)
        scene.destroy()
    assert found["default"][0] < found["CG"][0] / 5
    for way in ("default", "CG"):
        assert np.abs(found[way][1] - found["factors"][1]).max() < 1e-5 * np.abs(found["factors"][1]).max()


def test_a_body_that_cg_is_cheap_for_keeps_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compact, in space: of the answer that CG gives not a bit is other."""
    set_policy(monkeypatch, max_plain_direct_dofs=0)
    study = solver_comparison.loaded_box([1.0] * 3, 0.25, solver_comparison.RUBBER, [1e5, 0.0, -2e4], 2)
    found = []
    for solver in (solver_comparison.SOLVERS["default"], solver_comparison.SOLVERS["CG"]):
        scene, walk = make_scene(**{key: study[key] for key in TABLES}, solver=solver)
        found.append([walk.advance().solve.krylov_iterations for _ in range(2)])
        assert scene.solver is not None and scene.solver.selector.remaining == 0
        scene.destroy()
    assert found[0] == found[1]


def test_factors_that_are_preferred_find_a_stable_balance() -> None:
    """They give way to what goes downhill where need be: the column bends, and the tangent that it ends with is
    positive (dense eigenvalues)."""
    scene, walk = pressed(solver={"snes_rtol": 1e-9})
    assert scene.solver is not None
    scene.solver.selector.start_spell(preferred=True)
    assert walk.advance().solve.converged
    assert abs(displacement(scene, walk)[:, 0]).max() > 0.2 and scene.balance.stress.stored_energy() < 20.0
    free = np.flatnonzero(scene.balance.motion.free_dofs)
    assert np.linalg.eigvalsh(dense_tangent(scene)[np.ix_(free, free)])[0] > 0


@pytest.mark.parametrize("shift, positive", [(0.0, True), (-0.3, False)])
def test_what_factors_tell_is_what_dense_eigenvalues_tell(shift: float, positive: bool) -> None:
    """Of the tangent of the column as it is, and of the one pressed straight, far beyond Euler's load."""
    scene, _ = pressed()
    solver, balance = scene.solver, scene.balance
    assert solver is not None
    X = scene.domain.nodes
    straight = np.stack([0.0 * X[:, 0], shift * X[:, 1]], axis=1).reshape(-1)
    balance.set_displacement(straight)
    with solver.linear.factors():
        balance.work_vector.array_w[:] = 1.0
        assert solver.linear.solve()
        solver.linear.direct.measure_cost(solver.snes.ksp)
        told, beside = solver.linear.direct.equivalent_iterations, PETSc.PC().create(scene.domain.comm)
        beside.setType("python")  # as where springs beside the tangent go before the factors
        beside.setOperators(*solver.snes.ksp.getOperators())
        solver.snes.ksp.setPC(beside)
        solver.linear.direct.measure_cost(solver.snes.ksp)
        assert solver.linear.direct.equivalent_iterations == told
    free = np.flatnonzero(balance.motion.free_dofs)
    least = np.linalg.eigvalsh(dense_tangent(scene)[np.ix_(free, free)])[0]
    assert (least > 0) == positive == solver.linear.direct.is_positive
    assert 1 < solver.linear.direct.equivalent_iterations < 100


def test_factors_that_could_not_be_made_are_not_kept() -> None:
    """A singular tangent, twice: before, PETSc took the failed factors for made, and MUMPS ended in a traceback."""
    K = PETSc.Mat().createAIJ((2, 2), nnz=2, comm=PETSc.COMM_SELF)
    for i in range(2):
        K.setValues(i, [0, 1], [0.0, 0.0])
    K.assemble()
    ksp, (b, x) = PETSc.KSP().create(PETSc.COMM_SELF), K.createVecs()
    b.set(1.0)
    ksp.setType("cg")
    factors = DirectSolver(symmetric=True, dofs=2, dim=2)
    tangent: Any = SimpleNamespace(
        update_entries=lambda: None, attach_to=lambda ksp, pc: (ksp.setPC(pc), ksp.setOperators(K))
    )
    for _ in range(2):
        with factors.serving(ksp, ksp.getPC()):
            factors.update(ksp, tangent)
            ksp.solve(b, x)
            assert ksp.reason == PETSc.KSP.ConvergedReason.DIVERGED_PCSETUP_FAILED
    K.shift(2.0)
    with factors.serving(ksp, ksp.getPC()):
        factors.update(ksp, tangent)
        ksp.solve(b, x)
    assert x.array == pytest.approx([0.5, 0.5])
