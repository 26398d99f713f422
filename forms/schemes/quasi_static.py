"""Load stepping."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from .scheme import Array, AtTheEnd


@dataclass(frozen=True)
class QuasiStatic(AtTheEnd):
    """Load stepping: no inertia. v = (u - u_n) / dt is kept for damping and reports only."""

    summary: ClassVar[str] = "load stepping without inertia"
    inertia: ClassVar[bool] = False

    def rates(self, dt: float) -> tuple[float, float]:
        """(c_a, c_v) = (0, 1 / dt)."""
        return 0.0, 1 / dt

    def references(self, dt: float, u: Array, v: Array, a: Array) -> tuple[Array, Array]:
        """(u_n, u_n)."""
        return u, u
