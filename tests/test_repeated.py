"""The same study gives the same digits again: what is solved does not go by where things lie in memory."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc

import fracsim.solvers.petsc_options  # noqa: F401
from fracsim.solvers.preconditioner import rigid_body_nullspace

SIZE = 1001
FAR = 4000


@pytest.mark.parametrize("count", [2, 3, 5])
def test_vectors_that_lie_side_by_side_are_no_others(count: int) -> None:
    """PETSc takes such for the columns of a matrix, by default: their products have other last digits than those of
    vectors that lie about."""
    values = np.random.default_rng(3).normal(size=(count + 1, SIZE))
    x = PETSc.Vec().createWithArray(values[-1].copy(), comm=MPI.COMM_SELF)
    found = []
    for first in ((SIZE + 7) * np.arange(count), FAR * np.arange(count) ** 2):
        room = np.zeros(first[-1] + SIZE)
        basis = [room[start : start + SIZE] for start in first]
        for mine, each in zip(basis, values, strict=False):
            mine[:] = each
        found.append(np.asarray(x.mDot([PETSc.Vec().createWithArray(each, comm=MPI.COMM_SELF) for each in basis])))
    assert np.array_equal(*found)
    assert np.allclose(found[0], values[:-1] @ values[-1])


def test_rigid_modes_are_the_same_again() -> None:
    """To the last digit, with other things in memory: 3 of 8 were others."""
    places, kept, found = np.random.default_rng(5).normal(size=(SIZE, 3)), [], set()
    for size in range(8):
        found.add(b"".join(mode.array_r.tobytes() for mode in rigid_body_nullspace(MPI.COMM_SELF, places).getVecs()))
        kept.append([PETSc.Vec().createSeq(SIZE * 3 - 2 * k * size) for k in range(size)])
    assert len(found) == 1
