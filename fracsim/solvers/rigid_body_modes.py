"""The rigid motions of a body as vectors of PETSc: what a stiffness does not resist."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from petsc4py import PETSc

Values = npt.NDArray[np.float64]


def rigid_body_nullspace(comm: MPI.Comm, positions: Values) -> PETSc.NullSpace:
    """Translations and linearised rotations, orthonormal: 3 in 2D, 6 in 3D.

    `places`: (n, d) of this rank's nodes from where the rotations turn about, m (collective).
    """
    coordinates = PETSc.Vec().createWithArray(positions.reshape(-1), bsize=positions.shape[1], comm=comm)
    return PETSc.NullSpace().createRigidBody(coordinates)
