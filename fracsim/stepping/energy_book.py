"""External work and viscous dissipation of a step, for the energy balance of history.csv."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..mechanics.balance import Equilibrium
from .state import State

Values = npt.NDArray[np.float64]


def acting(equations: Equilibrium, lumped: bool) -> tuple[Values, Values | None]:
    """(loads and reactions, damping forces) at the level of the step where they balance; (owned dofs,), N.

    Without the inertia of prescribed dofs where mass is `lumped` (`work_done`).
    """
    held = equations.held
    forces = equations.applied_force().copy()
    forces[held] += equations.unbalanced[held]
    if lumped:
        forces[held] -= equations.mass[held] * equations.rates()[1][held]
    return forces, equations.viscous_force()


def work_done(
    equations: Equilibrium,
    state: State,
    increment: Values,
    v: Values,
    forces: Values,
    drag: Values | None,
    *,
    lumped: bool,
) -> tuple[float, float]:
    """External work and viscous dissipation of the step on this rank, J, with forces that change linearly in time.

    Those of this step (`forces`, `drag`) belong to t + (1 - alpha_f) dt, those of the last one to t - alpha_f dt; their
    line is taken at t + dt/2. Forces at the end of a step of generalized-alpha would not do, since they balance
    nothing: the pressure of a nearly incompressible body is off there by lambda |grad du|^2.

    The inertia of prescribed dofs, whose velocity (`v` at the start) may jump, is not among the forces where mass is
    `lumped`: what moves them is the gain of their kinetic energy.
    """
    late, held = equations.scheme.alpha_f, equations.held
    gained = 0.0
    if lumped:
        gained = 0.5 * float(equations.mass[held] @ (state.v[held] ** 2 - v[held] ** 2))
    work = float(((0.5 + late) * forces + (0.5 - late) * state.forces) @ increment) + gained
    viscous = 0.0
    if drag is not None:
        earlier = state.drag if state.drag is not None else 0.0
        viscous = float(((0.5 + late) * drag + (0.5 - late) * earlier) @ increment)
    state.forces, state.drag = forces, drag
    return work, viscous
