"""One nonlinear solve: attempts of Newton's method (newton), and which is tried where one fails.

Iterations or factors: what a solve begins with, and when iterations stop to make way.

Iterations begin. Where they fail the system is factorised, and the next solves start with factors: as many as the spell
says, which doubles each time that iterations fail again, and is short again once they do not. So they do where
iterations were dearer than factors, as long as those find a balance that is stable.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from ..mechanics.balance import Balance
from ..timestepping.stepper import SolveResult
from .direct_solver import MANY, SOONER_THAN_GMRES, DirectSolver
from .line_search import EXACT_TANGENTS, POSITIVE_TANGENTS
from .newton import NewtonSolver
from .petsc_options import PetscOptions, option_errors
from .preconditioner import Due

if TYPE_CHECKING:
    from .line_search import ModifiedNewton, TangentModification
    from .linear_solver import LinearSolver

# solves that start with factors once iterations have failed: the first time, and at most
FIRST_SPELL, LONGEST_SPELL = 8, 256
Values = npt.NDArray[np.float64]
# Of GMRES, where CG has failed: with PETSc's 30 it stalls where a body is nearly incompressible.
RESTART = 200
ASTRAY = 8  # solves that go downhill at once, after two running whose first exact tangents have misled


class SolverSelector:
    """What the solves of one KSP begin with.

    Attributes:
        left: solves that start with factors, still to come.
        watches: whether a solve stops where iterations get dear.    dear: whether the last one has.
    """

    def __init__(self, factors: DirectSolver, *, may_prefer: bool) -> None:
        """`may_prefer`: whether factors may be taken because they are cheaper, not only where iterations fail."""
        self._factors, self._may_prefer = factors, may_prefer
        self.left, self._spell, self._preferred = 0, FIRST_SPELL, False
        self.watches, self.dear = may_prefer, False

    def begins_with_factors(self) -> bool:
        """Whether the solve that comes now does."""
        if not self.left:
            return False
        self.left -= 1
        return True

    def trusts(self, result: SolveResult) -> bool:
        """Whether what factors found is taken; if not, iterations have their turn."""
        if not self._preferred or (result.converged and self._factors.positive):
            return True
        self.left = 0
        return False

    def take(self, *, preferred: bool) -> None:
        """Start with factors for a spell; `preferred`: because iterations were dear, not because they failed."""
        self._preferred = preferred
        self.left, self._spell = self._spell, min(2 * self._spell, LONGEST_SPELL)

    def iterate(self) -> None:
        """Iterations have served: no factors, and the next spell is short."""
        self._spell = FIRST_SPELL
        self._factors.forget()

    def was_dear(self, result: SolveResult, *, positively: bool) -> bool:
        """Whether factors would have cost less than the iterations of a solve."""
        cheap = result.krylov_iterations <= self.worth(result.newton_iterations, positively=positively)
        return self._may_prefer and result.converged and not cheap

    def gets_dear(self, krylov: int, newton: int, *, positively: bool) -> bool:
        """Whether a solve with so many iterations stops to go on with factors."""
        self.dear = bool(
            self.watches and newton and krylov > max(self._factors.dear, self.worth(newton, positively=positively))
        )
        return self.dear

    def worth(self, newton: int, *, positively: bool) -> float:
        """Iterations that cost as much as factors in a solve of so many Newton iterations; `positively`: with moduli
        made positive, which take several times as many of them as exact ones without inertia."""
        return self._factors.worth * (min(newton, MANY) if positively else max(newton, 1))


class NonlinearSolver:
    """What solves a `Balance`, set up once and kept for the whole run."""

    def __init__(self, balance: Balance, given: PetscOptions) -> None:
        """`given`: PETSc options of the study, over the defaults. InputError where PETSc does not take one."""
        self.balance, self._given = balance, given
        self._failures_before = 0  # linear solves that failed before `renew`
        self._abandons: Callable[[], bool] = lambda: False
        self._make()

    def _make(self) -> None:
        balance, given = self.balance, self._given
        self._newton = newton = NewtonSolver(balance, given)
        newton.set_stop_request(self._abandons)
        self._downhill: ModifiedNewton | None = newton.first_down
        self._led_astray = 0  # solves running whose first exact tangents have misled
        self._astray = 0  # solves to come that go downhill at once
        own = not any(key.startswith(("ksp_type", "pc_", "mg_")) for key in given)
        may_prefer = own and self.linear.may_factorise(SOONER_THAN_GMRES[balance.domain.dim])
        self._choice = SolverSelector(self.linear.factors, may_prefer=may_prefer)
        newton.gets_dear = lambda krylov, its: self._choice.gets_dear(krylov, its, positively=self._positively)

    @property
    def snes(self) -> PETSc.SNES:
        """That of the last attempt."""
        return self._newton.snes

    @property
    def linear(self) -> LinearSolver:
        """What linear systems are solved with."""
        return self._newton.linear

    @property
    def linear_failures(self) -> int:
        """Linear solves that failed outright and were taken as no correction."""
        return self._failures_before + self.linear.failures

    def solve(self, guess: Values) -> SolveResult:
        """Solve r(u) = 0 from the owned values `guess`; u holds the result, also where it is no solution
        (nonlinear_solver). Raises Abandoned (heed), and InputError where PETSc cannot solve with the options of the
        study."""
        with option_errors(self._given):
            return self._solve(guess)

    def _solve(self, guess: Values) -> SolveResult:
        choice = self._choice
        if choice.begins_with_factors() and choice.trusts(result := self._attempt_directly(guess)):
            return result
        result = self._attempt_iteratively(guess)
        if choice.dear:
            return self._go_on_directly(guess)
        if self._misled(result) and self.linear.may_factorise():
            result = self._attempt_directly(self.balance.level.u_n if self._sets_out_anew else guess)
            if result.converged:
                choice.take(preferred=False)
        elif choice.was_dear(result, positively=self._positively):
            choice.take(preferred=True)
        elif not self._misled(result):
            choice.iterate()
        return result

    def set_stop_request(self, stop_requested: Callable[[], bool]) -> None:
        """Ask `abandons` (collective) between Newton iterations; where it says so, `solve` raises Abandoned."""
        self._abandons = stop_requested
        self._newton.set_stop_request(stop_requested)

    def linear_response(self, force: Values) -> Values:
        """(owned dofs,) displacement that a force on free dofs causes in a step at the present u (Linear.response)."""
        with option_errors(self._given):
            self._newton.shrink()
            return self.linear.response(force, directly=bool(self._choice.left))

    def damage_changed(self, broke: int | None = None) -> None:
        """Some cells lost stiffness as so many edges broke, on all ranks (None: nobody knows)."""
        self._newton.damage_changed(broke)

    def rebuild(self) -> None:
        """Take the tangent that the balance has now, and keep nothing of earlier solves but counts (collective)."""
        self._failures_before = self.linear_failures
        self.destroy()
        self._make()

    # --- what is tried ---

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
        return not self._newton.was_first and not self.balance.scheme.inertia

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
            result = self._attempt_downhill(guess, POSITIVE_TANGENTS)
        else:
            result, start = self._attempt_exactly_first(guess)
        stalled = self.snes.ksp.reason == PETSc.KSP.ConvergedReason.DIVERGED_MAX_IT and self.linear.may_factorise()
        stalled = stalled or self.linear.may_factorise(SOONER_THAN_GMRES[self.balance.domain.dim])
        if self._misled(result) and self.snes.ksp.getType() == "cg" and not stalled:
            # CG met negative curvature (a buckling, softening or nearly incompressible body): GMRES does not mind it.
            self.snes.ksp.setType("gmres")
            self.snes.ksp.setGMRESRestart(RESTART)
            result = self._newton.attempt(start)
            self.snes.ksp.setType("cg")
        return result

    def _attempt_exactly_first(self, guess: Values) -> tuple[SolveResult, Values | None]:
        """With exact tangents, and what is tried where they mislead; and where another attempt may start from."""
        newton = self._newton
        result = newton.attempt(guess)
        if newton.crawls:
            result = self._attempt_downhill(None, (EXACT_TANGENTS,))
        start = (
            None if newton.goes_down and not self.balance.contact.remaining_motion() else guess
        )  # on the way down: goes on
        self._see_whether_astray(result)
        if self._misled(result):
            if self._sets_out_anew:
                start = self.balance.level.u_n
            if self.snes.ksp.reason != PETSc.KSP.ConvergedReason.DIVERGED_INDEFINITE_MAT:  # which is K's own doing
                # Smoothers of an older tangent need not be positive for this one.
                self.linear.preconditioner.due = Due.REBUILD
            if self.balance.conservative:
                result = self._attempt_downhill(start, POSITIVE_TANGENTS)
            else:
                with self.linear.set_up_anew():
                    result = newton.attempt(start)
        return result, start

    def _see_whether_astray(self, result: SolveResult) -> None:
        """Of an attempt with exact tangents: whether its first one has misled, as that of the solve before."""
        down = self.balance.scheme.inertia and self.balance.conservative
        self._led_astray = self._led_astray + 1 if down and not result.newton_iterations and self._misled(result) else 0
        if self._led_astray > 1:
            self._astray = ASTRAY

    @cached_property
    def _sets_out_anew(self) -> bool:
        """Whether a step is tried from where it begins once its first guess has misled: what flies there may be turned
        inside out, and without a potential (a pressure has none) there is no going down from it. Where prescribed dofs
        or contact set the pace that place is no better."""
        return (
            self.balance.scheme.inertia
            and not self.balance.conservative
            and not self.balance.contact.limits_newton_steps
        )

    def _attempt_downhill(self, guess: Values | None, ways: tuple[TangentModification, ...]) -> SolveResult:
        """Down the incremental potential in ways that are tried in turn. (From the start of every attempt positive
        moduli would cost more than they save, where exact tangents do: an iteration more.)"""
        down = self._downhill = self._downhill or self._newton.another_downhill()
        for way in ways:
            down.use_modification(way)
            with self.linear.set_up_anew() if way.rebuild_preconditioner else nullcontext():
                result = self._newton.attempt(None if way.from_last_iterate else guess, down)
            if not self._misled(result):
                break
        down.use_modification(None)
        return result

    def _attempt_directly(self, guess: Values | None) -> SolveResult:
        with self._to_the_end(), self.linear.factors.of(self.snes.ksp):
            result = self._newton.attempt(guess)
            if result.newton_iterations and result.converged and self.snes.ksp.getType() == "preonly":
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

    def destroy(self) -> None:
        """Give back PETSc's objects and take the options out of its database; nothing may be solved any more."""
        self._newton.destroy()
        if self._downhill is not None:
            self._downhill.destroy()
