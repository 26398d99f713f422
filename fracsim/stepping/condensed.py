"""A tangent with what is kept beside it: K - sum of U C U^T + sum of C', applied only.

The part of low rank is that of unknowns which terms have eliminated, C' the springs (mechanics.stiff).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from ..mechanics.stiff import Stiff
from ..mesh.ranks import total

Values = npt.NDArray[np.float64]


class Condensed:
    """The context of a PETSc matrix; preconditioners are made of K alone: k more iterations see to the part of low
    rank, and woodbury to springs."""

    def __init__(
        self,
        tangent: PETSc.Mat,
        parts: Callable[[], list[tuple[Values, Values]]],
        springs: Callable[[], list[Stiff]],
    ) -> None:
        """`parts`: U (owned dofs, k) and C (k, k) of each, `springs`: as they are now."""
        self._tangent, self._parts, self._springs = tangent, parts, springs

    def mult(self, _: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = (K - sum of U C U^T + sum of C') x (collective)."""
        self._tangent.mult(x, y)
        for U, C in self._parts():
            y.array_w[:] -= U @ (C @ total(self._tangent.comm.tompi4py(), U.T @ x.array_r))
        for each in self._springs():
            each.matrix.multAdd(x, y, y)

    def matrix(self) -> PETSc.Mat:
        """The matrix."""
        result: Any = PETSc.Mat().createPython(self._tangent.getSizes(), self, comm=self._tangent.comm)
        result.setUp()
        return result
