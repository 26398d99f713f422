"""Assembly of linear forms into vectors, and of the tangent into a matrix.

Cell matrices are summed in DOLFINx's sparse matrix and given to PETSc by rows. PETSc's MatSetValuesLocal, which
fem.petsc.assemble_matrix calls for every cell, takes twice as long as the kernels and DOLFINx's insertion together: 44
ms instead of 25 for 24,000 tetrahedra. The price is a second copy of the values. Large bodies have several cells
assembled at a time (kernel_selection).

The matrix can be summed in blocks of the d dofs of a node. Products use the blocks (block_matrix). PETSc's matrix of
single entries, from which multigrid is set up, is updated on demand, and may be without entries in between. Where a
body falls apart, entries of dead cells are zeros that every product still reads; they are dropped from time to time.
The unknowns stay.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from petsc4py import PETSc

from ..mesh.dolfinx_compat import (
    assemble_local_vector,
    create_matrix,
    create_vector,
    make_block_csr,
    make_scalar_csr,
)
from ..mesh.domain import Domain
from ..mesh.parallel import sum_over_ranks
from .jit import CellForm
from .kernel_selection import KernelCache, KernelSelection

if TYPE_CHECKING:
    from ctypes import CDLL

    from .block_matrix import BlockMatrix
    from .cell_subset_assembly import CellSubsetAssembler
    from .inertia import MassBlocks

Flags = npt.NDArray[np.bool_]
Values = npt.NDArray[np.float64]


class TangentAssembler:
    """Bilinear form, and the matrix into which it is assembled.

    Attributes:
        form: compiled form.
        blocks: matrix in blocks, if the form is assembled into blocks; until `shrink` replaces it.
        diagonal_blocks: (owned nodes,) indices of the blocks on the diagonal, if there are blocks.
        entries_outdated: whether the blocks are newer than `matrix`.
    """

    def __init__(self, form: CellForm, kernels: KernelSelection | None = None) -> None:
        """`kernels`: selection of kernels; None: the default one."""
        self.form = form
        self.kernels = kernels or KernelSelection()
        self.blocks: BlockMatrix | None = None
        self.entries_outdated = False
        self._dead: Flags | None = None
        self._matrix: PETSc.Mat | None = None
        self._has_entries = True

    @property
    def matrix(self) -> PETSc.Mat:
        """PETSc's matrix of single entries, until `shrink` replaces it (collective the first time)."""
        # made at its first use, since `switch_to_blocks` would replace it
        if self._matrix is None:
            self._create()
        assert self._matrix is not None
        return self._matrix

    def switch_to_blocks(self, *, with_dead_cells: bool = False) -> BlockMatrix | None:
        """Assemble into blocks from now on; returns the matrix in blocks, None if there is no kernel (collective).

        Args:
            with_dead_cells: whether cells that the form excludes have blocks.
        """
        if self.blocks is None:
            code = self.kernels.block_product(self.form.mesh.comm, self.form.function_spaces[0].dofmap.index_map_bs)
            if code is None:
                return None
            self.destroy()
            self._create(code, with_dead_cells)
        return self.blocks

    def _create(self, block_code: CDLL | None = None, with_dead_cells: bool = False) -> None:
        """Create matrices with the pattern of the form's cells and a full diagonal.

        Args:
            block_code: library of products with blocks; None: single entries.
            with_dead_cells: whether cells that the form excludes are in the pattern.
        """
        pattern = fem.create_sparsity_pattern(self.form.whole if with_dead_cells else self.form)
        owned = self.form.function_spaces[0].dofmap.index_map.size_local
        pattern.insert_diagonal(np.arange(owned, dtype=np.int32))
        pattern.finalize()
        self._matrix, self._has_entries = create_matrix(self.form.mesh.comm, pattern), True
        self._sum = make_scalar_csr(pattern) if block_code is None else make_block_csr(pattern)
        self._kernel_of = KernelCache(lambda form: self.kernels.bilinear_form(form, self._sum))
        rows, columns = (self._sum.index_map(axis) for axis in (0, 1))
        starts = self._sum.indptr[: rows.size_local + 1]
        # entries or blocks of owned rows; those of ghosts come after them
        self._owned = slice(int(starts[-1]))
        global_columns = np.concatenate([np.arange(*columns.local_range), columns.ghosts])
        self._starts = starts.astype(PETSc.IntType)
        self._columns = global_columns[self._sum.indices[self._owned]].astype(PETSc.IntType)
        self._block_code = block_code
        if block_code is not None:
            from .block_matrix import BlockMatrix

            self.blocks = BlockMatrix(self._sum, block_code)
            row_of_block = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
            self.diagonal_blocks = np.flatnonzero(self._sum.indices[self._owned] == row_of_block)

    def may_shrink(self, dead: Flags, share: float) -> bool:
        """Return True if `shrink` would replace the matrices by smaller ones, or revive cells (collective).

        Args:
            dead: (owned cells,) cells that the form excludes now.
            share: largest share of living cells among those in the pattern at which the matrices are to be replaced.
        """
        was_dead = np.zeros_like(dead) if self._dead is None else self._dead
        counts = np.array([np.sum(~dead), np.sum(~was_dead), np.sum(was_dead & ~dead)])
        alive, in_pattern, revived = sum_over_ranks(self.form.mesh.comm, counts)
        return bool(revived or (alive < in_pattern and alive <= share * in_pattern))

    def shrink(self, dead: Flags) -> None:
        """Replace the matrices by those of the cells that are alive; the old ones are freed first (collective)."""
        self._dead = dead.copy()
        self.release_entries()
        self.destroy()
        self._create(self._block_code)

    def __call__(
        self, bcs: list[fem.DirichletBC], extra_form: fem.Form | None = None, mass: MassBlocks | None = None
    ) -> None:
        """Assemble the form; rows and columns of prescribed dofs become those of the identity (collective).

        Args:
            bcs: conditions on prescribed dofs.
            extra_form: form of the same pattern to be added.
            mass: blocks to be added, if there are blocks.
        """
        if self._matrix is None:
            self._create()
        self._sum.data[:] = 0.0
        for form in (self.form, extra_form) if extra_form is not None else (self.form,):
            self._add(form, bcs)
        self._sum.scatter_reverse()
        if self.blocks is None:
            self.matrix.setValuesIJV(self._starts, self._columns, self._sum.data[self._owned])
            self.matrix.assemble()
            return
        if mass is not None:
            self._block_diagonals[mass.blocks] += mass.values
        self.entries_outdated = True

    def assemble_block_diagonals(self, form: fem.Form, bcs: list[fem.DirichletBC]) -> Values:
        """(blocks of owned rows, d) diagonals of the blocks of a form of the same pattern (collective).

        Rows and columns of prescribed dofs are zero. The blocks of the tangent are overwritten: it has to be assembled
        after this.
        """
        self._sum.data[:] = 0.0
        fem.assemble_matrix(self._sum, form, bcs, 0.0)  # type: ignore[arg-type]
        self._sum.scatter_reverse()
        return self._block_diagonals.copy()

    @property
    def _block_diagonals(self) -> Values:
        """(blocks of owned rows, d) view of the diagonals of the blocks."""
        d = self.matrix.getBlockSize()
        return np.einsum("bii->bi", self._sum.data[: d * d * self._owned.stop].reshape(-1, d, d))

    def _add(self, form: fem.Form, bcs: list[fem.DirichletBC]) -> None:
        """Add a form to the sum (collective the first time)."""
        if (kernel := self._kernel_of(form)) is None:
            fem.assemble_matrix(self._sum, form, bcs)  # type: ignore[arg-type]
        else:
            kernel.add_to(self._sum, bcs)

    def update_entries(self) -> bool:
        """Update `matrix` from newer blocks; returns whether there were any (collective)."""
        if outdated := self.entries_outdated:
            d = self.matrix.getBlockSize()
            values = self._sum.data[: d * d * self._owned.stop]
            if not self._has_entries:
                self.matrix.setPreallocationNNZ(self._entries_of_rows())
                self._has_entries = True
            self.matrix.setValuesBlockedIJV(self._starts, self._columns, values)
            self.matrix.assemble()
            self.entries_outdated = False
        return outdated

    def release_entries(self) -> None:
        """Free the entries of `matrix` until they are updated from the blocks (collective).

        The matrix itself stays, since solvers of PETSc refer to it.
        """
        self.matrix.setPreallocationNNZ((0, 0))
        self._has_entries, self.entries_outdated = False, True

    def _entries_of_rows(self) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
        """(owned dofs,) numbers of entries in columns of this rank, and in other columns."""
        d, (first, last) = self.matrix.getBlockSize(), self._sum.index_map(1).local_range
        is_local = (self._columns >= first) & (self._columns < last)
        local = np.add.reduceat(is_local, self._starts[:-1], dtype=np.int32)  # each row has its diagonal
        return np.repeat(d * local, d), np.repeat(d * (np.diff(self._starts) - local), d)

    def destroy(self) -> None:
        """Free the matrices."""
        if self._matrix is None:
            return
        self._matrix.destroy()
        self._matrix = None
        if self.blocks is not None:
            self.blocks.destroy()
            self.blocks = None
        self.entries_outdated = False
        del self._sum, self._kernel_of


class VectorAssembler:
    """Assembler of linear forms over the displacement space of a domain.

    Attributes:
        domain: the mesh.
        owned_dof_count: number of dofs of this rank.
        kernels: selection of kernels, of all that a scene assembles.
    """

    def __init__(self, domain: Domain, kernels: KernelSelection | None = None) -> None:
        """`kernels`: selection of kernels; None: the default one."""
        self.domain = domain
        self.kernels = kernels or KernelSelection()
        self.owned_dof_count = domain.node_count * domain.dim
        self._work = self.create_vector()
        self._kernel_of = KernelCache(self.kernels.linear_form)
        self._subset_of: dict[CellForm, CellSubsetAssembler | None] = {}

    def create_vector(self) -> PETSc.Vec:
        """New vector over the dofs, ghosts included."""
        dofs = self.domain.space.dofmap
        return create_vector(dofs.index_map, dofs.index_map_bs)

    def __call__(self, form: fem.Form) -> Values:
        """(owned dofs,) copy of an assembled form (collective)."""
        return self.assemble_local_vector(self._work, form).array_r.copy()

    def sum_contributions(self, add: Callable[[Values], None]) -> Values:
        """(owned dofs,) sums over ranks of what `add` adds to an array of their dofs, ghosts included (collective)."""
        with self._work.localForm() as local:
            local.set(0.0)
            add(local.array_w)
        return self.sum_over_ranks(self._work).array_r.copy()

    def assemble_local_vector(self, b: PETSc.Vec, form: fem.Form) -> PETSc.Vec:
        """b, overwritten with an assembled form (collective)."""
        return self.sum_over_ranks(self.assemble_local_part(b, form))

    def assemble_local_part(self, b: PETSc.Vec, form: fem.Form) -> PETSc.Vec:
        """b, overwritten with this rank's part of a form, ghosts included (collective the first time)."""
        with b.localForm() as local:
            local.set(0.0)
            done = self._add_by_kernel(local.array_w, form)
        if not done:
            assemble_local_vector(b, form)
        return b

    def _add_by_kernel(self, values: Values, form: fem.Form) -> bool:
        """Add this rank's part of a form to the values of dofs, if there is a kernel for it; returns whether."""
        if (kernel := self._kernel_of(form)) is not None:
            kernel.add_to(values)
            return True
        if not isinstance(form, CellForm) or (cells := form.remaining_cells) is None:
            return False
        if form not in self._subset_of:
            self._subset_of[form] = self.kernels.cell_subset(form)
        if (subset := self._subset_of[form]) is None:
            return False
        subset.add_cells(cells, values)
        return True

    def sum_over_ranks(self, b: PETSc.Vec) -> PETSc.Vec:
        """b, with the parts of other ranks added to its owned dofs (collective)."""
        b.ghostUpdate(PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)
        return b

    def destroy(self) -> None:
        """Free PETSc's vector."""
        self._work.destroy()
