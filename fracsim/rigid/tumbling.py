"""How a rigid body turns in a step: by its angular momentum, which stays to round-off where nothing acts.

    l' = l + dt m,    R' = exp(dt w_m) R,   w_m = (R_m I R_m^T)^-1 (l + l') / 2,   R_m = exp(dt w_m / 2) R

the implicit midpoint rule, of second order and without a drift of the energy, found by fixed points: it converges where
a body turns by less than about a radian a step.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

Values = npt.NDArray[np.float64]

ROUNDS = 30
SAME = 1e-14  # change of the turn in a step, rad, that is none


def tumbled(turn: Values, inertia: Values, spin: Values, moment: Values, dt: float) -> tuple[Values, Values]:
    """(n, 3, 3) rotations and (n, 3) spins after a step of dt (s), from those before.

    `inertia`: (n, 3, 3) in the axes of the bodies, kg m^2.    `moment`: (n, 3) in the axes of space, N m.
    """
    if not len(turn):
        return turn, spin
    momentum = np.einsum("nij,nj->ni", _in_space(inertia, turn), spin)
    after = momentum + dt * moment
    middle, angle = (momentum + after) / 2, dt * spin
    for _ in range(ROUNDS):
        halfway = Rotation.from_rotvec(angle / 2).as_matrix() @ turn
        found = dt * np.linalg.solve(_in_space(inertia, halfway), middle[:, :, None])[:, :, 0]
        change, angle = float(np.abs(found - angle).max()), found
        if change < SAME:
            break
    turned = (Rotation.from_rotvec(angle) * Rotation.from_matrix(turn)).as_matrix()
    return turned, np.linalg.solve(_in_space(inertia, turned), after[:, :, None])[:, :, 0]


def _in_space(inertia: Values, turn: Values) -> Values:
    return np.asarray(turn @ inertia @ np.swapaxes(turn, 1, 2))
