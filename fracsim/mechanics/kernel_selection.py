"""Selection of how forms are assembled and expressions are evaluated: by DOLFINx, or by faster kernels in C.

This is the one place that chooses. Every kernel has a plain counterpart in DOLFINx or NumPy, which is used where a
method here returns None: with `plain`, for small bodies, without a compiler, or for forms that the kernels do not
support.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from dolfinx import fem, la
from dolfinx.mesh import Mesh
from mpi4py import MPI

from ..mesh.dolfinx_compat import coefficient_spaces

if TYPE_CHECKING:
    from ctypes import CDLL

    from .cell_subset_assembly import CellSubsetAssembler
    from .jit import CellForm
    from .psd_projection import Flags, Values
    from .simd_kernels import SimdBilinearForm, SimdExpression, SimdFunctional, SimdLinearForm


@dataclass(frozen=True)
class KernelSelection:
    """Choice between DOLFINx and kernels of several cells at a time (simd_kernels), blocks, and subsets of cells.

    Attributes:
        plain: whether DOLFINx does everything.
        min_dofs: number of dofs on all ranks from which a form is compiled once more, in 1 to 2 s the first time. A
            tangent of 3,141 dofs takes 2 ms with it and 9 ms without.
        min_cells: number of cells on all ranks from which an expression of every step or frame is, in 0.5 s, for a
            third of its time.
    """

    plain: bool = False
    min_dofs: int = 3_000
    min_cells: int = 5_000

    def _pays_for(self, form: fem.Form) -> bool:
        if self.plain:
            return False
        spaces = form.function_spaces or coefficient_spaces(form)
        dofs = (space.dofmap.index_map.size_global * space.dofmap.index_map_bs for space in spaces)
        return any(count >= self.min_dofs for count in dofs)

    def functional(self, form: fem.Form) -> SimdFunctional | None:
        """Kernel of an integral over cells (collective)."""
        if not self._pays_for(form):
            return None
        from .simd_kernels import SimdFunctional

        return SimdFunctional.for_form(form)

    def linear_form(self, form: fem.Form) -> SimdLinearForm | None:
        """Kernel of a linear form (collective)."""
        if not self._pays_for(form):
            return None
        from .simd_kernels import SimdLinearForm

        return SimdLinearForm.for_form(form)

    def bilinear_form(self, form: fem.Form, matrix: la.MatrixCSR) -> SimdBilinearForm | None:
        """Kernel of a bilinear form that is added to a matrix (collective)."""
        if not self._pays_for(form):
            return None
        from .simd_kernels import SimdBilinearForm

        return SimdBilinearForm.for_form(form, matrix)

    def expression(
        self, expression: fem.Expression, mesh: Mesh, cells: int, find_source: Callable[[], Path]
    ) -> SimdExpression | None:
        """Kernel of an expression that is evaluated in every step, at one point of each cell (collective).

        Args:
            expression: as DOLFINx compiled it.
            mesh: the mesh.
            cells: number of cells of this rank.
            find_source: returns the C file of FFCx's kernel (collective).
        """
        if self.plain or mesh.comm.allreduce(cells) < self.min_cells:
            return None
        from .simd_kernels import SimdExpression

        return SimdExpression.for_expression(expression, mesh, find_source())

    def block_product(self, comm: MPI.Comm, size: int) -> CDLL | None:
        """Library of products with a tangent in blocks of size x size numbers (collective)."""
        if self.plain:
            return None
        from .block_matrix import compile_block_product

        return compile_block_product(comm, size)

    def psd_correction(self) -> Callable[[Values, float, float, Values, Flags], None] | None:
        """Function that corrects moduli with negative eigenvalues, see psd_projection."""
        if self.plain:
            return None
        from .psd_projection import psd_correction

        return psd_correction

    def polar_rotation(self, comm: MPI.Comm, dim: int) -> Callable[[Values], Values] | None:
        """Function of the polar rotations of (n, d, d) matrices (collective)."""
        if self.plain:
            return None
        from .polar_rotation import compiled_polar_rotation

        return compiled_polar_rotation(comm, dim)

    def cell_subset(self, form: CellForm) -> CellSubsetAssembler | None:
        """Assembler of a linear form over a subset of its cells."""
        if self.plain:
            return None
        from .cell_subset_assembly import CellSubsetAssembler

        return CellSubsetAssembler(form)


class KernelCache[Kernel]:
    """Kernels of forms, each made when it is first needed."""

    def __init__(self, make: Callable[[fem.Form], Kernel | None]) -> None:
        """`make`: kernel of a form; None: DOLFINx assembles it."""
        self._make = make
        self._kernels: dict[fem.Form, Kernel | None] = {}

    def __call__(self, form: fem.Form) -> Kernel | None:
        """Kernel of a form (collective the first time)."""
        if form not in self._kernels:
            self._kernels[form] = self._make(form)
        return self._kernels[form]
