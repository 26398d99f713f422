"""A damped linear oscillator u'' + a u' + w^2 (u + b u') = 0 moved by the Scheme protocol alone, and its exact
motion."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fracsim.forms.schemes import Scheme

Values = npt.NDArray[np.float64]


def run(
    scheme: Scheme, w: float, dt: float, steps: int, start: tuple[float, float], a: float = 0.0, b: float = 0.0
) -> Values:
    """(steps + 1, 3) u, v, acceleration from (u, v) at t = 0 with the acceleration of the equation there."""
    u, v = start
    drag = a + b * w**2
    rows = [(u, v, -(w**2) * u - drag * v)]
    c_a, c_v = scheme.rate_coefficients(dt)
    for _ in range(steps):
        u_a, u_v = scheme.reference_displacements(dt, *rows[-1])
        x = (c_a * u_a + drag * c_v * u_v) / (c_a + drag * c_v + w**2)
        rows.append(scheme.complete_step(dt, x, *rows[-1]))
    return np.array(rows)


def exact(w: float, t: Values | float, start: tuple[float, float], zeta: float = 0.0) -> Values:
    """u(t) of an underdamped oscillator: exp(-zeta w t) (u0 cos w_d t + (v0 + zeta w u0) / w_d sin w_d t)."""
    u, v = start
    damped = w * np.sqrt(1 - zeta**2)
    t = np.asarray(t)
    return np.exp(-zeta * w * t) * (u * np.cos(damped * t) + (v + zeta * w * u) / damped * np.sin(damped * t))


def slopes(errors: list[float]) -> Values:
    """Orders of convergence between successive halvings of the step."""
    return np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
