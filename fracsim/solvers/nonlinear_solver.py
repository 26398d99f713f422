"""Nonlinear solver of a step: strategies are tried in turn until one of them solves the balance of forces.

Equations: docs/theory.md#newtons-method.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from ..mechanics.balance import Balance
from . import policy as policies
from .linear_solver import LinearSolver
from .newton import NewtonSolver, SolveResult
from .petsc_options import PetscOptions, option_errors
from .policy import SolverPolicy
from .strategies import ITERATIVE_NAMES, STRATEGIES, Solvers, SolverSelector, Task, try_in_turn

Values = npt.NDArray[np.float64]


class NonlinearSolver:
    """Solver of the balance of forces of each step, set up once for a run.

    Attributes:
        balance: equations.
        selector: choice between Krylov iterations and factors.
        attempts: names of the strategies that the last solve has tried.
    """

    def __init__(
        self, balance: Balance, given: PetscOptions, *, plain: bool = False, policy: SolverPolicy | None = None
    ) -> None:
        """Set up the solvers (collective).

        Args:
            balance: equations.
            given: PETSc options of the study, which replace the defaults.
            plain: whether PETSc and DOLFINx alone are used, without code written for speed.
            policy: limits and tuned numbers; None: the default ones.

        Raises:
            InputError: if PETSc does not accept an option.
        """
        self.balance, self._given, self._plain = balance, given, plain
        self._policy = policies.DEFAULT_POLICY if policy is None else policy
        self._earlier_failures = 0  # linear solves that failed before `rebuild`
        self._stop_requested: Callable[[], bool] | None = None
        self._create_solvers()

    def _create_solvers(self) -> None:
        balance, policy = self.balance, self._policy
        newton = self._newton = NewtonSolver(balance, self._given, policy, plain=self._plain)
        if self._stop_requested is not None:
            newton.set_stop_request(self._stop_requested)
        self.attempts: list[str] = []
        is_default = not any(key.startswith(("ksp_type", "pc_", "mg_")) for key in self._given)
        direct_is_cheap = newton.linear.may_factorise(policy.max_direct_before_gmres(balance.domain.dim))
        self.selector = SolverSelector(
            newton.linear.direct,
            policy,
            may_prefer=is_default and direct_is_cheap,
            has_inertia=balance.scheme.inertia,
        )
        self._solvers = Solvers(balance, newton, self.selector, policy)

    @property
    def snes(self) -> PETSc.SNES:
        """SNES of the last attempt."""
        return self._newton.snes

    @property
    def linear(self) -> LinearSolver:
        """Linear solver."""
        return self._newton.linear

    @property
    def linear_failures(self) -> int:
        """Number of linear solves that failed and gave no correction."""
        return self._earlier_failures + self.linear.failures

    def set_stop_request(self, stop_requested: Callable[[], bool]) -> None:
        """Set a function (collective) called between Newton iterations; where it is true `solve` raises StepAborted."""
        self._stop_requested = stop_requested
        self._newton.set_stop_request(stop_requested)

    def edges_broke(self, count: int | None) -> None:
        """React to the number of edges that broke on all ranks; None: an unknown number (collective)."""
        self._newton.edges_broke(count)

    def rebuild(self) -> None:
        """Set up all solvers again for the present tangent of the balance; counts are kept (collective)."""
        self._earlier_failures = self.linear_failures
        self.destroy()
        self._create_solvers()

    def linear_response(self, force: Values) -> Values:
        """(owned dofs,) linear displacement response of a step to a force on free dofs, m (collective)."""
        with option_errors(self._given):
            self._newton.shrink_tangent()
            return self.linear.response(force, directly=bool(self.selector.remaining))

    def solve(self, guess: Values) -> SolveResult:
        """Solve r(u) = 0 from `guess`, (owned dofs,) m (collective).

        u of the balance holds the result, also where it is no solution. Iterations are those of all strategies tried.

        Raises:
            StepAborted: if a stop was requested.
            InputError: if PETSc cannot solve with the options of the study.
        """
        self.attempts = []
        newton, krylov = self._newton.spent
        with option_errors(self._given):
            attempt = try_in_turn(STRATEGIES, self._solvers, Task(guess, self.selector, self.attempts))
        if attempt.strategy in ITERATIVE_NAMES:
            if self.selector.was_expensive(attempt.result, modified=self._newton.used_second_snes):
                self.selector.start_spell(preferred=True)
            elif not attempt.linear_solves_failed:
                self.selector.iterations_served()
        newton, krylov = self._newton.spent[0] - newton, self._newton.spent[1] - krylov
        return replace(attempt.result, newton_iterations=newton, krylov_iterations=krylov)

    def destroy(self) -> None:
        """Free PETSc's objects and remove the options from its database; the solver cannot be used any more."""
        self._newton.destroy()
