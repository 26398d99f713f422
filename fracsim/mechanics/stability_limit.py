"""The stable step of explicit time integration, from bounds on how fast single cells vibrate. No DOLFINx here.

No assembled body is faster than its fastest cell on its own (Irons and Treharne 1971).

Equations: docs/theory.md#stable-time-step.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from ..mesh.small_matrices import barycentric_gradients

Values = npt.NDArray[np.float64]

SAFETY = 0.9  # of the stable step: the bound is that of linear elasticity on the current shape


def frequency_bounds(
    corners: Values, mu: float | Values, lmbda: float | Values, density: float | Values, factor: float
) -> Values:
    """(cells,) upper bounds of omega^2 of simplices with corners (cells, d + 1, d) on their own, 1/s^2.

    A P1 simplex has lumped mass rho V / (d + 1) a node and energy V (mu |sym H|^2 + lambda/2 (tr H)^2), H = grad u.
    With L = sum_i g_i x g_i a nodal motion with gradient H has sum |u_i|^2 >= H : H L^-1 >= (tr H)^2 / tr L,
    hence omega^2 <= (d + 1) / rho (2 mu lmax(L) + lambda tr L). `factor`: d + 1, or what takes its place with quadratic
    displacement. A cell without volume has no bound: 0.

    Args:
        mu, lmbda: Lame's parameters, Pa.    density: kg/m^3; numbers, or (cells,).
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        gradients = barycentric_gradients(corners)
        spread = np.einsum("nai,naj->nij", gradients, gradients)
    spread[~np.isfinite(spread).all(axis=(1, 2))] = 0.0
    largest, trace = np.linalg.eigvalsh(spread)[:, -1], np.trace(spread, axis1=1, axis2=2)
    return np.asarray(factor / density * (2 * mu * largest + lmbda * trace))


def stable_step(highest: float, a: float, b: float) -> float:
    """2/omega (sqrt(1 + xi^2) - xi) in s of the highest omega in 1/s, xi = (a/omega + b omega)/2 of Rayleigh damping
    taken half a step late; as 2/omega / (sqrt(1 + xi^2) + xi), which does not cancel."""
    if highest == 0:
        return float("inf")
    xi = (a / highest + b * highest) / 2
    return 2 / highest / (math.hypot(1, xi) + xi)
