"""Backward Euler, and load stepping, which has its velocity but no inertia."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from .scheme import Array, EndOfStepScheme


@dataclass(frozen=True)
class BackwardEuler(EndOfStepScheme):
    """v = (u - u_n) / dt, a = (v - v_n) / dt: first order, L-stable, dissipative (the scheme of M22)."""

    summary: ClassVar[str] = "first order, damps vibrations; at long steps as good as without inertia"
    inertia: ClassVar[bool] = True

    def rate_coefficients(self, dt: float) -> tuple[float, float]:
        """Return 1 / dt^2 and 1 / dt."""
        return 1 / dt**2, 1 / dt

    def reference_displacements(self, dt: float, u: Array, v: Array, a: Array) -> tuple[Array, Array]:
        """Return u_n + dt v_n and u_n."""
        return u + dt * v, u


@dataclass(frozen=True)
class QuasiStatic(EndOfStepScheme):
    """Load stepping without inertia; v = (u - u_n) / dt is used by damping and output alone."""

    summary: ClassVar[str] = "load stepping without inertia"
    inertia: ClassVar[bool] = False

    def rate_coefficients(self, dt: float) -> tuple[float, float]:
        """Return 0 and 1 / dt."""
        return 0.0, 1 / dt

    def reference_displacements(self, dt: float, u: Array, v: Array, a: Array) -> tuple[Array, Array]:
        """Return u_n and u_n."""
        return u, u
