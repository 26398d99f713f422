"""Multigrid's cycle in single precision, against matrices written out."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from mpi4py import MPI
from petsc4py import PETSc

from cases import BAR, study
from fracsim.scene import Scene, build_scene
from fracsim.solvers.linear_solver import LinearSolver
from fracsim.solvers.multigrid import bcsr, hierarchy, vcycle
from fracsim.solvers.multigrid.levels import SmoothedLevel
from fracsim.solvers.newton import UNLIMITED_COST, SolveResult
from fracsim.solvers.policy import DEFAULT_POLICY
from fracsim.solvers.preconditioner import Update, mass_stiffness_ratio
from fracsim.solvers.strategies import Attempt, Task, _exact_tangents, _first_positive_tangents
from support.scenes import Walk
from support.solver_policy import set_policy

Values = npt.NDArray[np.float64]

pytestmark = pytest.mark.fast_solver_only("a V cycle of our own, in single precision")


def bar(dim: int, given: dict[str, Any], **tables: Any) -> Scene:
    """A bar of soft neo-Hookean stuff that is pulled, of some hundred nodes; `tables`: others of the study."""
    fine = {2: {"size": [0.6, 0.2], "h": 0.02}, 3: {"size": [0.6, 0.2, 0.2], "h": 0.05}}[dim]
    usual: dict[str, Any] = {
        "mesh": fine,
        "material": {"energy": "neo-hookean", "young": 1e6, "poisson": 0.4, "density": 1000.0},
        "fracture": {"strength": 1e12},
        "time": {"end": 1.0, "scheme": "backward-euler", "step": 5e-3},
        "boundary": [{"on": "left", "fix": "xyz"[:dim]}, {"on": "right", "velocity": [4.0, *[0.0] * (dim - 1)]}],
        "solver": {"snes_type": "ksponly"} | given,
    }
    return build_scene(MPI.COMM_SELF, study(BAR, **usual | tables))


def linear_of(scene: Scene) -> LinearSolver:
    return scene.solver.linear  # type: ignore[union-attr]


def written_out(apply: Any, like: PETSc.Vec) -> Values:
    """The matrix of what `apply` does to a vector."""
    x, y, columns = like.duplicate(), like.duplicate(), []
    for column in range(like.getSize()):
        x.zeroEntries()
        x.array_w[column] = 1.0
        apply(x, y)
        columns.append(y.array_r.copy())
    return np.array(columns).T


def inverse_blocks(A: Values, size: int) -> Values:
    """Of the blocks of A on the diagonal, as a matrix; of the size of their diagonals where they are not positive."""
    B = np.zeros_like(A)
    for at in (slice(first, first + size) for first in range(0, len(A), size)):
        D = A[at, at]
        B[at, at] = np.linalg.inv(D if np.linalg.eigvalsh(D)[0] > 0 else np.diag(np.abs(np.diag(D))))
    return B


def by_hand(A: list[Values], P: list[Values], levels: list[SmoothedLevel]) -> Values:
    """M of the finest level in double precision, p by Chebyshev's polynomial of the eigenvalues of L^T A L, L L^T = B:
    r after n steps is T_n((m - l) / h) / T_n(m / h) of r before; C is as many cycles as there shall be, each of what
    the one before has left; the coarsest matrix is inverted."""
    M = np.linalg.inv(A[0])
    for here, between, level in zip(A[1:], P, levels, strict=True):
        L = np.linalg.cholesky(inverse_blocks(here, level._size))
        values, vectors = np.linalg.eigh(L.T @ here @ L)
        most, effort = largest_of(level), level.smoothing
        m, h = (1.1 + effort.lower_bound) / 2 * most, (1.1 - effort.lower_bound) / 2 * most
        T = np.polynomial.Chebyshev.basis(effort.steps)
        left = T((m - values) / h) / T(m / h)
        p = L @ (vectors * ((1 - left) / values)) @ vectors.T @ L.T
        rest = np.eye(len(here)) - p @ here
        once = 2 * p - p @ here @ p + rest @ between @ M @ between.T @ rest.T
        M = np.zeros_like(once)
        for _ in range(effort.cycles):
            M = M + once @ (np.eye(len(here)) - here @ M)
    return M


def largest_eigenvalue(B: Values, A: Values) -> float:
    """Of B A."""
    L = np.linalg.cholesky(B)
    return float(np.linalg.eigvalsh(L.T @ A @ L)[-1])


def largest_of(level: SmoothedLevel) -> float:
    """The eigenvalue that it smooths for."""
    return 2 / (level._weights[0][1] * (1.1 + level.smoothing.lower_bound))


def dense(matrix: PETSc.Mat) -> Values:
    copy = matrix.convert("dense", PETSc.Mat())
    return np.asarray(copy.getDenseArray().copy())


@pytest.mark.parametrize(("dim", "slowly"), [(2, 1.0), (3, 1.0), (2, 0.0), (3, 0.0)])
def test_it_is_multigrid_written_out(dim: int, slowly: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of PETSc's matrices, at the tangent that it was set up from, and with that of a body which has moved since as the
    finest, also where it has stiffened by more than smoothers of before would bear; symmetric and positive. Of the
    largest eigenvalue Lanczos' method finds nine tenths at least. `slowly`: 0 where more is done with coarser
    levels."""
    set_policy(monkeypatch, min_block_dofs=0, slow_cycle_ratio=slowly)
    monkeypatch.setattr(hierarchy, "ROWS_AT_A_TIME", 16)  # several parts of each prolongation
    small = {2: {"size": [0.6, 0.14], "h": 0.02}, 3: {"size": [0.6, 0.15, 0.15], "h": 0.05}}  # matrices are dense
    scene = bar(dim, {}, mesh=small[dim])
    Walk(scene).advance()
    linear, preconditioner = linear_of(scene), linear_of(scene).preconditioner
    preconditioner._due = Update.REFRESH
    assert linear.solve()
    made, pc = preconditioner.applied.vcycle, preconditioner.pc
    assert isinstance(made, vcycle.SinglePrecisionVCycle) and preconditioner.serving.handle == made.pc.handle
    A = [dense(pc.getMGSmoother(level).getOperators()[1]) for level in range(pc.getMGLevels())]
    P = [dense(pc.getMGInterpolation(level)) for level in range(1, len(A))]
    sizes = [level._size for level in made._levels]
    assert sizes[-1] == dim < sizes[0]
    largest = [largest_of(level) for level in made._levels]
    finest, *coarser = [level.smoothing for level in made._levels[::-1]]
    usual = [finest] * len(coarser)
    assert (
        finest == (2, 0.1, 1)
        and coarser == (usual if slowly else list(vcycle.THOROUGH_SMOOTHING[: len(coarser)])) != []
    )
    inverses = [inverse_blocks(each, size) for each, size in zip(A[1:], sizes, strict=True)]
    at_first = [largest_eigenvalue(B, each) for B, each in zip(inverses, A[1:], strict=True)]
    assert np.all(np.abs(np.divide(largest, at_first) - 0.95) < 0.05 + 1e-5)
    balance, free = scene.balance, scene.balance.motion.free_dofs
    for moved in (0.0, 0.2, 0.4):
        wild = np.random.default_rng(1).uniform(-1.0, 1.0, len(free)) * moved * balance.domain.mean_edge_length
        balance.set_displacement(balance.u.x.array[: len(free)] + np.where(free, wild, 0.0))
        preconditioner._due = Update.NONE
        assert linear.solve() or moved > 0.2  # where the tangent is not positive
        linear.tangent.update_entries()
        before, A[-1] = A[-1], dense(linear.tangent.matrix)
        assert np.abs(A[-1] - before).max() >= moved / 2 * np.abs(before).max()
        reference, M = (
            each[np.ix_(free, free)]
            for each in (by_hand(A, P, made._levels), written_out(preconditioner.serving.apply, balance.work_vector))
        )
        assert np.abs(M - reference).max() < 1e-5 * np.abs(reference).max()
        assert np.abs(M - M.T).max() < 1e-5 * np.abs(M).max()
        assert np.linalg.eigvalsh(M + M.T)[0] > 0
    assert largest_eigenvalue(inverses[-1], A[-1]) > 1.1 * 1.1 * at_first[-1]


def test_more_is_done_with_coarser_levels_of_what_is_slender(monkeypatch: pytest.MonkeyPatch) -> None:
    """A strip that is bent slowly takes a fifth fewer iterations for it, on three meshes together (17 to 28 % each);
    with a block nothing more is done."""
    set_policy(monkeypatch, min_block_dofs=0)
    set_policy(monkeypatch, slow_iterations=99)  # aggregates stay of one kind
    strip, block, its = [3.0, 0.04, 0.02], [0.2, 0.2, 0.2], np.zeros(3)
    cases = (
        (strip, DEFAULT_POLICY.slow_cycle_ratio),
        (strip, 1.0),
        (block, DEFAULT_POLICY.slow_cycle_ratio),
    )
    for (number, (size, slowly)), seed in product(enumerate(cases), (1, 2, 3)):
        set_policy(monkeypatch, slow_cycle_ratio=slowly)
        scene = bar(
            3, {}, mesh={"size": size, "h": 0.02, "pattern": "unstructured", "seed": seed},
            boundary=[{"on": "left", "fix": "xyz"}, {"on": "right", "velocity": [0.0, 0.0, 0.01]}],
            time={"end": 9.0, "scheme": "backward-euler", "step": 3.0},
        )  # fmt: skip
        its[number] += Walk(scene).advance().solve.krylov_iterations
        made = linear_of(scene).preconditioner.applied.vcycle
        assert made is not None
        assert (made._levels[-2].smoothing == vcycle.THOROUGH_SMOOTHING[0]) == (size is strip and slowly < 1)
    assert its[0] < 0.8 * its[1] and its[2] < its[0]


def test_it_takes_no_more_iterations_than_in_double_precision(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of PETSc's own cycle, which a user who names its smoother keeps, and which goes by single entries of the
    diagonal: the same motion to the solver's tolerance."""
    set_policy(monkeypatch, min_block_dofs=0)
    its, u = [], []
    for given in ({}, {"mg_levels_pc_type": "jacobi"}):
        scene = bar(3, given | {"ksp_rtol": 1e-8})
        walk = Walk(scene)
        its.append([walk.advance().solve.krylov_iterations for _ in range(4)])
        u.append(walk.u)
        assert (linear_of(scene).preconditioner.applied.vcycle is None) == bool(given)
    assert all(0.8 * double <= single <= double for single, double in zip(*its, strict=True)) and min(its[0]) > 5
    np.testing.assert_allclose(*u, rtol=0, atol=1e-6 * np.abs(u[1]).max())


@pytest.mark.parametrize("dim", (2, 3))
def test_corrections_go_by_the_tangent_in_single_precision(dim: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Six digits of K, written out, and all of how it resists what moves along as one; solves by themselves go by all
    of them."""
    set_policy(monkeypatch, min_block_dofs=0)
    scene = bar(dim, {"snes_type": "newtonls"})
    Walk(scene).advance()
    linear = linear_of(scene)
    context = linear.operators.operator.getPythonContext()
    assert context.fine_level is linear.preconditioner.fine_level
    linear.tangent.update_entries()
    K = dense(linear.tangent.matrix)
    error = written_out(linear.operators.operator.mult, scene.balance.work_vector) - K
    assert 0 < np.abs(error).max() < 1e-6 * np.abs(K).max()
    assert np.abs(error - error.T).max() < 1e-14 * np.abs(K).max()
    moved = error.reshape(len(K) // dim, dim, -1, dim).sum(axis=2)  # what a translation meets at each node
    assert 1e-9 * np.abs(K).max() < np.abs(moved).max()
    assert np.abs(moved + moved.transpose(0, 2, 1)).max() < 1e-14 * np.abs(K).max()
    assert linear.solve() and context.fine_level is None
    linear.tangent.update_entries()
    K = dense(linear.tangent.matrix)
    assert (
        np.abs(written_out(linear.operators.operator.mult, scene.balance.work_vector) - K).max()
        < 1e-14 * np.abs(K).max()
    )


@pytest.mark.parametrize("step", [5e-3, 0.8])
def test_what_is_rounded_is_found_by_the_next_correction(step: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same motion as with corrections in double precision, in as many iterations, also in steps so long that
    inertia has some 1e-6 of a cell's stiffness; which those are where it holds next to nothing."""
    set_policy(monkeypatch, min_block_dofs=0)
    pulled = [{"on": "left", "fix": "xyz"}, {"on": "right", "velocity": [0.02 / step, 0.0, 0.0]}]
    more = {"time": {"end": 200 * step, "scheme": "backward-euler", "step": step}, "boundary": pulled}
    its, u = [], []
    for rounded in (DEFAULT_POLICY.min_single_precision_inertia, np.inf):
        set_policy(monkeypatch, min_single_precision_inertia=rounded)
        scene = bar(3, {"snes_type": "newtonls", "snes_rtol": 1e-9}, **more)
        assert step < 0.8 or mass_stiffness_ratio(scene.balance) < 2e-6
        walk = Walk(scene)
        its.append([walk.advance().solve.newton_iterations for _ in range(4)])
        u.append(walk.u)
        assert (linear_of(scene).operators.operator.getPythonContext().fine_level is None) == (rounded == np.inf)
    assert its[0] == its[1]
    np.testing.assert_allclose(*u, rtol=0, atol=1e-8 * np.abs(u[1]).max())


def test_coarse_spaces_are_kept_where_no_edge_has_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    """Once CG has taken longer by some iterations, the cycle is made anew on the same ones; once by more of them, or
    where edges broke, everything is."""
    set_policy(monkeypatch, min_block_dofs=0)
    scene = bar(3, {})
    Walk(scene).advance()
    linear, preconditioner = linear_of(scene), linear_of(scene).preconditioner
    all_of_it, some = DEFAULT_POLICY.vcycle_setup_cost, DEFAULT_POLICY.vcycle_refresh_cost
    assert 1 < some + 1 < 2 * some + 2 < all_of_it
    for extra, broke, cycle_kept, spaces_kept in (
        (some - 1, 0, True, True), (some + 1, 0, False, True), (2 * some, 0, True, True),
        (2 * some + 2, 0, False, True), (all_of_it + 1, 0, False, False),
        (some + 1, 1, True, True), (all_of_it + 1, 1, False, False), (some + 1, 0, False, True),
    ):  # fmt: skip
        preconditioner._extra_iterations = extra
        preconditioner.edges_broke(broke)
        made, spaces = preconditioner.applied.vcycle, preconditioner.pc.getMGInterpolation(1)
        assert linear.solve()
        assert (preconditioner.applied.vcycle is made) == cycle_kept, (extra, broke)
        assert (preconditioner.pc.getMGInterpolation(1).handle == spaces.handle) == spaces_kept, (extra, broke)


@pytest.mark.parametrize("dim", (2, 3))
def test_a_large_body_frees_multigrid_and_its_matrix(dim: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Once the cycle has been copied: steps that break edges are the same to the last bit, and a refresh rebuilds."""
    ends = []
    for kept in (10**9, 0):
        set_policy(monkeypatch, min_block_dofs=0, max_kept_multigrid_dofs=kept)
        scene = bar(dim, {"snes_type": "newtonls"}, fracture={"strength": 5e4})
        walk = Walk(scene)
        reports = [walk.advance() for _ in range(4)]
        linear = linear_of(scene)
        assert (linear.operators.matrix.getInfo()["nz_used"] == 0) == (kept == 0)
        assert all(report.solve.converged for report in reports) and sum(report.broken for report in reports)
        iterations = [report.solve.krylov_iterations for report in reports]
        ends.append((iterations, scene.fracture.graph.broken, walk.state.u))  # type: ignore[union-attr]
        linear.preconditioner._due = Update.REFRESH
        assert linear.preconditioner.next_update() == (Update.REFRESH if kept else Update.REBUILD)
        assert linear.solve()
    assert ends[0][0] == ends[1][0]
    for kept_array, freed_array in zip(ends[0][1:], ends[1][1:], strict=True):
        np.testing.assert_array_equal(kept_array, freed_array)


def test_without_a_compiler_petscs_own_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    set_policy(monkeypatch, min_block_dofs=0)
    monkeypatch.setattr(bcsr, "compile_block_csr", lambda *_: None)
    scene = bar(3, {})
    assert Walk(scene).advance().solve.converged
    preconditioner = linear_of(scene).preconditioner
    assert preconditioner.applied.vcycle is None and preconditioner.serving.getType() == "gamg"


def test_levels_of_an_indefinite_tangent_are_made_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """CG fails for a positive tangent of a bar pressed to half its length with levels of the exact one, which is
    indefinite. Strategies have these made again; levels of an earlier tangent are kept."""
    set_policy(monkeypatch, min_block_dofs=0)
    scene = bar(3, {})
    Walk(scene).advance()
    linear, balance, free = linear_of(scene), scene.balance, scene.balance.motion.free_dofs
    preconditioner, solvers = linear.preconditioner, scene.solver._solvers  # type: ignore[union-attr]
    pressed = np.zeros((len(free) // 3, 3))
    pressed[:, 0] = -0.5 * balance.domain.nodes[: len(pressed), 0]
    balance.set_displacement(np.where(free, pressed.ravel(), balance.u.x.array[: len(free)]))
    failed = Attempt("exact tangents", SolveResult(False, 0, 0, ""), linear_solves_failed=True)

    def solve(eigenvalue_floor: float | None) -> tuple[bool, object]:
        balance.work_vector.array_w[:] = np.where(free, 1.0, 0.0)
        return linear.solve(eigenvalue_floor), preconditioner.applied.vcycle

    def fail() -> object:
        solved, cycle = solve(None)
        assert not solved and linear.ksp.reason == PETSc.KSP.ConvergedReason.DIVERGED_INDEFINITE_MAT
        return cycle

    preconditioner._due = Update.REBUILD
    cycle = fail()
    assert solve(0.0) == (False, cycle)
    preconditioner._due = Update.REBUILD
    cycle = fail()
    solvers.start_after_failure(failed)
    solved, made = solve(0.0)
    assert solved and made is not cycle
    assert fail() is made  # which was set up for a positive tangent
    solvers.start_after_failure(failed)
    assert solve(0.0) == (True, made)


def test_a_failure_that_an_indefinite_tangent_explains_keeps_the_levels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where CG finds the tangent or the preconditioner indefinite, or a line search no descent, levels of an earlier
    tangent are kept; where CG takes too many iterations they are made again."""
    set_policy(monkeypatch, min_block_dofs=0)
    scene = bar(3, {})
    Walk(scene).advance()
    linear, reason = linear_of(scene), PETSc.KSP.ConvergedReason
    preconditioner, solvers = linear.preconditioner, scene.solver._solvers  # type: ignore[union-attr]
    failed = Attempt("exact tangents", SolveResult(False, 0, 0, ""), linear_solves_failed=True)
    linear.balance.work_vector.set(0.0)
    linear.solve()
    assert preconditioner._last_update == Update.NONE
    for code, update in (
        (reason.DIVERGED_INDEFINITE_MAT, Update.NONE), (reason.DIVERGED_INDEFINITE_PC, Update.NONE),
        (reason.CONVERGED_RTOL, Update.NONE), (reason.DIVERGED_MAX_IT, Update.REBUILD),
    ):  # fmt: skip
        linear.ksp.setConvergedReason(code)
        solvers.start_after_failure(failed)
        assert preconditioner._due == update


@pytest.mark.parametrize("scheme", ["backward-euler", "quasi-static"])
@pytest.mark.parametrize("norm, follows", [(0.5, None), (1.5, "guess")])
def test_positive_tangents_continue_where_exact_ones_reduced_the_residual(
    monkeypatch: pytest.MonkeyPatch, scheme: str, norm: float, follows: str | None
) -> None:
    """With inertia the next attempt starts at the last iterate if |r| has fallen there, otherwise at the first guess.

    Without inertia it always starts at the first guess: |r| also falls toward an unstable balance.
    """
    time = {"end": 1.0, "scheme": scheme, "step": 5e-3}
    scene = bar(2, {"snes_type": "newtonls"}, time=time)
    newton, solvers = scene.solver._solvers.newton, scene.solver._solvers  # type: ignore[union-attr]
    guess = np.zeros(scene.balance.owned_dof_count)

    def attempt(given: np.ndarray | None, *_: object, **__: object) -> SolveResult:
        newton._convergence.first_norm = 1.0
        newton.snes.setFunctionNorm(norm)
        solvers.linear.ksp.setConvergedReason(PETSc.KSP.ConvergedReason.DIVERGED_INDEFINITE_MAT)
        return SolveResult(False, 1, 1, "")

    monkeypatch.setattr(newton, "attempt", attempt)
    last = _exact_tangents(solvers, Task(guess, UNLIMITED_COST, []), None)
    assert last.linear_solves_failed
    assert (last.start is None) == (follows is None and scheme == "backward-euler")


def test_levels_that_are_not_positive_for_positive_tangents_are_made_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """An attempt with positive tangents that an indefinite preconditioner ends goes on from its last iterate with
    levels made anew; one that ends otherwise does not."""
    scene, reason = bar(3, {}), PETSc.KSP.ConvergedReason
    Walk(scene).advance()
    linear, solvers = linear_of(scene), scene.solver._solvers  # type: ignore[union-attr]
    guess = np.zeros(3)
    failed = Attempt("exact tangents", SolveResult(False, 0, 0, ""), linear_solves_failed=True, start=guess)
    for code, expected in (
        (reason.DIVERGED_INDEFINITE_PC, [(True, Update.NONE), (False, Update.REBUILD)]),
        (reason.DIVERGED_INDEFINITE_MAT, [(True, Update.NONE)]),
    ):
        calls: list[tuple[bool, Update]] = []

        def attempt(given: np.ndarray | None, *_: object, code: int = code, calls: list[Any] = calls) -> SolveResult:
            calls.append((given is guess, linear.preconditioner._due))
            linear.ksp.setConvergedReason(code if len(calls) == 1 else reason.CONVERGED_RTOL)
            return SolveResult(len(calls) > 1, 1, 1, "")

        linear.preconditioner._due = linear.preconditioner._last_update = Update.NONE
        linear.ksp.setConvergedReason(reason.DIVERGED_INDEFINITE_MAT)
        monkeypatch.setattr(solvers.newton, "attempt", attempt)
        result = _first_positive_tangents(solvers, Task(guess, UNLIMITED_COST, []), failed)
        assert calls == expected and result.start is guess
        assert result.result.converged == (len(expected) == 2)


def test_coarse_matrices_are_the_same_with_stored_products(monkeypatch: pytest.MonkeyPatch) -> None:
    """P^T (A P) in place of PETSc's sums row by row, whose option is in the database during the set-up alone."""
    levels = []
    for limit in (0, DEFAULT_POLICY.max_stored_product_dofs):
        set_policy(monkeypatch, max_stored_product_dofs=limit)
        scene = bar(3, {})
        Walk(scene).advance()
        pc = linear_of(scene).preconditioner.pc
        levels.append([dense(pc.getMGSmoother(level).getOperators()[1]) for level in range(pc.getMGLevels())])
        assert not PETSc.Options().hasName("matptap_via")
    assert len(levels[0]) == len(levels[1]) > 1
    for one, other in zip(*levels, strict=True):
        np.testing.assert_allclose(other, one, rtol=0, atol=1e-12 * abs(one).max())
