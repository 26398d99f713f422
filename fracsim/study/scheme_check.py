"""Check of a time scheme of the user: uniform motion, convergence, and stability of an oscillator in long steps."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

from ..errors import InputError

_MEMBERS = (
    "inertia", "implicit", "carries_acceleration", "alpha_f", "check_parameters", "rate_coefficients",
    "reference_displacements", "complete_step", "prescribed_dof_rates",
)  # fmt: skip


def check_scheme(scheme: Any, label: str) -> None:
    """Check an implicit scheme (forms.schemes.Scheme).

    Raises:
        InputError: that begins with `label`, if something is missing or wrong.
    """
    if missing := [name for name in _MEMBERS if not hasattr(scheme, name)]:
        raise InputError(f"{label} has no {missing[0]}; derive it from fracsim.forms.schemes.EndOfStepScheme")
    if not scheme.implicit:
        raise InputError(f"{label} is explicit, and explicit steps are those of the program: implicit = True is needed")
    try:
        scheme.check_parameters()
        wrong = _uniform_motion_fault(scheme) or (_oscillator_fault(scheme) if scheme.inertia else "")
    except (ArithmeticError, TypeError, ValueError) as error:
        raise InputError(f"{label}: {error}") from error
    if wrong:
        raise InputError(f"{label} {wrong}")


def _uniform_motion_fault(scheme: Any) -> str:
    """Return what is wrong with a step of a body in uniform motion; empty: nothing."""
    (c_a, c_v), dt, u, v = scheme.rate_coefficients(0.5), 0.5, 1.0, 2.0
    half = scheme.rate_coefficients(0.25)
    if not (_near(half[0], 4 * c_a) and _near(half[1], 2 * c_v)):
        return "has rates c_a and c_v that are not in proportion to 1 / dt^2 and 1 / dt"
    x = u + (1 - scheme.alpha_f) * dt * v
    u_a, u_v = scheme.reference_displacements(dt, u, v, 0.0)
    end, velocity, acceleration = scheme.complete_step(dt, x, u, v, 0.0)
    if not (_near(c_v * (x - u_v), v) and _near(1 + c_a * (x - u_a), 1)):
        return "does not keep a uniform motion: c_v (u - u_v) is to be v, and c_a (u - u_a) 0"
    if not (_near(end, u + dt * v) and _near(velocity, v) and _near(1 + acceleration, 1)):
        return "does not complete a step of uniform motion: u + dt v, v and 0 are needed"
    return ""


def _oscillator_fault(scheme: Any) -> str:
    """Return what is wrong with the motion u'' = -u from u = 1 at rest, u = cos t; empty: nothing."""
    # When steps are halved, errors fall by a factor of 1.7 at least.
    errors = [abs(_oscillate(scheme, 2.0 / steps, steps)[0] - math.cos(2.0)) for steps in (50, 100, 200)]
    if errors[0] > 0.2 or any(after > 1e-9 and before < 1.7 * after for before, after in pairwise(errors)):
        listed = ", ".join(f"{error:.2g}" for error in errors)
        return f"does not converge: with steps of 0.04, 0.02 and 0.01 an oscillator is off by {listed}"
    for dt in (1.0, 5.0, 50.0):
        if not (largest := _oscillate(scheme, dt, 200)[1]) <= 2:
            return f"is not stable: in 200 steps of omega dt = {dt:g} an oscillator grows from 1 to {largest:.3g}"
    return ""


def _oscillate(scheme: Any, dt: float, steps: int) -> tuple[float, float]:
    """Return the displacement of u'' = -u after some steps, and the largest on the way."""
    u, v, a, largest = 1.0, 0.0, -1.0, 1.0
    c_a, _ = scheme.rate_coefficients(dt)
    for _ in range(steps):
        u_a, _ = scheme.reference_displacements(dt, u, v, a)
        x = c_a * u_a / (c_a + 1)
        u, v, a = scheme.complete_step(dt, x, u, v, a)
        largest = max(largest, abs(u))
    return u, largest


def _near(value: float, expected: float) -> bool:
    return math.isclose(value, expected, rel_tol=1e-12)
