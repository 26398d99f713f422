"""Forms and expressions of several cells at a time, by SIMD: FFCx's kernels with vectors of LANES numbers.

FFCx writes C for one cell. The tangent of a hyperelastic tetrahedron is 2,000 products and sums of scalars, one at a
time, and DOLFINx then searches for the position of each of 16 blocks. Here the same C is compiled with vectors instead
of scalars (extensions of GCC and Clang, one lane a cell, with the same rounding), and positions are searched for once:
220 ns a cell instead of 950. Kernels with conditions, or with functions that vectors do not have, are left to DOLFINx.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from ctypes import CDLL, Structure, byref, c_int64, c_void_p, cast
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from dolfinx import fem, la
from dolfinx.mesh import Mesh
from mpi4py import MPI

from ..mesh.c_library import LANES, Float64, Int32, compile_on_all_ranks, struct_pointer
from ..mesh.dolfinx_compat import (
    FormField,
    cell_geometry,
    cell_node_count,
    expression_fields,
    form_cell_nodes,
    form_fields,
    integrated_cells_of,
    kernel_constants,
    set_identity_rows,
)

Values = npt.NDArray[np.float64]

FUNCTIONS = ("fabs", "sqrt", "log", "exp")  # evaluated lane by lane
SOURCE = Path(__file__).with_suffix(".c")
_LANE_BY_LANE = """
static inline real lanes_{0}(real x) {{ for (int i = 0; i < LANES; ++i) x[i] = {0}(x[i]); return x; }}
#define {0} lanes_{0}
"""
_POWERS = """ // with a constant exponent
static inline real lanes_pow(real x, double n) { for (int i = 0; i < LANES; ++i) x[i] = pow(x[i], n); return x; }
#define pow lanes_pow
"""


class _SimdForm(Structure):
    """Structure `Form` of simd_kernels.c."""

    _fields_ = (
        *((name, c_int64) for name in ("count", "width", "size")),
        *((name, Int32) for name in ("cells", "dofs", "corners")),
        *((name, Float64) for name in ("x", "c")),
        ("fields", c_void_p),
    )  # fmt: skip


class _SimdField(Structure):
    """Structure `Field` of simd_kernels.c."""

    _fields_ = (("dofs", Int32), ("values", Float64))


class _KernelFields:
    """Coefficients of a kernel, which C reads from their own arrays.

    Attributes:
        width: number of values in a cell.    pointer: to the structures of the fields.
    """

    def __init__(self, fields: Sequence[FormField]) -> None:
        self._pointers = [(struct_pointer(field.dofs), struct_pointer(field.values)) for field in fields]
        self._structures = (_SimdField * (len(fields) + 1))(*(_SimdField(*pair) for pair in self._pointers))
        self.width = sum(field.dofs.shape[1] * field.size for field in fields)
        self.pointer = cast(self._structures, c_void_p)


class SimdKernel:
    """Form over cells, whose kernel takes several cells at a time."""

    @classmethod
    def for_form(cls, form: fem.Form, *more: Any) -> Self | None:
        """Kernel of a form, None if it cannot be vectorised; `more`: further arguments of the class (collective)."""
        code = compile_simd_form(form)
        return None if code is None else cls(form, code, *more)

    def __init__(self, form: fem.Form, code: CDLL) -> None:
        """`code`: library of `compile_simd_form`."""
        self._form, self._code = form, code
        self._nodes = form_cell_nodes(form) if form.rank else cell_geometry(form.mesh.geometry)
        self._fields = _KernelFields(form_fields(form))

    @property
    def _cells(self) -> npt.NDArray[np.int32]:
        """Cells over which the form integrates at present."""
        cells = integrated_cells_of(self._form)
        assert cells is not None  # `compile_simd_form` takes no other form
        return cells

    def _call(self, function: Any, *arguments: npt.NDArray[Any]) -> int:
        """Result of a C function of the form and further arrays."""
        cells, geometry, c = self._cells, self._form.mesh.geometry, kernel_constants(self._form)
        arrays = cells, self._nodes, cell_geometry(geometry), geometry.x, c
        form = _SimdForm(len(cells), self._fields.width, len(c), *map(struct_pointer, arrays), self._fields.pointer)
        return int(function(byref(form), *arguments) or 0)


class SimdFunctional(SimdKernel):
    """Integral over cells."""

    def integrate(self) -> float:
        """Sum over this rank's cells."""
        values = np.empty(len(self._cells))
        self._call(self._code.fill, values)
        return float(values.sum())


class SimdLinearForm(SimdKernel):
    """Linear form over cells."""

    def add_to(self, values: Values) -> None:
        """Add this rank's part to the values of dofs (dofs,), ghosts included."""
        self._call(self._code.add, values)


class SimdBilinearForm(SimdKernel):
    """Bilinear form over cells, and the positions of its blocks in a matrix of blocks or of single entries."""

    def __init__(self, form: fem.Form, code: CDLL, matrix: la.MatrixCSR) -> None:
        super().__init__(form, code)
        dofmap = form.function_spaces[0].dofmap
        self._bs = dofmap.index_map_bs
        self._prescribed = np.zeros(dofmap.index_map.size_local + dofmap.index_map.num_ghosts, np.uint8)
        self._positions = np.zeros((len(self._nodes), self._nodes.shape[1] ** 2), np.int32)
        starts = matrix.indptr.astype(np.int64)
        # rows and columns of a node are so far apart: 1 in a matrix of blocks
        spacing = 1 if matrix.block_size[0] > 1 else self._bs
        row_lengths = np.diff(starts)[::spacing]
        self._strides = (np.full_like(row_lengths, self._bs) if spacing == 1 else row_lengths).astype(np.int32)
        code.find(c_int64(len(self._nodes)), self._nodes, c_int64(spacing), starts, matrix.indices, self._positions)

    def add_to(self, matrix: la.MatrixCSR, bcs: list[fem.DirichletBC]) -> None:
        """Add this rank's part as DOLFINx does: rows and columns of prescribed dofs become those of the identity."""
        self._prescribed[:] = 0  # a bit for each prescribed axis of a node
        for bc in bcs:
            dofs = bc.dof_indices()[0]
            np.bitwise_or.at(self._prescribed, dofs // self._bs, (1 << dofs % self._bs).astype(np.uint8))
        if missing := self._call(self._code.add_blocks, self._positions, self._strides, self._prescribed, matrix.data):
            raise ValueError(f"the matrix has no place for cell {missing - 1} of its form")
        set_identity_rows(matrix, self._form, bcs)


class SimdExpression:
    """Expression at one point of each cell."""

    @classmethod
    def for_expression(cls, expression: fem.Expression, mesh: Mesh, source: Path) -> Self | None:
        """Expression of FFCx's kernel in the file `source`; None if it cannot be vectorised (collective)."""
        kernel = vectorise_kernel(source.read_text(encoding="utf-8"))
        if kernel is None:
            return None
        sizes = {"RANK": 0, "D": 1, "NODES": expression.value_size, "CORNERS": cell_node_count(mesh.geometry)}
        code = _compile(mesh.comm, kernel, sizes, expression_fields(expression), "-O3")
        return None if code is None else cls(expression, mesh, code)

    def __init__(self, expression: fem.Expression, mesh: Mesh, code: CDLL) -> None:
        """`code`: library of `for_expression`."""
        self._expression, self._geometry, self._code = expression, mesh.geometry, code
        self._fields = _KernelFields(expression_fields(expression))

    def __call__(self, cells: npt.NDArray[np.int32], values: Values) -> None:
        """Evaluate the expression in cells (n,) into values (n, components)."""
        c = kernel_constants(self._expression)
        geometry = struct_pointer(cell_geometry(self._geometry)), struct_pointer(self._geometry.x)
        form = _SimdForm(
            len(cells),
            self._fields.width,
            len(c),
            struct_pointer(cells),
            None,
            *geometry,
            struct_pointer(c),
            self._fields.pointer,
        )
        self._code.fill(byref(form), values)


# --- compiling ------------------------------------------------------------------------------------------------------


def compile_simd_form(form: fem.Form) -> CDLL | None:
    """Library of the vectorised kernel of a form; None if it cannot be vectorised (collective)."""
    if integrated_cells_of(form) is None:
        return None
    fields, corners = form_fields(form), cell_node_count(form.mesh.geometry)
    bs, nodes = 1, 1
    if form.rank:
        space = form.function_spaces[0]
        bs, nodes = space.dofmap.index_map_bs, space.element.space_dimension // space.dofmap.index_map_bs
    # kernels of curved cells gain only half, and take 15 s to compile
    if max([nodes, *(field.dofs.shape[1] for field in fields)]) > corners:
        return None
    sizes = {"RANK": form.rank, "D": bs, "NODES": nodes, "CORNERS": corners}
    source = Path(str(form.module.__file__))  # type: ignore[union-attr]
    kernel = vectorise_kernel(source.with_name(source.name.split(".")[0] + ".c").read_text(encoding="utf-8"))
    if kernel is None:
        return None
    return _compile(form.mesh.comm, kernel, sizes, fields)


def _compile(
    comm: MPI.Comm, kernel: str, sizes: Mapping[str, int], fields: Sequence[FormField], *more: str
) -> CDLL | None:
    """Library of simd_kernels.c with a vectorised kernel (collective).

    Args:
        comm: of the mesh.
        kernel: body of the kernel.
        sizes: macros of simd_kernels.c.
        fields: coefficients of the kernel.
        more: further compiler flags.
    """
    takes = (f"TAKE({number},{field.dofs.shape[1]},{field.size})" for number, field in enumerate(fields))
    functions = "".join(_LANE_BY_LANE.format(name) for name in FUNCTIONS) + _POWERS
    text = SOURCE.read_text(encoding="utf-8").replace("// functions\n", functions).replace("// kernel\n", f"{kernel}\n")
    defined = [f"-D{name}={value}" for name, value in sizes.items()] + [f"-DFIELDS={''.join(takes)}"]
    return compile_on_all_ranks(comm, "lanes", text, [*_FLAGS, *more, *defined])


def vectorise_kernel(source: str) -> str | None:
    """Body of the only kernel in FFCx's C, for vectors of LANES numbers; None if it cannot be vectorised."""
    _, *kernels = source.split("\nvoid tabulate_tensor_")
    end = re.search(r"\n(ufcx_integral|bool enabled_|static double points_)", kernels[0]) if len(kernels) == 1 else None
    if end is None or "{" not in kernels[0]:
        return None
    body = kernels[0][kernels[0].index("{") : end.start()]
    called = set(re.findall(r"\b([A-Za-z_]\w*) *\(", re.sub(r"//.*|\bpow\(\w+, \d+\)", "", body)))
    if "?" in body or not called <= {"for", *FUNCTIONS}:
        return None
    return "\n".join(_vectorise_line(line) for line in body.split("\n"))


def _vectorise_line(line: str) -> str:
    """Line of C with vectors instead of scalars: tables stay scalars, loops are unrolled."""
    if loop := re.match(r" *for \(int [ij]", line):
        return f"#pragma GCC unroll 4\n{loop.string}"
    declared = re.match(r" *double (\w+(?:\[\d+\])*) = (.*);$", line)
    if declared is None:
        return line
    name, value = declared.groups()
    return f"real {name} = {{0}};" if value in ("0", "0.0", "{0}") else f"real {name} = ({value}) - zero;"


# terms with the zeros of tables are dropped; no other flag may change the order of sums
_FLAGS = ["-O2", f"-DLANES={LANES}", "-fno-signed-zeros", "-ffinite-math-only", "-fno-trapping-math", "-fno-math-errno"]
