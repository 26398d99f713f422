"""Block CSR matrices and prolongations in single precision, and ghosted vectors for products with them (C)."""

from __future__ import annotations

from collections.abc import Iterable
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
# Numbers after the last block, which SIMD instructions read and ignore.
PADDING = 8
PROLONGATION_SOURCE = Path(__file__).with_name("prolongation.c")


class GhostedVector:
    """Vector with the numbers of this rank, followed by those of its ghosts.

    Attributes:
        array: its numbers.
        pointer: address of its numbers.
    """

    def __init__(self, nodes: IndexMap, size: int, kind: type = np.float32) -> None:
        """Allocate zeros; `size`: numbers of a node, `kind`: their type."""
        self._vector = la.vector(nodes, size, kind)
        self.array: npt.NDArray[Any] = self._vector.array
        self.pointer = array_pointer(self.array)
        self._is_serial = nodes.comm.size == 1

    def update_ghosts(self) -> None:
        """Copy the numbers of the owners to the ghosts (collective)."""
        if not self._is_serial:
            self._vector.scatter_forward()

    def add_ghosts_to_owners(self) -> None:
        """Add the numbers of the ghosts to those of the owners (collective)."""
        if not self._is_serial:
            self._vector.scatter_reverse(la.InsertMode.add)


class BlockCSR:
    """Block CSR matrix A with the rows of this rank. Vectors that it multiplies have ghosts.

    Attributes:
        blocks: (blocks, size^2) stored by columns.
    """

    def __init__(self, code: CDLL, size: int, starts: npt.NDArray[np.int64], columns: npt.NDArray[np.int32]) -> None:
        """Allocate a zero matrix.

        Args:
            code: compiled for blocks of size x size.
            size: rows of a block.
            starts: (rows + 1,) first block of each row.
            columns: (blocks,) column of each block.
        """
        self._code, numbers = code, np.zeros(int(starts[-1]) * size**2 + PADDING, np.float32)
        self.blocks: Single = numbers[:-PADDING].reshape(-1, size**2)
        self._pattern = c_int64(len(starts) - 1), array_pointer(starts), array_pointer(columns)
        self._all = *self._pattern, array_pointer(numbers)
        self._residual, self._smoothing_step, self._add = (
            unchecked_function(code, name, *self._all) for name in ("residual", "smoothing_step", "add")
        )  # fmt: skip

    def assign_scaled(self, blocks: Values, left: Values, right: Values) -> None:
        """Assign diag(left) A diag(right), of the blocks (n, rows, columns) of A."""
        self._code.scale(
            *self._pattern, array_pointer(blocks), array_pointer(left), array_pointer(right), self._all[-1]
        )

    def compute_rounding_loss(self, blocks: Values, left: Values, right: Values, lost: Single) -> None:
        """Compute the sum of the rounding errors in each row of `blocks`; left and right undo the scaling."""
        self._code.rounding_loss(
            *self._all, array_pointer(blocks), array_pointer(left), array_pointer(right), array_pointer(lost)
        )

    def multiply(self, lost: Single, left: Values, z: GhostedVector, x: Values, y: Values) -> None:
        """Compute y = diag(left) A z + lost x in double precision; z has ghosts."""
        self._code.multiply(
            *self._all, array_pointer(lost), array_pointer(left), z.pointer, array_pointer(x), array_pointer(y)
        )

    def compute_residual(self, b: GhostedVector, x: GhostedVector, residual: GhostedVector) -> None:
        """Compute residual = b - A x."""
        self._residual(*self._all, b.pointer, x.pointer, residual.pointer)

    def smoothing_step(
        self,
        B: BlockDiagonal,
        keep: float,
        take: float,
        b: GhostedVector,
        x: GhostedVector,
        d: GhostedVector,
        result: GhostedVector,
    ) -> None:
        """Compute d = keep d + take B (b - A x) and result = x + d."""
        self._smoothing_step(
            *self._all, B.pointer, c_float(keep), c_float(take), b.pointer, x.pointer, d.pointer, result.pointer
        )  # fmt: skip

    def add_product(self, x: GhostedVector, y: GhostedVector) -> None:
        """Add A x to y."""
        self._add(*self._all, x.pointer, y.pointer)


class BlockDiagonal:
    """Block-diagonal matrix B of symmetric blocks, with the rows of this rank.

    Attributes:
        blocks: (rows, size, size).
        pointer: address of its numbers.
    """

    def __init__(self, code: CDLL, size: int, rows: int) -> None:
        """Allocate a zero matrix; `code`: compiled for blocks of size x size."""
        numbers = np.zeros(rows * size**2 + PADDING, np.float32)
        self._code, self._rows, self.pointer = code, c_int64(rows), array_pointer(numbers)
        self.blocks: Single = numbers[:-PADDING].reshape(rows, size, size)

    def assign_inverse(self, D: Single) -> None:
        """Assign D^-1; for blocks that are not positive that of the absolute values of their diagonal."""
        self._code.invert(self._rows, array_pointer(D), self.pointer)

    def first_step(self, take: float, b: GhostedVector, d: GhostedVector, x: GhostedVector) -> None:
        """Compute d = x = take B b."""
        self._code.first_step(self._rows, self.pointer, c_float(take), b.pointer, d.pointer, x.pointer)


def compile_block_csr(comm: MPI.Comm, size: int) -> CDLL | None:
    """Return the code for blocks of size x size; None without a compiler (collective)."""
    lanes = next(n for n in (2, 4, 8) if n >= size)
    return compile_on_all_ranks(
        comm, "bcsr", SOURCE.read_text(encoding="utf-8"), [*FAST_FLAGS, f"-DR={size}", f"-DLANES={lanes}"]
    )


class Prolongation:
    """Prolongation diag(left) P diag(right), P with the rows of this rank."""

    def __init__(self, code: CDLL, parts: Iterable[BlockCSRData], left: Values, right: Values) -> None:
        """Assign the scaled blocks of P, whose rows come in parts; `code`: compiled for their size."""
        starts = [np.zeros(1, np.int64)]
        columns, numbers, row = [], [], 0
        for part in parts:
            rows, scaled = len(part.starts) - 1, np.empty(part.values.size, np.float32)
            of_rows = left[part.values.shape[1] * row :]
            pattern = c_int64(rows), array_pointer(part.starts), array_pointer(part.columns)
            code.scale(
                *pattern, *(array_pointer(array) for array in (part.values, of_rows, right)), array_pointer(scaled)
            )
            starts.append(starts[-1][-1] + part.starts[1:])
            columns.append(part.columns)
            numbers.append(scaled)
            row += rows
        pointers = [array_pointer(np.concatenate(pieces)) for pieces in (starts, columns, numbers)]
        self._all = c_int64(row), *pointers
        self._add, self._add_transposed = (
            unchecked_function(code, name, *self._all) for name in ("add", "add_transposed")
        )

    def add_product(self, x: GhostedVector, y: GhostedVector) -> None:
        """Add P x to y; x has ghosts."""
        self._add(*self._all, x.pointer, y.pointer)

    def add_transposed_product(self, x: GhostedVector, y: GhostedVector) -> None:
        """Add P^T x to y, which has ghosts."""
        self._add_transposed(*self._all, x.pointer, y.pointer)


def compile_prolongation(comm: MPI.Comm, rows: int, columns: int) -> CDLL | None:
    """Return the code for blocks of rows x columns; None without a compiler (collective)."""
    return compile_on_all_ranks(
        comm,
        "prolongation",
        PROLONGATION_SOURCE.read_text(encoding="utf-8"),
        [*FAST_FLAGS, f"-DR={rows}", f"-DC={columns}"],
    )
