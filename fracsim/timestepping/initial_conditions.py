"""Velocity at the start."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..mechanics.balance import Balance
from ..mesh.parallel import sum_over_ranks

Values = npt.NDArray[np.float64]


def initial_velocity(balance: Balance, velocity: Values | None, spin: Values | None) -> Values:
    """(owned dofs,) v = velocity + spin x (X - centre of mass), m/s; (d,) m/s, and (1,) in 2D or (3,) rad/s."""
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
