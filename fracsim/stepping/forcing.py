"""How exactly the linear systems of Newton's method are solved while contact acts.

    eta_k = min(LOOSE, max(rtol, 0.9 (|r_k| / |r_k-1|)^2, little / (10 |r_k|)))

(the second choice of Eisenstat and Walker, SIAM J. Sci. Comput. 17, 1996). While Newton's method finds out what
touches, a pair an iteration, and while the barrier bends more than its tangent knows, digits of a correction are worth
nothing; there are many such iterations, and CG takes four times as many in each as for the body alone. Any iterate of
CG goes down the potential, which is what the line search goes by. Without contact two exact corrections do, and are
cheaper than three rough ones.
"""

from __future__ import annotations

import math

LOOSE = 1e-2


class Forcing:
    """The relative tolerances of the solves in one attempt."""

    def __init__(self, rtol: float) -> None:
        """`rtol`: of solves that are exact enough for anything."""
        self._rtol = self._used = rtol
        self._last = 0.0

    def begin(self) -> None:
        """An attempt begins: no residual is known."""
        self._last = 0.0

    def exact(self) -> float:
        """The tolerance where no contact acts."""
        self._last, self._used = 0.0, self._rtol
        return self._used

    def rough(self, norm: float, little: float) -> float:
        """That at a residual of `norm`, N, where `little` N is a solution."""
        gained = (norm / self._last) ** 2 if self._last else 1.0
        enough = 0.1 * little / norm if norm else 1.0
        self._last, self._used = norm, min(LOOSE, max(self._rtol, 0.9 * gained, enough))
        return self._used

    def iterations(self, its: int) -> int:
        """How many a solve to the exact tolerance would have taken, which took `its` (at a constant rate)."""
        return round(its * math.log(self._rtol) / math.log(self._used))
