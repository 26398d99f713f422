"""Inertia relief: what a free body under a load accelerates with is taken off the load, and what is left strains it.

A rigid motion a = R c of the body balances the load in every rigid mode R,

    R^T (f - M R c) = 0,   (R^T M R) c = R^T f,

with the lumped masses M of the mesh that is solved on, so that f - M a is orthogonal to the modes to round-off and the
strain of K u = f - M a is the same whichever u of all rigid motions is taken. B07 (sec. 5) pins three points instead:
what the load is out of balance by then acts on these (rigid.pinned).

Equations: docs/theory.md#free-body-analysis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Relief:
    """Of one body with n nodes.

    Attributes:
        mass: (n,) lumped, kg, or (n, d) of each unknown.    modes: (n d, m) rigid modes, in any basis.
    """

    mass: Values
    modes: Values

    def __call__(self, force: Values) -> Values:
        """(n, d) nodal forces f - M a that no longer accelerate the body, from forces f (n, d), N."""
        mass = np.repeat(self.mass, force.shape[1]) if self.mass.ndim == 1 else self.mass.reshape(-1)
        weighted = mass[:, None] * self.modes
        c = np.linalg.solve(self.modes.T @ weighted, self.modes.T @ force.reshape(-1))
        return np.asarray(force - (weighted @ c).reshape(force.shape))
