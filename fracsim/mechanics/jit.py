"""Compiling forms: one place for the compiler's flags."""

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
from ..mesh.dolfinx_compat import bind_to_cells, evaluate, keep_kernels, only_cells, source_of
from ..mesh.domain import Domain
from ..mesh.library_cache import library_folder, no_room, not_for_others
from ..mesh.parallel import raise_together

if TYPE_CHECKING:
    from .simd_kernels import SimdExpression

keep_kernels()

_CENTRE = {2: np.array([[1 / 3, 1 / 3]]), 3: np.array([[0.25, 0.25, 0.25]])}


@cache
def jit_options() -> dict[str, list[str] | int | Path]:
    """Of FFCx, which caches kernels by source and flags."""
    return {"cffi_extra_compile_args": machine_flags(), "timeout": PATIENCE, "cache_dir": library_folder()}


PATIENCE = 60  # s that a process waits for a kernel that another one compiles; FFCx's 10 are too few on a busy machine


MANY = 10_000  # dofs from which on it pays to compile a form once more, for 1 to 2 s, for several cells at a time
MANY_CELLS = 5_000  # from which on it does for what is asked in every step: half a second, and a third of the time


class SimdKernelCache[Lanes]:
    """What takes several cells of a form at a time (mechanics.simd_kernels), made where it is first asked for."""

    def __init__(self, make: Callable[[fem.Form], Lanes | None]) -> None:
        """`make`: None where it cannot be done."""
        self._make = make
        self._made: dict[fem.Form, Lanes | None] = {}

    def __call__(self, form: fem.Form) -> Lanes | None:
        """That of a form; None where it does not pay, or cannot be done (collective the first time)."""
        if form not in self._made:
            self._made[form] = self._make(form) if _is_large(form) else None
        return self._made[form]


def _is_large(form: fem.Form) -> bool:
    spaces = form.function_spaces or [field.function_space for field in form._cpp_object.coefficients]
    return any(each.dofmap.index_map.size_global * each.dofmap.index_map_bs >= MANY for each in spaces)


def compile_form(form: ufl.Form) -> fem.Form:
    """Compile a UFL form (collective)."""
    return compile_collectively(form.ufl_domain().ufl_cargo().comm, lambda: fem.form(form, jit_options=jit_options()))


class CellForm(fem.Form):
    """A form over `cells_measure`, cells of which may be left out later: its kernels stay, and so do its facets. They
    are bound to the cells that are left when DOLFINx asks for them next; vectors are summed over `left` without that.

    fem.create_form would bind kernels to other cells as well, but in DOLFINx 0.9 it mixes up the coefficients of a form
    whose derivatives let one of them vanish.
    """

    def __init__(self, form: ufl.Form) -> None:
        whole = compile_form(form)
        self._whole: Any = whole._cpp_object
        self._dead: npt.NDArray[np.bool_] | None = None  # that are not left out yet
        self._out: npt.NDArray[np.bool_] | None = None  # that are
        self._left: npt.NDArray[np.int64] | None = None
        super().__init__(whole._cpp_object, whole.ufcx_form, whole.code, whole.module)
        self._constants = [constant._cpp_object for constant in form.constants()]

    @property
    def _cpp_object(self) -> Any:
        """What DOLFINx asks a form for."""
        if self._dead is not None:
            dead, self._dead = self._dead, None  # binding asks for it, too
            self._bound = self._over(~dead)
        return self._bound

    @_cpp_object.setter
    def _cpp_object(self, bound: Any) -> None:
        self._bound = bound

    @property
    def all_cells_form(self) -> Any:
        """C++ form over all cells of the measure, as it was compiled: to ask it for anything binds nothing anew."""
        return self._whole

    @property
    def remaining_cells(self) -> npt.NDArray[np.int64] | None:
        """The cells that it is integrated over, once any have been left out; None before, and where it has other
        integrals."""
        if self._left is None and self._out is not None and (cells := self._cells) is not None:
            self._left = cells[~self._out[cells]]
        return self._left

    @cached_property
    def _cells(self) -> npt.NDArray[np.int64] | None:
        """Those of the measure; None of a form with other integrals."""
        return only_cells(self._whole)

    def exclude_cells(self, dead: npt.NDArray[np.bool_]) -> None:
        """Integrate from here on over those cells of the measure that are not flagged (not collective)."""
        self._dead = self._out = dead
        self._left = None

    def _over(self, chosen: npt.NDArray[np.bool_]) -> Any:
        return bind_to_cells(self, self._whole, self._constants, lambda cells: cells[chosen[cells]])


def cell_measure(domain: Domain, cells: npt.NDArray[np.int32] | None = None) -> ufl.Measure:
    """Measure of the given owned cells; None: of all of them."""
    every = np.arange(domain.cell_count, dtype=np.int32) if cells is None else cells
    return ufl.Measure("dx", domain=domain.mesh, subdomain_data=[(1, every)])(1)


def compile_collectively[Kernel](comm: MPI.Comm, compile_kernel: Callable[[], Kernel]) -> Kernel:
    """Compile; where an earlier process was killed while it compiled the same kernel, clear that away and do it again.

    FFCx takes what such a process left for a compilation that is still under way. A failure on one rank is raised on
    all (collective).
    """
    kernel, failure = _attempt(compile_kernel)
    timed_out = comm.allreduce("JIT compilation timed out" in str(failure), op=MPI.LOR)
    if timed_out and comm.allreduce(_clear_abandoned(), op=MPI.LOR):
        kernel, failure = _attempt(compile_kernel)
    raise_together(comm, failure)
    assert kernel is not None
    return kernel


def _attempt[Kernel](compile_kernel: Callable[[], Kernel]) -> tuple[Kernel | None, Exception | None]:
    try:
        with not_for_others():
            return compile_kernel(), None
    except Exception as error:  # the compiler's, the linker's, the file system's
        return None, _explained(error)


def _explained(error: Exception) -> Exception:
    """What a user can mend of a compiler's failure, which comes as an error of setuptools', cffi's or DOLFINx's."""
    kind, folder = type(error).__module__.split(".")[0], library_folder()
    if kind not in ("cffi", "distutils", "setuptools") and "Compile" not in str(error) and "Link" not in str(error):
        return error
    if no_room(folder):
        return CannotWrite(f"no room to compile kernels in {folder}; make room, or name another XDG_CACHE_HOME")
    return InputError(f"a kernel cannot be compiled in {folder}: {error}; install a C compiler, or name yours in CC")


def _clear_abandoned() -> bool:
    """Remove kernels that have been compiling for longer than anyone waits; whether there were any."""
    folder = library_folder()
    abandoned = [
        path for path in folder.glob("libffcx_*.c")
        if not path.with_suffix(".c.cached").exists() and time.time() - path.stat().st_mtime > PATIENCE - 1
    ]  # fmt: skip
    for path in abandoned:
        path.unlink(missing_ok=True)
    return bool(abandoned)


def renumber_labels(expression: Expr) -> Expr:
    """An expression whose labels (of ufl.variable) are numbered from 0, in the order in which they are met: they do not
    tell how many there have been before it.

    FFCx knows a kernel again by its signature. UFL 2024.2 puts the number of a label into that of an expression: each
    scene of a process would compile its own.
    """
    anew: dict[Expr, Expr] = {}
    given = 0
    for part in unique_post_traversal(expression):
        if isinstance(part, Label):
            anew[part], given = Label(given), given + 1
            continue
        operands = [anew[each] for each in part.ufl_operands]
        same = all(new is old for new, old in zip(operands, part.ufl_operands, strict=True))
        anew[part] = part if same else part._ufl_expr_reconstruct_(*operands)
    return anew[expression]


class CellExpression:
    """A UFL expression as its mean over each cell, evaluated by a compiled kernel into an array that is kept.

    What depends on F alone is constant in a cell with linear displacement, and asked for at its centre; with quadratic
    displacement at the points where stress is integrated, which have equal weights.

    Attributes:
        width: components of the expression.    count: points of a cell.
    """

    def __init__(
        self, comm: MPI.Comm, mesh: Mesh, expression: Expr, cells: int, points: npt.NDArray[np.float64] | None = None,
        *, every_step: bool = False,
    ) -> None:  # fmt: skip
        """`points`: (count, d) of the reference cell; None: by the fields that the expression is made of. `often`: it
        is asked for in every step, so that compiling it once more may pay (collective)."""
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
        pays = every_step and self.points_per_cell == 1 and comm.allreduce(cells) >= MANY_CELLS
        self._lanes = self._in_lanes() if pays else None
        self._values: npt.NDArray[np.float64] | None = None

    def __call__(self, cells: npt.NDArray[np.int32] | None = None) -> npt.NDArray[np.float64]:
        """(cells, width) values on all owned cells (an array that the next such call overwrites) or on those given."""
        values = self.evaluate_at_points(cells)
        return (
            values if self.points_per_cell == 1 else values.reshape(-1, self.points_per_cell, self.width).mean(axis=1)
        )

    def evaluate_at_points(self, cells: npt.NDArray[np.int32] | None = None) -> npt.NDArray[np.float64]:
        """(cells, count width) the same at each of the points."""
        if cells is None:
            if self._values is None:
                self._values = np.empty((len(self._all), self.points_per_cell * self.width))
            return self._into(self._values, self._all)
        return self._into(np.empty((len(cells), self.points_per_cell * self.width)), cells)

    def _into(self, values: npt.NDArray[np.float64], cells: npt.NDArray[np.int32]) -> npt.NDArray[np.float64]:
        if self._lanes is None:
            return evaluate(self._compiled, self.mesh, cells, values)
        self._lanes(cells, values)
        return values

    def _in_lanes(self) -> SimdExpression | None:
        from .simd_kernels import SimdExpression

        source = source_of(self._compiled, self.mesh, jit_options())
        return SimdExpression.for_expression(self._compiled, self.mesh, source)


def point_expression(domain: Domain, expression: Expr, *, every_step: bool = False) -> CellExpression:
    """An expression whose `at_points` are those of a `point_field`."""
    points = stress_points(domain.mesh) if domain.order == 2 else _CENTRE[domain.dim]
    return CellExpression(domain.comm, domain.mesh, expression, domain.cell_count, points, every_step=every_step)


def _points_of(mesh: Mesh, expression: Expr) -> npt.NDArray[np.float64]:
    """(count, d) points of the reference cell that do for an expression."""
    fields = [field.ufl_element() for field in extract_coefficients(expression)]
    quadratic = any(element.embedded_superdegree > 1 for element in fields)
    return stress_points(mesh) if quadratic else _CENTRE[mesh.topology.dim]


def stress_points(mesh: Mesh) -> npt.NDArray[np.float64]:
    """(3 or 4, d) points of the reference cell where stress is integrated with quadratic displacement
    (forms.balance.points_of_stress)."""
    points: npt.NDArray[np.float64] = np.asarray(basix.make_quadrature(mesh.basix_cell(), STRESS_DEGREE)[0])
    return points


def quadratic_shape_functions(mesh: Mesh) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """(count, k) functions of the nodes of a cell with quadratic displacement at these points, and (count, k, d) their
    derivatives by the barycentric coordinates of the corners but the first."""
    element = basix.create_element(basix.ElementFamily.P, mesh.basix_cell(), 2, basix.LagrangeVariant.gll_warped)
    table: npt.NDArray[np.float64] = np.asarray(element.tabulate(1, stress_points(mesh)))[..., 0]
    return table[0], np.moveaxis(table[1:], 0, -1)


STRESS_DEGREE = 2  # of the quadrature of a stress where displacement is quadratic


def points_per_cell(domain: Domain) -> int:
    """How many points `point_field` has in a cell."""
    return 1 if domain.order == 1 else domain.dim + 1


def point_field(domain: Domain, shape: tuple[int, ...], name: str) -> fem.Function:
    """A field of scalars or tensors with a value at each point where stress is integrated, those of a cell one after
    the other in `x.array`; DG0 with linear displacement."""
    if domain.order == 1:
        return fem.Function(fem.functionspace(domain.mesh, ("DG", 0, shape)), name=name)
    element = basix.ufl.quadrature_element(domain.mesh.basix_cell(), shape, degree=STRESS_DEGREE)
    return fem.Function(fem.functionspace(domain.mesh, element), name=name)
