"""A toy term of the balance: every node hangs on a spring to where it is at rest. All that a new term takes is this
file and a line in fracsim.scene.TERMS."""

from __future__ import annotations

import numpy as np
from dolfinx import fem
from petsc4py import PETSc

from fracsim.mechanics.term import Term, Values
from fracsim.scene import TermInputs


class Spring(Term):
    """k u on every dof, k in N/m."""

    name = "spring"

    def __init__(self, u: fem.Function, owned: int, k: float) -> None:
        self._u, self._owned, self._k = u, owned, k

    @classmethod
    def of(cls, inputs: TermInputs) -> list[Term]:
        """As TERMS makes it."""
        return [cls(inputs.u, inputs.assembler.owned_dof_count, 2.0)]

    @property
    def _at(self) -> Values:
        return np.asarray(self._u.x.array[: self._owned])

    def add_nodal_forces(self, rows: Values) -> None:
        """r += k u."""
        rows += self._k * self._at

    def add_stiffness(self, K: PETSc.Mat) -> None:
        """K += k I."""
        diagonal = K.createVecLeft()
        diagonal.set(self._k)
        K.setDiagonal(diagonal, PETSc.InsertMode.ADD)
        diagonal.destroy()

    def stored_energy(self) -> float:
        """k u . u / 2, J."""
        return float(self._k * self._at @ self._at) / 2


class Tie(Term):
    """k (u_i - u_j) between two dofs that share no cell, and Newton steps of half their length (serial)."""

    name = "tie"

    def __init__(self, u: fem.Function, vector: PETSc.Vec, i: int, j: int, k: float) -> None:
        self._u, self._ends, self._k = u, (i, j), k
        self._matrix = PETSc.Mat().createAIJ((vector.getSizes(),) * 2, bsize=vector.getBlockSize(), comm=vector.comm)
        self._matrix.setUp()
        self.steps = 0

    @property
    def _force(self) -> float:
        i, j = self._ends
        return float(self._k * (self._u.x.array[i] - self._u.x.array[j]))

    def add_nodal_forces(self, rows: Values) -> None:
        """Equal and opposite."""
        i, j = self._ends
        rows[i] += self._force
        rows[j] -= self._force

    def coupling_matrix(self) -> PETSc.Mat:
        """k [[1, -1], [-1, 1]] on the two dofs."""
        i, j = self._ends
        values = self._k * np.array([1.0, -1.0, -1.0, 1.0])
        self._matrix.setValues([i, j], [i, j], values)
        self._matrix.assemble()
        return self._matrix

    def stored_energy(self) -> float:
        """k (u_i - u_j)^2 / 2, J."""
        return self._force**2 / (2 * self._k)

    def max_step_fraction(self, change: Values) -> float:
        """Half, while the two are pulled apart by more than a millionth in a step."""
        i, j = self._ends
        self.steps += 1
        return 0.5 if abs(change[i] - change[j]) > 1e-6 else 1.0
