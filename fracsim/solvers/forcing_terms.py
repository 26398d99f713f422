"""How exactly the linear systems of Newton's method are solved, and with which tangent.

While contact acts:

    eta_k = min(LOOSE, max(rtol, 0.9 (|r_k| / |r_k-1|)^2, little / (10 |r_k|)))

(the second choice of Eisenstat and Walker, SIAM J. Sci. Comput. 17, 1996). While Newton's method finds out what
touches, a pair an iteration, and while the barrier bends more than its tangent knows, digits of a correction are worth
nothing; there are many such iterations, and CG takes four times as many in each as for the body alone. Any iterate of
CG goes down the potential, which is what the line search goes by.

Without contact (`Sparing`) two exact corrections often do, and three rough ones would be dearer. But the last of them
goes on for digits that nobody asks for, and what the first leaves is nonlinear, whatever the digits of its solution. So
what CG leaves is a share of what the tangent leaves anyhow, q_k = |r_k+1| / |r_k|, or little against a solution; and
the tangent is kept where with it, too, r comes to be little: it leaves 2 q of r then, the new one q^2. CG stops by the
preconditioned residual, and under a load on an end leaves fifteen times that share of r. So the first solve is told by
what CG left of r in the last attempt: taken for the tangent's, that let CG stop earlier from step to step.

Equations: docs/theory.md#inexact-newton.
"""

from __future__ import annotations

import math
from collections.abc import Callable

LOOSE = 1e-2


class EisenstatWalkerForcing:
    """The relative tolerances of the solves in one attempt."""

    def __init__(self, rtol: float) -> None:
        """`rtol`: of solves that are exact enough for anything."""
        self._rtol = self._used = rtol
        self._last = 0.0

    def begin_attempt(self) -> None:
        """An attempt begins: no residual is known."""
        self._last = 0.0

    def tight_tolerance(self) -> float:
        """The tolerance where no contact acts."""
        self._last, self._used = 0.0, self._rtol
        return self._used

    def tolerance_for(self, norm: float, little: float) -> float:
        """That at a residual of `norm`, N, where `little` N is a solution."""
        gained = (norm / self._last) ** 2 if self._last else 1.0
        enough = 0.1 * little / norm if norm else 1.0
        self._last, self._used = norm, min(LOOSE, max(self._rtol, 0.9 * gained, enough))
        return self._used

    def equivalent_iterations(self, its: int) -> int:
        """How many a solve to the exact tolerance would have taken, which took `its` (at a constant rate)."""
        return round(its * math.log(self._rtol) / math.log(self._used))


SHARE, MOST = 0.1, 0.3  # of what the tangent leaves, which CG may leave: by its own norm, and of r
# of the residual of a solution: what CG may leave, on which ranks differ, and what a tangent that is kept may
SMALL, LEFT = 1e-2, 0.3
ROUGHEST, LOOSEST = 1e-2, 0.1  # no correction is rougher, and no last one: of a slender body it might not go down
ENOUGH = 3  # iterations that tell how quickly CG converges


class ContractionForcing:
    """The same of a body that touches nothing.

    Attributes:
        rtol: of solves that are exact enough for anything.
    """

    def __init__(self, rtol: float) -> None:
        self.rtol = self._used = rtol
        # of the last attempt: share of r that its first iteration has left, and what CG has left of r there, for what
        # it was to leave of the preconditioned residual
        self._first_left, self._first_excess = 0.0, 1.0
        self.begin_attempt()

    def begin_attempt(self) -> None:
        """An attempt begins: no residual is known."""
        self._norms: list[float] = []

    def record_iterate(self, norm: float, little: float, left_by_cg: Callable[[], float]) -> bool:
        """An iterate has a residual of `norm`, N, where `little` N is a solution; whether the tangent of the last one
        does for it. `left_by_cg`: what CG has left of r on the way there, N."""
        self._norms.append(norm)
        if len(self._norms) == 2:
            self._first_left = self._left
            self._first_excess = max(1.0, SHARE / MOST * left_by_cg() / (self._used * self._norms[0] or math.inf))
        return len(self._norms) > 1 and 2 * self._left * norm <= LEFT * little

    def tolerance_for(self, little: float, *, kept: bool) -> float:
        """That of the solve from there; `kept`: with the tangent of the last iterate."""
        first, enough = len(self._norms) == 1, SMALL * little / self._norms[-1] if self._norms[-1] else 1.0
        left = self._first_left / self._first_excess if first else (2 * self._left if kept else self._left**2)
        self._used = max(self.rtol, min(ROUGHEST, SHARE * left), min(enough, LOOSEST))
        return self._used

    def tight_tolerance(self) -> float:
        """The tolerance of a solve by itself."""
        self._used = self.rtol
        return self._used

    @property
    def _left(self) -> float:
        """Share of r that the last iteration has left."""
        return self._norms[-1] / self._norms[-2] if self._norms[-2] else 1.0

    def equivalent_iterations(self, its: int) -> int:
        """How many a solve to the exact tolerance would have taken, which took `its`; 0: too few to tell."""
        return round(its * math.log(self.rtol) / math.log(self._used)) if its >= ENOUGH else 0
