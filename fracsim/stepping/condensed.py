"""A tangent less a part of low rank, for unknowns that terms have eliminated: K - sum of U C U^T, applied only."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from ..mesh.ranks import total

Values = npt.NDArray[np.float64]


class Condensed:
    """The context of a PETSc matrix; preconditioners are made of K alone, and k more iterations see to the rest."""

    def __init__(self, tangent: PETSc.Mat, parts: Callable[[], list[tuple[Values, Values]]]) -> None:
        """`parts`: U (owned dofs, k) and C (k, k) of each, as they are now."""
        self._tangent, self._parts = tangent, parts

    def mult(self, _: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = (K - sum of U C U^T) x (collective)."""
        self._tangent.mult(x, y)
        for U, C in self._parts():
            y.array_w[:] -= U @ (C @ total(self._tangent.comm.tompi4py(), U.T @ x.array_r))

    def matrix(self) -> PETSc.Mat:
        """The matrix."""
        result: Any = PETSc.Mat().createPython(self._tangent.getSizes(), self, comm=self._tangent.comm)
        result.setUp()
        return result
