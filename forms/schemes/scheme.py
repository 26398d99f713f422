"""Interface of a time scheme: displacement is the unknown; velocity and acceleration are affine functions of it.

Every implicit scheme is written as

    a = c_a (u - u_a),    v = c_v (u - u_v),

with numbers c_a (1/s^2), c_v (1/s) that depend on dt, and vectors u_a, u_v (m) that depend on the state at the start of
the step. Differences of displacements keep the digits at small dt, while sums with u / dt^2 lose them. The arrays may
be of any kind that adds and multiplies.

A scheme is a frozen dataclass and a line in SCHEMES. Its fields are its keys in [time]: numbers with a default, their
limits in `metadata` ("gt", "ge", "lt", "le") beside a "description".

Equations: docs/theory.md#time-integration.
"""

from __future__ import annotations

from dataclasses import Field, dataclass
from typing import Any, ClassVar, Protocol

Array = Any


class Scheme(Protocol):
    """Interface of a scheme; the unknown x is u at the level (1 - alpha_f) u_{n+1} + alpha_f u_n.

    Attributes:
        summary: one line for `fracsim list`.
        inertia: whether there is inertia.
        implicit: whether a step solves a system of equations.
        carries_acceleration: whether a step depends on the acceleration at its start.
    """

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]
    summary: ClassVar[str]
    inertia: ClassVar[bool]
    implicit: ClassVar[bool]
    carries_acceleration: ClassVar[bool]

    @property
    def alpha_f(self) -> float:
        """Weight of the start of the step in the balance of forces."""

    def check_parameters(self) -> None:
        """Check parameters that are each within their limits.

        Raises:
            ValueError: they do not fit together.
        """

    def rate_coefficients(self, dt: float) -> tuple[float, float]:
        """Return c_a (1/s^2) and c_v (1/s)."""

    def reference_displacements(self, dt: float, u: Array, v: Array, a: Array) -> tuple[Array, Array]:
        """Return u_a and u_v, m, from the state at the start of the step."""

    def complete_step(self, dt: float, x: Array, u: Array, v: Array, a: Array) -> tuple[Array, Array, Array]:
        """Return u, v and a at the end of the step from the solution x and the state at its start."""

    def prescribed_dof_rates(self, dt: float, u: Array, start: Array, v: Array) -> tuple[Array, Array] | None:
        """Return velocity and acceleration of dofs with prescribed displacement; None: those of `complete_step`.

        Args:
            dt: step, s.
            u: displacement at its end, m.
            start: displacement at its start, m.
            v: velocity at its start, m/s.
        """


def prescribed_rates(dt: float, u: Array, start: Array, v: Array) -> tuple[Array, Array]:
    """Return the mean velocity of prescribed dofs over a step, and its change over dt.

    The arguments are those of `Scheme.prescribed_dof_rates`.
    """
    # In some schemes a jump of a prescribed velocity would oscillate for ever, without damping.
    rate = (u - start) / dt
    return rate, (rate - v) / dt


class EndOfStepScheme:
    """Base of schemes that balance forces at the end of the step: x is u_{n+1}."""

    implicit: ClassVar[bool] = True
    carries_acceleration: ClassVar[bool] = False
    alpha_f: ClassVar[float] = 0.0

    def check_parameters(self) -> None:
        """Accept all parameters."""

    def complete_step(self: Any, dt: float, x: Array, u: Array, v: Array, a: Array) -> tuple[Array, Array, Array]:
        """Return x, c_v (x - u_v) and c_a (x - u_a)."""
        (c_a, c_v), (u_a, u_v) = self.rate_coefficients(dt), self.reference_displacements(dt, u, v, a)
        return x, c_v * (x - u_v), c_a * (x - u_a)

    def prescribed_dof_rates(self, dt: float, u: Array, start: Array, v: Array) -> tuple[Array, Array] | None:
        """Return None: prescribed dofs are completed like all others."""
        return None


@dataclass(frozen=True)
class Rigid(EndOfStepScheme):
    """Rigid bodies, strained by impacts alone (Bao et al. 2007); fracsim.rigid moves them.

    The class is there for studies and lists: no displacement is integrated.
    """

    summary: ClassVar[str] = "stiff bodies move rigidly, blows strain and break them; needs [brittle] to break"
    inertia: ClassVar[bool] = True

    def rate_coefficients(self, dt: float) -> tuple[float, float]:
        """Raise NotImplementedError: no displacement is integrated."""
        raise NotImplementedError("rigid bodies have no displacement to step")

    def reference_displacements(self, dt: float, u: Array, v: Array, a: Array) -> tuple[Array, Array]:
        """Raise NotImplementedError: no displacement is integrated."""
        raise NotImplementedError("rigid bodies have no displacement to step")
