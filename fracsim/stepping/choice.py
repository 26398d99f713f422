"""Iterations or factors: what a solve begins with, and when iterations stop to make way.

Iterations begin. Where they fail the system is factorised, and the next solves start with factors: as many as the spell
says, which doubles each time that iterations fail again, and is short again once they do not. So they do where
iterations were dearer than factors, as long as those find a balance that is stable.
"""

from __future__ import annotations

from .factors import MANY, Factors
from .stepper import SolveResult

# solves that start with factors once iterations have failed: the first time, and at most
FIRST_SPELL, LONGEST_SPELL = 8, 256


class Choice:
    """What the solves of one KSP begin with.

    Attributes:
        left: solves that start with factors, still to come.
        watches: whether a solve stops where iterations get dear.    dear: whether the last one has.
    """

    def __init__(self, factors: Factors, *, may_prefer: bool) -> None:
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
        cheap = result.krylov <= self.worth(result.newton, positively=positively)
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
