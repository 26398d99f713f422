"""Backward Euler, the scheme of M22."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from .scheme import Array, AtTheEnd


@dataclass(frozen=True)
class BackwardEuler(AtTheEnd):
    """v = (u - u_n) / dt, a = (v - v_n) / dt: first order, L-stable, loses energy (the scheme of M22)."""

    summary: ClassVar[str] = "first order, damps vibrations; at long steps as good as without inertia"
    inertia: ClassVar[bool] = True

    def rates(self, dt: float) -> tuple[float, float]:
        """(1 / dt^2, 1 / dt)."""
        return 1 / dt**2, 1 / dt

    def references(self, dt: float, u: Array, v: Array, a: Array) -> tuple[Array, Array]:
        """(u_n + dt v_n, u_n)."""
        return u + dt * v, u
