"""A tangent with what is kept beside it: K - sum of U C U^T + sum of C', applied only.

The part of low rank is that of unknowns which terms have eliminated, C' the springs (mechanics.extra_couplings).

A preconditioner of a body that is held by a few stiff springs: that of the body, and the springs exactly.

    (P^-1 + U S U^T)^-1 = P - V G V^T,   V = P U,   G = (S^-1 + U^T V)^-1

(Sherman, Morrison and Woodbury). P: the body's own, symmetric; U, S: what a balance has of Stiff. It costs an
application of P for each spring and tangent, and 2 m products a dof for each iteration.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from ..mechanics.extra_couplings import StiffCoupling
from ..mesh.parallel import sum_over_ranks

Values = npt.NDArray[np.float64]


class LowRankOperator:
    """The context of a PETSc matrix; preconditioners are made of K alone: k more iterations see to the part of low
    rank, and woodbury to springs."""

    def __init__(
        self,
        tangent: PETSc.Mat,
        parts: Callable[[], list[tuple[Values, Values]]],
        springs: Callable[[], list[StiffCoupling]],
    ) -> None:
        """`parts`: U (owned dofs, k) and C (k, k) of each, `springs`: as they are now."""
        self._tangent, self._parts, self._springs = tangent, parts, springs

    def mult(self, _: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = (K - sum of U C U^T + sum of C') x (collective)."""
        self._tangent.mult(x, y)
        for U, C in self._parts():
            y.array_w[:] -= U @ (C @ sum_over_ranks(self._tangent.comm.tompi4py(), U.T @ x.array_r))
        for each in self._springs():
            each.matrix.multAdd(x, y, y)

    def to_petsc(self) -> PETSc.Mat:
        """The matrix."""
        result: Any = PETSc.Mat().createPython(self._tangent.getSizes(), self, comm=self._tangent.comm)
        result.setUp()
        return result


class WoodburyPreconditioner:
    """The context of a PETSc preconditioner."""

    def __init__(self, body: PETSc.PC, springs: list[StiffCoupling], like: PETSc.Vec) -> None:
        """`body`: P, set up; `like`: a vector of its size (collective)."""
        self._body, self._comm = body, like.comm.tompi4py()
        U = np.concatenate([each.directions for each in springs], axis=1)
        self._V = _applied(body, U, like)
        flexibility = np.diag(1.0 / np.concatenate([each.stiffness for each in springs]))
        self._G = np.linalg.inv(flexibility + sum_over_ranks(self._comm, U.T @ self._V))

    def apply(self, _: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = (P - V G V^T) x (collective)."""
        self._body.apply(x, y)
        y.array_w[:] -= self._V @ (self._G @ sum_over_ranks(self._comm, self._V.T @ x.array_r))


def _applied(body: PETSc.PC, U: Values, like: PETSc.Vec) -> Values:
    """(owned dofs, m) P U (collective)."""
    x, y, V = like.duplicate(), like.duplicate(), np.empty_like(U)
    for column in range(U.shape[1]):
        x.array_w[:] = U[:, column]
        body.apply(x, y)
        V[:, column] = y.array_r
    x.destroy()
    y.destroy()
    return V
