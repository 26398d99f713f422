"""What broken edges no longer hold, of reactions and of accelerations, from which the next step starts.

M a of before would push for a part of it once more, with energy that is counted as dissipated. The acceleration
changes by c_a (c_a M + K)^-1 f of the forces f that the breaks released, K of the body before them: M^-1 f for motion
that steps resolve, with an error of second order, and as good as nothing for what is over long before the step's end.
M^-1 f itself, or K after the breaks, sets slivers and cells that hang by an edge ringing: energy that was kept to 1 %
doubled.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..mechanics.balance import Equilibrium
from .newton import Solver
from .state import State

Values = npt.NDArray[np.float64]


def release(equations: Equilibrium, solver: Solver | None, state: State, solved: Values, damage: list[Values]) -> None:
    """Bring forces and acceleration of the state to the damage of now; `damage`: as it was before (collective).

    Forces are those at `solved`, where a balances them: the end of a step of generalized-alpha is an extrapolation.
    """
    held = equations.held
    before = equations.unbalanced[held]
    equations.update_reactions()
    if not equations.scheme.remembers:
        state.forces[held] += equations.unbalanced[held] - before
        return
    equations.displace(solved)
    after = equations.internal_force()
    damage = equations.exchange_damage(damage)
    released = equations.internal_force() - after
    change = _acceleration(equations, solver, np.where(equations.free, released, 0.0))
    equations.exchange_damage(damage)
    equations.displace(state.u)
    state.forces[held] -= released[held]
    state.a = state.a + change


def _acceleration(equations: Equilibrium, solver: Solver | None, released: Values) -> Values:
    """(owned dofs,) what forces released at the start of a step add to a, m/s^2."""
    if solver is None:  # explicit steps resolve all motion
        return equations.inertia.solve(released, equations.free)
    return equations.c_a * solver.yielding(released)
