"""How much of what holds a cell is its inertia: which preconditioner does for a body that comes apart.

c_a rho h^2 / Y,   c_a = da/du of the scheme (1 / dt^2 in backward Euler),   h: mean edge
"""

from __future__ import annotations

import numpy as np

from ..mechanics.balance import Balance
from ..mesh.ranks import total

HELD = 1e-3  # above which what hangs by a node or an edge is held by its inertia
SWEPT = 1e-2  # above which sweeps do without coarse spaces: no force gets far in a step


def inertia_share(balance: Balance) -> float:
    """The inertia of a cell as a share of its stiffness, in the step that is solved now (collective)."""
    domain, material = balance.domain, balance.stress.material
    sums = [np.sum(each * domain.volumes) for each in (material.young, material.density)]
    stiffness, mass = total(domain.comm, np.array(sums))
    return float(balance.c_a * mass * domain.mean_edge**2 / stiffness)
