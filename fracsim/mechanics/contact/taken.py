"""How far a free obstacle is on its way with a step of Newton's method that takes it along."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ...mesh.ranks import total

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Taken:
    """From points at x (n, d) by `moved` (n, d), m, and from the obstacle's way z (k,) by `dz`."""

    x: Values
    moved: Values
    z: Values
    dz: Values

    def share(self, x: Values, comm: MPI.Comm = MPI.COMM_SELF) -> float:
        """Of the way, where the points of all ranks of `comm` are at x (n, d) now: the nearest place on it
        (collective)."""
        gone, length = total(comm, [float(np.vdot(x - self.x, self.moved)), float(np.vdot(self.moved, self.moved))])
        return float(np.clip(gone / length, 0.0, 1.0)) if length > 0 else 0.0

    def at(self, share: float) -> Values:
        """(k,) z there."""
        return self.z + share * self.dz
