"""Forms and expressions of several cells at a time: FFCx's kernel with numbers of LANES lanes, and what becomes of what
it makes (simd_kernels.c).

FFCx writes C for one cell, and the tangent of a hyperelastic tetrahedron is 2,000 products and sums of scalars, of
which a processor does one at a time; DOLFINx then looks up the place of each of 16 blocks. Here the same C is compiled
with vectors in the place of scalars (GCC's and Clang's, a lane a cell: no rounding differs), and places are looked up
once: 220 ns a cell where it took 950. What vectors of C cannot do, a choice by a condition and most functions, stays
DOLFINx's work.
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

from ..mesh.c_library import Float64, Int32, compile_on_all_ranks, struct_pointer
from ..mesh.dolfinx_compat import (
    FormField,
    cells_of,
    constants_of,
    expression_fields,
    form_fields,
    identity_rows,
    integrals,
    nodes_of_cells,
)

Values = npt.NDArray[np.float64]

LANES = 4
FUNCTIONS = ("fabs", "sqrt", "log", "exp")  # that are taken lane by lane
SOURCE = Path(__file__).with_suffix(".c")
_LANE_BY_LANE = """
static inline real lanes_{0}(real x) {{ for (int i = 0; i < LANES; ++i) x[i] = {0}(x[i]); return x; }}
#define {0} lanes_{0}
"""
_POWERS = """ // by a number
static inline real lanes_pow(real x, double n) { for (int i = 0; i < LANES; ++i) x[i] = pow(x[i], n); return x; }
#define pow lanes_pow
"""


class _Form(Structure):
    """As in C."""

    _fields_ = (
        *((name, c_int64) for name in ("count", "width", "size")),
        *((name, Int32) for name in ("cells", "dofs", "corners")),
        *((name, Float64) for name in ("x", "c")),
        ("fields", c_void_p),
    )  # fmt: skip


class _Field(Structure):
    """The same."""

    _fields_ = (("dofs", Int32), ("values", Float64))


class _Fields:
    """What a kernel is given of functions: looked up in their own arrays, cell by cell.

    Attributes:
        width: numbers in a cell.    place: where C has them.
    """

    def __init__(self, fields: Sequence[FormField]) -> None:
        self._kept = [(struct_pointer(field.dofs), struct_pointer(field.values)) for field in fields]
        self._here = (_Field * (len(fields) + 1))(*(_Field(*each) for each in self._kept))
        self.width = sum(field.dofs.shape[1] * field.size for field in fields)
        self.place = cast(self._here, c_void_p)


class SimdKernel:
    """A form of cells, whose kernel takes several at a time."""

    @classmethod
    def for_form(cls, form: fem.Form, *more: Any) -> Self | None:
        """Those of a form, where that can be done; `more`: what the class takes beside it (collective)."""
        code = compile_simd_form(form)
        return None if code is None else cls(form, code, *more)

    def __init__(self, form: fem.Form, code: CDLL) -> None:
        """`code`: what `compiled` has made of the form."""
        self._form, self._code = form, code
        self._nodes = nodes_of_cells(form) if form.rank else form.mesh.geometry.dofmap
        self._fields = _Fields(form_fields(form))

    def _call(self, function: Any, *given: npt.NDArray[Any]) -> int:
        """What a function of C returns."""
        cells, geometry, c = cells_of(self._form), self._form.mesh.geometry, constants_of(self._form)
        arrays = cells, self._nodes, geometry.dofmap, geometry.x, c
        form = _Form(len(cells), self._fields.width, len(c), *map(struct_pointer, arrays), self._fields.place)
        return int(function(byref(form), *given) or 0)


class SimdFunctional(SimdKernel):
    """A functional of cells."""

    def integrate(self) -> float:
        """Of this rank's cells."""
        values = np.empty(len(cells_of(self._form)))
        self._call(self._code.fill, values)
        return float(values.sum())


class SimdLinearForm(SimdKernel):
    """A linear form of cells."""

    def add_to(self, values: Values) -> None:
        """Add this rank's part to the values of dofs, ghosts included."""
        self._call(self._code.add, values)


class SimdBilinearForm(SimdKernel):
    """A bilinear form of cells, and where what it adds is in a matrix of blocks, or of single entries."""

    def __init__(self, form: fem.Form, code: CDLL, matrix: la.MatrixCSR) -> None:
        super().__init__(form, code)
        dofmap = form.function_spaces[0].dofmap
        self._bs = dofmap.index_map_bs
        self._held = np.zeros(dofmap.index_map.size_local + dofmap.index_map.num_ghosts, np.uint8)
        self._places = np.zeros((len(self._nodes), self._nodes.shape[1] ** 2), np.int32)
        starts = matrix.indptr.astype(np.int64)
        apart = 1 if matrix.block_size[0] > 1 else self._bs
        lengths = np.diff(starts)[::apart]  # of rows
        self._strides = (np.full_like(lengths, self._bs) if apart == 1 else lengths).astype(np.int32)
        code.find(c_int64(len(self._nodes)), self._nodes, c_int64(apart), starts, matrix.indices, self._places)

    def add_to(self, matrix: la.MatrixCSR, bcs: list[fem.DirichletBC]) -> None:
        """Add this rank's part as DOLFINx does: rows and columns of prescribed dofs become the identity's."""
        self._held[:] = 0
        for bc in bcs:
            dofs = bc.dof_indices()[0]
            np.bitwise_or.at(self._held, dofs // self._bs, (1 << dofs % self._bs).astype(np.uint8))
        if missing := self._call(self._code.add_blocks, self._places, self._strides, self._held, matrix.data):
            raise ValueError(f"the matrix has no place for cell {missing - 1} of its form")
        identity_rows(matrix, self._form, bcs)


class SimdExpression:
    """An expression, at a point of each cell."""

    @classmethod
    def for_expression(cls, expression: fem.Expression, mesh: Mesh, source: Path) -> Self | None:
        """That of FFCx's kernel in `source`, where it can be done (collective)."""
        kernel = vectorise_kernel(source.read_text())
        if kernel is None:
            return None
        sizes = {"RANK": 0, "D": 1, "NODES": expression.value_size, "CORNERS": mesh.geometry.cmap.dim}
        code = _built(mesh.comm, kernel, sizes, expression_fields(expression), "-O3")
        return None if code is None else cls(expression, mesh, code)

    def __init__(self, expression: fem.Expression, mesh: Mesh, code: CDLL) -> None:
        """`code`: what `of` has made of the expression."""
        self._expression, self._geometry, self._code = expression, mesh.geometry, code
        self._fields = _Fields(expression_fields(expression))

    def __call__(self, cells: npt.NDArray[np.int32], values: Values) -> None:
        """Fill values (cells, components) with those of cells."""
        c = constants_of(self._expression)
        of_mesh = struct_pointer(self._geometry.dofmap), struct_pointer(self._geometry.x)
        form = _Form(
            len(cells),
            self._fields.width,
            len(c),
            struct_pointer(cells),
            None,
            *of_mesh,
            struct_pointer(c),
            self._fields.place,
        )
        self._code.fill(byref(form), values)


# --- compiling ------------------------------------------------------------------------------------------------------


def compile_simd_form(form: fem.Form) -> CDLL | None:
    """What `Lanes` takes of a form; None where there is no such thing (collective)."""
    if integrals(form) != [fem.IntegralType.cell]:
        return None
    fields, corners = form_fields(form), form.mesh.geometry.cmap.dim
    bs, nodes = 1, 1
    if form.rank:
        space = form.function_spaces[0]
        bs, nodes = space.dofmap.index_map_bs, space.element.space_dimension // space.dofmap.index_map_bs
    if max([nodes, *(each.dofs.shape[1] for each in fields)]) > corners:  # bent cells gain half, and compile in 15 s
        return None
    sizes = {"RANK": form.rank, "D": bs, "NODES": nodes, "CORNERS": corners}
    source = Path(str(form.module.__file__))  # type: ignore[union-attr]
    kernel = vectorise_kernel(source.with_name(source.name.split(".")[0] + ".c").read_text())
    if kernel is None:
        return None
    return _built(form.mesh.comm, kernel, sizes, fields)


def _built(
    comm: MPI.Comm, kernel: str, sizes: Mapping[str, int], fields: Sequence[FormField], *more: str
) -> CDLL | None:
    """simd_kernels.c around a kernel that is given fields, with `more` flags (collective)."""
    takes = (f"TAKE({number},{each.dofs.shape[1]},{each.size})" for number, each in enumerate(fields))
    functions = "".join(_LANE_BY_LANE.format(name) for name in FUNCTIONS) + _POWERS
    text = SOURCE.read_text().replace("// functions\n", functions).replace("// kernel\n", f"{kernel}\n")
    defined = [f"-D{name}={value}" for name, value in sizes.items()] + [f"-DFIELDS={''.join(takes)}"]
    return compile_on_all_ranks(comm, "lanes", text, [*_FLAGS, *more, *defined])


def vectorise_kernel(source: str) -> str | None:
    """The body of the only kernel in FFCx's C, for numbers with lanes; None where it does what those cannot."""
    _, *kernels = source.split("\nvoid tabulate_tensor_")
    end = re.search(r"\n(ufcx_integral|bool enabled_|static double points_)", kernels[0]) if len(kernels) == 1 else None
    if end is None or "{" not in kernels[0]:
        return None
    body = kernels[0][kernels[0].index("{") : end.start()]
    called = set(re.findall(r"\b([A-Za-z_]\w*) *\(", re.sub(r"//.*|\bpow\(\w+, \d+\)", "", body)))
    if "?" in body or not called <= {"for", *FUNCTIONS}:
        return None
    return "\n".join(_line_in_lanes(line) for line in body.split("\n"))


def _line_in_lanes(line: str) -> str:
    """A line of C: tables stay numbers, what is declared beside them has lanes, and loops are written out."""
    if loop := re.match(r" *for \(int [ij]", line):
        return f"#pragma GCC unroll 4\n{loop.string}"
    declared = re.match(r" *double (\w+(?:\[\d+\])*) = (.*);$", line)
    if declared is None:
        return line
    name, value = declared.groups()
    return f"real {name} = {{0}};" if value in ("0", "0.0", "{0}") else f"real {name} = ({value}) - zero;"


# sums with the zeros of tables are left out; nothing else may be, or sums would be taken in another order
_FLAGS = ["-O2", f"-DLANES={LANES}", "-fno-signed-zeros", "-ffinite-math-only", "-fno-trapping-math", "-fno-math-errno"]
