"""Mixed-mode crack tips in 2D: stress intensity factors, the kink angle, and the energy that the kink releases.

    K_k = E'/2 (- int t . Sigma_k grad q dA + int q rho a . (grad u_k) t dA)
    Sigma_k = (sigma : grad u_k) I - H^T sigma_k - (grad u_k)^T sigma

u_k, sigma_k is the field around the tip of a crack along t with K_k = 1 (Williams 1957), and H = grad u (Stern, Becker
and Dunham 1976; with inertia Rethore et al. 2005). Fields that do not belong to the tip, such as the stress along the
crack faces, drop out at any size of the disc.

    psi = atan2(K_II, K_I)
    K_k(t) = F_kI(t) K_I + F_kII(t) K_II        at the tip of a kink by t that is short (Amestoy and Leblond 1992)

The crack turns to the t of the largest K_I(t)^2 + K_II(t)^2. The force along the crack, (K_I^2 + K_II^2) / E', is that
of straight growth: in pure sliding a kink by 75.8 degrees releases 1.517 times as much. Where K_I < 0 the crack faces
press on each other, and K_I counts as 0.

Equations: docs/theory.md#tension-and-sliding.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from math import pi

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class TipDiscFields:
    """Fields in the discs of tips, one row for each pair of a tip and a cell.

    Attributes:
        apart: (pairs, 2) from the tip to the cell, m.
        tangent: (pairs, 2) unit tangent t of the crack at the tip.
        slope: (pairs, 2) V grad q, m.
        inside: (pairs,) V q, m^2.
        stress: (pairs, 2, 2) Cauchy stress, Pa.
        H: (pairs, 2, 2) displacement gradient.
        inertia_force: (pairs, 2) rho a, N/m^3.
        mu: (pairs,) shear modulus, Pa.
        kappa: (pairs,) (lambda + 3 mu) / (lambda + mu).
    """

    apart: Values
    tangent: Values
    slope: Values
    inside: Values
    stress: Values
    H: Values
    inertia_force: Values
    mu: Values
    kappa: Values


def auxiliary_gradients(positions: Values, mu: Values, kappa: Values) -> Values:
    """Return grad u (n, 2, 2, 2) of the fields with K_I = 1 and with K_II = 1, at positions (n, 2), m, from the tip.

    The crack lies along -x. 2 mu (u_x + i u_y) = kappa phi - z conj(phi') - conj(psi) with
    phi' = (K_I - i K_II) / 2 (2 pi z)^1/2 (Muskhelishvili). Units: 1 / (Pa sqrt(m)).
    """
    z = positions[:, 0] + 1j * positions[:, 1]
    # A tip may be the very centroid of a cell, where the field is infinite: that cell is left out.
    is_finite = z != 0
    z = np.where(is_finite, z, 1.0)
    root = 1 / (2 * np.sqrt(2 * np.pi * z))
    modes = []
    for K in (1.0, -1.0j):
        first, mirrored = K * root, np.conj(K) * root
        second = -first / (2 * z)
        by_z = kappa * first - np.conj(first)
        by_conj = -z * np.conj(second) - np.conj(mirrored - first - z * second)
        by_x, by_y = by_z + by_conj, 1j * (by_z - by_conj)
        modes.append(np.stack([by_x.real, by_y.real, by_x.imag, by_y.imag], axis=1).reshape(-1, 2, 2))
    return np.asarray(np.stack(modes, axis=1) * (is_finite / (2 * mu))[:, None, None, None])


def intensity_contributions(fields: TipDiscFields) -> Values:
    """Return the contributions (pairs, 2) of cells to K_I and K_II of their tips, Pa sqrt(m)."""
    t = fields.tangent
    # Rotation to axes along and across the crack.
    Q = np.stack([t, np.column_stack([-t[:, 1], t[:, 0]])], axis=1)
    slope, inertia_force, positions = (
        np.einsum("pai,pi->pa", Q, vectors) for vectors in (fields.slope, fields.inertia_force, fields.apart)
    )
    stress, H = (Q @ tensors @ Q.transpose(0, 2, 1) for tensors in (fields.stress, fields.H))
    mu, kappa = fields.mu, fields.kappa
    gradient = auxiliary_gradients(positions, mu, kappa)
    strain = (gradient + gradient.transpose(0, 1, 3, 2)) / 2
    # lambda tr(eps) with lambda = mu (3 - kappa) / (kappa - 1).
    dilation = mu * (3 - kappa) / (kappa - 1) * np.einsum("pkii->kp", gradient)
    sigma = 2 * mu[:, None, None, None] * strain + dilation.T[..., None, None] * np.eye(2)
    # The four terms of t . Sigma_k grad q and of the inertia, in axes along the crack.
    energy = np.einsum("pij,pkij->pk", stress, gradient) * slope[:, :1]
    energy -= np.einsum("pi,pkij,pj->pk", H[:, :, 0], sigma, slope)
    energy -= np.einsum("pki,pij,pj->pk", gradient[..., 0], stress, slope)
    energy -= fields.inside[:, None] * np.einsum("pi,pki->pk", inertia_force, gradient[..., 0])
    return np.asarray(-4 * (mu / (kappa + 1))[:, None] * energy)  # E' = 8 mu / (kappa + 1)


def rotate_back(angle: Values, stress: Values, F: Values, inertia_force: Values) -> tuple[Values, Values, Values]:
    """Return stress, grad u and rho a (n, ...) without the rotation by angles (n,), rad."""
    c, s = np.cos(angle), np.sin(angle)
    Q = np.stack([c, s, -s, c], axis=1).reshape(-1, 2, 2)
    return Q @ stress @ Q.transpose(0, 2, 1), Q @ F - np.eye(2), np.einsum("nij,nj->ni", Q, inertia_force)


def phase_angles(intensities: Values) -> Values:
    """Return psi = atan2(K_II, K_I) (n,), rad, of stress intensities (n, 2)."""
    return np.asarray(np.arctan2(intensities[:, 1], intensities[:, 0]))


def kink_matrix(angle: Values) -> Values:
    """Return F (n, 2, 2), which takes K_I and K_II of a crack to those of a short kink by angles (n,), rad.

    Series in m = angle / pi (Amestoy and Leblond 1992, equation 66), valid up to 80 degrees.
    """
    m = np.asarray(angle) / pi
    even = m[:, None] ** np.arange(0, 22, 2)
    odd = m[:, None] ** np.arange(1, 21, 2)
    return np.stack([even @ _F_11, odd @ _F_12, odd @ _F_21, even @ _F_22], axis=1).reshape(-1, 2, 2)


_F_11 = np.array([
    1, -3 * pi**2 / 8, pi**2 - 5 * pi**4 / 128, pi**2 / 9 - 11 * pi**4 / 72 + 119 * pi**6 / 15360, 5.07790, -2.88312,
    -0.0925, 2.996, -4.059, 1.63, 4.1,
])  # fmt: skip
_F_12 = np.array([
    -3 * pi / 2, 10 * pi / 3 + pi**3 / 16, -2 * pi - 133 * pi**3 / 180 + 59 * pi**5 / 1280, 12.313906, -7.32433, 1.5793,
    4.0216, -6.915, 4.21, 4.56,
])  # fmt: skip
_F_21 = np.array([
    pi / 2, -4 * pi / 3 - pi**3 / 48, -2 * pi / 3 + 13 * pi**3 / 30 - 59 * pi**5 / 3840, -6.176023, 4.44112, -1.5340,
    -2.0700, 4.684, -3.95, -1.32,
])  # fmt: skip
_F_22 = np.array([
    1, -4 - 3 * pi**2 / 8, 8 / 3 + 29 * pi**2 / 18 - 5 * pi**4 / 128,
    -32 / 15 - 4 * pi**2 / 9 - 1159 * pi**4 / 7200 + 119 * pi**6 / 15360, 10.58254, -4.78511, -1.8804, 7.280, -7.591,
    0.25, 12.5,
])  # fmt: skip


@cache
def _kink_table() -> tuple[Values, Values, Values]:
    """Return phase angles (361,) from 0 to pi / 2, and the kinks' angles, rad, and energy release rates there."""
    # Up to 80 degrees.
    angle: Values = np.asarray(np.linspace(0, 4 / 9 * pi, 8001), np.float64)
    psi: Values = np.asarray(np.linspace(0, pi / 2, 361), np.float64)
    K = kink_matrix(-angle) @ np.array([np.cos(psi), np.sin(psi)])
    released: Values = np.einsum("nij,nij->nj", K, K)
    best = released.argmax(axis=0)
    return psi, np.asarray(angle[best]), np.asarray(released[best, np.arange(len(psi))])


def kink_angle(psi: Values) -> Values:
    """Return the kink angle (n,), rad, anti-clockwise from the tangent, at phase angles psi (n,)."""
    phases, angles, _ = _kink_table()
    # A closed crack has no K_I.
    return -np.sign(np.sin(psi)) * np.interp(np.arctan2(np.abs(np.sin(psi)), np.cos(psi)), phases, angles)


def kink_gain(psi: Values) -> Values:
    """Return the energy release of the kinked crack over that of straight growth (n,), at phase angles psi (n,)."""
    phases, _, gains = _kink_table()
    closed = np.where(np.cos(psi) < 0, np.sin(psi) ** 2, 1.0)
    return closed * np.interp(np.arctan2(np.abs(np.sin(psi)), np.cos(psi)), phases, gains)
