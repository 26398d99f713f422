"""The generalized-alpha method.

J. Chung, G. M. Hulbert: A time integration algorithm for structural dynamics with improved numerical dissipation: the
generalized-alpha method. J. Appl. Mech. 60 (1993) 371-375.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from .newmark import Newmark
from .scheme import Array, driven


@dataclass(frozen=True)
class GeneralizedAlpha:
    """Second order, with the dissipation of high frequencies set by rho, 0 to 1.

    Newmark's formulae with forces balanced inside the step, M a_{n+1-am} + f(u_{n+1-af}) = f_ext(t_{n+1-af}), where
    am = (2 rho - 1)/(rho + 1), af = rho/(rho + 1), gamma = 1/2 - am + af, beta = (1 - am + af)^2 / 4. The amplitude of
    a mode far above 1/dt shrinks by rho a step; rho = 1 is the trapezoidal rule at the mid-point.
    """

    rho: float = field(
        default=0.8,
        metadata={
            "ge": 0,
            "le": 1,
            "description": "Of `generalized-alpha`: amplitude of the fastest vibrations after a step.",
        },
    )
    summary: ClassVar[str] = "second order; rho sets how much of the fastest modes is left after a step"
    inertia: ClassVar[bool] = True
    carries_acceleration: ClassVar[bool] = True
    implicit: ClassVar[bool] = True

    def check(self) -> None:
        """Nothing to refuse: stable for every step and rho."""

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

    def prescribed(self, dt: float, u: Array, start: Array, v: Array) -> tuple[Array, Array] | None:
        """By their own law."""
        return driven(dt, u, start, v)

    def _level(self, end: Array, start: Array) -> Array:
        return (1 - self.alpha_f) * end + self.alpha_f * start
