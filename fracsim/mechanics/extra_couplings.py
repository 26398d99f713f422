"""Stiffness between nodes that share no cell, as a matrix over the dofs of all ranks: what `Term.coupling` gives."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc
from scipy.sparse import csr_matrix

from ..mesh.domain import Domain

Ints = npt.NDArray[np.int64]


class CouplingBuilder:
    """Makes the matrix of a term; the last one is kept, and gone once there is another."""

    def __init__(self, domain: Domain) -> None:
        self._domain = domain
        self._last: PETSc.Mat | None = None

    def __call__(self, part: csr_matrix, nodes: Ints) -> PETSc.Mat:
        """The sum over ranks of their parts (n d, n d), N/m, over nodes (n,) by their global numbers (collective)."""
        self.destroy()
        d, owned = self._domain.dim, self._domain.node_count * self._domain.dim
        matrix = self._last = PETSc.Mat().create(self._domain.comm)
        matrix.setSizes(((owned, PETSc.DETERMINE),) * 2, bsize=d)
        matrix.setType(PETSc.Mat.Type.AIJ)
        matrix.setUp()
        dofs = (d * nodes[:, None] + np.arange(d)).reshape(-1).astype(PETSc.IntType)
        start, columns = part.indptr.astype(PETSc.IntType), dofs[part.indices]
        matrix.setValuesIJV(start, columns, part.data, PETSc.InsertMode.ADD_VALUES, dofs)
        matrix.assemble()
        return matrix

    def destroy(self) -> None:
        """Give the memory of PETSc's matrix back."""
        if self._last is not None:
            self._last.destroy()
            self._last = None
