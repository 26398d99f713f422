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
    """What the stepper needs of a scheme. The unknown x is u at the level (1 - alpha_f) u_{n+1} + alpha_f u_n."""

    inertia: ClassVar[bool]
    implicit: ClassVar[bool]
    rings: ClassVar[bool]  # a jump of a velocity that is prescribed by displacements does not die out
    remembers: ClassVar[bool]  # a step goes on from the acceleration at its start

    @property
    def alpha_f(self) -> float: ...

    def rates(self, dt: float) -> tuple[float, float]:
        """(c_a, c_v) in 1/s^2 and 1/s."""

    def references(self, dt: float, u: Array, v: Array, a: Array) -> tuple[Array, Array]:
        """(u_a, u_v) in m from the state at the start of the step."""

    def finish(self, dt: float, x: Array, u: Array, v: Array, a: Array) -> tuple[Array, Array, Array]:
        """(u, v, a) at the end of the step from the solved x and the state at its start."""


class _AtTheEnd:
    """Schemes that balance forces at the end of the step: x is u_{n+1} itself."""

    implicit: ClassVar[bool] = True
    rings: ClassVar[bool] = False
    remembers: ClassVar[bool] = False
    alpha_f: ClassVar[float] = 0.0

    def finish(self: Any, dt: float, x: Array, u: Array, v: Array, a: Array) -> tuple[Array, Array, Array]:
        """(x, c_v (x - u_v), c_a (x - u_a))."""
        (c_a, c_v), (u_a, u_v) = self.rates(dt), self.references(dt, u, v, a)
        return x, c_v * (x - u_v), c_a * (x - u_a)


@dataclass(frozen=True)
class QuasiStatic(_AtTheEnd):
    """Load stepping: no inertia. v = (u - u_n) / dt is kept for damping and reports only."""

    inertia: ClassVar[bool] = False

    def rates(self, dt: float) -> tuple[float, float]:
        """(c_a, c_v) = (0, 1 / dt)."""
        return 0.0, 1 / dt

    def references(self, dt: float, u: Array, v: Array, a: Array) -> tuple[Array, Array]:
        """(u_n, u_n)."""
        return u, u


@dataclass(frozen=True)
class BackwardEuler(_AtTheEnd):
    """v = (u - u_n) / dt, a = (v - v_n) / dt: first order, L-stable, loses energy (the scheme of M22)."""

    inertia: ClassVar[bool] = True

    def rates(self, dt: float) -> tuple[float, float]:
        """(1 / dt^2, 1 / dt)."""
        return 1 / dt**2, 1 / dt

    def references(self, dt: float, u: Array, v: Array, a: Array) -> tuple[Array, Array]:
        """(u_n + dt v_n, u_n)."""
        return u + dt * v, u


@dataclass(frozen=True)
class Newmark(_AtTheEnd):
    """Newmark 1959: u = u_n + dt v_n + dt^2 ((1/2 - beta) a_n + beta a), v = v_n + dt ((1 - gamma) a_n + gamma a).

    beta = 1/4, gamma = 1/2 is the trapezoidal rule: second order, conserves the energy of a linear body.
    gamma > 1/2 dissipates and is of first order.
    """

    beta: float = 0.25
    gamma: float = 0.5
    inertia: ClassVar[bool] = True
    rings: ClassVar[bool] = True
    remembers: ClassVar[bool] = True

    def rates(self, dt: float) -> tuple[float, float]:
        """(1 / (beta dt^2), gamma / (beta dt))."""
        return 1 / (self.beta * dt**2), self.gamma / (self.beta * dt)

    def references(self, dt: float, u: Array, v: Array, a: Array) -> tuple[Array, Array]:
        """u_a = u_n + dt v_n + dt^2 (1/2 - beta) a_n;  u_v = u_a - beta dt / gamma (v_n + dt (1 - gamma) a_n)."""
        u_a = u + dt * v + (0.5 - self.beta) * dt**2 * a
        return u_a, u_a - (self.beta * dt / self.gamma) * (v + (1 - self.gamma) * dt * a)


@dataclass(frozen=True)
class GeneralizedAlpha:
    """Chung and Hulbert 1993: second order, with the dissipation of high frequencies set by rho, 0 to 1.

    Newmark's formulae with forces balanced inside the step, M a_{n+1-am} + f(u_{n+1-af}) = f_ext(t_{n+1-af}), where
    am = (2 rho - 1)/(rho + 1), af = rho/(rho + 1), gamma = 1/2 - am + af, beta = (1 - am + af)^2 / 4. The amplitude of
    a mode far above 1/dt shrinks by rho a step; rho = 1 is the trapezoidal rule at the mid-point.
    """

    rho: float = 0.8
    inertia: ClassVar[bool] = True
    rings: ClassVar[bool] = True
    remembers: ClassVar[bool] = True
    implicit: ClassVar[bool] = True

    @property
    def alpha_m(self) -> float:
        """am."""
        return (2 * self.rho - 1) / (self.rho + 1)

    @property
    def alpha_f(self) -> float:
        """af."""
        return self.rho / (self.rho + 1)

    @property
    def newmark(self) -> Newmark:
        """The formulae that join u, v and a at the ends of the step."""
        shift = self.alpha_f - self.alpha_m
        return Newmark((1 + shift) ** 2 / 4, 0.5 + shift)

    def rates(self, dt: float) -> tuple[float, float]:
        """((1 - am) / ((1 - af) beta dt^2), gamma / (beta dt)): of a at the level am and v at the level af."""
        c_a, c_v = self.newmark.rates(dt)
        return c_a * (1 - self.alpha_m) / (1 - self.alpha_f), c_v

    def references(self, dt: float, u: Array, v: Array, a: Array) -> tuple[Array, Array]:
        """x for which a_{n+1-am} vanishes, and x for which v_{n+1-af} does."""
        (c_a, c_v), (u_a, u_v) = self.newmark.rates(dt), self.newmark.references(dt, u, v, a)
        still = u_a - self.alpha_m / (1 - self.alpha_m) / c_a * a
        rest = u_v - self.alpha_f / (1 - self.alpha_f) / c_v * v
        return self._level(still, u), self._level(rest, u)

    def finish(self, dt: float, x: Array, u: Array, v: Array, a: Array) -> tuple[Array, Array, Array]:
        """u_{n+1} = (x - af u_n) / (1 - af), with Newmark's v and a."""
        return self.newmark.finish(dt, (x - self.alpha_f * u) / (1 - self.alpha_f), u, v, a)

    def _level(self, end: Array, start: Array) -> Array:
        return (1 - self.alpha_f) * end + self.alpha_f * start


@dataclass(frozen=True)
class CentralDifference(_AtTheEnd):
    """Explicit central differences in velocity Verlet form: u moves by v and a of the start, then a follows from u.

    u = u_n + dt v_n + dt^2/2 a_n,  M a = f_ext - f_int(u) - C v_{n+1/2},  v = v_n + dt/2 (a_n + a). Second order,
    stable for dt < 2 / omega_max, no system to solve. `rates` serve damping only.
    """

    inertia: ClassVar[bool] = True
    implicit: ClassVar[bool] = False
    remembers: ClassVar[bool] = True

    def rates(self, dt: float) -> tuple[float, float]:
        """(0, 1/dt): inertia is not part of the assembled forces."""
        return 0.0, 1 / dt

    def references(self, dt: float, u: Array, v: Array, a: Array) -> tuple[Array, Array]:
        """(u_n, u_n)."""
        return u, u
