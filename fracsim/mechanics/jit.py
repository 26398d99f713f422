"""Compiled forms and expressions, with the compiler's flags in one place, and fields at integration points."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import basix
import basix.ufl
import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from dolfinx.mesh import Mesh
from mpi4py import MPI
from ufl.algorithms import extract_coefficients
from ufl.core.expr import Expr
from ufl.corealg.traversal import unique_post_traversal
from ufl.variable import Label

from ..errors import CannotWrite, InputError
from ..mesh.c_library import machine_flags
from ..mesh.dolfinx_compat import bind_to_cells, cache_kernels, evaluate, integrated_cells_of, kernel_source
from ..mesh.domain import Domain
from ..mesh.library_cache import is_disk_full, library_folder, private_umask
from ..mesh.parallel import raise_on_all_ranks

if TYPE_CHECKING:
    from .kernel_selection import KernelSelection
    from .simd_kernels import SimdExpression

cache_kernels()

_CENTRE = {2: np.array([[1 / 3, 1 / 3]]), 3: np.array([[0.25, 0.25, 0.25]])}


@cache
def jit_options() -> dict[str, list[str] | int | Path]:
    """Options of FFCx, which caches kernels by source and flags."""
    return {"cffi_extra_compile_args": machine_flags(), "timeout": PATIENCE, "cache_dir": library_folder()}


# seconds that a process waits for a kernel that another one compiles; FFCx's 10 are too few on a busy machine
PATIENCE = 60


def compile_form(form: ufl.Form) -> fem.Form:
    """Compile a UFL form (collective)."""
    return compile_collectively(form.ufl_domain().ufl_cargo().comm, lambda: fem.form(form, jit_options=jit_options()))


class CellForm(fem.Form):
    """Form over `cell_measure` from which cells can be excluded later, with the same compiled kernels.

    Kernels are bound to the remaining cells when DOLFINx asks for the form next. Vectors are assembled over
    `remaining_cells` without that.

    Attributes:
        whole: the form over all cells of the measure, as it was compiled.
    """

    # fem.create_form would bind kernels to other cells as well, but in DOLFINx 0.9 it mixes up the coefficients of a
    # form whose derivatives let one of them vanish

    def __init__(self, form: ufl.Form) -> None:
        compiled = compile_form(form)
        self.whole = compiled
        self._excluded: npt.NDArray[np.bool_] | None = None
        self._remaining: npt.NDArray[np.int64] | None = None
        super().__init__(compiled._cpp_object, compiled.ufcx_form, compiled.code, compiled.module)
        self._constants = [constant._cpp_object for constant in form.constants()]

    @cached_property
    def _cpp_object(self) -> Any:
        """C++ form that DOLFINx uses, over the remaining cells."""
        assert self._excluded is not None  # without excluded cells it is the compiled form
        return self._over(~self._excluded)

    @property
    def remaining_cells(self) -> npt.NDArray[np.int64] | None:
        """Cells of the integral once any have been excluded; None before, and for forms with other integrals."""
        if self._remaining is None and self._excluded is not None and (cells := self._cells) is not None:
            self._remaining = cells[~self._excluded[cells]]
        return self._remaining

    @cached_property
    def _cells(self) -> npt.NDArray[np.int64] | None:
        """Cells of the measure; None for a form with other integrals."""
        cells = integrated_cells_of(self.whole)
        return None if cells is None else np.array(cells, np.int64)

    def exclude_cells(self, dead: npt.NDArray[np.bool_]) -> None:
        """Integrate from now on over the cells of the measure that are not flagged (cells,) (not collective)."""
        self._excluded, self._remaining = dead, None
        self.__dict__.pop("_cpp_object", None)  # kernels are bound to the remaining cells when it is asked for

    def _over(self, chosen: npt.NDArray[np.bool_]) -> Any:
        return bind_to_cells(self.whole, self._constants, lambda cells: cells[chosen[cells]])


def cell_measure(domain: Domain, cells: npt.NDArray[np.int32] | None = None) -> ufl.Measure:
    """Measure of owned cells (n,); None: of all of them."""
    entities = np.arange(domain.cell_count, dtype=np.int32) if cells is None else cells
    return ufl.Measure("dx", domain=domain.mesh, subdomain_data=[(1, entities)])(1)


def compile_collectively[Kernel](comm: MPI.Comm, compile_kernel: Callable[[], Kernel]) -> Kernel:
    """Compile a kernel on all ranks; a failure on one rank is raised on all (collective).

    Files of an earlier process that was killed while it compiled the same kernel are removed: FFCx takes them for a
    compilation that is still running.
    """
    kernel, failure = _attempt(compile_kernel)
    timed_out = comm.allreduce("JIT compilation timed out" in str(failure), op=MPI.LOR)
    if timed_out and comm.allreduce(_clear_abandoned(), op=MPI.LOR):
        kernel, failure = _attempt(compile_kernel)
    raise_on_all_ranks(comm, failure)
    assert kernel is not None
    return kernel


def _attempt[Kernel](compile_kernel: Callable[[], Kernel]) -> tuple[Kernel | None, Exception | None]:
    try:
        with private_umask():
            return compile_kernel(), None
    except Exception as error:  # the compiler's, the linker's, the file system's
        return None, _explained(error)


def _explained(error: Exception) -> Exception:
    """Error with a message for users of a compiler's failure, which setuptools, cffi or DOLFINx raised."""
    kind, folder = type(error).__module__.split(".")[0], library_folder()
    if kind not in ("cffi", "distutils", "setuptools") and "Compile" not in str(error) and "Link" not in str(error):
        return error
    if is_disk_full(folder):
        return CannotWrite(f"no room to compile kernels in {folder}; make room, or name another XDG_CACHE_HOME")
    return InputError(f"a kernel cannot be compiled in {folder}: {error}; install a C compiler, or name yours in CC")


def _clear_abandoned() -> bool:
    """Remove kernels that have been compiling for longer than `PATIENCE`; returns whether there were any."""
    folder = library_folder()
    abandoned = [
        path for path in folder.glob("libffcx_*.c")
        if not path.with_suffix(".c.cached").exists() and time.time() - path.stat().st_mtime > PATIENCE - 1
    ]  # fmt: skip
    for path in abandoned:
        path.unlink(missing_ok=True)
    return bool(abandoned)


def renumber_labels(expression: Expr) -> Expr:
    """The same expression with the labels of ufl.variable numbered from 0, in the order of traversal.

    FFCx recognises a kernel by its signature, which with UFL 2024.2 has the numbers of labels. Each scene of a process
    would otherwise compile its own kernels.
    """
    renumbered: dict[Expr, Expr] = {}
    count = 0
    for part in unique_post_traversal(expression):
        if isinstance(part, Label):
            renumbered[part], count = Label(count), count + 1
            continue
        operands = [renumbered[operand] for operand in part.ufl_operands]
        same = all(new is old for new, old in zip(operands, part.ufl_operands, strict=True))
        renumbered[part] = part if same else part._ufl_expr_reconstruct_(*operands)
    return renumbered[expression]


class CellExpression:
    """UFL expression that a compiled kernel evaluates in each cell.

    A function of F is constant in a cell with linear displacement, and is evaluated at its centre. With quadratic
    displacement it is evaluated at the points where stress is integrated, which have equal weights.

    Attributes:
        mesh: the mesh.
        width: components of the expression.    count: points of a cell.
    """

    def __init__(
        self, comm: MPI.Comm, mesh: Mesh, expression: Expr, cells: int, points: npt.NDArray[np.float64] | None = None,
        *, kernels: KernelSelection | None = None,
    ) -> None:  # fmt: skip
        """Compile an expression (collective).

        Args:
            comm: of the mesh.
            mesh: the mesh.
            expression: a scalar, vector or tensor.
            cells: number of cells of this rank.
            points: (count, d) points of the reference cell; None: those that the fields of the expression need.
            kernels: selection of kernels, for an expression of every step; None: DOLFINx evaluates it.
        """
        shape = expression.ufl_shape
        self.mesh = mesh
        self.width = int(np.prod(shape, dtype=int))
        points = _points_of(mesh, expression) if points is None else points
        self.points_per_cell = len(points)
        self._compiled = compile_collectively(
            comm,
            lambda: fem.Expression(renumber_labels(expression), points, comm=comm, jit_options=jit_options()),
        )
        self._all = np.arange(cells, dtype=np.int32)
        self._kernel: SimdExpression | None = None
        if kernels is not None and self.points_per_cell == 1:
            self._kernel = kernels.expression(
                self._compiled, mesh, cells, lambda: kernel_source(self._compiled, mesh, jit_options())
            )

    def __call__(self, cells: npt.NDArray[np.int32] | None = None) -> npt.NDArray[np.float64]:
        """(cells, width) mean values in all owned cells or in `cells`."""
        values = self.evaluate_at_points(cells)
        return (
            values if self.points_per_cell == 1 else values.reshape(-1, self.points_per_cell, self.width).mean(axis=1)
        )

    def evaluate_at_points(self, cells: npt.NDArray[np.int32] | None = None) -> npt.NDArray[np.float64]:
        """(cells, points_per_cell width) values at each of the points."""
        if cells is None:
            cells = self._all
        return self._into(np.empty((len(cells), self.points_per_cell * self.width)), cells)

    def _into(self, values: npt.NDArray[np.float64], cells: npt.NDArray[np.int32]) -> npt.NDArray[np.float64]:
        if self._kernel is None:
            return evaluate(self._compiled, self.mesh, cells, values)
        self._kernel(cells, values)
        return values


def point_expression(domain: Domain, expression: Expr, *, kernels: KernelSelection | None = None) -> CellExpression:
    """Expression at the points of a `point_field`; `kernels`: as for CellExpression (collective)."""
    points = stress_points(domain.mesh) if domain.order == 2 else _CENTRE[domain.dim]
    return CellExpression(domain.comm, domain.mesh, expression, domain.cell_count, points, kernels=kernels)


def _points_of(mesh: Mesh, expression: Expr) -> npt.NDArray[np.float64]:
    """(count, d) points of the reference cell at which an expression is evaluated."""
    fields = [field.ufl_element() for field in extract_coefficients(expression)]
    quadratic = any(element.embedded_superdegree > 1 for element in fields)
    return stress_points(mesh) if quadratic else _CENTRE[mesh.topology.dim]


def stress_points(mesh: Mesh) -> npt.NDArray[np.float64]:
    """(3 or 4, d) points of the reference cell where stress is integrated, with quadratic displacement.

    The same as in forms.balance.points_of_stress.
    """
    points: npt.NDArray[np.float64] = np.asarray(basix.make_quadrature(mesh.basix_cell(), STRESS_DEGREE)[0])
    return points


def quadratic_shape_functions(mesh: Mesh) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Shape functions (count, k) of the nodes of a quadratic cell at `stress_points`, and derivatives (count, k, d).

    Derivatives are by the barycentric coordinates of all corners but the first.
    """
    element = basix.create_element(basix.ElementFamily.P, mesh.basix_cell(), 2, basix.LagrangeVariant.gll_warped)
    table: npt.NDArray[np.float64] = np.asarray(element.tabulate(1, stress_points(mesh)))[..., 0]
    return table[0], np.moveaxis(table[1:], 0, -1)


STRESS_DEGREE = 2  # degree of the quadrature of stress with quadratic displacement


def points_per_cell(domain: Domain) -> int:
    """Number of points of a `point_field` in a cell."""
    return 1 if domain.order == 1 else domain.dim + 1


def point_field(domain: Domain, shape: tuple[int, ...], name: str) -> fem.Function:
    """Field of scalars or tensors at the points where stress is integrated; DG0 with linear displacement.

    The values of a cell's points come one after the other in `x.array`.
    """
    if domain.order == 1:
        return fem.Function(fem.functionspace(domain.mesh, ("DG", 0, shape)), name=name)
    element = basix.ufl.quadrature_element(domain.mesh.basix_cell(), shape, degree=STRESS_DEGREE)
    return fem.Function(fem.functionspace(domain.mesh, element), name=name)
