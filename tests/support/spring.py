"""A toy term of the balance: every node hangs on a spring to where it is at rest. All that a new term takes is this
file and a line in fracsim.scene.TERMS."""

from __future__ import annotations

import numpy as np
from dolfinx import fem
from petsc4py import PETSc

from fracsim.mechanics.term import Term, Values
from fracsim.scene import Parts


class Spring(Term):
    """k u on every dof, k in N/m."""

    name = "spring"

    def __init__(self, u: fem.Function, owned: int, k: float) -> None:
        self._u, self._owned, self._k = u, owned, k

    @classmethod
    def of(cls, parts: Parts) -> Spring:
        """As TERMS makes it."""
        return cls(parts.u, parts.assembler.owned, 2.0)

    @property
    def _at(self) -> Values:
        return np.asarray(self._u.x.array[: self._owned])

    def add_force(self, rows: Values) -> None:
        """r += k u."""
        rows += self._k * self._at

    def add_stiffness(self, K: PETSc.Mat) -> None:
        """K += k I."""
        diagonal = K.createVecLeft()
        diagonal.set(self._k)
        K.setDiagonal(diagonal, PETSc.InsertMode.ADD)
        diagonal.destroy()

    def stored(self) -> float:
        """k u . u / 2, J."""
        return float(self._k * self._at @ self._at) / 2
