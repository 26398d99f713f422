"""Inexact Newton: relative tolerance of each linear solve, and whether it may use the tangent of the iterate before.

Equations: docs/theory.md#inexact-newton.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from .policy import DEFAULT_POLICY, SolverPolicy


class ContractionForcing:
    """Tolerances of the linear solves of an attempt with inertia.

    CG may leave a share of what the linearisation leaves, q_k^2 of r with q_k = |r_{k+1}| / |r_k|, or a small share of
    the residual of a solution. The last tangent is used again where it suffices, and leaves 2 q_k of r, as one that is
    made positive does.

    Attributes:
        rtol: tight tolerance.
    """

    def __init__(self, rtol: float, policy: SolverPolicy = DEFAULT_POLICY) -> None:
        """Begin without a residual; `rtol` is the tight tolerance."""
        self.rtol = self._used = rtol
        self._policy = policy
        # Of the first iteration of the last attempt: its contraction of r, and the share of r that CG left over the
        # tolerance. CG stops by the preconditioned residual, and under a load on an end leaves fifteen times that share
        # of r. Counted as contraction, this would let CG stop earlier from step to step.
        self._first_left, self._first_excess = 0.0, 1.0
        self.begin_attempt()

    def begin_attempt(self) -> None:
        """Forget the residuals of earlier attempts."""
        self._norms: list[float] = []

    def record_iterate(self, norm: float, solved_norm: float, left_by_cg: Callable[[], float]) -> bool:
        """Record an iterate; return True if the last tangent suffices for the solve from there.

        Args:
            norm: |r| there, N.
            solved_norm: |r| of a solution, N.
            left_by_cg: evaluates the residual that CG has left in the linear system of the last solve, N.
        """
        policy = self._policy
        self._norms.append(norm)
        if len(self._norms) == 2:
            self._first_left = self._contraction
            allowed = self._used * self._norms[0] or math.inf
            ratio = policy.cg_share / policy.cg_share_of_residual
            self._first_excess = max(1.0, ratio * left_by_cg() / allowed)
        return len(self._norms) > 1 and 2 * self._contraction * norm <= policy.reused_tangent_share * solved_norm

    def tolerance_for(self, solved_norm: float, *, exact: bool) -> float:
        """Return the tolerance of the solve from the last iterate.

        Args:
            solved_norm: |r| of a solution, N.
            exact: whether the tangent is that of the iterate; else it is an earlier or a modified one.
        """
        policy, norm = self._policy, self._norms[-1]
        enough = policy.cg_share_of_solution * solved_norm / norm if norm else 1.0
        if len(self._norms) == 1:
            left = self._first_left / self._first_excess
        else:
            left = self._contraction**2 if exact else 2 * self._contraction
        share = min(policy.max_correction_rtol, policy.cg_share * left)
        self._used = max(self.rtol, share, min(enough, policy.max_last_correction_rtol))
        return self._used

    def tight_tolerance(self) -> float:
        """Return the tolerance of a single solve."""
        self._used = self.rtol
        return self._used

    @property
    def _contraction(self) -> float:
        """|r_{k+1}| / |r_k| of the last iteration, q_k."""
        return self._norms[-1] / self._norms[-2] if self._norms[-2] else 1.0

    def equivalent_iterations(self, its: int) -> int:
        """Return the iterations of a solve to the tight tolerance, where the last solve took `its`.

        0 if these are too few.
        """
        if its < self._policy.min_rate_iterations:
            return 0
        return round(its * math.log(self.rtol) / math.log(self._used))
