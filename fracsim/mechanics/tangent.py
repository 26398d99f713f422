"""Assembling the tangent: element matrices are summed in DOLFINx's own sparse matrix and handed to PETSc row by row.

PETSc's MatSetValuesLocal, which fem.petsc.assemble_matrix calls for every cell, takes twice as long as the kernels and
DOLFINx's insertion together: 44 ms against 25 for 24,000 tetrahedra. The price is a second copy of the values.

Where a body falls apart, the entries of its dead cells are zeros that every product with the matrix still reads. They
are given up from time to time: the matrix shrinks, the unknowns stay.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from petsc4py import PETSc

from ..mesh.dolfinx_calls import create_matrix, expanded_csr
from ..mesh.ranks import total

Flags = npt.NDArray[np.bool_]


class Assembly:
    """A bilinear form and the matrix that it is assembled into.

    Attributes:
        form: the compiled form.    matrix: PETSc's, kept until `fit` makes a smaller one.
    """

    matrix: PETSc.Mat

    def __init__(self, form: fem.Form) -> None:
        self.form = form
        self._dead: Flags | None = None
        self._make()

    def _make(self) -> None:
        """Matrices with the pattern of the cells that the form is integrated over, and a full diagonal."""
        pattern = fem.create_sparsity_pattern(self.form)
        owned = self.form.function_spaces[0].dofmap.index_map.size_local
        pattern.insert_diagonal(np.arange(owned, dtype=np.int32))
        pattern.finalize()
        self.matrix = create_matrix(self.form.mesh.comm, pattern)
        self._sum = expanded_csr(pattern)
        rows, columns = (self._sum.index_map(axis) for axis in (0, 1))
        starts = self._sum.indptr[: rows.size_local + 1]
        self._own = slice(int(starts[-1]))  # entries of owned rows; those of ghosts come after
        names = np.concatenate([np.arange(*columns.local_range), columns.ghosts])
        self._starts = starts.astype(PETSc.IntType)
        self._columns = names[self._sum.indices[self._own]].astype(PETSc.IntType)

    def fit(self, dead: Flags, share: float) -> bool:
        """Give up the entries of cells that the form has left out, where at most `share` of the cells that there is
        room for are alive, and make room for cells that are back; whether the matrix is a new one (collective).

        `dead`: (owned cells,) flags of what is left out now.
        """
        had = np.zeros_like(dead) if self._dead is None else self._dead
        alive, room, back = total(self.form.mesh.comm, np.array([np.sum(~dead), np.sum(~had), np.sum(had & ~dead)]))
        if not back and (alive == room or alive > share * room):
            return False
        self._dead = dead.copy()
        self.matrix.destroy()
        self._make()
        return True

    def __call__(self, bcs: list[fem.DirichletBC], more: fem.Form | None = None) -> None:
        """Assemble, with another form of the same pattern; rows and columns of prescribed dofs become the identity's
        (collective)."""
        self._sum.data[:] = 0.0
        for form in (self.form, more) if more is not None else (self.form,):
            fem.assemble_matrix(self._sum, form, bcs)  # type: ignore[arg-type]
        self._sum.scatter_reverse()
        self.matrix.setValuesIJV(self._starts, self._columns, self._sum.data[self._own])
        self.matrix.assemble()

    def destroy(self) -> None:
        """Give the memory of PETSc's matrix back."""
        self.matrix.destroy()
