"""Stable step of explicit time integration, and speed of Rayleigh waves, which bounds cracks. Without DOLFINx.

The stable step is from bounds on the frequencies of single cells: no assembled body has a higher frequency than its
fastest cell on its own (Irons and Treharne 1971, A bound theorem in eigenvalues and its practical applications).

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
    """(cells,) upper bounds of omega^2 of simplices on their own, 1/s^2; 0 for a cell without volume.

    A P1 simplex has lumped mass rho V / (d + 1) a node and energy V (mu |sym H|^2 + lambda/2 (tr H)^2), H = grad u.
    With L = sum_i g_i x g_i a nodal motion with gradient H has sum |u_i|^2 >= H : H L^-1 >= (tr H)^2 / tr L, hence
    omega^2 <= (d + 1) / rho (2 mu lmax(L) + lambda tr L).

    Args:
        corners: (cells, d + 1, d) positions, m.
        mu: first Lame parameter (shear modulus), Pa; a number or (cells,).
        lmbda: second Lame parameter, Pa; a number or (cells,).
        density: kg/m^3; a number or (cells,).
        factor: d + 1, or its counterpart for quadratic displacement.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        gradients = barycentric_gradients(corners)
        spread = np.einsum("nai,naj->nij", gradients, gradients)
    spread[~np.isfinite(spread).all(axis=(1, 2))] = 0.0
    largest, trace = np.linalg.eigvalsh(spread)[:, -1], np.trace(spread, axis1=1, axis2=2)
    return np.asarray(factor / density * (2 * mu * largest + lmbda * trace))


def stable_step(highest: float, a: float, b: float) -> float:
    """Stable step 2/omega (sqrt(1 + xi^2) - xi), s, with Rayleigh damping that lags by half a step.

    Args:
        highest: highest angular frequency omega, 1/s.
        a: mass-proportional damping, 1/s.
        b: stiffness-proportional damping, s; xi = (a/omega + b omega)/2.
    """
    if highest == 0:
        return float("inf")
    xi = (a / highest + b * highest) / 2
    # 2/omega / (sqrt(1 + xi^2) + xi) is the same without cancellation
    return 2 / highest / (math.hypot(1, xi) + xi)


def rayleigh_wave_speed[Numbers](shear: Numbers, poisson: Numbers) -> Numbers:
    """Return c_R, m/s, of waves along a free surface, which bounds the speed of an opening crack.

    c_R = c_s (0.862 + 1.14 nu) / (1 + nu) (Freund 1990), within 0.7 % of the root of Rayleigh's equation for nu >= 0.1,
    and 1.4 % at nu = 0.

    Args:
        shear: speed of shear waves c_s, m/s.
        poisson: Poisson's ratio nu; in plane stress that of the equivalent plane strain.
    """
    return shear * (0.862 + 1.14 * poisson) / (1 + poisson)  # type: ignore[operator]
