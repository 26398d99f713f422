"""What PETSc keeps or believes by itself: smoothers of an older tangent, and the residual of CG's recursion."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc

from fracsim.solvers.linear_solver import LinearStepCG
from fracsim.solvers.policy import DEFAULT_POLICY
from fracsim.solvers.preconditioner import renew_smoothers

RANDOM = np.random.default_rng(11)


def chain(n: int, diagonal: np.ndarray) -> PETSc.Mat:
    """(n, n) of springs in a row, each point on a spring to the ground as well."""
    matrix = PETSc.Mat().createAIJ((n, n), nnz=3, comm=MPI.COMM_SELF)
    for row in range(n):
        for column in (row - 1, row + 1):
            if 0 <= column < n:
                matrix.setValue(row, column, -1.0)
        matrix.setValue(row, row, diagonal[row])
    matrix.assemble()
    return matrix


def dense(matrix: PETSc.Mat) -> np.ndarray:
    return np.asarray(matrix.convert("dense").getDenseArray()).copy()


def test_smoothers_have_the_diagonal_of_the_present_tangent() -> None:
    """Jacobi on the fine level is r / diag(K) of the matrix as it is, though multigrid keeps its set-up."""
    n = 400
    matrix = chain(n, np.full(n, 2.01))
    ksp = PETSc.KSP().create(MPI.COMM_SELF)
    ksp.setOperators(matrix)
    pc = ksp.getPC()
    pc.setType("gamg")
    options = PETSc.Options()
    own = {"smoothers_mg_levels_pc_type": "jacobi", "smoothers_pc_gamg_coarse_eq_limit": "20"}
    for key, value in own.items():
        options[key] = value
    ksp.setOptionsPrefix("smoothers_")
    ksp.setFromOptions()
    for key in own:
        options.delValue(key)
    x, b = matrix.createVecs()
    b.set(1.0)
    ksp.solve(b, x)
    assert pc.getMGLevels() > 1
    # as where contact becomes stiff at a few points
    stiff = RANDOM.choice(n, 10, replace=False)
    for row in stiff:
        matrix.setValue(row, row, 1e6)
    matrix.assemble()
    pc.setReusePreconditioner(True)
    renew_smoothers(pc)
    ksp.solve(b, x)
    assert ksp.reason > 0
    fine = pc.getMGSmoother(pc.getMGLevels() - 1).getPC()
    fine.apply(b, x)
    np.testing.assert_allclose(x.array_r, b.array_r / np.diag(dense(matrix)), rtol=1e-14)


@pytest.mark.parametrize("accuracy", [1e-6, 1e-30])
def test_a_linear_step_is_judged_by_b_minus_A_x(accuracy: float) -> None:
    """|b - A x| by NumPy, also where CG's recursion says that nothing is left: 1e-30 is below round-off."""
    n = 60
    matrix = chain(n, 2.0 + 10.0 ** RANDOM.uniform(-6, 2, n))
    b = matrix.createVecLeft()
    b.array_w[:] = RANDOM.normal(size=n)
    x = b.duplicate()
    pc = PETSc.PC().create(MPI.COMM_SELF)
    pc.setOperators(matrix)
    pc.setType("jacobi")
    pc.setUp()
    cg = LinearStepCG(MPI.COMM_SELF, 5000, DEFAULT_POLICY)
    assert cg.solve(matrix, matrix, pc, b, x, accuracy)
    left = float(np.linalg.norm(b.array_r - dense(matrix) @ x.array_r))
    # both are of the size of round-off in the second case, and differ by round-off
    assert left / 3 < cg.residual_norm < 3 * left
    assert cg.residual_norm > 1e-30
    cg.destroy()
