"""Tangents of several cells at a time: FFCx's kernel with numbers of LANES lanes, and adding what it makes to blocks.

FFCx writes C for one cell, and the tangent of a hyperelastic tetrahedron is 2,000 products and sums of scalars, of
which a processor does one at a time; DOLFINx then looks up the place of each of 16 blocks. Here the same C is compiled
with vectors in the place of scalars (GCC's and Clang's, a lane a cell: no rounding differs), and places are looked up
once: 220 ns a cell where it took 950. What vectors of C cannot do, a choice by a condition and most functions, stays
DOLFINx's work.
"""

from __future__ import annotations

import re
from ctypes import CDLL, c_int64
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from dolfinx import fem, la
from dolfinx.jit import mpi_jit_decorator

from ..mesh.dolfinx_calls import cells_of, identity_rows, integrals, nodes_of_cells, packed
from .compiled import at, built

LANES = 4
FUNCTIONS = ("fabs", "sqrt", "log", "exp")  # that are taken lane by lane

_SOURCE = """
#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <string.h>

enum { NODES = %(nodes)d, D = %(bs)d, CORNERS = %(corners)d };
typedef double real __attribute__((vector_size(8 * LANES), may_alias));
static const real zero = {0};
%(functions)s
static inline void kernel(real* restrict A, const real* restrict w, const real* restrict c,
    const real* restrict coordinate_dofs)
%(kernel)s

/* Rows and columns of prescribed dofs are emptied; held: a bit for each prescribed axis of a node. */
static inline void empty(double* A, const int32_t* nodes, const uint8_t* held)
{
  for (int i = 0; i < NODES * D; ++i)
    if (held[nodes[i / D]] >> i %% D & 1)
      for (int j = 0; j < NODES * D; ++j) A[LANES * (NODES * D * i + j)] = A[LANES * (NODES * D * j + i)] = 0.0;
}

/* Tell the processor what will be added to next. */
static inline void fetch(const int32_t* places, const double* sum)
{
  for (int i = 0; i < NODES * NODES; ++i)
  {
    __builtin_prefetch(sum + places[i], 1);
    __builtin_prefetch(sum + places[i] + D * D - 1, 1);
  }
}

/* A: lane after lane of (NODES D)^2 numbers. */
static inline void insert(const double* A, const int32_t* nodes, const int32_t* places, const int32_t* strides,
    double* sum)
{
  for (int a = 0; a < NODES; ++a)
    for (int b = 0; b < NODES; ++b)
    {
      double* to = sum + places[NODES * a + b];
      const int64_t stride = strides[nodes[a]];
      const double* from = A + LANES * D * (NODES * D * a + b);
#pragma GCC unroll 3
      for (int r = 0; r < D; ++r)
#pragma GCC unroll 3
        for (int s = 0; s < D; ++s) to[stride * r + s] += from[LANES * (NODES * D * r + s)];
    }
}

/* Add the blocks of cells, rows of which are as far apart as their node's stride; returns 0, or the number, from 1 on,
   of a cell that has no place. */
int64_t add(int64_t count, const int32_t* cells, const int32_t* dofs, const int32_t* corners, const double* x,
         int64_t width, const double* w, int64_t size, const double* c,
         const int32_t* places, const int32_t* strides, const uint8_t* held, double* sum)
{
  real constants[size + 1], numbers[width + 1], points[3 * CORNERS], A[NODES * D * NODES * D];
  for (int i = 0; i < size; ++i) constants[i] = zero + c[i];
  for (int64_t first = 0; first < count; first += LANES)
  {
    const int left = count - first < LANES ? (int)(count - first) : LANES;
    for (int lane = 0; lane < LANES; ++lane)
    {
      const int64_t at = first + (lane < left ? lane : 0);
      for (int i = 0; i < width; ++i) numbers[i][lane] = w[width * at + i];
      const int32_t* cell = corners + (int64_t)CORNERS * cells[at];
      for (int i = 0; i < CORNERS; ++i)
        for (int axis = 0; axis < 3; ++axis) points[3 * i + axis][lane] = x[3 * (int64_t)cell[i] + axis];
    }
    memset(A, 0, sizeof A);
    kernel(A, numbers, constants, points);
    for (int lane = 0; lane < left; ++lane)
    {
      const int64_t cell = cells[first + lane];
      const int32_t* nodes = dofs + NODES * cell;
      bool any = false;
      for (int a = 0; a < NODES; ++a) any |= held[nodes[a]] != 0;
      if (any) empty((double*)A + lane, nodes, held);
      if (places[NODES * NODES * cell] < 0) return cell + 1;
      if (first + LANES + lane < count) fetch(places + NODES * NODES * (int64_t)cells[first + LANES + lane], sum);
      insert((const double*)A + lane, nodes, places + NODES * NODES * cell, strides, sum);
    }
  }
  return 0;
}

/* The place of the first entry of each block of each cell, the first one -1 where a block has none. columns: of blocks
   one after another (apart = 1), or of entries row by row (apart = D). */
void find(int64_t count, const int32_t* dofs, int64_t apart, const int64_t* starts, const int32_t* columns,
          int32_t* places)
{
  for (int64_t cell = 0; cell < count; ++cell, places += NODES * NODES)
  {
    const int32_t* nodes = dofs + NODES * cell;
    bool has = true;
    for (int a = 0; a < NODES; ++a)
      for (int b = 0; b < NODES; ++b)
      {
        int64_t at = starts[apart * nodes[a]], end = starts[apart * nodes[a] + 1];
        while (at < end && columns[at] != apart * nodes[b]) at += apart;
        places[NODES * a + b] = (int32_t)(apart == 1 ? D * D * at : at);
        has &= at < end;
      }
    if (!has) places[0] = -1;
  }
}
"""

_LANE_BY_LANE = """
static inline real lanes_{0}(real x) {{ for (int i = 0; i < LANES; ++i) x[i] = {0}(x[i]); return x; }}
#define {0} lanes_{0}
"""


class Lanes:
    """A bilinear form of cells, and where what it adds is in a matrix of blocks, or of single entries."""

    def __init__(self, form: fem.Form, matrix: la.MatrixCSR, code: CDLL) -> None:
        """`code`: what `compiled` has made of the form."""
        self._form, self._code, self._geometry = form, code, form.mesh.geometry
        dofmap = form.function_spaces[0].dofmap
        self._nodes, self._bs = nodes_of_cells(form), dofmap.index_map_bs
        self._held = np.zeros(dofmap.index_map.size_local + dofmap.index_map.num_ghosts, np.uint8)
        self._places = np.zeros((len(self._nodes), self._nodes.shape[1] ** 2), np.int32)
        starts = matrix.indptr.astype(np.int64)
        apart = 1 if matrix.block_size[0] > 1 else self._bs
        lengths = np.diff(starts)[::apart]  # of rows
        self._strides = (np.full_like(lengths, self._bs) if apart == 1 else lengths).astype(np.int32)
        self._call("find", len(self._nodes), self._nodes, apart, starts, matrix.indices, self._places)

    def add(self, matrix: la.MatrixCSR, bcs: list[fem.DirichletBC]) -> None:
        """Add this rank's part as DOLFINx does: rows and columns of prescribed dofs become the identity's."""
        cells, geometry, (w, c) = cells_of(self._form), self._geometry, packed(self._form)
        self._held[:] = 0
        for bc in bcs:
            dofs = bc.dof_indices()[0]
            np.bitwise_or.at(self._held, dofs // self._bs, (1 << dofs % self._bs).astype(np.uint8))
        missing = self._call(
            "add", len(cells), cells, self._nodes, geometry.dofmap, geometry.x, w.shape[1], w, len(c), c,
            self._places, self._strides, self._held, matrix.data,
        )  # fmt: skip
        if missing:
            raise ValueError(f"the matrix has no place for cell {missing - 1} of its form")
        identity_rows(matrix, self._form, bcs)

    def _call(self, name: str, *given: int | npt.NDArray[Any]) -> int:
        function = getattr(self._code, name)
        function.restype = c_int64
        result: int = function(*(c_int64(each) if isinstance(each, int) else at(each) for each in given))
        return result


# --- compiling ------------------------------------------------------------------------------------------------------


def compiled(form: fem.Form) -> CDLL | None:
    """What `Lanes` takes of a form; None where there is no such thing (collective)."""
    if integrals(form) != [fem.IntegralType.cell]:
        return None
    space = form.function_spaces[0]
    bs, corners = space.dofmap.index_map_bs, form.mesh.geometry.cmap.dim
    sizes = {"bs": bs, "nodes": space.element.space_dimension // bs, "corners": corners}
    if sizes["nodes"] > corners:  # bent cells gain half as much, and take 15 s to compile
        return None
    kernel = Path(str(form.module.__file__))  # type: ignore[union-attr]
    try:
        code: CDLL | None = _library(form.mesh.comm, kernel.with_name(kernel.name.split(".")[0] + ".c"), sizes)
    except Exception:  # of a compiler that has no vectors, or of C that is written otherwise some day
        return None
    return code


@mpi_jit_decorator  # type: ignore[misc]
def _library(source: Path, sizes: dict[str, int]) -> CDLL | None:
    """What FFCx wrote, compiled once more."""
    if (kernel := in_lanes(source.read_text())) is None:
        return None
    functions = "".join(_LANE_BY_LANE.format(name) for name in FUNCTIONS)
    return built("lanes", _SOURCE % (sizes | {"kernel": kernel, "functions": functions}), _FLAGS)


def in_lanes(source: str) -> str | None:
    """The body of the only kernel in FFCx's C, for numbers with lanes; None where it does what those cannot."""
    _, *kernels = source.split("\nvoid tabulate_tensor_")
    if len(kernels) != 1:
        return None
    body = kernels[0][kernels[0].index("{") : kernels[0].index("\nufcx_integral ")].split("\nbool enabled_")[0]
    called = set(re.findall(r"\b([A-Za-z_]\w*) *\(", re.sub(r"//.*", "", body)))
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
