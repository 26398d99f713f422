"""External work and viscous dissipation of a step, for the energy balance of history.csv.

Equations: docs/theory.md#energy-balance.

What broken edges no longer hold, of reactions and of accelerations, from which the next step starts.

M a of before would push for a part of it once more, with energy that is counted as dissipated. The acceleration
changes by c_a (c_a M + K)^-1 f of the forces f that the breaks released, K of the body before them: M^-1 f for motion
that steps resolve, with an error of second order, and as good as nothing for what is over long before the step's end.
M^-1 f itself, or K after the breaks, sets slivers and cells that hang by an edge ringing: energy that was kept to 1 %
doubled. Contact is not in K: blows (mechanics.contact_time_weights) are no part of the acceleration that is carried,
and what it loses by breaks inside a body has no resultant.

Equations: docs/theory.md#time-integration.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from ..mechanics.balance import Balance
from ..mechanics.term_protocols import SurfaceSeparator
from .state import State

Values = npt.NDArray[np.float64]


def balanced_forces(balance: Balance, *, lumped: bool) -> tuple[Values, Values | None]:
    """(loads and reactions, damping forces) at the level of the step where they balance; (owned dofs,), N.

    Without the inertia of prescribed dofs where mass is `lumped` (`work_done`).
    """
    owned = balance.motion.owned_dofs
    forces = balance.energies.applied_forces()
    forces[owned] += balance.reactions[owned]
    if lumped:
        forces[owned] -= balance.mass.lumped[owned] * balance.rates()[1][owned]
    return forces, balance.energies.damping_forces()


def step_work(
    balance: Balance, start: State, u: Values, v: Values, forces: Values, drag: Values | None, *, lumped: bool
) -> tuple[float, float]:
    """External work and viscous dissipation of a step from `start` to u, v on this rank, J.

    Forces change linearly in time: those of this step (`forces`, `drag`) belong to t + (1 - alpha_f) dt, those of the
    last one to t - alpha_f dt; their line is taken at t + dt/2. Forces at the end of a step of generalized-alpha would
    not do, since they balance nothing: the pressure of a nearly incompressible body is off there by lambda |grad du|^2.

    The inertia of prescribed dofs, whose velocity may jump, is not among the forces where mass is `lumped`: what moves
    them is the gain of their kinetic energy.
    """
    late, owned, increment = balance.scheme.alpha_f, balance.motion.owned_dofs, u - start.u
    gained = 0.0
    if lumped:
        gained = 0.5 * float(balance.mass.lumped[owned] @ (v[owned] ** 2 - start.v[owned] ** 2))
    work = float(((0.5 + late) * forces + (0.5 - late) * start.forces) @ increment) + gained
    viscous = 0.0
    if drag is not None:
        earlier = start.drag if start.drag is not None else 0.0
        viscous = float(((0.5 + late) * drag + (0.5 - late) * earlier) @ increment)
    return work, viscous


def released_state(
    balance: Balance,
    end: State,
    solved: Values,
    before: Sequence[Values],
    response: Callable[[Values], Values] | None,
) -> State:
    """The end of a step with the forces and the acceleration that belong to the damage of now (collective).

    `before`: the fields of damage as they were. `solved`: (owned dofs,) displacement at which the step's forces
    balance; the end of a step of generalized-alpha is an extrapolation. `response`: displacement that forces (owned
    dofs,) cause in a step, linearly; None where steps resolve all motion (explicit ones).
    """
    owned, forces = balance.motion.owned_dofs, end.forces.copy()
    reactions = balance.reactions[owned]
    balance.update_reactions()
    if not balance.scheme.carries_acceleration:
        forces[owned] += balance.reactions[owned] - reactions
        return replace(end, forces=forces)
    free = balance.motion.free_dofs
    if response is None:  # forces balance at the end of the step, where the body is
        lost = balance.stress.assemble_released_forces(before)
        change = balance.mass.solve(np.where(free, lost, 0.0), free)
    else:
        balance.set_displacement(solved)
        lost = balance.stress.assemble_released_forces(before)
        current = balance.stress.exchange_damage(before)
        if any(isinstance(term, SurfaceSeparator) for term in balance.terms):
            balance.set_displacement(end.u)  # gaps are open at the step's end, and need not be where forces balance
        change = balance.c_a * response(np.where(free, lost, 0.0))
        balance.stress.exchange_damage(current)
        balance.set_displacement(end.u)
    forces[owned] -= lost[owned]
    return replace(end, forces=forces, a=end.a + change)
