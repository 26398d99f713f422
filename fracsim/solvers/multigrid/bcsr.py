"""Rows of square blocks in single precision, and vectors for products with them.

What carries from a level of multigrid's cycle (vcycle) to the next finer one and, transposed, back.

In single precision. Blocks come row by row, so that products with them and with their transpose both take a row of a
block at once: one copy serves both, and what the cycle reads stays near the processor.
"""

from __future__ import annotations

from ctypes import CDLL, c_float, c_int64
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from dolfinx import la
from dolfinx.common import IndexMap
from mpi4py import MPI

from ...mesh.c_library import FAST_FLAGS, array_pointer, compile_on_all_ranks, unchecked_function
from .hierarchy import BlockCSRData

Single = npt.NDArray[np.float32]
Values = npt.NDArray[np.float64]
SOURCE = Path(__file__).with_suffix(".c")
BEHIND = 8  # numbers after the last block, which SIMD instructions read and ignore
PROLONGATION_SOURCE = Path(__file__).with_name("prolongation.c")


class GhostedVector:
    """Numbers of this rank, those of ghosts behind them.

    Attributes:
        array: all of them.    place: where they begin.
    """

    def __init__(self, nodes: IndexMap, size: int, kind: type = np.float32) -> None:
        """`size`: numbers of a node; `kind`: of number."""
        self._vector = la.vector(nodes, size, kind)
        self.array: npt.NDArray[Any] = self._vector.array
        self.pointer = array_pointer(self.array)
        self._alone = nodes.comm.size == 1

    def update_ghosts(self) -> None:
        """Those of ghosts become their owners' (collective)."""
        if not self._alone:
            self._vector.scatter_forward()

    def add_ghosts_to_owners(self) -> None:
        """Those of ghosts are added to their owners' (collective)."""
        if not self._alone:
            self._vector.scatter_reverse(la.InsertMode.add)


class BlockCSR:
    """Rows of this rank. Vectors to be multiplied with have their ghosts.

    Attributes:
        blocks: (blocks, numbers of one) column by column.
    """

    def __init__(self, code: CDLL, size: int, starts: npt.NDArray[np.int64], columns: npt.NDArray[np.int32]) -> None:
        """`code`: compiled for blocks of size x size; `starts`: (rows + 1,) of rows; `columns`: (blocks,)."""
        self._code, numbers = code, np.zeros(int(starts[-1]) * size**2 + BEHIND, np.float32)
        self.blocks: Single = numbers[:-BEHIND].reshape(-1, size**2)
        self._pattern = c_int64(len(starts) - 1), array_pointer(starts), array_pointer(columns)
        self._all = *self._pattern, array_pointer(numbers)
        self._residual, self._smooth, self._add = (
            unchecked_function(code, name, *self._all) for name in ("residual", "smooth", "add")
        )  # fmt: skip

    def assign_scaled(self, blocks: Values, left: Values, right: Values) -> None:
        """Be diag(left) A diag(right), of A's blocks (n, rows, columns)."""
        self._code.scale(
            *self._pattern, array_pointer(blocks), array_pointer(left), array_pointer(right), self._all[-1]
        )

    def compute_rounding_loss(self, blocks: Values, left: Values, right: Values, lost: Single) -> None:
        """What rounding has taken from each row of A's blocks, where left and right are undone (C tells)."""
        self._code.lose(
            *self._all, array_pointer(blocks), array_pointer(left), array_pointer(right), array_pointer(lost)
        )

    def multiply(self, lost: Single, left: Values, z: GhostedVector, x: Values, y: Values) -> None:
        """y = diag(left) A z + lost x in double precision, z of ghosts as well."""
        self._code.multiply(
            *self._all, array_pointer(lost), array_pointer(left), z.pointer, array_pointer(x), array_pointer(y)
        )

    def compute_residual(self, b: GhostedVector, x: GhostedVector, left: GhostedVector) -> None:
        """left = b - A x."""
        self._residual(*self._all, b.pointer, x.pointer, left.pointer)

    def smoothing_step(
        self,
        by: BlockDiagonal,
        keep: float,
        take: float,
        b: GhostedVector,
        x: GhostedVector,
        d: GhostedVector,
        to: GhostedVector,
    ) -> None:
        """d = keep d + take B (b - A x), to = x + d."""
        self._smooth(
            *self._all, by.pointer, c_float(keep), c_float(take), b.pointer, x.pointer, d.pointer, to.pointer
        )  # fmt: skip

    def add_product(self, x: GhostedVector, y: GhostedVector) -> None:
        """y += A x."""
        self._add(*self._all, x.pointer, y.pointer)


class BlockDiagonal:
    """Blocks of this rank's rows on the diagonal, B, symmetric.

    Attributes:
        blocks: (rows, size, size).    place: where they begin.
    """

    def __init__(self, code: CDLL, size: int, rows: int) -> None:
        """`code`: compiled for blocks of size x size."""
        numbers = np.zeros(rows * size**2 + BEHIND, np.float32)
        self._code, self._rows, self.pointer = code, c_int64(rows), array_pointer(numbers)
        self.blocks: Single = numbers[:-BEHIND].reshape(rows, size, size)

    def assign_inverse(self, D: Single) -> None:
        """B = D^-1 of blocks as these; where D is not positive, of the size of its diagonal."""
        self._code.invert(self._rows, array_pointer(D), self.pointer)

    def first_step(self, take: float, b: GhostedVector, d: GhostedVector, x: GhostedVector) -> None:
        """d = x = take B b."""
        self._code.begin(self._rows, self.pointer, c_float(take), b.pointer, d.pointer, x.pointer)


def compile_block_csr(comm: MPI.Comm, size: int) -> CDLL | None:
    """For blocks of size x size; None without a compiler (collective)."""
    lanes = next(n for n in (2, 4, 8) if n >= size)
    return compile_on_all_ranks(
        comm, "rows", SOURCE.read_text(encoding="utf-8"), [*FAST_FLAGS, f"-DR={size}", f"-DLANES={lanes}"]
    )


class Prolongation:
    """diag(left) P diag(right), of P's blocks in the rows of this rank."""

    def __init__(self, code: CDLL, P: BlockCSRData, left: Values, right: Values) -> None:
        """`code`: compiled for blocks of that size."""
        numbers = np.empty(P.values.size, np.float32)
        pattern = c_int64(len(P.starts) - 1), array_pointer(P.starts), array_pointer(P.columns)
        code.scale(*pattern, array_pointer(P.values), array_pointer(left), array_pointer(right), array_pointer(numbers))
        self._all = *pattern, array_pointer(numbers)
        self._add, self._add_transposed = (
            unchecked_function(code, name, *self._all) for name in ("add", "add_transposed")
        )

    def add_product(self, x: GhostedVector, y: GhostedVector) -> None:
        """y += P x, of x with its ghosts."""
        self._add(*self._all, x.pointer, y.pointer)

    def add_transposed_product(self, x: GhostedVector, y: GhostedVector) -> None:
        """y += P^T x, ghosts of y included."""
        self._add_transposed(*self._all, x.pointer, y.pointer)


def compile_prolongation(comm: MPI.Comm, rows: int, columns: int) -> CDLL | None:
    """For blocks of that size; None without a compiler (collective)."""
    return compile_on_all_ranks(
        comm, "between", PROLONGATION_SOURCE.read_text(encoding="utf-8"), [*FAST_FLAGS, f"-DR={rows}", f"-DC={columns}"]
    )
