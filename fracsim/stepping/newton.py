"""One nonlinear solve: PETSc SNES with line search, options from the study, and what is tried where it fails."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from ..errors import InputError
from ..mechanics.balance import Balance
from .choice import Choice
from .downhill import EXACT, POSITIVE
from .factors import SOONER_THAN_GMRES
from .linear import Linear, chosen_options
from .petsc_options import Options, OptionSet, refusing
from .preconditioner import Due
from .stepper import SolveResult

if TYPE_CHECKING:
    from .downhill import Downhill, Way
    from .patches import Patches

Values = npt.NDArray[np.float64]

# A jump of prescribed dofs larger than this share of an edge is carried into the body before Newton starts.
LARGE_GAP = 0.01

# Of GMRES, where CG has failed: with PETSc's 30 it stalls where a body is nearly incompressible.
RESTART = 200

FAST = 0.1  # of the residual before, below which Newton's method gets on by itself
RESTS = (
    4  # of an attempt that goes by the norm, which may rise where few nodes come to rest: it could go about in circles
)
CRAWL = 2  # iterations that halve |r| at least, where Newton's method by its norm gets anywhere
ASTRAY = 8  # solves that go downhill at once, after two running whose first exact tangents have misled
LINEAR_SOLVES = 3  # of a step that is linear, before Newton's method with all that it tries takes over
LEGS, LEAST_LEGS = 20, 5  # solves of a step in which obstacles that are jammed come on, and before they are given up
ON_THE_WAY = 1e-2  # rtol of all but the last of them

_SNES = {value: name for name, value in vars(PETSc.SNES.ConvergedReason).items() if isinstance(value, int)}
_KSP = {value: name for name, value in vars(PETSc.KSP.ConvergedReason).items() if isinstance(value, int)}


class Solver:
    """SNES on a `Balance`, set up once and kept for the whole run.

    Attributes:
        snes: that of the last attempt.    linear: what its linear systems are solved with.
    """

    def __init__(self, balance: Balance, given: Options) -> None:
        """`given`: PETSc options of the study, over the defaults. InputError where PETSc does not take one."""
        self.balance = balance
        self._down: Downhill | None = None  # what the SNES of the last attempt goes by
        chosen = chosen_options(balance, given)
        self._options = OptionSet(chosen)
        snes = self.snes = PETSc.SNES().create(balance.domain.comm)
        self._made = [snes]
        snes.setOptionsPrefix(self._options.prefix)
        snes.setFunction(lambda _, x, b: balance.free_residual(x, b), balance.vector)
        self._x = balance.vector.duplicate()
        try:
            refusing(snes.setFromOptions)
            self.linear = Linear(balance, snes.ksp, self._options, given, chosen, lambda: self._smallness)
        except InputError:
            self._options.remove()
            raise
        self._take_tangent()
        snes.setConvergenceTest(self._converged)
        if balance.limits_steps:
            snes.setLineSearchPreCheck(self._limit)
            if balance.conservative:
                from .downhill import Downhill

                self._down = Downhill(balance, snes)
        self._first_choice, self._downhill = (snes, self._down), self._down
        self._rtol = self._own_rtol = float(chosen["snes_rtol"])
        self._single = chosen["snes_type"] == "ksponly"
        self._by_steps = chosen["snes_type"] == "newtonls"
        self._patches: Patches | None = None  # of a body that breaks
        self._first = self._last_little = 0.0
        self._norms: list[float] = []  # of the residual in the last attempt
        self._led_astray = 0  # solves running whose first exact tangents have misled
        self._astray = 0  # solves to come that go downhill at once
        self._rests = 0  # how often few nodes came to rest in it
        own = not any(key.startswith(("ksp_type", "pc_", "mg_")) for key in given)
        may_prefer = own and self.linear.may_factorise(SOONER_THAN_GMRES[balance.domain.dim])
        self._choice = Choice(self.linear.factors, may_prefer=may_prefer)

    @property
    def linear_failures(self) -> int:
        """Linear solves that failed outright and were taken as no correction."""
        return self.linear.failures

    def _take_tangent(self) -> None:
        """Linearise into the matrix that the balance has now."""
        linear = self.linear
        for snes in self._made:
            snes.setJacobian(
                lambda *_: linear.linearise(self.snes.getFunctionNorm(), self._last_little),
                linear.operator, self.balance.stiffness.matrix,
            )  # fmt: skip

    @property
    def _smallness(self) -> float | None:
        return None if self._down is None else self._down.small

    def _shrink(self) -> None:
        if self.linear.shrink():
            self._take_tangent()

    # --- a solve, and what is tried where it fails ---

    def solve(self, guess: Values) -> SolveResult:
        """Solve r(u) = 0 from the owned values `guess`; u holds the result, also where it is no solution (choice)."""
        choice = self._choice
        if choice.begins_with_factors() and choice.trusts(result := self._attempt_directly(guess)):
            return result
        result = self._attempt_iteratively(guess)
        if choice.dear:
            return self._go_on_directly(guess)
        if self._misled(result) and self.linear.may_factorise():
            result = self._attempt_directly(self.balance.level.u if self._sets_out_anew else guess)
            if result.converged:
                choice.take(preferred=False)
        elif choice.was_dear(result, positively=self._positively):
            choice.take(preferred=True)
        elif not self._misled(result):
            choice.iterate()
        return result

    def _go_on_directly(self, guess: Values) -> SolveResult:
        """From where iterations have become dear; all the way by them where factors find nothing that is stable."""
        choice, positively = self._choice, self._positively
        choice.dear, krylov, newton = False, self.snes.getLinearSolveIterations(), self.snes.its
        result = self._attempt_directly(None)
        if result.converged and self.linear.factors.positive:
            if krylov > choice.worth(newton, positively=positively):
                choice.take(preferred=True)
            return result
        with self._to_the_end():
            return self._attempt_iteratively(guess)

    @property
    def _positively(self) -> bool:
        """Whether the last attempt was with moduli made positive, and without inertia."""
        return self.snes is not self._first_choice[0] and not self.balance.scheme.inertia

    @contextmanager
    def _to_the_end(self) -> Iterator[None]:
        """However dear iterations get."""
        watched, self._choice.watches = self._choice.watches, False
        try:
            yield
        finally:
            self._choice.watches = watched

    def _attempt_iteratively(self, guess: Values) -> SolveResult:
        if self._astray:
            self._astray -= 1
            start: Values | None = guess
            result = self._attempt_downhill(guess, POSITIVE)
        else:
            result, start = self._attempt_exactly_first(guess)
        stalled = self.snes.ksp.reason == PETSc.KSP.ConvergedReason.DIVERGED_MAX_IT and self.linear.may_factorise()
        stalled = stalled or self.linear.may_factorise(SOONER_THAN_GMRES[self.balance.domain.dim])
        if self._misled(result) and self.snes.ksp.getType() == "cg" and not stalled:
            # CG met negative curvature (a buckling, softening or nearly incompressible body): GMRES does not mind it.
            self.snes.ksp.setType("gmres")
            self.snes.ksp.setGMRESRestart(RESTART)
            result = self._attempt(start)
            self.snes.ksp.setType("cg")
        return result

    def _attempt_exactly_first(self, guess: Values) -> tuple[SolveResult, Values | None]:
        """With exact tangents, and what is tried where they mislead; and where another attempt may start from."""
        result = self._attempt(guess)
        if self._crawls:
            result = self._attempt_downhill(None, (EXACT,))
        start = None if self._down is not None and not self.balance.left() else guess  # on the way down: goes on
        self._see_whether_astray(result)
        if self._misled(result):
            if self._sets_out_anew:
                start = self.balance.level.u
            if self.snes.ksp.reason != PETSc.KSP.ConvergedReason.DIVERGED_INDEFINITE_MAT:  # which is K's own doing
                # Smoothers of an older tangent need not be positive for this one.
                self.linear.preconditioner.due = Due.REBUILD
            if self.balance.conservative:
                result = self._attempt_downhill(start, POSITIVE)
            else:
                with self.linear.set_up_anew():
                    result = self._attempt(start)
        return result, start

    def _see_whether_astray(self, result: SolveResult) -> None:
        """Of an attempt with exact tangents: whether its first one has misled, as that of the solve before."""
        down = self.balance.scheme.inertia and self.balance.conservative
        self._led_astray = self._led_astray + 1 if down and not result.newton and self._misled(result) else 0
        if self._led_astray > 1:
            self._astray = ASTRAY

    @cached_property
    def _sets_out_anew(self) -> bool:
        """Whether a step is tried from where it begins once its first guess has misled: what flies there may be turned
        inside out, and without a potential (a pressure has none) there is no going down from it. Where prescribed dofs
        or contact set the pace that place is no better."""
        return self.balance.scheme.inertia and not self.balance.conservative and not self.balance.limits_steps

    def _attempt_downhill(self, guess: Values | None, ways: tuple[Way, ...]) -> SolveResult:
        """Down the incremental potential in ways that are tried in turn. (From the start of every attempt positive
        moduli would cost more than they save, where exact tangents do: an iteration more.)"""
        down = self._downhill = self._downhill or self._another_downhill()
        for way in ways:
            down.made_positive(way)
            with self.linear.set_up_anew() if way.anew else nullcontext():
                result = self._attempt(None if way.goes_on else guess, (down.snes, down))
            if not self._misled(result):
                break
        down.made_positive(None)
        return result

    def _another_downhill(self) -> Downhill:
        """A second SNES, with the linear solver of the first."""
        from .downhill import Downhill

        snes = PETSc.SNES().create(self.balance.domain.comm)
        snes.setOptionsPrefix(self._options.prefix)
        snes.setKSP(self.snes.ksp)
        down = Downhill(self.balance, snes)
        self._made.append(snes)
        self._take_tangent()
        snes.setLineSearchPreCheck(self._limit)
        snes.setFromOptions()
        snes.setConvergenceTest(self._converged)
        return down

    def _attempt_directly(self, guess: Values | None) -> SolveResult:
        with self._to_the_end(), self.linear.factors.of(self.snes.ksp):
            result = self._attempt(guess)
            if result.newton and result.converged and self.snes.ksp.getType() == "preonly":
                self.linear.factors.learn(self.snes.ksp)
        return result

    def _misled(self, result: SolveResult) -> bool:
        """Whether it was the linear solves that failed: outright, or by what they found.

        A solution of K d = -r lowers |r| for short steps along it, so a line search that fails was given none: CG may
        stop on a tangent that is not positive before it notices. Whether it does is a matter of the last digits, and
        so would be a step that is halved for it.
        """
        line_search = PETSc.SNES.ConvergedReason.DIVERGED_LINE_SEARCH
        return not result.converged and (self.snes.ksp.reason < 0 or self.snes.reason == line_search)

    def _attempt(self, guess: Values | None, other: tuple[PETSc.SNES, Downhill] | None = None) -> SolveResult:
        """From `guess`; None: from where the last attempt has come to."""
        self.snes, self._down = other or self._first_choice
        self._norms, self._rests = [], 0
        self._shrink()
        self.balance.set_out()
        extended = 0 if guess is None else self._start_from(guess)
        if self.linear.linearly and (solved := self._solve_as_linear()) is not None:
            return replace(solved, krylov=solved.krylov + extended)
        newton, krylov, held = self._solve_in_legs()
        reason = self.snes.reason
        self.balance.displace_to(self._x)
        if reason > 0 and self._single:  # Newton's method has evaluated them for its test
            self.balance.update_reactions()
        if held:
            return SolveResult(False, newton, krylov + extended, f"Obstacles are jammed: not there in {LEGS} solves")
        return SolveResult(reason > 0, newton, krylov + extended, "" if reason > 0 else self._sentence())

    def _start_from(self, guess: Values) -> int:
        """Set x to what Newton's method may start from; returns Krylov iterations."""
        self._x.array_w[:] = guess
        extended = self.linear.extend(self._x) if self.balance.motion.largest_gap(guess) > LARGE_GAP else 0
        if self.balance.limits_steps:
            self._x.array_w[:] = self.balance.reachable(self._x.array_r.copy())
            self.balance.displace_to(self._x)  # terms look there for what is held back
        return extended

    def _solve_in_legs(self) -> tuple[int, int, bool]:
        """Newton's method from x, once more each time that what was held back has gone on: all iterations, and whether
        something is still held back: for good, as far as the last leg tells."""
        newton = krylov = 0
        left = 1.0
        for leg in range(LEGS):
            before, left = left, self.balance.left()
            if leg >= LEAST_LEGS and left > (LEGS - leg) * (before - left):
                break
            self._rtol = ON_THE_WAY if left else self._own_rtol
            if self._down is not None:
                self._down.descent.begin()
            if self.linear.forcing is not None:
                self.linear.forcing.begin()
            self.snes.solve(None, self._x)
            newton, krylov = newton + self.snes.its, krylov + self.snes.getLinearSolveIterations()
            if self.snes.reason <= 0 or not left:
                return newton, krylov, False
            self.balance.go_on()
        return newton, krylov, True

    def _solve_as_linear(self) -> SolveResult | None:
        """From x, where the balance is linear; None: not in a few solves, and Newton's method takes over."""
        balance, x, krylov, left = self.balance, self._x, 0, np.inf
        for its in range(LINEAR_SOLVES + 1):
            if not (solved := np.isfinite(left) and self._is_small(left, its)):
                balance.free_residual(x, balance.vector)
                solved = self._is_small(left := balance.vector.norm(), its)
            if solved:
                return SolveResult(True, its, krylov, "")
            if its == LINEAR_SOLVES or (made := self.linear.correct(self._little(left))) is None:
                break
            left, krylov = made[0], krylov + made[1]
            x.axpy(-1.0, self.linear.correction)
            balance.displace_to(x)
            balance.update_reactions()
        self.linear.preconditioner.its = None
        return None

    def linear_response(self, force: Values) -> Values:
        """(owned dofs,) displacement that a force on free dofs causes in a step at the present u (Linear.response)."""
        self._shrink()
        return self.linear.response(force, directly=bool(self._choice.left))

    def damage_changed(self, broke: int | None = None) -> None:
        """Some cells lost stiffness as so many edges broke, on all ranks (None: nobody knows): refresh the
        preconditioner at the next tangent, where that pays."""
        self.linear.preconditioner.damage_changed(broke)
        if broke != 0 and self._patches is None and self._by_steps:
            from .patches import patches_of

            self._patches = patches_of(self.balance)

    def _limit(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """The step x <- x - y, no longer than the terms of the balance allow (collective)."""
        if self._down is not None:
            self._down.descent.set_out()
            self._down.hold_back(y)
        if not self.balance.limits_steps:
            return
        share = self.balance.longest_step(-y.array_r)
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
        if self._choice.gets_dear(snes.getLinearSolveIterations(), its, positively=self._positively):
            return int(reason.DIVERGED_INNER)
        if self._down is not None and self.balance.scheme.inertia and self._down.stalls(snes.getFunctionNorm(), its):
            return int(reason.DIVERGED_MAX_IT)  # half the step is done in a few iterations
        self._norms.append(snes.getFunctionNorm())
        return int(reason.DIVERGED_LINE_SEARCH if self._crawls else reason.ITERATING)

    def _is_small_at_rest(self, snes: PETSc.SNES, its: int) -> bool:
        """Let the few nodes that hold most of the residual of an iterate come to rest; whether it is a solution then
        (collective). SNES goes on from there: it takes the norm of the residual anew."""
        if self._patches is None or not its or (self._down is None and self._rests >= RESTS):
            return False
        if snes.getFunctionNorm() < FAST * self._norms[-1]:  # nothing holds it up
            return False
        if not self._patches.rest(self._last_little):
            return False
        self._rests += 1
        if self._down is not None:
            self._down.descent.rested()
        x, r = snes.getSolution(), snes.getFunction()[0]
        x.array_w[:] = self.balance.u.x.array[: self.balance.owned]
        snes.computeFunction(x, r)
        snes.setFunctionNorm(r.norm())
        return self._is_small(snes.getFunctionNorm(), its)

    @property
    def _crawls(self) -> bool:
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
            self._first = 0.0 if self.balance.limits_steps else norm
        return norm <= self._little(self._first if its else 0.0)

    def _little(self, first: float) -> float:
        """|r| of a solution, N, where that of the guess is `first` (collective)."""
        scale, floor = self.balance.force_scale()
        self._last_little = max(self._rtol * max(first, scale), floor)
        return self._last_little

    def destroy(self) -> None:
        """Give back PETSc's objects and take the options out of its database; nothing may be solved any more."""
        self._options.remove()
        for kept in (self.linear, *self._made, self._x):
            kept.destroy()
        if self._downhill is not None:
            self._downhill.destroy()
