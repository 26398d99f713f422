"""Time schemes: displacement is the unknown; velocity and acceleration are affine functions of it.

Every implicit scheme is written as

    a = c_a (u - u_a),    v = c_v (u - u_v),

with numbers c_a (1/s^2), c_v (1/s) that depend on dt, and vectors u_a, u_v (m) that depend on the state at the start of
the step. Differences of displacements keep the digits at small dt, while sums with u / dt^2 lose them. The arrays may
be of any kind that adds and multiplies.

A scheme is a frozen dataclass and a line in SCHEMES, by the name of `time.scheme`. Its fields are its keys in [time]:
numbers with a default, their limits in `metadata` ("gt", "ge", "lt", "le") beside a "description".

N. M. Newmark (1959), A method of computation for structural dynamics, J. Eng. Mech. Div. (ASCE) 85, 67-94. J. Chung, G.
M. Hulbert (1993), A time integration algorithm for structural dynamics with improved numerical dissipation: the
generalized-alpha method, J. Appl. Mech. 60, 371-375. L. Verlet (1967), Computer "experiments" on classical fluids,
Phys. Rev. 159, 98-103.

Equations: docs/theory.md#time-integration.
"""

from __future__ import annotations

from dataclasses import Field, dataclass, field
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


@dataclass(frozen=True)
class Newmark(EndOfStepScheme):
    """u = u_n + dt v_n + dt^2 ((1/2 - beta) a_n + beta a), v = v_n + dt ((1 - gamma) a_n + gamma a).

    beta = 1/4, gamma = 1/2 is the trapezoidal rule: second order, it conserves the energy of a linear body. gamma > 1/2
    dissipates and is of first order. Every step is stable if 2 beta >= gamma >= 1/2 (Hughes 1987, The Finite Element
    Method, section 9.1).
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

    def check_parameters(self) -> None:
        """Check that every step is stable.

        Raises:
            ValueError: beta < gamma / 2, for which only short steps are stable.
        """
        # 1e-12: rounding errors of beta and gamma as they are written.
        if 2 * self.beta < self.gamma - 1e-12:
            raise ValueError("newmark is stable for every step where beta >= gamma / 2; raise beta")

    def rate_coefficients(self, dt: float) -> tuple[float, float]:
        """Return 1 / (beta dt^2) and gamma / (beta dt)."""
        return 1 / (self.beta * dt**2), self.gamma / (self.beta * dt)

    def reference_displacements(self, dt: float, u: Array, v: Array, a: Array) -> tuple[Array, Array]:
        """Return u_a and u_v, m.

        u_a = u_n + dt v_n + dt^2 (1/2 - beta) a_n and u_v = u_a - beta dt / gamma (v_n + dt (1 - gamma) a_n).
        """
        u_a = u + dt * v + (0.5 - self.beta) * dt**2 * a
        return u_a, u_a - (self.beta * dt / self.gamma) * (v + (1 - self.gamma) * dt * a)

    def prescribed_dof_rates(self, dt: float, u: Array, start: Array, v: Array) -> tuple[Array, Array] | None:
        """Return the mean velocity over the step, and its change over dt."""
        return prescribed_rates(dt, u, start, v)


@dataclass(frozen=True)
class GeneralizedAlpha:
    """Second order, with a dissipation of high frequencies set by rho, 0 to 1.

    It has Newmark's formulae, and balances forces within the step: M a_{n+1-am} + f(u_{n+1-af}) = f_ext(t_{n+1-af})
    with am = (2 rho - 1)/(rho + 1), af = rho/(rho + 1), gamma = 1/2 - am + af, beta = (1 - am + af)^2 / 4. The
    amplitude of a mode far above 1/dt decreases by rho in a step; rho = 1 is the trapezoidal rule at the mid-point.
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

    def check_parameters(self) -> None:
        """Accept all parameters: every step is stable for every rho."""

    @property
    def alpha_m(self) -> float:
        """Weight am of the start of the step in the acceleration."""
        return (2 * self.rho - 1) / (self.rho + 1)

    @property
    def alpha_f(self) -> float:
        """Weight af of the start of the step in the forces."""
        return self.rho / (self.rho + 1)

    @property
    def newmark(self) -> Newmark:
        """Newmark's formulae for u, v and a at the ends of the step."""
        shift = self.alpha_f - self.alpha_m
        return Newmark((1 + shift) ** 2 / 4, 0.5 + shift)

    def rate_coefficients(self, dt: float) -> tuple[float, float]:
        """Return (1 - am) / ((1 - af) beta dt^2), of a at the level am, and gamma / (beta dt), of v at the level af."""
        c_a, c_v = self.newmark.rate_coefficients(dt)
        return c_a * (1 - self.alpha_m) / (1 - self.alpha_f), c_v

    def reference_displacements(self, dt: float, u: Array, v: Array, a: Array) -> tuple[Array, Array]:
        """Return x for which a_{n+1-am} vanishes, and x for which v_{n+1-af} vanishes."""
        (c_a, c_v), (u_a, u_v) = self.newmark.rate_coefficients(dt), self.newmark.reference_displacements(dt, u, v, a)
        without_acceleration = u_a - self.alpha_m / (1 - self.alpha_m) / c_a * a
        at_rest = u_v - self.alpha_f / (1 - self.alpha_f) / c_v * v
        return self._at_force_level(without_acceleration, u), self._at_force_level(at_rest, u)

    def complete_step(self, dt: float, x: Array, u: Array, v: Array, a: Array) -> tuple[Array, Array, Array]:
        """Return u_{n+1} = (x - af u_n) / (1 - af), with Newmark's v and a."""
        return self.newmark.complete_step(dt, (x - self.alpha_f * u) / (1 - self.alpha_f), u, v, a)

    def prescribed_dof_rates(self, dt: float, u: Array, start: Array, v: Array) -> tuple[Array, Array] | None:
        """Return the mean velocity over the step, and its change over dt."""
        return prescribed_rates(dt, u, start, v)

    def _at_force_level(self, end: Array, start: Array) -> Array:
        """Return (1 - af) end + af start."""
        return (1 - self.alpha_f) * end + self.alpha_f * start


@dataclass(frozen=True)
class CentralDifference(EndOfStepScheme):
    """Explicit central differences in velocity Verlet form: Newmark's formulae with beta = 0 and gamma = 1/2.

    u = u_n + dt v_n + dt^2/2 a_n,  M a = f_ext - f_int(u) - C v_{n+1/2},  v = v_n + dt/2 (a_n + a). Second order,
    stable for dt < 2 / omega_max, without a system to solve. `rate_coefficients` are used by damping alone.
    """

    summary: ClassVar[str] = "central differences, no system to solve; the step is cut to what the fastest cell allows"
    inertia: ClassVar[bool] = True
    implicit: ClassVar[bool] = False
    carries_acceleration: ClassVar[bool] = True

    def rate_coefficients(self, dt: float) -> tuple[float, float]:
        """Return 0 and 1/dt: inertia is not part of the assembled forces."""
        return 0.0, 1 / dt

    def reference_displacements(self, dt: float, u: Array, v: Array, a: Array) -> tuple[Array, Array]:
        """Return u_n and u_n."""
        return u, u


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


def conserves_energy(scheme: Scheme) -> bool:
    """Return whether a scheme has no numerical dissipation in a linear body; False for schemes of users."""
    match scheme:
        case QuasiStatic() | CentralDifference() | Newmark(gamma=0.5) | GeneralizedAlpha(rho=1):
            return True
        case _:
            return False


SCHEMES: dict[str, type[Scheme]] = {
    "backward-euler": BackwardEuler,
    "newmark": Newmark,
    "generalized-alpha": GeneralizedAlpha,
    "explicit": CentralDifference,
    "quasi-static": QuasiStatic,
    "rigid": Rigid,
}
