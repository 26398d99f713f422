"""Newmark's method.

N. M. Newmark: A method of computation for structural dynamics. J. Eng. Mech. Div. (ASCE) 85 (1959) 67-94.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from .scheme import Array, AtTheEnd, driven


@dataclass(frozen=True)
class Newmark(AtTheEnd):
    """u = u_n + dt v_n + dt^2 ((1/2 - beta) a_n + beta a), v = v_n + dt ((1 - gamma) a_n + gamma a).

    beta = 1/4, gamma = 1/2 is the trapezoidal rule: second order, conserves the energy of a linear body.
    gamma > 1/2 dissipates and is of first order. Stable for every step where 2 beta >= gamma >= 1/2 (Hughes, The Finite
    Element Method, 1987, sec. 9.1).
    """

    beta: float = field(
        default=0.25,
        metadata={
            "gt": 0,
            "le": 0.5,
            "description": "Of `newmark`: weight of the new acceleration in u, at least gamma / 2.",
        },
    )
    gamma: float = field(
        default=0.5,
        metadata={"ge": 0.5, "le": 1, "description": "Of `newmark`: weight of the new acceleration in v; > 1/2 damps."},
    )
    summary: ClassVar[str] = "second order; the trapezoidal rule unless beta and gamma say otherwise"
    inertia: ClassVar[bool] = True
    carries_acceleration: ClassVar[bool] = True

    def check(self) -> None:
        """ValueError where only short steps are stable."""
        if 2 * self.beta < self.gamma - 1e-12:
            raise ValueError("newmark is stable for every step where beta >= gamma / 2; raise beta")

    def rates(self, dt: float) -> tuple[float, float]:
        """(1 / (beta dt^2), gamma / (beta dt))."""
        return 1 / (self.beta * dt**2), self.gamma / (self.beta * dt)

    def references(self, dt: float, u: Array, v: Array, a: Array) -> tuple[Array, Array]:
        """u_a = u_n + dt v_n + dt^2 (1/2 - beta) a_n;  u_v = u_a - beta dt / gamma (v_n + dt (1 - gamma) a_n)."""
        u_a = u + dt * v + (0.5 - self.beta) * dt**2 * a
        return u_a, u_a - (self.beta * dt / self.gamma) * (v + (1 - self.gamma) * dt * a)

    def prescribed(self, dt: float, u: Array, start: Array, v: Array) -> tuple[Array, Array] | None:
        """By their own law."""
        return driven(dt, u, start, v)
