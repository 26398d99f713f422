"""External work and viscous dissipation of a step, for the energy balance of history.csv.

Equations: docs/theory.md#energy-balance.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..mechanics.balance import Balance
from .state import State

Values = npt.NDArray[np.float64]


def acting(balance: Balance, *, lumped: bool) -> tuple[Values, Values | None]:
    """(loads and reactions, damping forces) at the level of the step where they balance; (owned dofs,), N.

    Without the inertia of prescribed dofs where mass is `lumped` (`work_done`).
    """
    own = balance.motion.owned
    forces = balance.applied()
    forces[own] += balance.reactions[own]
    if lumped:
        forces[own] -= balance.mass.lumped[own] * balance.rates()[1][own]
    return forces, balance.drag()


def work_done(
    balance: Balance, start: State, u: Values, v: Values, forces: Values, drag: Values | None, *, lumped: bool
) -> tuple[float, float]:
    """External work and viscous dissipation of a step from `start` to u, v on this rank, J.

    Forces change linearly in time: those of this step (`forces`, `drag`) belong to t + (1 - alpha_f) dt, those of the
    last one to t - alpha_f dt; their line is taken at t + dt/2. Forces at the end of a step of generalized-alpha would
    not do, since they balance nothing: the pressure of a nearly incompressible body is off there by lambda |grad du|^2.

    The inertia of prescribed dofs, whose velocity may jump, is not among the forces where mass is `lumped`: what moves
    them is the gain of their kinetic energy.
    """
    late, own, increment = balance.scheme.alpha_f, balance.motion.owned, u - start.u
    gained = 0.0
    if lumped:
        gained = 0.5 * float(balance.mass.lumped[own] @ (v[own] ** 2 - start.v[own] ** 2))
    work = float(((0.5 + late) * forces + (0.5 - late) * start.forces) @ increment) + gained
    viscous = 0.0
    if drag is not None:
        earlier = start.drag if start.drag is not None else 0.0
        viscous = float(((0.5 + late) * drag + (0.5 - late) * earlier) @ increment)
    return work, viscous
