"""How much of the nodes' mass a point of the surface has to itself, and how fast springs at points make a body vibrate.

Points follow nodes by weights w: springs k_p between points and what stands still are K = sum_p k_p w_p w_p^T. The
rows of M^-1 K bound its eigenvalues (Gershgorin), whatever the directions of the springs:

    omega^2  <=  max over nodes a of  1/m_a  sum_p |w_pa| k_p S_p,    S_p = sum_b |w_pb|

and with k_p = M_p the bound is 1 for masses M_p = A_p min over nodes a of p of  m_a / (sum_q |w_qa| A_q S_q).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ...mesh.split.local import Following
from ...mesh.split.places import Places

Values = npt.NDArray[np.float64]

SOME = 1e-6  # weights below this share of all of a point are round-off of arms that cancel


class Carried:
    """What points carry of the nodes that they follow."""

    def __init__(self, at: Places, follow: Following, mass: Values) -> None:
        """`mass`: (owned dofs,) lumped, kg (collective)."""
        self._follow, self._size = follow, abs(at.weights)
        self._sum = np.asarray(self._size.sum(axis=1)).ravel()
        self._mass = follow.nodal(mass)[:, 0].copy()

    def rate(self, stiffness: Values) -> Values:
        """(columns,) 1/m_a sum_p |w_pa| k_p S_p at the nodes that points follow, 1/s^2, of k (n,) N/m (collective)."""
        load = self._size.T @ (stiffness * self._sum)
        spread = np.zeros((len(load), self._follow.dim))
        spread[:, 0] = load
        summed = self._follow.nodal(self._follow.summed(spread))[:, 0]
        return np.asarray(summed / np.maximum(self._mass, np.finfo(float).tiny))

    def fastest(self, stiffness: Values) -> float:
        """The bound of omega^2 over all ranks, 1/s^2 (collective)."""
        return float(self._follow.comm.allreduce(float(self.rate(stiffness).max(initial=0.0)), op=MPI.MAX))

    def masses(self, area: Values) -> Values:
        """(n,) M_p, kg, of points with shares `area` (n,) of the surface (collective)."""
        rate, size = self.rate(area), self._size.tocoo()
        counts = size.data > SOME * self._sum[size.row]
        most = np.zeros(len(area))
        np.maximum.at(most, size.row[counts], rate[size.col[counts]])
        return np.where(most > 0, area / np.where(most > 0, most, 1.0), 0.0)
