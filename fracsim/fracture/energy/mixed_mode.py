"""A tip in tension and sliding: where the crack turns, and what that releases beside going straight on (in the plane).

    K_k = E'/2 (- int t . Sigma_k grad q dA + int q rho a . (grad u_k) t dA)
    Sigma_k = (sigma : grad u_k) I - H^T sigma_k - (grad u_k)^T sigma

u_k, sigma_k: around the tip of a crack along t with K_k = 1 (Williams 1957); H = grad u (Stern, Becker and Dunham 1976;
with inertia Rethore et al. 2005). What does not belong to the tip, as the stress along the crack's sides or what loads
and ends at some distance make, drops out at any size of the disc. Mean stress around the tip, taken here before, says
K_II / K_I with the disc's size in it, and three times the scatter: 62 degrees of a crack that goes by 67 (kalthoff).

    psi = atan2(K_II, K_I)
    tan(t/2) = - 2 K_II / (K_I + (K_I^2 + 8 K_II^2)^1/2)        the greatest hoop stress (Erdogan and Sih 1963)
    K = cos(t/2) (K_I cos^2(t/2) - 3/2 K_II sin t)              of the crack that turns by t

The force along the crack, (K_I^2 + K_II^2) / E', is of growing straight on. In pure sliding the crack that turns
releases a third more. Where K_I < 0 the sides press on each other, and it has no part.

Equations: docs/theory.md#tension-and-sliding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Around:
    """What lies in discs: (pairs, ...) of a tip and a cell.

    Attributes:
        apart: (pairs, 2) from the tip to the cell, m.    tangent: (pairs, 2) t of the tip, of length 1.
        slope: (pairs, 2) V grad q, m.    inside: (pairs,) V q, m^2.
        stress: (pairs, 2, 2) Pa.    H: (pairs, 2, 2) grad u.    push: (pairs, 2) rho a, N/m^3.
        mu, kappa: (pairs,) shear modulus in Pa, and (lambda + 3 mu) / (lambda + mu).
    """

    apart: Values
    tangent: Values
    slope: Values
    inside: Values
    stress: Values
    H: Values
    push: Values
    mu: Values
    kappa: Values


def near_tip(places: Values, mu: Values, kappa: Values) -> Values:
    """(n, 2, 2, 2) grad u at places (n, 2) in m from the tip of a crack along - x, of K_I = 1 and of K_II = 1.

    2 mu (u_x + i u_y) = kappa phi - z conj(phi') - conj(psi), phi' = (K_I - i K_II) / 2 (2 pi z)^1/2 (Muskhelishvili).
    """
    z = places[:, 0] + 1j * places[:, 1]
    elsewhere = z != 0  # a tip in the very middle of a cell: what is infinite there is left out
    z = np.where(elsewhere, z, 1.0)
    root = 1 / (2 * np.sqrt(2 * np.pi * z))
    both = []
    for K in (1.0, -1.0j):
        first, mirrored = K * root, np.conj(K) * root
        second = -first / (2 * z)
        by_z = kappa * first - np.conj(first)
        by_conj = -z * np.conj(second) - np.conj(mirrored - first - z * second)
        by_x, by_y = by_z + by_conj, 1j * (by_z - by_conj)
        both.append(np.stack([by_x.real, by_y.real, by_x.imag, by_y.imag], axis=1).reshape(-1, 2, 2))
    return np.asarray(np.stack(both, axis=1) * (elsewhere / (2 * mu))[:, None, None, None])


def shares(around: Around) -> Values:
    """(pairs, 2) what each cell adds to K_I and K_II of its tip, Pa sqrt(m)."""
    t = around.tangent
    Q = np.stack([t, np.column_stack([-t[:, 1], t[:, 0]])], axis=1)
    slope, push, places = (np.einsum("pai,pi->pa", Q, x) for x in (around.slope, around.push, around.apart))
    stress, H = (Q @ x @ Q.transpose(0, 2, 1) for x in (around.stress, around.H))
    mu, kappa = around.mu, around.kappa
    field = near_tip(places, mu, kappa)
    strain = (field + field.transpose(0, 1, 3, 2)) / 2
    dilation = mu * (3 - kappa) / (kappa - 1) * np.einsum("pkii->kp", field)
    sigma = 2 * mu[:, None, None, None] * strain + dilation.T[..., None, None] * np.eye(2)
    energy = np.einsum("pij,pkij->pk", stress, field) * slope[:, :1]
    energy -= np.einsum("pi,pkij,pj->pk", H[:, :, 0], sigma, slope)
    energy -= np.einsum("pki,pij,pj->pk", field[..., 0], stress, slope)
    energy -= around.inside[:, None] * np.einsum("pi,pki->pk", push, field[..., 0])
    return np.asarray(-4 * (mu / (kappa + 1))[:, None] * energy)  # E' = 8 mu / (kappa + 1)


def turned_back(angle: Values, stress: Values, F: Values, push: Values) -> tuple[Values, Values, Values]:
    """Stress, grad u and rho a, (n, ...), where all has turned by angles (n,), as without that."""
    c, s = np.cos(angle), np.sin(angle)
    Q = np.stack([c, s, -s, c], axis=1).reshape(-1, 2, 2)
    return Q @ stress @ Q.transpose(0, 2, 1), Q @ F - np.eye(2), np.einsum("nij,nj->ni", Q, push)


def kink(psi: Values) -> Values:
    """(n,) the angle by which a crack turns, from its tangent, anti-clockwise."""
    first, second = np.maximum(np.cos(psi), 0.0), np.sin(psi)
    whole = first + np.sqrt(first**2 + 8 * second**2)
    return np.asarray(-2 * np.arctan2(2 * second, whole))


def gain(psi: Values) -> Values:
    """(n,) what the crack that turns releases, over that of growing straight on."""
    t = kink(psi)
    turned = np.cos(t / 2) * (np.maximum(np.cos(psi), 0.0) * np.cos(t / 2) ** 2 - 1.5 * np.sin(psi) * np.sin(t))
    return np.asarray(turned**2)
