"""Newton's method: one attempt to solve r(u) = 0 for a balance of forces, by PETSc's SNES with a line search.

Equations: docs/theory.md#newtons-method.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from ..errors import InputError, StepAborted
from ..mechanics.balance import Balance
from .linear_solver import LinearSolver, chosen_options
from .petsc_options import PetscOptions, PetscOptionSet, call_petsc
from .policy import SolverPolicy
from .weak_callbacks import weak_callback

if TYPE_CHECKING:
    from .line_search import ModifiedNewton, TangentModification
    from .nonlinear_elimination import NonlinearElimination

Values = npt.NDArray[np.float64]

_SNES = {value: name for name, value in vars(PETSc.SNES.ConvergedReason).items() if isinstance(value, int)}
_KSP = {value: name for name, value in vars(PETSc.KSP.ConvergedReason).items() if isinstance(value, int)}


@dataclass(frozen=True)
class SolveResult:
    """The end of a nonlinear solve.

    Attributes:
        converged: whether r(u) = 0 to the tolerance.
        newton_iterations, krylov_iterations: those that it took.
        reason: a sentence where it did not converge.
        stopped_for_cost: whether it was ended because its Krylov iterations cost more than they may.
    """

    converged: bool
    newton_iterations: int
    krylov_iterations: int
    reason: str
    stopped_for_cost: bool = False


class CostLimit:
    """Bound on the Krylov iterations of an attempt; this one has none."""

    def is_exceeded(self, krylov: int, newton: int, *, modified: bool) -> bool:
        """Whether an attempt ends after so many Krylov and Newton iterations; `modified`: by `ModifiedNewton`."""
        return False


UNLIMITED_COST = CostLimit()


class NewtonSolver:
    """SNES objects on a `Balance`, which share one linear solver.

    The first SNES goes down |r|, or the incremental potential where contact limits its steps. A second one with
    tangents made positive (`ModifiedNewton`) is made when it is first asked for.

    Attributes:
        snes: the SNES of the last attempt.
        linear: the linear solver.
    """

    def __init__(self, balance: Balance, given: PetscOptions, policy: SolverPolicy, *, plain: bool = False) -> None:
        """`given`: PETSc options of the study, over the defaults. InputError where PETSc does not take one."""
        self.balance, self._policy, self._plain = balance, policy, plain
        self._stop_requested: Callable[[], bool] = lambda: False
        chosen = chosen_options(balance, given, plain=plain, policy=policy)
        self._options = PetscOptionSet(chosen)
        snes = self.snes = self._first = PETSc.SNES().create(balance.domain.comm)
        self._all_snes = [snes]
        snes.setOptionsPrefix(self._options.prefix)
        snes.setFunction(lambda _, x, b: balance.assemble_free_residual(x, b), balance.work_vector)
        self._x = balance.work_vector.duplicate()
        try:
            call_petsc(snes.setFromOptions)
            self.linear = LinearSolver(balance, snes.ksp, self._options, given, chosen, policy, plain=plain)
        except InputError:
            self._options.remove()
            raise
        self._set_jacobians()
        snes.setConvergenceTest(weak_callback(self._test_convergence))
        self._first_modified: ModifiedNewton | None = None  # the merit of the first SNES; None: |r|
        self._second_modified: ModifiedNewton | None = None
        if balance.contact.limits_newton_steps:
            snes.setLineSearchPreCheck(weak_callback(self._limit_step))
            if balance.conservative:
                from .line_search import ModifiedNewton

                self._first_modified = ModifiedNewton(balance, snes, policy)
        self._rtol = self._asked_rtol = float(chosen["snes_rtol"])
        self._is_single_solve = chosen["snes_type"] == "ksponly"
        self._has_line_search = chosen["snes_type"] == "newtonls"
        self._elimination: NonlinearElimination | None = None  # of a body that breaks
        # --- of the last attempt ---
        self._modified = self._first_modified
        self._limit: CostLimit = UNLIMITED_COST
        self._aborted = self._stopped_for_cost = False
        self._first_norm = self._solved_norm = 0.0
        self._norms: list[float] = []  # |r| of its iterates
        self._eliminations = 0

    def set_stop_request(self, stop_requested: Callable[[], bool]) -> None:
        """Ask `stop_requested` (collective) between iterations; once it is true an attempt raises StepAborted."""
        self._stop_requested = stop_requested

    def edges_broke(self, count: int | None) -> None:
        """So many edges broke on all ranks, whose cells lost stiffness; None: an unknown number (collective)."""
        self.linear.edges_broke(count)
        if count != 0 and self._elimination is None and self._has_line_search and not self._plain:
            from .nonlinear_elimination import create_elimination

            self._elimination = create_elimination(self.balance, self._policy)

    # --- the last attempt ---

    @property
    def used_second_snes(self) -> bool:
        """Whether the last attempt was not by the first SNES."""
        return self.snes is not self._first

    @property
    def descended_potential(self) -> bool:
        """Whether the line search of the last attempt went down the incremental potential."""
        return self._modified is not None

    @property
    def crawls(self) -> bool:
        """Whether the line search of the last attempt cut the last steps to next to nothing, as |r| is no merit of
        them.

        The residual of one cell that is all but flat grows before it falls. The incremental potential would let steps
        be whole, if there is one that this attempt does not use. (Without inertia factors see to slow attempts.)
        """
        norms, balance, count = self._norms, self.balance, self._policy.crawl_iterations
        is_slow = len(norms) > count and norms[-1] > norms[-1 - count] / 2
        has_other_merit = not self.descended_potential and balance.conservative and balance.scheme.inertia
        return is_slow and has_other_merit and self.snes.ksp.getType() == "cg"

    # --- the tangent ---

    def _set_jacobians(self) -> None:
        """Let all SNES objects linearise into the matrix that the balance has now."""
        tangent = self.linear.operators
        for snes in self._all_snes:
            snes.setJacobian(weak_callback(self._linearise), tangent.operator, tangent.matrix)

    def _linearise(self, *_: object) -> None:
        self.linear.linearise(self.snes.getFunctionNorm(), self._solved_norm, self._eigenvalue_floor())

    def _eigenvalue_floor(self) -> float | None:
        return None if self._modified is None else self._modified.eigenvalue_floor()

    def shrink_tangent(self) -> None:
        """Take a smaller tangent where damage has made one possible (collective)."""
        if self.linear.shrink():
            self._set_jacobians()

    def _second(self) -> ModifiedNewton:
        """The second SNES, which has the linear solver of the first; the first where that goes down a potential."""
        if self._first_modified is not None:
            return self._first_modified
        if self._second_modified is None:
            from .line_search import ModifiedNewton

            snes = PETSc.SNES().create(self.balance.domain.comm)
            snes.setOptionsPrefix(self._options.prefix)
            snes.setKSP(self._first.ksp)
            self._second_modified = ModifiedNewton(self.balance, snes, self._policy)
            self._all_snes.append(snes)
            self._set_jacobians()
            snes.setLineSearchPreCheck(weak_callback(self._limit_step))
            snes.setFromOptions()
            snes.setConvergenceTest(weak_callback(self._test_convergence))
        return self._second_modified

    # --- an attempt ---

    def attempt(
        self, guess: Values | None, modification: TangentModification | None = None, limit: CostLimit = UNLIMITED_COST
    ) -> SolveResult:
        """Newton's method from `guess`, (owned dofs,) m; None: from where the last attempt ended (collective).

        `modification`: tangents made positive, by the second SNES; None: exact ones, by the first. Raises StepAborted.
        """
        if modification is None:
            self.snes, self._modified = self._first, self._first_modified
        else:
            self._modified = self._second()
            self.snes = self._modified.snes
        self._limit, self._norms, self._eliminations = limit, [], 0
        self._stopped_for_cost = False
        if self._modified is not None:
            self._modified.use_modification(modification)
        try:
            return self._attempt(guess)
        finally:
            if self._modified is not None:
                self._modified.use_modification(None)

    def _attempt(self, guess: Values | None) -> SolveResult:
        self.shrink_tangent()
        self.balance.begin_solve()
        extended = 0 if guess is None else self._start_from(guess)
        if self.linear.steps_are_linear and (solved := self._solve_linear_step()) is not None:
            return replace(solved, krylov_iterations=solved.krylov_iterations + extended)
        newton, krylov, is_jammed = self._advance_obstacles()
        converged = self.snes.reason > 0
        self.balance.set_iterate(self._x)
        if converged and self._is_single_solve:  # otherwise the convergence test has evaluated them
            self.balance.update_reactions()
        krylov += extended
        if is_jammed:
            reason = f"Obstacles are jammed: not there in {self._policy.max_obstacle_solves} solves"
            return SolveResult(False, newton, krylov, reason, self._stopped_for_cost)
        return SolveResult(converged, newton, krylov, "" if converged else self._failure(), self._stopped_for_cost)

    def _start_from(self, guess: Values) -> int:
        """Set x to a first guess that Newton's method may start from; returns Krylov iterations (collective)."""
        self._x.array_w[:] = guess
        jumps = self.balance.motion.max_deviation(guess) > self._policy.max_support_jump
        extended = self.linear.extend(self._x, self._eigenvalue_floor()) if jumps else 0
        if self.balance.contact.limits_newton_steps:
            self._x.array_w[:] = self.balance.feasible_guess(self._x.array_r.copy())
            self.balance.set_iterate(self._x)  # terms look there for what is held back
        return extended

    def _advance_obstacles(self) -> tuple[int, int, bool]:
        """Solve from x, once more each time that obstacles which were held back have advanced (collective).

        Returns all Newton and Krylov iterations, and whether obstacles are still held back: for good, as far as the
        last advance tells.
        """
        policy, newton, krylov, remaining = self._policy, 0, 0, 1.0
        for solve in range(policy.max_obstacle_solves):
            before, remaining = remaining, self.balance.contact.remaining_motion()
            solves_to_come = policy.max_obstacle_solves - solve
            if solve >= policy.min_obstacle_solves and remaining > solves_to_come * (before - remaining):
                break
            self._rtol = policy.intermediate_rtol if remaining else self._asked_rtol
            if self._modified is not None:
                self._modified.merit.begin_solve()
            if self.linear.forcing is not None:
                self.linear.forcing.begin_attempt()
            self._aborted = False
            self.snes.solve(None, self._x)
            if self._aborted:
                raise StepAborted
            newton, krylov = newton + self.snes.its, krylov + self.snes.getLinearSolveIterations()
            if self.snes.reason <= 0 or not remaining:
                return newton, krylov, False
            self.balance.contact.continue_motion()
        return newton, krylov, True

    def _solve_linear_step(self) -> SolveResult | None:
        """Solve a linear balance from x; None: a few solves were not enough, and Newton's method takes over."""
        balance, x, krylov, norm = self.balance, self._x, 0, np.inf
        for solve in range(self._policy.max_linear_solves + 1):
            if not (solved := np.isfinite(norm) and self._is_solved(norm, solve)):
                balance.assemble_free_residual(x, balance.work_vector)
                norm = balance.work_vector.norm()
                solved = self._is_solved(norm, solve)
            if solved:
                return SolveResult(True, solve, krylov, "")
            if self._stop_requested():
                raise StepAborted
            if solve == self._policy.max_linear_solves:
                break
            result = self.linear.solve_linear_step(self._norm_of_solution(norm), self._eigenvalue_floor())
            if result is None:
                break
            norm, krylov = result[0], krylov + result[1]
            x.axpy(-1.0, self.linear.correction)
            balance.set_iterate(x)
            balance.update_reactions()
        self.linear.linear_step_failed()
        return None

    def _limit_step(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Shorten the step x <- x - y to what the terms of the balance allow (collective)."""
        if self._modified is not None:
            self._modified.merit.begin_line_search()
            self._modified.clip_correction(y)
        if not self.balance.contact.limits_newton_steps:
            return
        share = self.balance.max_step_fraction(-y.array_r)
        if share < 1:
            y.scale(share)

    # --- convergence ---

    def _test_convergence(self, snes: PETSc.SNES, its: int, norms: tuple[float, float, float]) -> int:
        """SNES's convergence test: |r| <= rtol max(|r_0|, |forces|), or below round-off; see `_norm_of_solution`.

        PETSc's own test against |r_0| alone asks for more digits as the first guess gets better.
        """
        reason = PETSc.SNES.ConvergedReason
        if not np.isfinite(norms[2]):
            return int(reason.DIVERGED_FNORM_NAN)
        if self._is_solved(norms[2], its) or self._is_solved_by_elimination(snes, its):
            return int(reason.CONVERGED_FNORM_RELATIVE)
        if self._stop_requested():  # SNES ends its solve, and can be used again
            self._aborted = True
            return int(reason.DIVERGED_INNER)
        modified = self.used_second_snes
        self._stopped_for_cost = self._limit.is_exceeded(snes.getLinearSolveIterations(), its, modified=modified)
        if self._stopped_for_cost:
            return int(reason.DIVERGED_INNER)
        has_inertia = self.balance.scheme.inertia
        if self._modified is not None and has_inertia and self._modified.has_stalled(snes.getFunctionNorm(), its):
            return int(reason.DIVERGED_MAX_IT)  # half the step is solved in a few iterations
        self._norms.append(snes.getFunctionNorm())
        return int(reason.DIVERGED_LINE_SEARCH if self.crawls else reason.ITERATING)

    def _is_solved_by_elimination(self, snes: PETSc.SNES, its: int) -> bool:
        """Relax the few nodes that hold most of the residual of an iterate; whether that solves the balance
        (collective).

        SNES goes on from there, with the norm of the residual there.
        """
        has_others = self._modified is not None or self._eliminations < self._policy.max_eliminations
        if self._elimination is None or not its or not has_others:
            return False
        if snes.getFunctionNorm() < self._policy.fast_reduction * self._norms[-1]:  # nothing holds it up
            return False
        if not self._elimination.relax_nodes(self._solved_norm):
            return False
        self._eliminations += 1
        if self._modified is not None:
            self._modified.merit.note_elimination()
        x, r = snes.getSolution(), snes.getFunction()[0]
        x.array_w[:] = self.balance.u.x.array[: self.balance.owned_dof_count]
        snes.computeFunction(x, r)
        snes.setFunctionNorm(r.norm())
        return self._is_solved(snes.getFunctionNorm(), its)

    def _is_solved(self, norm: float, its: int) -> bool:
        """Whether |r| = `norm`, N, after so many iterations is that of a solution (collective)."""
        if its == 0:
            # A first guess that contact has cut is off by more than any force of the step, however stiff the body.
            self._first_norm = 0.0 if self.balance.contact.limits_newton_steps else norm
        return norm <= self._norm_of_solution(self._first_norm if its else 0.0)

    def _norm_of_solution(self, first_norm: float) -> float:
        """Largest |r| of a solution, N, where the first guess has `first_norm`, N (collective)."""
        scale, round_off = self.balance.energies.force_scale()
        self._solved_norm = max(self._rtol * max(first_norm, scale), round_off)
        return self._solved_norm

    def _failure(self) -> str:
        reason = _SNES.get(self.snes.reason, str(self.snes.reason)).lower()
        text = reason.removeprefix("diverged_").replace("_", " ")
        if self.snes.reason == PETSc.SNES.ConvergedReason.DIVERGED_LINEAR_SOLVE:
            reason = _KSP.get(self.snes.ksp.reason, "?").lower()
            text += " (" + reason.removeprefix("diverged_").replace("_", " ") + ")"
        return f"Newton's method stopped after {self.snes.its} iterations: {text}"

    def destroy(self) -> None:
        """Give back PETSc's objects and take the options out of its database; nothing may be solved any more."""
        self._options.remove()
        for owned in (self.linear, *self._all_snes, self._x):
            owned.destroy()
        for modified in (self._first_modified, self._second_modified):
            if modified is not None:
                modified.destroy()
