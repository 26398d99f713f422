"""A tip in tension and sliding: where the crack turns, and what that releases beside going straight on (in the plane).

    sigma_nn = c_1 K_I, sigma_nt = c_2 K_II, averaged around a tip;   psi = atan2(K_II, K_I)
    tan(t/2) = - 2 K_II / (K_I + (K_I^2 + 8 K_II^2)^1/2)        the greatest hoop stress (Erdogan and Sih 1963)
    K = cos(t/2) (K_I cos^2(t/2) - 3/2 K_II sin t)              of the crack that turns by t

The force along the crack, (K_I^2 + K_II^2) / E', is of growing straight on. In pure sliding the crack that turns
releases a third more. Across it the force is - 2 K_I K_II / E' and what the stress along the crack's sides adds: a disc
has as much of it as of K_II where that stress is large (a blow along a notch), so that it has no part.
Where K_I < 0 the sides press on each other, and it has no part.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[np.float64]

# (1 / 2 pi) int cos(t/2) (1 +- sin(t/2) sin(3t/2)) dt = 2/pi (1 +- 1/5), of sigma_nn and sigma_nt over (2 pi r)^1/2
NORMAL, SHEAR = 2.4 / np.pi, 1.6 / np.pi


def phase(stress: Values, tangent: Values) -> Values:
    """(n,) psi from stress (n, 2, 2) averaged around tips that go along unit vectors (n, 2)."""
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    opening = np.einsum("ni,nij,nj->n", normal, stress, normal) / NORMAL
    sliding = np.einsum("ni,nij,nj->n", tangent, stress, normal) / SHEAR
    return np.arctan2(sliding, opening)


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
