"""The penalty that pushes bodies apart in explicit steps: its force is bounded, and so is how fast it vibrates.

How much of the nodes' mass a point of the surface has to itself, and how fast springs at points make a body vibrate.

Points follow nodes by weights w: springs k_p between points and what stands still are K = sum_p k_p w_p w_p^T. The
rows of M^-1 K bound its eigenvalues (Gershgorin), whatever the directions of the springs:

    omega^2  <=  max over nodes a of  1/m_a  sum_p |w_pa| k_p S_p,    S_p = sum_b |w_pb|

and with k_p = M_p the bound is 1 for masses M_p = A_p min over nodes a of p of  m_a / (sum_q |w_qa| A_q S_q).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..errors import InputError
from ..mesh.split_surface.local_surface import ParentMatrix
from ..mesh.split_surface.surface_map import SurfaceMap

Values = npt.NDArray[np.float64]
SOME = 1e-6  # weights below this share of all of a point are round-off of arms that cancel


@dataclass(frozen=True)
class Penalty:
    """b(g) = kappa (d - g)^2 / (2 d) below the gap g = d, 0 above: energy per area, J/m^2.

    `stiffness` kappa in Pa, the pressure of a gap that is just closed; `width` d in m. Beyond, as the points of a body
    may be for a moment, the pressure goes on growing by kappa / d a metre: it knows no gap that cannot be.
    """

    stiffness: float
    width: float

    def __post_init__(self) -> None:
        """InputError where it pushes nothing apart."""
        for word, value in (("stiffness", self.stiffness), ("width", self.width)):
            if not 0 < value < np.inf:
                raise InputError(f"the {word} of a penalty is {value}: it must be a positive number")

    @property
    def rate(self) -> float:
        """b'' = kappa / d, Pa/m."""
        return self.stiffness / self.width

    def energy(self, g: Values) -> Values:
        """(n,) b, J/m^2."""
        return np.asarray(self.rate / 2 * self._into(g) ** 2)

    def slope(self, g: Values) -> Values:
        """(n,) b', Pa: minus the pressure."""
        return np.asarray(-self.rate * self._into(g)) + 0.0  # no -0.0

    def curvature(self, g: Values) -> Values:
        """(n,) b'', Pa/m."""
        return np.where(g < self.width, self.rate, 0.0)

    def _into(self, g: Values) -> Values:
        return np.maximum(self.width - g, 0.0)


class NodalMassShare:
    """What points carry of the nodes that they follow."""

    def __init__(self, at: SurfaceMap, follow: ParentMatrix, mass: Values) -> None:
        """`mass`: (owned dofs,) lumped, kg (collective)."""
        self._follow, self._size = follow, abs(at.weights)
        self._sum = np.asarray(self._size.sum(axis=1)).ravel()
        self._mass = follow.nodal(mass)[:, 0].copy()

    def node_rates(self, stiffness: Values) -> Values:
        """(columns,) 1/m_a sum_p |w_pa| k_p S_p at the nodes that points follow, 1/s^2, of k (n,) N/m (collective)."""
        load = self._size.T @ (stiffness * self._sum)
        spread = np.zeros((len(load), self._follow.dim))
        spread[:, 0] = load
        summed = self._follow.nodal(self._follow.summed(spread))[:, 0]
        return np.asarray(summed / np.maximum(self._mass, np.finfo(float).tiny))

    def max_rate(self, stiffness: Values) -> float:
        """The bound of omega^2 over all ranks, 1/s^2 (collective)."""
        return float(self._follow.comm.allreduce(float(self.node_rates(stiffness).max(initial=0.0)), op=MPI.MAX))

    def point_masses(self, area: Values) -> Values:
        """(n,) M_p, kg, of points with shares `area` (n,) of the surface (collective)."""
        rate, size = self.node_rates(area), self._size.tocoo()
        counts = size.data > SOME * self._sum[size.row]
        most = np.zeros(len(area))
        np.maximum.at(most, size.row[counts], rate[size.col[counts]])
        return np.where(most > 0, area / np.where(most > 0, most, 1.0), 0.0)
