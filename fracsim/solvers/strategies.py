"""Strategies to solve the balance of forces of a step, the order in which they are tried, and which one begins.

A strategy is tried where it applies after the last attempt: Newton's method with exact tangents, with tangents made
positive, with a fresh preconditioner, with GMRES, with factors. `STRATEGIES` is the list.

Equations: docs/theory.md#newtons-method.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from ..mechanics.balance import Balance
from .direct_solver import DirectSolver
from .line_search import POSITIVE_TANGENTS, TangentModification
from .linear_solver import LinearSolver
from .newton import UNLIMITED_COST, CostLimit, NewtonSolver, SolveResult
from .policy import SolverPolicy

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Task:
    """Task of a solve.

    Attributes:
        guess: (owned dofs,) first guess of u, m.
        limit: bound on the cost of Krylov iterations.
        tried: names of the strategies tried so far.
    """

    guess: Values
    limit: CostLimit
    tried: list[str]


@dataclass(frozen=True)
class Attempt:
    """Last attempt of a solve, for strategies that may follow it.

    Attributes:
        strategy: name of its strategy.
        result: its result.
        linear_solves_failed: whether it did not converge because linear solves failed.
        start: (owned dofs,) u from which the next strategy starts, m; None: from the last iterate.
    """

    strategy: str
    result: SolveResult
    linear_solves_failed: bool = False
    start: Values | None = None


class SolverSelector(CostLimit):
    """Choice whether a solve begins with Krylov iterations or with factors, and when iterations cost too much.

    Solves begin with iterations. Where these fail, or cost more than factors that find a stable balance, a number of
    solves begins with factors. That number doubles each time that iterations fail again, and is reset once they
    converge.

    Attributes:
        remaining: number of solves to come that begin with factors.
    """

    def __init__(self, direct: DirectSolver, policy: SolverPolicy, *, may_prefer: bool, has_inertia: bool) -> None:
        """`may_prefer`: whether factors are used where they are cheaper, not only where iterations fail."""
        self._direct, self._policy, self._may_prefer, self._has_inertia = direct, policy, may_prefer, has_inertia
        self.remaining, self._spell, self._preferred = 0, policy.first_direct_solves, False

    def begins_with_factors(self) -> bool:
        """Whether the next solve begins with factors; counts that solve."""
        if not self.remaining:
            return False
        self.remaining -= 1
        return True

    def accepts_factors(self, result: SolveResult) -> bool:
        """Whether the result of factors at the start of a solve is accepted; if not, iterations begin from now on."""
        if not self._preferred or (result.converged and self._direct.is_positive):
            return True
        self.remaining = 0
        return False

    def start_spell(self, *, preferred: bool) -> None:
        """Let the next solves begin with factors; `preferred`: iterations were expensive, but did not fail."""
        self._preferred = preferred
        self.remaining, self._spell = self._spell, min(2 * self._spell, self._policy.max_direct_solves)

    def iterations_served(self) -> None:
        """Free the factors and reset the number of solves with factors, after Krylov iterations have converged."""
        self._spell = self._policy.first_direct_solves
        self._direct.release()

    def was_expensive(self, result: SolveResult, *, modified: bool) -> bool:
        """Whether factors would have cost less than the iterations of a solve."""
        worth = self.worth_of_factors(result.newton_iterations, modified=modified)
        return self._may_prefer and result.converged and result.krylov_iterations > worth

    def is_exceeded(self, krylov: int, newton: int, *, modified: bool) -> bool:
        """Whether an attempt ends after so many iterations, to continue with factors."""
        worth = self.worth_of_factors(newton, modified=modified)
        return bool(self._may_prefer and newton and krylov > max(self._direct.trial_iterations, worth))

    def worth_of_factors(self, newton: int, *, modified: bool) -> float:
        """Krylov iterations that cost as much as factors for so many Newton iterations.

        `modified`: with tangents made positive. Without inertia these take several times as many Newton iterations.
        """
        counted = min(newton, self._policy.tangents_on_trial) if modified and not self._has_inertia else max(newton, 1)
        return self._direct.equivalent_iterations * counted


@dataclass(frozen=True)
class Solvers:
    """Solvers that the strategies of a nonlinear solver share.

    Attributes:
        balance: equations.
        newton: Newton's method.
        selector: choice between Krylov iterations and factors.
        policy: limits of the strategies.
    """

    balance: Balance
    newton: NewtonSolver
    selector: SolverSelector
    policy: SolverPolicy

    @property
    def linear(self) -> LinearSolver:
        """Linear solver of Newton's method."""
        return self.newton.linear

    @property
    def ksp(self) -> PETSc.KSP:
        """Krylov solver of the last attempt."""
        return self.newton.snes.ksp

    def solve_directly(self, guess: Values | None) -> SolveResult:
        """Attempt a solve with factors from `guess`, (owned dofs,) m; None: from the last iterate (collective)."""
        with self.linear.factors():
            result = self.newton.attempt(guess)
            if result.newton_iterations and result.converged and self.ksp.getType() == "preonly":
                self.linear.direct.measure_cost(self.ksp)
        return result

    def linear_solves_failed(self, result: SolveResult) -> bool:
        """Whether an attempt did not converge because linear solves failed, or their solutions were no descent.

        A solution of K d = -r lowers |r| for short steps along d. So a line search that fails was given none: CG may
        stop on an indefinite tangent before it notices, which depends on round-off. A halved step must not.
        """
        if not self.balance.scheme.inertia and self.linear.preconditioner.is_indefinite:
            return True  # the balance that factors have found is unstable
        line_search = PETSc.SNES.ConvergedReason.DIVERGED_LINE_SEARCH
        return not result.converged and (self.ksp.reason < 0 or self.newton.snes.reason == line_search)

    @cached_property
    def restart_at_step_start(self) -> bool:
        """Whether fallbacks start from the state at the start of the step, not from the first guess.

        At the first guess fragments in flight may be inverted, and without a potential (a pressure has none) there is
        no descent from it. Where prescribed dofs or contact set the pace the start of the step is no better.
        """
        balance = self.balance
        return balance.scheme.inertia and not balance.conservative and not balance.contact.limits_newton_steps

    def start_after_failure(self, last: Attempt) -> Values | None:
        """(owned dofs,) start after exact tangents have failed, m; also tells the preconditioner of the failure.

        The preconditioner is not the cause where the tangent is indefinite: as CG notices, as a line search without
        descent shows, or by the exact solution for changed nodes, which makes the preconditioner indefinite.
        """
        reason = PETSc.KSP.ConvergedReason
        if self.ksp.reason > 0 or self.ksp.reason in (reason.DIVERGED_INDEFINITE_MAT, reason.DIVERGED_INDEFINITE_PC):
            self.linear.preconditioner.tangent_was_indefinite()
        else:
            self.linear.preconditioner.solve_failed()
        return self.balance.level.u_n if self.restart_at_step_start else last.start


@dataclass(frozen=True)
class Strategy:
    """One way to solve a step.

    Attributes:
        name: name of the strategy.
        applies: whether it is tried after the last attempt; None: there is no result yet.
        run: makes the attempt; returns None if its result is rejected.
    """

    name: str
    applies: Callable[[Solvers, Attempt | None], bool]
    run: Callable[[Solvers, Task, Attempt | None], Attempt | None]


def try_in_turn(strategies: Sequence[Strategy], solvers: Solvers, task: Task) -> Attempt:
    """Try each strategy that applies after the last attempt, in turn; returns the last attempt (collective)."""
    attempt: Attempt | None = None
    for strategy in strategies:
        if strategy.applies(solvers, attempt):
            task.tried.append(strategy.name)
            attempt = strategy.run(solvers, task, attempt)
    assert attempt is not None
    return attempt


FACTORS_OF_SPELL = "factors, as in the last solves"
EXACT = "exact tangents"
FRESH_PRECONDITIONER = "preconditioner updated for each tangent"
GMRES = "GMRES"
FACTORS_FROM_LAST_ITERATE = "factors, from the last iterate"
ITERATIONS_AT_ANY_COST = "iterations at any cost"
FACTORS_FROM_START = "factors, from the start"


# --- factors, as in the last solves ---


def _begins_with_factors(solvers: Solvers, last: Attempt | None) -> bool:
    return last is None and solvers.selector.begins_with_factors()


def _factors_of_spell(solvers: Solvers, task: Task, last: Attempt | None) -> Attempt | None:
    result = solvers.solve_directly(task.guess)
    return Attempt(FACTORS_OF_SPELL, result) if solvers.selector.accepts_factors(result) else None


# --- exact tangents ---


def _exact_tangents(solvers: Solvers, task: Task, last: Attempt | None) -> Attempt:
    """Attempt with exact tangents; the next one continues from the last iterate if that one is nearer to a solution.

    It is nearer after a descent of the potential, and with inertia also where |r| has fallen. Without inertia |r|
    falls toward an unstable balance as well.
    """
    newton, balance = solvers.newton, solvers.balance
    result = newton.attempt(task.guess, limit=task.limit)
    is_nearer = newton.descended_potential or (balance.scheme.inertia and newton.reduced_residual)
    continues = is_nearer and not balance.contact.remaining_motion()
    return Attempt(EXACT, result, solvers.linear_solves_failed(result), None if continues else task.guess)


def _exact_tangents_failed(last: Attempt | None) -> bool:
    return last is not None and last.strategy == EXACT and last.linear_solves_failed


# --- tangents made positive ---


def _needs_positive_tangents(solvers: Solvers, last: Attempt | None) -> bool:
    return solvers.balance.conservative and _exact_tangents_failed(last)


def _first_positive_tangents(solvers: Solvers, task: Task, last: Attempt | None) -> Attempt:
    assert last is not None
    start = solvers.start_after_failure(last)
    attempt = _modified_tangents(solvers, POSITIVE_TANGENTS[0], start, task)
    if attempt.linear_solves_failed and solvers.ksp.reason == PETSc.KSP.ConvergedReason.DIVERGED_INDEFINITE_PC:
        solvers.linear.preconditioner.solve_failed()  # that of an earlier tangent is not positive
        attempt = replace(_modified_tangents(solvers, POSITIVE_TANGENTS[0], None, task), start=start)
    return attempt


def _modified_tangents(
    solvers: Solvers, modification: TangentModification, start: Values | None, task: Task
) -> Attempt:
    updated = solvers.linear.preconditioner.updated_for_each_tangent
    with updated() if modification.rebuild_preconditioner else nullcontext():
        guess = None if modification.from_last_iterate else start
        result = solvers.newton.attempt(guess, modification, task.limit)
    return Attempt(modification.name, result, solvers.linear_solves_failed(result), start=start)


def _following(modification: TangentModification, earlier: TangentModification) -> Strategy:
    """Positive tangents of another kind, tried where linear solves failed with those of an earlier kind."""

    def applies(solvers: Solvers, last: Attempt | None) -> bool:
        return last is not None and last.strategy == earlier.name and last.linear_solves_failed

    def run(solvers: Solvers, task: Task, last: Attempt | None) -> Attempt:
        assert last is not None
        return _modified_tangents(solvers, modification, last.start, task)

    return Strategy(modification.name, applies, run)


# --- exact tangents of a balance without a potential, with a preconditioner of their own ---


def _needs_fresh_preconditioner(solvers: Solvers, last: Attempt | None) -> bool:
    """Whether exact tangents may be solved with another preconditioner, or from another start.

    From the same start a tangent stays indefinite, and one whose preconditioner could not be set up stays as it is.
    """
    if solvers.balance.conservative or not _exact_tangents_failed(last):
        return False
    reason = PETSc.KSP.ConvergedReason
    is_final = solvers.ksp.reason in (reason.DIVERGED_INDEFINITE_MAT, reason.DIVERGED_PCSETUP_FAILED)
    return solvers.restart_at_step_start or not is_final


def _fresh_preconditioner(solvers: Solvers, task: Task, last: Attempt | None) -> Attempt:
    assert last is not None
    start = solvers.start_after_failure(last)
    with solvers.linear.preconditioner.updated_for_each_tangent():
        result = solvers.newton.attempt(start, limit=task.limit)
    return Attempt(FRESH_PRECONDITIONER, result, solvers.linear_solves_failed(result), start=start)


# --- GMRES ---


def _needs_gmres(solvers: Solvers, last: Attempt | None) -> bool:
    """Whether CG met negative curvature, as in a buckling, softening or nearly incompressible body.

    Not where factors take no longer, nor where CG ran out of iterations or had no preconditioner, as GMRES would.
    """
    reason = PETSc.KSP.ConvergedReason
    if last is None or not last.linear_solves_failed or solvers.ksp.getType() != "cg":
        return False
    if solvers.ksp.reason == reason.DIVERGED_PCSETUP_FAILED:
        return False
    linear = solvers.linear
    if solvers.ksp.reason == reason.DIVERGED_MAX_IT and linear.may_factorise():
        return False
    return not linear.may_factorise(solvers.policy.max_direct_before_gmres(solvers.balance.domain.dim))


def _gmres(solvers: Solvers, task: Task, last: Attempt | None) -> Attempt:
    assert last is not None
    solvers.ksp.setType("gmres")
    solvers.ksp.setGMRESRestart(solvers.policy.gmres_restart)
    result = solvers.newton.attempt(last.start, limit=task.limit)
    solvers.ksp.setType("cg")
    return Attempt(GMRES, result, solvers.linear_solves_failed(result))


# --- after iterations that cost too much, or failed ---


def _stopped_for_cost(solvers: Solvers, last: Attempt | None) -> bool:
    return last is not None and last.result.stopped_for_cost


def _factors_from_last_iterate(solvers: Solvers, task: Task, last: Attempt | None) -> Attempt | None:
    """Attempt with factors; its result is rejected where the balance found is not stable."""
    snes = solvers.newton.snes
    krylov, newton = snes.getLinearSolveIterations(), snes.its
    worth = solvers.selector.worth_of_factors(newton, modified=solvers.newton.used_second_snes)
    result = solvers.solve_directly(None)
    if not (result.converged and solvers.linear.direct.is_positive):
        return None
    if krylov > worth:
        solvers.selector.start_spell(preferred=True)
    return Attempt(FACTORS_FROM_LAST_ITERATE, result)


def _has_no_result(solvers: Solvers, last: Attempt | None) -> bool:
    return last is None


def _iterations_at_any_cost(solvers: Solvers, task: Task, last: Attempt | None) -> Attempt:
    attempt = try_in_turn(ITERATIVE_STRATEGIES, solvers, replace(task, limit=UNLIMITED_COST))
    return Attempt(ITERATIONS_AT_ANY_COST, attempt.result)


def _iterations_failed(solvers: Solvers, last: Attempt | None) -> bool:
    failed = last is not None and last.strategy in ITERATIVE_NAMES and last.linear_solves_failed
    return failed and solvers.linear.may_factorise()


def _factors_from_start(solvers: Solvers, task: Task, last: Attempt | None) -> Attempt:
    result = solvers.solve_directly(solvers.balance.level.u_n if solvers.restart_at_step_start else task.guess)
    if result.converged:
        solvers.selector.start_spell(preferred=False)
    return Attempt(FACTORS_FROM_START, result)


# --- the list ---

ITERATIVE_STRATEGIES = (
    Strategy(EXACT, _has_no_result, _exact_tangents),
    Strategy(POSITIVE_TANGENTS[0].name, _needs_positive_tangents, _first_positive_tangents),
    *(_following(later, earlier) for earlier, later in pairwise(POSITIVE_TANGENTS)),
    Strategy(FRESH_PRECONDITIONER, _needs_fresh_preconditioner, _fresh_preconditioner),
    Strategy(GMRES, _needs_gmres, _gmres),
)
ITERATIVE_NAMES = frozenset(strategy.name for strategy in ITERATIVE_STRATEGIES)
STRATEGIES = (
    Strategy(FACTORS_OF_SPELL, _begins_with_factors, _factors_of_spell),
    *ITERATIVE_STRATEGIES,
    Strategy(FACTORS_FROM_LAST_ITERATE, _stopped_for_cost, _factors_from_last_iterate),
    Strategy(ITERATIONS_AT_ANY_COST, _has_no_result, _iterations_at_any_cost),
    Strategy(FACTORS_FROM_START, _iterations_failed, _factors_from_start),
)
