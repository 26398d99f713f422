"""What a time scheme is: displacement at the end of a step is the unknown; velocity and acceleration are affine in it.

Every implicit scheme is written as

    a = c_a (u - u_a),    v = c_v (u - u_v),

with numbers c_a (1/s^2), c_v (1/s) that depend on dt and vectors u_a, u_v (m) that depend on the state at the start of
the step. Differences of displacements, not sums with u / dt^2, keep the digits at small dt. The arrays may be of any
kind that adds and multiplies.

A scheme is one file with a frozen dataclass, and one line in SCHEMES. Its fields are its keys in [time]: numbers with
a default, their limits in `metadata` ("gt", "ge", "lt", "le").

Equations: docs/theory.md#time-integration.
"""

from __future__ import annotations

from dataclasses import Field
from typing import Any, ClassVar, Protocol

Array = Any


class Scheme(Protocol):
    """What the stepper needs of a scheme. The unknown x is u at the level (1 - alpha_f) u_{n+1} + alpha_f u_n."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]
    summary: ClassVar[str]  # one line for `fracsim list`
    inertia: ClassVar[bool]
    implicit: ClassVar[bool]
    carries_acceleration: ClassVar[bool]  # a step goes on from the acceleration at its start

    @property
    def alpha_f(self) -> float: ...

    def check(self) -> None:
        """ValueError where the parameters, each within its limits, do not suit a study together."""

    def rates(self, dt: float) -> tuple[float, float]:
        """(c_a, c_v) in 1/s^2 and 1/s."""

    def references(self, dt: float, u: Array, v: Array, a: Array) -> tuple[Array, Array]:
        """(u_a, u_v) in m from the state at the start of the step."""

    def finish(self, dt: float, x: Array, u: Array, v: Array, a: Array) -> tuple[Array, Array, Array]:
        """(u, v, a) at the end of the step from the solved x and the state at its start."""

    def prescribed(self, dt: float, u: Array, start: Array, v: Array) -> tuple[Array, Array] | None:
        """(velocity, acceleration) over a step of dofs whose displacement is prescribed: `start` and u (m) at its ends,
        v before. None: those of `finish`."""


def driven(dt: float, u: Array, start: Array, v: Array) -> tuple[Array, Array]:
    """(velocity, acceleration) of prescribed dofs that move by their own law over a step.

    For schemes in which a jump of a prescribed velocity would not die out: they would swing about it for ever.
    """
    rate = (u - start) / dt
    return rate, (rate - v) / dt


class AtTheEnd:
    """Schemes that balance forces at the end of the step: x is u_{n+1} itself."""

    implicit: ClassVar[bool] = True
    carries_acceleration: ClassVar[bool] = False
    alpha_f: ClassVar[float] = 0.0

    def check(self) -> None:
        """Nothing to refuse."""

    def finish(self: Any, dt: float, x: Array, u: Array, v: Array, a: Array) -> tuple[Array, Array, Array]:
        """(x, c_v (x - u_v), c_a (x - u_a))."""
        (c_a, c_v), (u_a, u_v) = self.rates(dt), self.references(dt, u, v, a)
        return x, c_v * (x - u_v), c_a * (x - u_a)

    def prescribed(self, dt: float, u: Array, start: Array, v: Array) -> tuple[Array, Array] | None:
        """As all other dofs."""
        return None
