"""Newton's method: an attempt to solve a balance by PETSc's SNES with line search, options from the study.

Equations: docs/theory.md#newtons-method.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from ..errors import InputError
from ..mechanics.balance import Balance
from ..timestepping.stepper import SolveResult, StepAborted
from .linear_solver import LinearSolver, chosen_options
from .petsc_options import PetscOptions, PetscOptionSet, call_petsc
from .weak_callbacks import weak_callback

if TYPE_CHECKING:
    from .line_search import ModifiedNewton
    from .nonlinear_elimination import NonlinearElimination

Values = npt.NDArray[np.float64]

# A jump of prescribed dofs larger than this share of an edge is carried into the body before Newton starts.
LARGE_GAP = 0.01

FAST = 0.1  # of the residual before, below which Newton's method gets on by itself
# of an attempt that goes by the norm, which may rise where few nodes come to rest: it could go about in circles
RESTS = 4
CRAWL = 2  # iterations that halve |r| at least, where Newton's method by its norm gets anywhere
LINEAR_SOLVES = 3  # of a step that is linear, before Newton's method with all that it tries takes over
LEGS, LEAST_LEGS = 20, 5  # solves of a step in which obstacles that are jammed come on, and before they are given up
ON_THE_WAY = 1e-2  # rtol of all but the last of them

_SNES = {value: name for name, value in vars(PETSc.SNES.ConvergedReason).items() if isinstance(value, int)}
_KSP = {value: name for name, value in vars(PETSc.KSP.ConvergedReason).items() if isinstance(value, int)}


class NewtonSolver:
    """SNES on a `Balance`, and others that share its linear solver.

    Attributes:
        snes: that of the last attempt.    first_down: what the first SNES goes by; None: the norm of r.
        linear: what linear systems are solved with.
        gets_dear: of Krylov iterations and Newton's, whether an attempt is given up for them.
    """

    def __init__(self, balance: Balance, given: PetscOptions) -> None:
        """`given`: PETSc options of the study, over the defaults. InputError where PETSc does not take one."""
        self.balance = balance
        self.first_down: ModifiedNewton | None = None
        self._down: ModifiedNewton | None = None  # what the SNES of the last attempt goes by
        self.gets_dear: Callable[[int, int], bool] = lambda krylov, its: False
        self._abandons: Callable[[], bool] = lambda: False
        self._abandoned = False  # in the last solve
        chosen = chosen_options(balance, given)
        self._options = PetscOptionSet(chosen)
        snes = self.snes = self._first = PETSc.SNES().create(balance.domain.comm)
        self._made = [snes]
        snes.setOptionsPrefix(self._options.prefix)
        snes.setFunction(lambda _, x, b: balance.assemble_free_residual(x, b), balance.work_vector)
        self._x = balance.work_vector.duplicate()
        try:
            call_petsc(snes.setFromOptions)
            self.linear = LinearSolver(balance, snes.ksp, self._options, given, chosen, lambda: self._smallness)
        except InputError:
            self._options.remove()
            raise
        self._take_tangent()
        snes.setConvergenceTest(weak_callback(self._converged))
        if balance.contact.limits_newton_steps:
            snes.setLineSearchPreCheck(weak_callback(self._limit))
            if balance.conservative:
                from .line_search import ModifiedNewton

                self.first_down = self._down = ModifiedNewton(balance, snes)
        self._rtol = self._own_rtol = float(chosen["snes_rtol"])
        self._single = chosen["snes_type"] == "ksponly"
        self._by_steps = chosen["snes_type"] == "newtonls"
        self._patches: NonlinearElimination | None = None  # of a body that breaks
        self._first_norm = self._last_little = 0.0
        self._norms: list[float] = []  # of the residual in the last attempt
        self._rests = 0  # how often few nodes came to rest in it

    def another_downhill(self) -> ModifiedNewton:
        """A second SNES, with the linear solver of the first."""
        from .line_search import ModifiedNewton

        snes = PETSc.SNES().create(self.balance.domain.comm)
        snes.setOptionsPrefix(self._options.prefix)
        snes.setKSP(self.snes.ksp)
        down = ModifiedNewton(self.balance, snes)
        self._made.append(snes)
        self._take_tangent()
        snes.setLineSearchPreCheck(weak_callback(self._limit))
        snes.setFromOptions()
        snes.setConvergenceTest(weak_callback(self._converged))
        return down

    @property
    def was_first(self) -> bool:
        """Whether the last attempt was by the first SNES."""
        return self.snes is self._first

    @property
    def goes_down(self) -> bool:
        """Whether the last attempt went by the incremental potential."""
        return self._down is not None

    def set_stop_request(self, abandons: Callable[[], bool]) -> None:
        """Ask `abandons` (collective) between iterations whether to go on; else an attempt raises Abandoned."""
        self._abandons = abandons

    # --- the tangent ---

    def _take_tangent(self) -> None:
        """Linearise into the matrix that the balance has now."""
        linear = self.linear
        for snes in self._made:
            snes.setJacobian(weak_callback(self._linearise), linear.operator, self.balance.tangent.matrix)

    def _linearise(self, *_: object) -> None:
        self.linear.linearise(self.snes.getFunctionNorm(), self._last_little)

    @property
    def _smallness(self) -> float | None:
        return None if self._down is None else self._down.eigenvalue_floor

    def shrink(self) -> None:
        """Take a smaller tangent where one does (collective)."""
        if self.linear.shrink():
            self._take_tangent()

    # --- an attempt ---

    def attempt(self, guess: Values | None, down: ModifiedNewton | None = None) -> SolveResult:
        """From `guess`; None: from where the last attempt has come to. `down`: by which SNES, None: by the first."""
        self.snes, self._down = (self._first, self.first_down) if down is None else (down.snes, down)
        self._norms, self._rests = [], 0
        self.shrink()
        self.balance.begin_solve()
        extended = 0 if guess is None else self._start_from(guess)
        if self.linear.linearly and (solved := self._solve_as_linear()) is not None:
            return replace(solved, krylov_iterations=solved.krylov_iterations + extended)
        newton, krylov, held = self._solve_in_legs()
        reason = self.snes.reason
        self.balance.set_iterate(self._x)
        if reason > 0 and self._single:  # Newton's method has evaluated them for its test
            self.balance.update_reactions()
        if held:
            return SolveResult(False, newton, krylov + extended, f"Obstacles are jammed: not there in {LEGS} solves")
        return SolveResult(reason > 0, newton, krylov + extended, "" if reason > 0 else self._sentence())

    def _start_from(self, guess: Values) -> int:
        """Set x to what Newton's method may start from; returns Krylov iterations."""
        self._x.array_w[:] = guess
        extended = self.linear.extend(self._x) if self.balance.motion.max_deviation(guess) > LARGE_GAP else 0
        if self.balance.contact.limits_newton_steps:
            self._x.array_w[:] = self.balance.feasible_guess(self._x.array_r.copy())
            self.balance.set_iterate(self._x)  # terms look there for what is held back
        return extended

    def _solve_in_legs(self) -> tuple[int, int, bool]:
        """Newton's method from x, once more each time that what was held back has gone on: all iterations, and whether
        something is still held back: for good, as far as the last leg tells."""
        newton = krylov = 0
        left = 1.0
        for leg in range(LEGS):
            before, left = left, self.balance.contact.remaining_motion()
            if leg >= LEAST_LEGS and left > (LEGS - leg) * (before - left):
                break
            self._rtol = ON_THE_WAY if left else self._own_rtol
            if self._down is not None:
                self._down.merit.begin_solve()
            if self.linear.forcing is not None:
                self.linear.forcing.begin_attempt()
            self._abandoned = False
            self.snes.solve(None, self._x)
            if self._abandoned:
                raise StepAborted
            newton, krylov = newton + self.snes.its, krylov + self.snes.getLinearSolveIterations()
            if self.snes.reason <= 0 or not left:
                return newton, krylov, False
            self.balance.contact.continue_motion()
        return newton, krylov, True

    def _solve_as_linear(self) -> SolveResult | None:
        """From x, where the balance is linear; None: not in a few solves, and Newton's method takes over."""
        balance, x, krylov, left = self.balance, self._x, 0, np.inf
        for its in range(LINEAR_SOLVES + 1):
            if not (solved := np.isfinite(left) and self._is_small(left, its)):
                balance.assemble_free_residual(x, balance.work_vector)
                solved = self._is_small(left := balance.work_vector.norm(), its)
            if solved:
                return SolveResult(True, its, krylov, "")
            if self._abandons():
                raise StepAborted
            if its == LINEAR_SOLVES or (made := self.linear.correct(self._little(left))) is None:
                break
            left, krylov = made[0], krylov + made[1]
            x.axpy(-1.0, self.linear.correction)
            balance.set_iterate(x)
            balance.update_reactions()
        self.linear.preconditioner.its = None
        return None

    def damage_changed(self, broke: int | None = None) -> None:
        """Some cells lost stiffness as so many edges broke, on all ranks (None: nobody knows): refresh the
        preconditioner at the next tangent, where that pays."""
        self.linear.preconditioner.damage_changed(broke)
        if broke != 0 and self._patches is None and self._by_steps:
            from .nonlinear_elimination import create_elimination

            self._patches = create_elimination(self.balance)

    def _limit(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """The step x <- x - y, no longer than the terms of the balance allow (collective)."""
        if self._down is not None:
            self._down.merit.begin_line_search()
            self._down.clip_correction(y)
        if not self.balance.contact.limits_newton_steps:
            return
        share = self.balance.max_step_fraction(-y.array_r)
        if share < 1:
            y.scale(share)

    # --- when it is done ---

    def _sentence(self) -> str:
        why = _SNES.get(self.snes.reason, str(self.snes.reason)).lower().removeprefix("diverged_").replace("_", " ")
        if self.snes.reason == PETSc.SNES.ConvergedReason.DIVERGED_LINEAR_SOLVE:
            why += " (" + _KSP.get(self.snes.ksp.reason, "?").lower().removeprefix("diverged_").replace("_", " ") + ")"
        return f"Newton's method stopped after {self.snes.its} iterations: {why}"

    def _converged(self, snes: PETSc.SNES, its: int, norms: tuple[float, float, float]) -> int:
        """|r| <= rtol max(|r_0|, |forces|) or below round-off: forces are what r is the difference of.

        PETSc's own test against |r_0| alone asks for more and more digits as the first guess gets better.
        """
        reason = PETSc.SNES.ConvergedReason
        if not np.isfinite(norms[2]):
            return int(reason.DIVERGED_FNORM_NAN)
        if self._is_small(norms[2], its) or self._is_small_at_rest(snes, its):
            return int(reason.CONVERGED_FNORM_RELATIVE)
        if self._abandons():  # asked of SNES to end its solve, which then can be used again
            self._abandoned = True
            return int(reason.DIVERGED_INNER)
        if self.gets_dear(snes.getLinearSolveIterations(), its):
            return int(reason.DIVERGED_INNER)
        if (
            self._down is not None
            and self.balance.scheme.inertia
            and self._down.has_stalled(snes.getFunctionNorm(), its)
        ):
            return int(reason.DIVERGED_MAX_IT)  # half the step is done in a few iterations
        self._norms.append(snes.getFunctionNorm())
        return int(reason.DIVERGED_LINE_SEARCH if self.crawls else reason.ITERATING)

    def _is_small_at_rest(self, snes: PETSc.SNES, its: int) -> bool:
        """Let the few nodes that hold most of the residual of an iterate come to rest; whether it is a solution then
        (collective). SNES goes on from there: it takes the norm of the residual anew."""
        if self._patches is None or not its or (self._down is None and self._rests >= RESTS):
            return False
        if snes.getFunctionNorm() < FAST * self._norms[-1]:  # nothing holds it up
            return False
        if not self._patches.relax_nodes(self._last_little):
            return False
        self._rests += 1
        if self._down is not None:
            self._down.merit.note_elimination()
        x, r = snes.getSolution(), snes.getFunction()[0]
        x.array_w[:] = self.balance.u.x.array[: self.balance.owned_dof_count]
        snes.computeFunction(x, r)
        snes.setFunctionNorm(r.norm())
        return self._is_small(snes.getFunctionNorm(), its)

    @property
    def crawls(self) -> bool:
        """Whether the line search has cut the last steps to next to nothing, by a norm that is no merit of them: the
        residual of one cell that is all but flat grows before it falls. Down the potential, if there is one that this
        attempt does not go by, they would be whole ones. (Without inertia factors see to what is slow.)"""
        norms, balance = self._norms, self.balance
        slow = len(norms) > CRAWL and norms[-1] > norms[-1 - CRAWL] / 2
        goes_down = self._down is not None or not (balance.conservative and balance.scheme.inertia)
        return slow and not goes_down and self.snes.ksp.getType() == "cg"

    def _is_small(self, norm: float, its: int) -> bool:
        """Whether that is so of |r| after so many iterations (collective)."""
        if its == 0:
            # a first guess that contact has cut is off by more than any force of the step, however stiff the body
            self._first_norm = 0.0 if self.balance.contact.limits_newton_steps else norm
        return norm <= self._little(self._first_norm if its else 0.0)

    def _little(self, first: float) -> float:
        """|r| of a solution, N, where that of the guess is `first` (collective)."""
        scale, floor = self.balance.energies.force_scale()
        self._last_little = max(self._rtol * max(first, scale), floor)
        return self._last_little

    def destroy(self) -> None:
        """Give back PETSc's objects and take the options out of its database; nothing may be solved any more."""
        self._options.remove()
        for kept in (self.linear, *self._made, self._x):
            kept.destroy()
