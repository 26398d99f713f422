"""State of a body between two time steps, and its initial velocity."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt

from ..mechanics.balance import Balance
from ..mesh.parallel import sum_over_ranks

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class State:
    """State of a body at time t. Arrays have the owned dofs and are never written to.

    Attributes:
        u: displacement, m.
        v: velocity, m/s.
        a: acceleration, m/s^2.
        t: time, s.
        step: number of steps taken.
        dt: size of the next step, s.
        dissipated: energy lost to fracture, plastic flow and damping, J, summed over the ranks.
        work: external work, J, summed over the ranks.
        easy_steps: successive steps without a reduction of the step size.
        elastic: stored energy, J, on this rank.
        forces: loads and reactions, N, at the level at which the last step balanced them.
        damping: damping forces at that level, N; None without damping.
        history: history variables by owner: "damage", "flow", "terms".
        out_of_balance: residual at the end of the last step, N; None if it is within the tolerance of the solver.
        previous_increment: displacement one step earlier, m, and the size of that step, s, for the extrapolation of a
            quasi-static load path; None if it is not known or not needed.
        frequencies: (cells,) bounds of omega^2 of undamaged cells, 1/s^2, for explicit steps; None in other schemes.
    """

    u: Values
    v: Values
    a: Values
    t: float = 0.0
    step: int = 0
    dt: float = 0.0
    dissipated: float = 0.0
    work: float = 0.0
    easy_steps: int = 0
    elastic: float = 0.0
    forces: Values = field(default_factory=lambda: np.empty(0))
    damping: Values | None = None
    history: dict[str, object] = field(default_factory=dict)
    out_of_balance: Values | None = None
    previous_increment: tuple[Values, float] | None = None
    frequencies: Values | None = None


class HistoryVariables(Protocol):
    """Interface of an object with history variables, such as damage or plastic flow.

    Every step begins with `restore`, so that a repeated or reduced step starts from the values of its state.
    """

    def snapshot(self) -> object:
        """Return the present values. They are never written to; the object is the same while nothing changes."""

    def restore(self, saved: object) -> bool:
        """Restore the values that `snapshot` returned; return True if they changed.

        Not collective; the result is the same on all ranks.
        """


def initial_velocity(balance: Balance, velocity: Values | None, spin: Values | None) -> Values:
    """Return v = velocity + spin x (X - centre of mass), (owned dofs,), m/s (collective).

    Args:
        balance: gives nodes and mass.
        velocity: (d,), m/s.
        spin: (1,) in 2D, (3,) in 3D, rad/s.
    """
    domain = balance.domain
    d, X = domain.dim, domain.nodes[: domain.node_count]
    v = np.zeros_like(X)
    if velocity is not None:
        v += velocity
    if spin is not None:
        mass = balance.mass.lumped.reshape(-1, d)[:, :1]
        sums = sum_over_ranks(domain.comm, np.concatenate([(mass * X).sum(axis=0), mass.sum(axis=0)]))
        arm = X - sums[:d] / sums[d]
        v += np.cross(spin, arm) if d == 3 else spin * np.column_stack([-arm[:, 1], arm[:, 0]])
    return v.reshape(-1)
