"""Coulomb friction with pressures and directions held: a potential of the sliding (Li et al. 2020, IPC, eq. 19).

    E(x) = mu sum_k N_k f(|T_k^T (x - x_0)|),   f(y) = y for y > e, -y^3 / (3 e^2) + y^2 / e + e / 3 below

N_k: what presses a pair together, N; T_k: its tangents; x_0: where the step began; e: `slip`, m. f' rises from 0 to 1,
so that the gradient is the friction of a backward Euler step: against the sliding, and mu N_k at most.
"""

from __future__ import annotations

from dataclasses import dataclass

import ipctk
import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix

from .sample_points import Centroids, Vertices

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class IpcFriction:
    """Friction of lagged pairs; x (n, d) as in Pairs."""

    mesh: ipctk.CollisionMesh
    parts: list[tuple[Vertices | Centroids, ipctk.TangentialCollisions]]
    start: Values
    potential: ipctk.FrictionPotential

    def energy(self, x: Values) -> float:
        """E(x), J: not stored, but the work against friction where the sliding is longer than `slip`."""
        moved = self._moved(x)
        return float(sum(self.potential(part, of.mesh, of.positions(moved)) for of, part in self.parts))

    def gradient(self, x: Values) -> Values:
        """(n, d) dE/dx, N: the force on the points is its negative."""
        moved = self._moved(x)
        found = sum(
            of.gradient(self.potential.gradient(part, of.mesh, of.positions(moved))) for of, part in self.parts
        )  # fmt: skip
        return np.asarray(self.mesh.to_full_dof(found)).reshape(x.shape)

    def hessian(self, x: Values, *, exact: bool = False) -> csr_matrix:
        """(n d, n d) d2E/dx2, N/m; unless `exact`, the share of each pair without its negative eigenvalues."""
        moved, how = self._moved(x), projection(exact=exact)
        found = sum(
            of.hessian(self.potential.hessian(part, of.mesh, of.positions(moved), how)) for of, part in self.parts
        )  # fmt: skip
        return csr_matrix(self.mesh.to_full_dof(found))

    def _moved(self, x: Values) -> Values:
        moved: Values = self.mesh.vertices(x) - self.start
        return moved


def projection(*, exact: bool) -> ipctk.PSDProjectionMethod:
    """What ipctk is to do with negative eigenvalues of a pair."""
    return ipctk.PSDProjectionMethod.NONE if exact else ipctk.PSDProjectionMethod.CLAMP
