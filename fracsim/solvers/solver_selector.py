"""Choice of the solver that a solve begins with: Krylov iterations or factors, exact tangents or positive ones.

Equations: docs/theory.md#newtons-method.
"""

from __future__ import annotations

from .direct_solver import DirectSolver
from .newton import CostLimit, SolveResult
from .policy import SolverPolicy


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
        self.remaining, self._spell, self._preferred = 0, policy.first_direct_spell, False

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
        self.remaining, self._spell = self._spell, min(2 * self._spell, self._policy.longest_direct_spell)

    def iterations_served(self) -> None:
        """Free the factors and reset the number of solves with factors, after Krylov iterations have converged."""
        self._spell = self._policy.first_direct_spell
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


class PositiveTangentSpell:
    """Number of solves to come that begin with tangents made positive.

    It is set after the first exact tangent gave no descent direction in two solves in a row.
    """

    def __init__(self, length: int) -> None:
        self._length, self._remaining, self._failures = length, 0, 0

    @property
    def is_active(self) -> bool:
        """Whether the next solve begins with positive tangents."""
        return self._remaining > 0

    def solve_begins(self) -> None:
        """Count a solve that begins with positive tangents."""
        self._remaining -= 1

    def first_exact_tangent_tried(self, *, failed: bool) -> None:
        """Count first exact tangents that failed in a row."""
        self._failures = self._failures + 1 if failed else 0
        if self._failures > 1:
            self._remaining = self._length
