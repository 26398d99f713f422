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
    """Result of a nonlinear solve.

    Attributes:
        converged: whether r(u) = 0 to the tolerance.
        newton_iterations, krylov_iterations: numbers of iterations.
        reason: a sentence if it did not converge.
        stopped_for_cost: whether it was ended because its Krylov iterations cost too much.
        is_rough: whether |r| is small beside that of the first guess alone, not beside the forces.
    """

    converged: bool
    newton_iterations: int
    krylov_iterations: int
    reason: str
    stopped_for_cost: bool = False
    is_rough: bool = False

    def with_iterations_of(self, other: SolveResult) -> SolveResult:
        """Return this result with the iterations of both."""
        newton = self.newton_iterations + other.newton_iterations
        return replace(
            self, newton_iterations=newton, krylov_iterations=self.krylov_iterations + other.krylov_iterations
        )


class CostLimit:
    """Bound on the Krylov iterations of an attempt; this one has none."""

    def is_exceeded(self, krylov: int, newton: int, *, modified: bool) -> bool:
        """Whether an attempt ends after so many Krylov and Newton iterations; `modified`: by `ModifiedNewton`."""
        return False


UNLIMITED_COST = CostLimit()


class ConvergenceTest:
    """Convergence test of SNES: |r| <= rtol max(|r_0|, |forces|), or below round-off.

    PETSc's own test against |r_0| alone requires more digits as the first guess gets better. A first guess may be off
    by far more than the forces of the solution: a slender body whose end is displaced, or a nearly incompressible one.
    While no edge is broken, |r_0| therefore counts up to a multiple of |forces|, for a few iterations.

    An attempt is also ended if it costs too much, if it cycles, or if a stop was requested.

    Attributes:
        first_norm: |r| of the first guess, N; 0 if contact limits Newton's steps.
        solved_norm: largest |r| of a solution, N.
        stopped_for_cost: whether the last attempt was ended because of its cost.
        aborted: whether the last solve was ended by a request to stop.
        is_rough: whether |r| of the last solution is small beside that of the first guess alone.
        stop_requested: function (collective) called between iterations; a solve ends where it is true.
    """

    def __init__(self, balance: Balance, rtol: float, policy: SolverPolicy) -> None:
        """`rtol`: relative tolerance of the residual."""
        self._balance, self._policy, self._asked_rtol = balance, policy, rtol
        self._rtol, self.first_norm = rtol, 0.0
        # iterations of the solve whose |r| was small beside that of the first guess, but not beside the forces
        self._further_iterations, self._is_intact = 0, True
        self.stop_requested: Callable[[], bool] = lambda: False
        self._elimination: NonlinearElimination | None = None  # of a body with broken edges
        self._last_norm = 0.0  # |r| of the last iterate
        self._eliminations = 0
        self._modified: ModifiedNewton | None = None
        self._limit: CostLimit = UNLIMITED_COST
        self._is_second = False
        self.solved_norm, self.stopped_for_cost, self.aborted, self.is_rough = 0.0, False, False, False

    def set_stop_request(self, stop_requested: Callable[[], bool]) -> None:
        """Set a function (collective) called between iterations; a solve ends where it is true."""
        self.stop_requested = stop_requested

    def allow_elimination(self) -> None:
        """Relax nodes that hold most of the residual separately from now on (collective)."""
        if self._elimination is None:
            from .nonlinear_elimination import create_elimination

            self._elimination = create_elimination(self._balance, self._policy)

    def edges_broke(self) -> None:
        """Let |r_0| count in full from now on: the forces of a fragment that comes loose vanish."""
        self._is_intact = False

    def begin_attempt(self, limit: CostLimit, modified: ModifiedNewton | None, *, is_second: bool) -> None:
        """Begin an attempt.

        Args:
            limit: bound on its cost.
            modified: merit function and tangents of its SNES; None: |r| and exact tangents.
            is_second: whether it is by the second SNES.
        """
        self._limit, self._modified, self._is_second = limit, modified, is_second
        self._eliminations, self.stopped_for_cost = 0, False

    def begin_solve(self, *, intermediate: bool) -> None:
        """Begin a solve of the attempt; `intermediate`: with a part of the obstacles' motion alone."""
        self._rtol = self._policy.intermediate_rtol if intermediate else self._asked_rtol
        self.aborted = False

    def reason_to_end(self, snes: PETSc.SNES, its: int, norms: tuple[float, float, float]) -> int:
        """Reason for SNES to end after `its` iterations, 0 to continue; `norms`: |x|, |dx| and |r| (collective)."""
        reason = PETSc.SNES.ConvergedReason
        if not np.isfinite(norms[2]):
            return int(reason.DIVERGED_FNORM_NAN)
        if self._all_solved(snes, norms[2], its) or self._is_solved_by_elimination(snes, its):
            return int(reason.CONVERGED_FNORM_RELATIVE)
        if self.stop_requested():  # SNES ends its solve, and can be used again
            self.aborted = True
            return int(reason.DIVERGED_INNER)
        krylov = snes.getLinearSolveIterations()
        self.stopped_for_cost = self._limit.is_exceeded(krylov, its, modified=self._is_second)
        if self.stopped_for_cost:
            return int(reason.DIVERGED_INNER)
        has_inertia = self._balance.scheme.inertia
        if self._modified is not None and has_inertia and self._modified.has_stalled(snes.getFunctionNorm(), its):
            return int(reason.DIVERGED_MAX_IT)  # half the step is solved in a few iterations
        self._last_norm = snes.getFunctionNorm()
        return int(reason.ITERATING)

    def _all_solved(self, snes: PETSc.SNES, norm: float, its: int) -> bool:
        """Whether r = 0 for u and for the unknowns that are eliminated from the linear systems (collective).

        Where r = 0 for u alone, or the last step was short, the others are solved for with u held, and r is evaluated
        again.
        """
        eliminated, solved = self._balance.eliminated, self.is_solved(norm, its)
        if eliminated is None or not eliminated.need_solution(solved=solved):
            return solved
        eliminated.solve()
        return self._is_solved_at_new_residual(snes, its)

    def _is_solved_at_new_residual(self, snes: PETSc.SNES, its: int) -> bool:
        """Evaluate r again, which has changed at the present iterate; whether u is a solution (collective)."""
        x, r = snes.getSolution(), snes.getFunction()[0]
        x.array_w[:] = self._balance.u.x.array[: self._balance.owned_dof_count]
        snes.computeFunction(x, r)
        snes.setFunctionNorm(r.norm())
        return self.is_solved(snes.getFunctionNorm(), its)

    def _is_solved_by_elimination(self, snes: PETSc.SNES, its: int) -> bool:
        """Relax the few nodes that hold most of the residual; whether the balance is solved then (collective).

        SNES continues from there, with the norm of the residual there.
        """
        may_relax = self._modified is not None or self._eliminations < self._policy.max_eliminations
        if self._elimination is None or not its or not may_relax:
            return False
        if snes.getFunctionNorm() < self._policy.fast_reduction_ratio * self._last_norm:
            return False
        if not self._elimination.relax_nodes(self.solved_norm):
            return False
        self._eliminations += 1
        if self._modified is not None:
            self._modified.merit.note_elimination()
        return self._is_solved_at_new_residual(snes, its)

    def is_solved(self, norm: float, its: int) -> bool:
        """Whether |r| = `norm`, N, after `its` iterations is that of a solution (collective)."""
        if its == 0:
            # a first guess that contact has cut is off by more than any force of the step, however stiff the body
            self.first_norm = 0.0 if self._balance.contact.limits_newton_steps else norm
            self._further_iterations, self.is_rough = 0, False
            return norm <= self.norm_of_solution(0.0)
        scale, round_off = self._set_solved_norm(self.first_norm)
        if norm > self.solved_norm:
            return False
        if not self._is_intact:
            return True
        limit = max(self._rtol * self._policy.max_first_norm_ratio * scale, round_off)
        self.is_rough = norm > limit
        if not self.is_rough or self._further_iterations == self._policy.max_further_iterations:
            return True
        self._further_iterations += 1
        self.solved_norm = limit
        return False

    def norm_of_solution(self, first_norm: float) -> float:
        """Largest |r| of a solution, N, where the first guess has `first_norm`, N (collective)."""
        self._set_solved_norm(first_norm)
        return self.solved_norm

    def _set_solved_norm(self, first_norm: float) -> tuple[float, float]:
        """Set `solved_norm`; return size and round-off of the forces, N (collective)."""
        scale, round_off = self._balance.energies.force_scale()
        self.solved_norm = max(self._rtol * max(first_norm, scale), round_off)
        return scale, round_off


class NewtonSolver:
    """Newton's method for a `Balance`: SNES objects that share one linear solver.

    The line search of the first SNES minimises |r|, or the incremental potential where contact limits its steps. A
    second SNES with tangents made positive (`ModifiedNewton`) is created at its first use.

    Attributes:
        snes: SNES of the last attempt.
        linear: linear solver.
        spent: numbers of all Newton and Krylov iterations so far.
    """

    def __init__(self, balance: Balance, given: PetscOptions, policy: SolverPolicy, *, plain: bool = False) -> None:
        """`given`: PETSc options of the study. Raises InputError if PETSc does not accept one."""
        self.balance, self._policy, self._plain = balance, policy, plain
        chosen = chosen_options(balance, given, plain=plain, policy=policy)
        self._options = PetscOptionSet(chosen)
        snes = self.snes = self._first = PETSc.SNES().create(balance.domain.comm)
        self._all_snes, self.spent = [snes], (0, 0)
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
        self._convergence = ConvergenceTest(balance, float(chosen["snes_rtol"]), policy)
        snes.setConvergenceTest(weak_callback(self._convergence.reason_to_end))
        self._first_modified: ModifiedNewton | None = None  # the merit of the first SNES; None: |r|
        self._second_modified: ModifiedNewton | None = None
        if balance.contact.limits_newton_steps:
            snes.setLineSearchPreCheck(weak_callback(self._limit_step))
            if balance.conservative:
                from .line_search import ModifiedNewton

                self._first_modified = ModifiedNewton(balance, snes, policy)
        self._is_single_solve = chosen["snes_type"] == "ksponly"
        self._has_line_search = chosen["snes_type"] == "newtonls"
        self._modified = self._first_modified  # of the last attempt

    def set_stop_request(self, stop_requested: Callable[[], bool]) -> None:
        """Set a function (collective) called between iterations; where it is true an attempt raises StepAborted."""
        self._convergence.set_stop_request(stop_requested)

    def edges_broke(self, count: int | None) -> None:
        """React to the number of edges that broke on all ranks; None: an unknown number (collective)."""
        self.linear.edges_broke(count)
        if count != 0:
            self._convergence.edges_broke()
        if count != 0 and self._has_line_search and not self._plain:
            self._convergence.allow_elimination()

    # --- the last attempt ---

    @property
    def used_second_snes(self) -> bool:
        """Whether the last attempt was not by the first SNES."""
        return self.snes is not self._first

    @property
    def descended_potential(self) -> bool:
        """Whether the line search of the last attempt minimised the incremental potential."""
        return self._modified is not None

    @property
    def reduced_residual(self) -> bool:
        """Whether |r| of the last iterate of the last attempt is below that of its first guess."""
        return bool(self.snes.getFunctionNorm() < self._convergence.first_norm)

    # --- the tangent ---

    def _set_jacobians(self) -> None:
        """Set the present tangent of the balance as the Jacobian of all SNES objects."""
        tangent = self.linear.operators
        for snes in self._all_snes:
            snes.setJacobian(weak_callback(self._linearise), tangent.operator, tangent.matrix)

    def _linearise(self, *_: object) -> None:
        self.linear.linearise(self.snes.getFunctionNorm(), self._convergence.solved_norm, self._eigenvalue_floor())

    def _eigenvalue_floor(self) -> float | None:
        return None if self._modified is None else self._modified.eigenvalue_floor()

    def shrink_tangent(self) -> None:
        """Replace the tangent by a smaller one if enough cells are without stress (collective)."""
        if self.linear.shrink():
            self._set_jacobians()

    def _second(self) -> ModifiedNewton:
        """Second SNES, with the linear solver of the first; the first where that one minimises a potential."""
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
            snes.setConvergenceTest(weak_callback(self._convergence.reason_to_end))
        return self._second_modified

    # --- an attempt ---

    def attempt(
        self, guess: Values | None, modification: TangentModification | None = None, limit: CostLimit = UNLIMITED_COST
    ) -> SolveResult:
        """Attempt a solve (collective).

        Args:
            guess: (owned dofs,) first guess of u, m; None: the last iterate.
            modification: how tangents are made positive, by the second SNES; None: exact tangents, by the first.
            limit: bound on the cost of Krylov iterations.

        Raises:
            StepAborted: if a stop was requested.
        """
        if modification is None:
            self.snes, self._modified = self._first, self._first_modified
        else:
            self._modified = self._second()
            self.snes = self._modified.snes
        self._convergence.begin_attempt(limit, self._modified, is_second=self.used_second_snes)
        if self._modified is not None:
            self._modified.use_modification(modification)
        try:
            result = self._attempt(guess)
        finally:
            if self._modified is not None:
                self._modified.use_modification(None)
        self.spent = self.spent[0] + result.newton_iterations, self.spent[1] + result.krylov_iterations
        return result

    def _attempt(self, guess: Values | None) -> SolveResult:
        self.shrink_tangent()
        self.balance.begin_solve()
        extended, is_feasible = self._start_from(guess)
        if not is_feasible:
            rounds = self._policy.max_extensions
            reason = f"Contact is in the way of the prescribed motion: not there in {rounds} extensions into the body"
            return SolveResult(False, 0, extended, reason, self._convergence.stopped_for_cost)
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
            return SolveResult(False, newton, krylov, reason, self._convergence.stopped_for_cost)
        reason = "" if converged else self._failure()
        is_rough = converged and self._convergence.is_rough
        return SolveResult(converged, newton, krylov, reason, self._convergence.stopped_for_cost, is_rough)

    def _start_from(self, guess: Values | None) -> tuple[int, bool]:
        """Set x to a feasible first guess near `guess`; None: near the last iterate (collective).

        Returns:
            Number of Krylov iterations, and whether there is one with prescribed dofs at their values.
        """
        extended = 0
        if guess is not None:
            self._x.array_w[:] = guess
            if self.balance.motion.max_deviation(guess) > self._policy.max_support_jump:
                extended = self.linear.extend(self._x, self._eigenvalue_floor())
        if self.balance.contact.limits_newton_steps:
            if guess is not None:
                self._x.array_w[:] = self.balance.feasible_guess(self._x.array_r.copy())
            krylov, is_feasible = self._complete_prescribed_motion()
            self.balance.set_iterate(self._x, prescribed=is_feasible)  # restricted obstacles are advanced from there
            return extended + krylov, is_feasible
        return extended, True

    def _complete_prescribed_motion(self) -> tuple[int, bool]:
        """Move prescribed dofs of x to their values, along a motion that contact allows (collective).

        A guess that contact has cut has a part of the prescribed motion alone. Where the rest cannot be added at the
        supports, it is extended into the body by Newton's steps, as far as contact allows in each.

        Returns:
            Number of Krylov iterations, and whether the values were reached.
        """
        balance, x, dofs, krylov = self.balance, self._x, self.balance.motion.owned_dofs, 0
        for extensions in range(self._policy.max_extensions + 1):
            if not balance.motion.max_deviation(x.array_r):
                return krylov, True
            start, change = x.array_r.copy(), np.zeros(x.getLocalSize())
            change[dofs] = balance.motion.values - start[dofs]
            balance.set_iterate(x, prescribed=False)
            if (fraction := balance.max_step_fraction(change)) < 1:
                if not fraction or extensions == self._policy.max_extensions:
                    break
                krylov += self.linear.extend(x, self._eigenvalue_floor(), fraction)
                change += x.array_r - start
                fraction = balance.max_step_fraction(change)
            x.array_w[:] = start + fraction * change
            if fraction == 1:
                x.array_w[dofs] = balance.motion.values
        return krylov, False

    def _advance_obstacles(self) -> tuple[int, int, bool]:
        """Solve from x, and again each time that obstacles with a restricted motion have advanced (collective).

        Returns:
            Numbers of all Newton and Krylov iterations, and whether obstacles are jammed: the last advances were too
            short to complete the motion in the solves that are left.
        """
        policy, newton, krylov, remaining = self._policy, 0, 0, 1.0
        for solve in range(policy.max_obstacle_solves):
            before, remaining = remaining, self.balance.contact.remaining_motion()
            solves_to_come = policy.max_obstacle_solves - solve
            if solve >= policy.min_obstacle_solves and remaining > solves_to_come * (before - remaining):
                break
            self._convergence.begin_solve(intermediate=bool(remaining))
            if self._modified is not None:
                self._modified.merit.begin_solve()
            self.linear.begin_attempt()
            self.snes.solve(None, self._x)
            if self._convergence.aborted:
                raise StepAborted
            newton, krylov = newton + self.snes.its, krylov + self.snes.getLinearSolveIterations()
            if self.snes.reason <= 0 or not remaining:
                return newton, krylov, False
            self.balance.contact.continue_motion()
        return newton, krylov, True

    def _solve_linear_step(self) -> SolveResult | None:
        """Solve a linear balance from x; returns None if a few solves were not enough, for Newton's method."""
        balance, x, krylov, norm = self.balance, self._x, 0, np.inf
        for solve in range(self._policy.max_linear_solves + 1):
            if not (solved := np.isfinite(norm) and self._convergence.is_solved(norm, solve)):
                balance.assemble_free_residual(x, balance.work_vector)
                norm = balance.work_vector.norm()
                solved = self._convergence.is_solved(norm, solve)
            if solved:
                return SolveResult(True, solve, krylov, "", is_rough=self._convergence.is_rough)
            if self._convergence.stop_requested():
                raise StepAborted
            if solve == self._policy.max_linear_solves:
                break
            result = self.linear.solve_linear_step(self._convergence.norm_of_solution(norm), self._eigenvalue_floor())
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
        if not self.balance.contact.limits_newton_steps:
            return
        share = self.balance.max_step_fraction(-y.array_r)
        if share < 1:
            y.scale(share)

    # --- end ---

    def _failure(self) -> str:
        reason = _SNES.get(self.snes.reason, str(self.snes.reason)).lower()
        text = reason.removeprefix("diverged_").replace("_", " ")
        if self.snes.reason == PETSc.SNES.ConvergedReason.DIVERGED_LINEAR_SOLVE:
            reason = _KSP.get(self.snes.ksp.reason, "?").lower()
            text += " (" + reason.removeprefix("diverged_").replace("_", " ") + ")"
        return f"Newton's method stopped after {self.snes.its} iterations: {text}"

    def destroy(self) -> None:
        """Free PETSc's objects and remove the options from its database; the solver cannot be used any more."""
        self._options.remove()
        for owned in (self.linear, *self._all_snes, self._x):
            owned.destroy()
        for modified in (self._first_modified, self._second_modified):
            if modified is not None:
                modified.destroy()
