"""The nonlinear solver of a step: strategies that are tried in turn until one solves the balance of forces.

Equations: docs/theory.md#newtons-method.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from ..mechanics.balance import Balance
from . import policy as policies
from .direct_solver import DirectSolver
from .line_search import EXACT_TANGENTS, POSITIVE_TANGENTS, TangentModification
from .linear_solver import LinearSolver
from .newton import UNLIMITED_COST, CostLimit, NewtonSolver, SolveResult
from .petsc_options import PetscOptions, option_errors
from .policy import SolverPolicy

Values = npt.NDArray[np.float64]


class SolverSelector(CostLimit):
    """Decides whether solves begin with Krylov iterations or with factors, and when iterations cost too much.

    Iterations begin. Where they fail, or cost more than factors that find a stable balance, the next solves begin with
    factors: a spell of them, which doubles each time that iterations fail again and is short again once they serve.

    Attributes:
        remaining: solves to come that begin with factors.
    """

    def __init__(self, direct: DirectSolver, policy: SolverPolicy, *, may_prefer: bool, has_inertia: bool) -> None:
        """`may_prefer`: factors may be taken because they are cheaper, not only where iterations fail."""
        self._direct, self._policy, self._may_prefer, self._has_inertia = direct, policy, may_prefer, has_inertia
        self.remaining, self._spell, self._preferred = 0, policy.first_direct_spell, False

    def begins_with_factors(self) -> bool:
        """Whether the next solve begins with factors; it counts as one of the spell."""
        if not self.remaining:
            return False
        self.remaining -= 1
        return True

    def accepts_factors(self, result: SolveResult) -> bool:
        """Whether what factors found at the start of a solve is taken; if not, the spell ends."""
        if not self._preferred or (result.converged and self._direct.is_positive):
            return True
        self.remaining = 0
        return False

    def start_spell(self, *, preferred: bool) -> None:
        """Begin the next solves with factors; `preferred`: iterations were expensive, but did not fail."""
        self._preferred = preferred
        self.remaining, self._spell = self._spell, min(2 * self._spell, self._policy.longest_direct_spell)

    def iterations_served(self) -> None:
        """Krylov iterations have solved: no factors, and the next spell is short."""
        self._spell = self._policy.first_direct_spell
        self._direct.release()

    def was_expensive(self, result: SolveResult, *, modified: bool) -> bool:
        """Whether factors would have cost less than the iterations of a solve."""
        worth = self.worth_of_factors(result.newton_iterations, modified=modified)
        return self._may_prefer and result.converged and result.krylov_iterations > worth

    def is_exceeded(self, krylov: int, newton: int, *, modified: bool) -> bool:
        """Whether an attempt ends after so many iterations, to go on with factors."""
        worth = self.worth_of_factors(newton, modified=modified)
        return bool(self._may_prefer and newton and krylov > max(self._direct.trial_iterations, worth))

    def worth_of_factors(self, newton: int, *, modified: bool) -> float:
        """Krylov iterations that cost as much as factors for so many Newton iterations.

        `modified`: with tangents made positive. Without inertia these take several times as many Newton iterations.
        """
        counted = min(newton, self._policy.tangents_on_trial) if modified and not self._has_inertia else max(newton, 1)
        return self._direct.equivalent_iterations * counted


@dataclass(frozen=True)
class Task:
    """What a solve has to do: from `guess`, (owned dofs,) m, within the cost `limit` of Krylov iterations."""

    guess: Values
    limit: CostLimit


@dataclass(frozen=True)
class Attempt:
    """The last attempt of a solve, for strategies that may follow it.

    Attributes:
        strategy: the name of its strategy.
        result: how it ended.
        linear_solves_failed: whether that is why it did not converge, see `NonlinearSolver._linear_solves_failed`.
        crawled: whether |r| made its steps too short (NewtonSolver.crawls).
        start: where a strategy that begins anew starts from, (owned dofs,) m; None: from the last iterate.
    """

    strategy: str
    result: SolveResult
    linear_solves_failed: bool = False
    crawled: bool = False
    start: Values | None = None


@dataclass(frozen=True)
class Strategy:
    """One way to solve a step.

    Attributes:
        name: of the strategy.
        applies: whether it is tried after the last attempt; None: no attempt stands.
        run: makes the attempt; None: its result does not stand.
    """

    name: str
    applies: Callable[[NonlinearSolver, Attempt | None], bool]
    run: Callable[[NonlinearSolver, Task, Attempt | None], Attempt | None]


class NonlinearSolver:
    """Solves the balance of forces of each step; set up once and kept for the whole run.

    Attributes:
        balance: the equations.    selector: whether solves begin with iterations or with factors.
        attempts: names of the strategies that the last solve has tried.
    """

    def __init__(
        self, balance: Balance, given: PetscOptions, *, plain: bool = False, policy: SolverPolicy | None = None
    ) -> None:
        """`given`: PETSc options of the study, over the defaults; `plain`: PETSc alone, without what is hand-written
        for speed. InputError where PETSc does not take an option (collective)."""
        self.balance, self._given, self._plain = balance, given, plain
        self._policy = policies.DEFAULT_POLICY if policy is None else policy
        self._earlier_failures = 0  # linear solves that failed before `rebuild`
        self._stop_requested: Callable[[], bool] = lambda: False
        self._make()

    def _make(self) -> None:
        balance, policy = self.balance, self._policy
        self._newton = NewtonSolver(balance, self._given, policy, plain=self._plain)
        self._newton.set_stop_request(self._stop_requested)
        self._failed_first_tangents = 0  # solves in a row whose first exact tangent was no descent
        self._positive_remaining = 0  # solves to come that begin with positive tangents
        self.attempts: list[str] = []
        is_default = not any(key.startswith(("ksp_type", "pc_", "mg_")) for key in self._given)
        self.selector = SolverSelector(
            self.linear.direct, policy, has_inertia=balance.scheme.inertia,
            may_prefer=is_default and self.linear.may_factorise(policy.max_direct_before_gmres(balance.domain.dim)),
        )  # fmt: skip

    @property
    def snes(self) -> PETSc.SNES:
        """The SNES of the last attempt."""
        return self._newton.snes

    @property
    def linear(self) -> LinearSolver:
        """The linear solver."""
        return self._newton.linear

    @property
    def linear_failures(self) -> int:
        """Linear solves that failed outright and were taken as no correction."""
        return self._earlier_failures + self.linear.failures

    # --- facts ---

    def set_stop_request(self, stop_requested: Callable[[], bool]) -> None:
        """Ask `stop_requested` (collective) between Newton iterations; once it is true `solve` raises StepAborted."""
        self._stop_requested = stop_requested
        self._newton.set_stop_request(stop_requested)

    def edges_broke(self, count: int | None) -> None:
        """So many edges broke on all ranks, whose cells lost stiffness; None: an unknown number (collective)."""
        self._newton.edges_broke(count)

    def rebuild(self) -> None:
        """Take the tangent that the balance has now, and keep nothing of earlier solves but counts (collective)."""
        self._earlier_failures = self.linear_failures
        self.destroy()
        self._make()

    # --- solves ---

    def linear_response(self, force: Values) -> Values:
        """Linear displacement response of a step to a force on free dofs, (owned dofs,) m (collective)."""
        with option_errors(self._given):
            self._newton.shrink_tangent()
            return self.linear.response(force, directly=bool(self.selector.remaining))

    def solve(self, guess: Values) -> SolveResult:
        """Solve r(u) = 0 from `guess`, (owned dofs,) m; u of the balance holds the result, also where it is no
        solution.

        Raises StepAborted, and InputError where PETSc cannot solve with the options of the study (collective).
        """
        self.attempts = []
        with option_errors(self._given):
            attempt = self._try(STRATEGIES, Task(guess, self.selector))
        if attempt.strategy in ITERATIVE_NAMES:
            if self.selector.was_expensive(attempt.result, modified=self._newton.used_second_snes):
                self.selector.start_spell(preferred=True)
            elif not attempt.linear_solves_failed:
                self.selector.iterations_served()
        return attempt.result

    def _try(self, strategies: Sequence[Strategy], task: Task) -> Attempt:
        """Try each strategy that applies after the last attempt, in turn; returns the last attempt."""
        attempt: Attempt | None = None
        for strategy in strategies:
            if strategy.applies(self, attempt):
                self.attempts.append(strategy.name)
                attempt = strategy.run(self, task, attempt)
        assert attempt is not None
        return attempt

    def destroy(self) -> None:
        """Give back PETSc's objects and take the options out of its database; nothing may be solved any more."""
        self._newton.destroy()

    # --- strategies: when they apply ---

    def _begins_with_factors(self, last: Attempt | None) -> bool:
        return last is None and self.selector.begins_with_factors()

    def _begins_with_exact_tangents(self, last: Attempt | None) -> bool:
        return last is None and not self._positive_remaining

    def _crawled(self, last: Attempt | None) -> bool:
        return last is not None and last.strategy == EXACT and last.crawled

    def _exact_tangents_failed(self, last: Attempt | None) -> bool:
        return last is not None and last.strategy in (EXACT, EXACT_DESCENT) and last.linear_solves_failed

    def _needs_positive_tangents(self, last: Attempt | None) -> bool:
        return last is None or (self.balance.conservative and self._exact_tangents_failed(last))

    def _needs_fresh_preconditioner(self, last: Attempt | None) -> bool:
        return not self.balance.conservative and self._exact_tangents_failed(last)

    def _needs_gmres(self, last: Attempt | None) -> bool:
        """CG met negative curvature (a buckling, softening or nearly incompressible body), which GMRES does not mind.

        Not where factors take no longer, nor where CG ran out of iterations, as GMRES would.
        """
        if last is None or not last.linear_solves_failed or self.snes.ksp.getType() != "cg":
            return False
        linear, max_it = self.linear, PETSc.KSP.ConvergedReason.DIVERGED_MAX_IT
        if self.snes.ksp.reason == max_it and linear.may_factorise():
            return False
        return not linear.may_factorise(self._policy.max_direct_before_gmres(self.balance.domain.dim))

    def _stopped_for_cost(self, last: Attempt | None) -> bool:
        return last is not None and last.result.stopped_for_cost

    def _nothing_stands(self, last: Attempt | None) -> bool:
        return last is None

    def _iterations_failed(self, last: Attempt | None) -> bool:
        failed = last is not None and last.strategy in ITERATIVE_NAMES and last.linear_solves_failed
        return failed and self.linear.may_factorise()

    # --- strategies: attempts ---

    def _factors_of_spell(self, task: Task, last: Attempt | None) -> Attempt | None:
        result = self._attempt_directly(task.guess)
        return Attempt(FACTORS_OF_SPELL, result) if self.selector.accepts_factors(result) else None

    def _exact_tangents(self, task: Task, last: Attempt | None) -> Attempt:
        result = self._newton.attempt(task.guess, limit=task.limit)
        attempt = self._after_exact_tangents(EXACT, result, task)
        if not attempt.crawled:
            self._count_failed_first_tangent(attempt)
        return attempt

    def _exact_descent(self, task: Task, last: Attempt | None) -> Attempt:
        result = self._newton.attempt(None, EXACT_TANGENTS, task.limit)
        attempt = self._after_exact_tangents(EXACT_DESCENT, result, task)
        self._count_failed_first_tangent(attempt)
        return attempt

    def _after_exact_tangents(self, name: str, result: SolveResult, task: Task) -> Attempt:
        """On the way down a potential the next attempt goes on, unless obstacles are held back."""
        goes_on = self._newton.descended_potential and not self.balance.contact.remaining_motion()
        crawled = name == EXACT and self._newton.crawls
        failed = self._linear_solves_failed(result)
        return Attempt(name, result, failed, crawled, None if goes_on else task.guess)

    def _count_failed_first_tangent(self, attempt: Attempt) -> None:
        """Begin some solves with positive tangents after exact first tangents have failed in two solves in a row."""
        descends = self.balance.scheme.inertia and self.balance.conservative
        failed_at_once = descends and not attempt.result.newton_iterations and attempt.linear_solves_failed
        self._failed_first_tangents = self._failed_first_tangents + 1 if failed_at_once else 0
        if self._failed_first_tangents > 1:
            self._positive_remaining = self._policy.positive_spell

    def _first_positive_tangents(self, task: Task, last: Attempt | None) -> Attempt:
        if last is None:
            self._positive_remaining -= 1
            start: Values | None = task.guess
        else:
            start = self._start_after_failure(last)
        return self._modified_tangents(POSITIVE_TANGENTS[0], start, task)

    def _modified_tangents(self, modification: TangentModification, start: Values | None, task: Task) -> Attempt:
        updated = self.linear.preconditioner.updated_for_each_tangent
        with updated() if modification.rebuild_preconditioner else nullcontext():
            guess = None if modification.from_last_iterate else start
            result = self._newton.attempt(guess, modification, task.limit)
        return Attempt(modification.name, result, self._linear_solves_failed(result), start=start)

    def _fresh_preconditioner(self, task: Task, last: Attempt | None) -> Attempt:
        assert last is not None
        start = self._start_after_failure(last)
        with self.linear.preconditioner.updated_for_each_tangent():
            result = self._newton.attempt(start, limit=task.limit)
        return Attempt(FRESH_PRECONDITIONER, result, self._linear_solves_failed(result), start=start)

    def _start_after_failure(self, last: Attempt) -> Values | None:
        """Where to start after exact tangents have failed; an indefinite tangent is not the preconditioner's doing."""
        if self.snes.ksp.reason != PETSc.KSP.ConvergedReason.DIVERGED_INDEFINITE_MAT:
            self.linear.preconditioner.solve_failed()
        return self.balance.level.u_n if self._restarts_at_step_start else last.start

    def _gmres(self, task: Task, last: Attempt | None) -> Attempt:
        assert last is not None
        ksp = self.snes.ksp
        ksp.setType("gmres")
        ksp.setGMRESRestart(self._policy.gmres_restart)
        result = self._newton.attempt(last.start, limit=task.limit)
        self.snes.ksp.setType("cg")
        return Attempt(GMRES, result, self._linear_solves_failed(result))

    def _factors_from_last_iterate(self, task: Task, last: Attempt | None) -> Attempt | None:
        """Stands where factors find a stable balance."""
        krylov, newton = self.snes.getLinearSolveIterations(), self.snes.its
        worth = self.selector.worth_of_factors(newton, modified=self._newton.used_second_snes)
        result = self._attempt_directly(None)
        if not (result.converged and self.linear.direct.is_positive):
            return None
        if krylov > worth:
            self.selector.start_spell(preferred=True)
        return Attempt(FACTORS_FROM_LAST_ITERATE, result)

    def _iterations_at_any_cost(self, task: Task, last: Attempt | None) -> Attempt:
        attempt = self._try(ITERATIVE_STRATEGIES, Task(task.guess, UNLIMITED_COST))
        return Attempt(ITERATIONS_AT_ANY_COST, attempt.result)

    def _factors_from_start(self, task: Task, last: Attempt | None) -> Attempt:
        result = self._attempt_directly(self.balance.level.u_n if self._restarts_at_step_start else task.guess)
        if result.converged:
            self.selector.start_spell(preferred=False)
        return Attempt(FACTORS_FROM_START, result)

    def _attempt_directly(self, guess: Values | None) -> SolveResult:
        with self.linear.factors():
            result = self._newton.attempt(guess)
            if result.newton_iterations and result.converged and self.snes.ksp.getType() == "preonly":
                self.linear.direct.measure_cost(self.snes.ksp)
        return result

    @cached_property
    def _restarts_at_step_start(self) -> bool:
        """Whether fallbacks start where the step starts, not at the first guess: fragments in flight may be turned
        inside out there, and without a potential (a pressure has none) there is no descent from it.

        Where prescribed dofs or contact set the pace the start of the step is no better.
        """
        balance = self.balance
        return balance.scheme.inertia and not balance.conservative and not balance.contact.limits_newton_steps

    def _linear_solves_failed(self, result: SolveResult) -> bool:
        """Whether linear solves are why an attempt did not converge: outright, or by their solutions.

        A solution of K d = -r lowers |r| for short steps along d. So a line search that fails was given none: CG may
        stop on an indefinite tangent before it notices, which depends on round-off. A halved step must not.
        """
        if not self.balance.scheme.inertia and self.linear.preconditioner.is_indefinite:
            return True  # the balance that factors have found is unstable
        line_search = PETSc.SNES.ConvergedReason.DIVERGED_LINE_SEARCH
        return not result.converged and (self.snes.ksp.reason < 0 or self.snes.reason == line_search)


def _following(modification: TangentModification, earlier: TangentModification) -> Strategy:
    """Positive tangents of another kind, tried where linear solves failed with those of an earlier kind."""

    def applies(solver: NonlinearSolver, last: Attempt | None) -> bool:
        return last is not None and last.strategy == earlier.name and last.linear_solves_failed

    def run(solver: NonlinearSolver, task: Task, last: Attempt | None) -> Attempt:
        assert last is not None
        return solver._modified_tangents(modification, last.start, task)

    return Strategy(modification.name, applies, run)


FACTORS_OF_SPELL = "factors, as in the last solves"
EXACT = "exact tangents"
EXACT_DESCENT = EXACT_TANGENTS.name
FRESH_PRECONDITIONER = "preconditioner updated for each tangent"
GMRES = "GMRES"
FACTORS_FROM_LAST_ITERATE = "factors, from the last iterate"
ITERATIONS_AT_ANY_COST = "iterations at any cost"
FACTORS_FROM_START = "factors, from the start"

ITERATIVE_STRATEGIES = (
    Strategy(EXACT, NonlinearSolver._begins_with_exact_tangents, NonlinearSolver._exact_tangents),
    Strategy(EXACT_DESCENT, NonlinearSolver._crawled, NonlinearSolver._exact_descent),
    Strategy(
        POSITIVE_TANGENTS[0].name, NonlinearSolver._needs_positive_tangents, NonlinearSolver._first_positive_tangents
    ),
    *(_following(later, earlier) for earlier, later in pairwise(POSITIVE_TANGENTS)),
    Strategy(FRESH_PRECONDITIONER, NonlinearSolver._needs_fresh_preconditioner, NonlinearSolver._fresh_preconditioner),
    Strategy(GMRES, NonlinearSolver._needs_gmres, NonlinearSolver._gmres),
)
ITERATIVE_NAMES = frozenset(strategy.name for strategy in ITERATIVE_STRATEGIES)
STRATEGIES = (
    Strategy(FACTORS_OF_SPELL, NonlinearSolver._begins_with_factors, NonlinearSolver._factors_of_spell),
    *ITERATIVE_STRATEGIES,
    Strategy(FACTORS_FROM_LAST_ITERATE, NonlinearSolver._stopped_for_cost, NonlinearSolver._factors_from_last_iterate),
    Strategy(ITERATIONS_AT_ANY_COST, NonlinearSolver._nothing_stands, NonlinearSolver._iterations_at_any_cost),
    Strategy(FACTORS_FROM_START, NonlinearSolver._iterations_failed, NonlinearSolver._factors_from_start),
)
