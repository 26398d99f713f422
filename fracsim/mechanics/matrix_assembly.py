"""Assembling the tangent: element matrices are summed in DOLFINx's own sparse matrix and handed to PETSc row by row.

PETSc's MatSetValuesLocal, which fem.petsc.assemble_matrix calls for every cell, takes twice as long as the kernels and
DOLFINx's insertion together: 44 ms against 25 for 24,000 tetrahedra. The price is a second copy of the values. Larger
bodies have several cells assembled at a time (simd_kernels).

It can be summed in blocks of the d dofs of a node instead. Products are made with those where they are (block_matrix);
PETSc's matrix of single entries, which multigrid is set up from, follows where it is asked for.

Where a body falls apart, the entries of its dead cells are zeros that every product with the matrix still reads. They
are given up from time to time: the matrix shrinks, the unknowns stay.

Assembled vectors: forms summed into PETSc vectors over all ranks.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from petsc4py import PETSc

from ..mesh.dolfinx_compat import assemble_into, block_csr, create_matrix, create_vector, expanded_csr, pattern_of
from ..mesh.domain import Domain
from ..mesh.parallel import sum_over_ranks
from .jit import CellForm, SimdKernelCache

if TYPE_CHECKING:
    from ctypes import CDLL

    from .block_matrix import BlockMatrix
    from .cell_subset_assembly import CellSubsetAssembler
    from .inertia import MassBlocks
    from .simd_kernels import SimdBilinearForm, SimdLinearForm

Flags = npt.NDArray[np.bool_]
Values = npt.NDArray[np.float64]


class TangentAssembler:
    """A bilinear form and the matrix that it is assembled into.

    Attributes:
        form: the compiled form.    matrix: PETSc's, kept until `fit` makes a smaller one.
        blocks: products with what is assembled into blocks, where it is; kept as long.
        on_diagonal: (owned nodes,) those blocks of owned rows that are on the diagonal, where there are blocks.
        is_behind: whether the blocks have been assembled since the matrix.
    """

    matrix: PETSc.Mat

    def __init__(self, form: CellForm) -> None:
        self.form = form
        self.blocks: BlockMatrix | None = None
        self.entries_outdated = False
        self._dead: Flags | None = None
        self._make()

    def switch_to_blocks(self, *, with_dead_cells: bool = False) -> BlockMatrix | None:
        """Assemble into blocks from here on; products with them, None where there is no compiler. `dead_too`: with room
        for cells that the form has left out (collective)."""
        if self.blocks is None:
            from .block_matrix import compile_block_product

            size = self.matrix.getBlockSize()
            if (code := compile_block_product(self.form.mesh.comm, size)) is None:
                return None
            self.matrix.destroy()
            self._make(code, with_dead_cells)
        return self.blocks

    def _make(self, by_blocks: CDLL | None = None, dead_too: bool = False) -> None:
        """Matrices with the pattern of the cells that the form is integrated over (`dead_too`: and of those left out),
        and a full diagonal; `by_blocks`: what makes products with blocks."""
        pattern = pattern_of(self.form.all_cells_form if dead_too else self.form._cpp_object)
        owned = self.form.function_spaces[0].dofmap.index_map.size_local
        pattern.insert_diagonal(np.arange(owned, dtype=np.int32))
        pattern.finalize()
        self.matrix = create_matrix(self.form.mesh.comm, pattern)
        self._lanes = SimdKernelCache(self._in_lanes)
        self._sum = expanded_csr(pattern) if by_blocks is None else block_csr(pattern)
        rows, columns = (self._sum.index_map(axis) for axis in (0, 1))
        starts = self._sum.indptr[: rows.size_local + 1]
        self._own = slice(int(starts[-1]))  # entries or blocks of owned rows; those of ghosts come after
        names = np.concatenate([np.arange(*columns.local_range), columns.ghosts])
        self._starts = starts.astype(PETSc.IntType)
        self._columns = names[self._sum.indices[self._own]].astype(PETSc.IntType)
        self._by_blocks = by_blocks
        if by_blocks is not None:
            from .block_matrix import BlockMatrix

            self.blocks = BlockMatrix(self._sum, by_blocks)
            rows = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
            self.diagonal_blocks = np.flatnonzero(self._sum.indices[self._own] == rows)

    def shrink(self, dead: Flags, share: float) -> bool:
        """Give up the entries of cells that the form has left out, where at most `share` of the cells that there is
        room for are alive, and make room for cells that are back; whether the matrix is a new one (collective).

        `dead`: (owned cells,) flags of what is left out now.
        """
        had = np.zeros_like(dead) if self._dead is None else self._dead
        alive, room, back = sum_over_ranks(
            self.form.mesh.comm, np.array([np.sum(~dead), np.sum(~had), np.sum(had & ~dead)])
        )
        if not back and (alive == room or alive > share * room):
            return False
        self._dead = dead.copy()
        self.destroy()
        self._make(self._by_blocks)
        return True

    def __call__(
        self, bcs: list[fem.DirichletBC], extra_form: fem.Form | None = None, mass: MassBlocks | None = None
    ) -> None:
        """Assemble, with another form of the same pattern; rows and columns of prescribed dofs become the identity's.
        `mass` is added to blocks, which `bring` makes the matrix of (collective)."""
        self._sum.data[:] = 0.0
        for form in (self.form, extra_form) if extra_form is not None else (self.form,):
            self._add(form, bcs)
        self._sum.scatter_reverse()
        if self.blocks is None:
            self.matrix.setValuesIJV(self._starts, self._columns, self._sum.data[self._own])
            self.matrix.assemble()
            return
        if mass is not None:
            self._diagonals[mass.blocks] += mass.values
        self.entries_outdated = True

    def assemble_block_diagonals(self, form: fem.Form, bcs: list[fem.DirichletBC]) -> Values:
        """(blocks of owned rows, d) what a form of the same pattern adds to the diagonal of each; nothing in rows and
        columns of prescribed dofs. It is summed in the tangent's place, which has to be assembled after it
        (collective)."""
        self._sum.data[:] = 0.0
        fem.assemble_matrix(self._sum, form, bcs, 0.0)  # type: ignore[arg-type]
        self._sum.scatter_reverse()
        return self._diagonals.copy()

    @property
    def _diagonals(self) -> Values:
        """The same of the sum, as part of it."""
        d = self.matrix.getBlockSize()
        return np.einsum("bii->bi", self._sum.data[: d * d * self._own.stop].reshape(-1, d, d))

    def _add(self, form: fem.Form, bcs: list[fem.DirichletBC]) -> None:
        """Add a form to the sum (collective the first time)."""
        if (lanes := self._lanes(form)) is None:
            fem.assemble_matrix(self._sum, form, bcs)  # type: ignore[arg-type]
        else:
            lanes.add_to(self._sum, bcs)

    def _in_lanes(self, form: fem.Form) -> SimdBilinearForm | None:
        from .simd_kernels import SimdBilinearForm

        return SimdBilinearForm.for_form(form, self._sum)

    def update_entries(self) -> bool:
        """Bring the matrix to where the blocks are, if there are any that it is behind of; whether there were
        (collective)."""
        if was_behind := self.entries_outdated:
            d = self.matrix.getBlockSize()
            values = self._sum.data[: d * d * self._own.stop]
            self.matrix.setValuesBlockedIJV(self._starts, self._columns, values)
            self.matrix.assemble()
            self.entries_outdated = False
        return was_behind

    def destroy(self) -> None:
        """Give the memory of PETSc's matrices back."""
        self.matrix.destroy()
        if self.blocks is not None:
            self.blocks.destroy()
            self.blocks, self.entries_outdated = None, False


class VectorAssembler:
    """Assembles linear forms over a domain's displacement space, with one vector that is kept.

    Attributes:
        domain: the mesh.    owned: dofs of this rank.
    """

    def __init__(self, domain: Domain) -> None:
        self.domain = domain
        self.owned_dof_count = domain.node_count * domain.dim
        self._kept = self.create_vector()
        self._lanes = SimdKernelCache(_in_lanes)
        self._few: dict[CellForm, CellSubsetAssembler] = {}

    def create_vector(self) -> PETSc.Vec:
        """A new vector over the dofs, ghosts included."""
        return create_vector(self.domain.space)

    def __call__(self, form: fem.Form) -> Values:
        """(owned dofs,) copy of an assembled form (collective)."""
        return self.assemble_into(self._kept, form).array_r.copy()

    def sum_contributions(self, add: Callable[[Values], None]) -> Values:
        """(owned dofs,) sums of what `add` adds to the dofs of each rank, ghosts included (collective)."""
        with self._kept.localForm() as local:
            local.set(0.0)
            add(local.array_w)
        return self.sum_over_ranks(self._kept).array_r.copy()

    def assemble_into(self, b: PETSc.Vec, form: fem.Form) -> PETSc.Vec:
        """Assemble into b, which loses what it held (collective)."""
        return self.sum_over_ranks(self.assemble_local_part(b, form))

    def assemble_local_part(self, b: PETSc.Vec, form: fem.Form) -> PETSc.Vec:
        """This rank's part alone into b; returns b (collective the first time)."""
        with b.localForm() as local:
            local.set(0.0)
            added = self._added_to(local.array_w, form)
        if not added:
            assemble_into(b, form)
        return b

    def _added_to(self, values: Values, form: fem.Form) -> bool:
        """Add this rank's part to the values of dofs, ghosts included, where DOLFINx need not do it."""
        if (lanes := self._lanes(form)) is not None:
            lanes.add_to(values)
        elif isinstance(form, CellForm) and (left := form.remaining_cells) is not None:
            if form not in self._few:
                from .cell_subset_assembly import CellSubsetAssembler

                self._few[form] = CellSubsetAssembler(form)
            self._few[form].add_cells(left, values)
        else:
            return False
        return True

    def sum_over_ranks(self, b: PETSc.Vec) -> PETSc.Vec:
        """b with the parts that other ranks have assembled for its owned dofs (collective)."""
        b.ghostUpdate(PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)
        return b

    def destroy(self) -> None:
        """Give the memory back."""
        self._kept.destroy()


def _in_lanes(form: fem.Form) -> SimdLinearForm | None:
    from .simd_kernels import SimdLinearForm

    return SimdLinearForm.for_form(form)
