"""Time discretisation: displacement at the end of a step is the unknown; velocity and acceleration are affine in it.

Every implicit scheme is written as

    a = c_a (u - u_a),    v = c_v (u - u_v),

with numbers c_a (1/s^2), c_v (1/s) that depend on dt and vectors u_a, u_v (m) that depend on the state at the start of
the step. Differences of displacements, not sums with u / dt^2, keep the digits at small dt. The arrays may be of any
kind that adds and multiplies.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

Array = Any


class Scheme(Protocol):
    """What the stepper needs of an implicit scheme."""

    inertia: ClassVar[bool]

    def rates(self, dt: float) -> tuple[float, float]:
        """(c_a, c_v) in 1/s^2 and 1/s."""

    def references(self, dt: float, u: Array, v: Array, a: Array) -> tuple[Array, Array]:
        """(u_a, u_v) in m from the state at the start of the step."""


@dataclass(frozen=True)
class QuasiStatic:
    """Load stepping: no inertia. v = (u - u_n) / dt is kept for damping and reports only."""

    inertia: ClassVar[bool] = False

    def rates(self, dt: float) -> tuple[float, float]:
        """(c_a, c_v) = (0, 1 / dt)."""
        return 0.0, 1 / dt

    def references(self, dt: float, u: Array, v: Array, a: Array) -> tuple[Array, Array]:
        """(u_n, u_n)."""
        return u, u


@dataclass(frozen=True)
class BackwardEuler:
    """v = (u - u_n) / dt, a = (v - v_n) / dt: first order, L-stable, loses energy (the scheme of M22)."""

    inertia: ClassVar[bool] = True

    def rates(self, dt: float) -> tuple[float, float]:
        """(1 / dt^2, 1 / dt)."""
        return 1 / dt**2, 1 / dt

    def references(self, dt: float, u: Array, v: Array, a: Array) -> tuple[Array, Array]:
        """(u_n + dt v_n, u_n)."""
        return u + dt * v, u


@dataclass(frozen=True)
class Newmark:
    """Newmark 1959: u = u_n + dt v_n + dt^2 ((1/2 - beta) a_n + beta a), v = v_n + dt ((1 - gamma) a_n + gamma a).

    beta = 1/4, gamma = 1/2 is the trapezoidal rule: second order, conserves the energy of a linear body.
    gamma > 1/2 dissipates and is of first order.
    """

    beta: float = 0.25
    gamma: float = 0.5
    inertia: ClassVar[bool] = True

    def rates(self, dt: float) -> tuple[float, float]:
        """(1 / (beta dt^2), gamma / (beta dt))."""
        return 1 / (self.beta * dt**2), self.gamma / (self.beta * dt)

    def references(self, dt: float, u: Array, v: Array, a: Array) -> tuple[Array, Array]:
        """u_a = u_n + dt v_n + dt^2 (1/2 - beta) a_n;  u_v = u_a - beta dt / gamma (v_n + dt (1 - gamma) a_n)."""
        u_a = u + dt * v + (0.5 - self.beta) * dt**2 * a
        return u_a, u_a - (self.beta * dt / self.gamma) * (v + (1 - self.gamma) * dt * a)
