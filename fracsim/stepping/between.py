"""What carries from a level of multigrid's cycle (cycle) to the next finer one and, transposed, back.

In single precision. Blocks come row by row, so that products with them and with their transpose both take a row of a
block at once: one copy serves both, and what the cycle reads stays near the processor.
"""

from __future__ import annotations

from ctypes import CDLL, c_int64
from pathlib import Path

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..mesh.compiled import FASTER, at, built_together, prepared
from .levels import Blocks
from .rows import Vector

Values = npt.NDArray[np.float64]

SOURCE = Path(__file__).with_suffix(".c")


class Between:
    """diag(left) P diag(right), of P's blocks in the rows of this rank."""

    def __init__(self, made: CDLL, P: Blocks, left: Values, right: Values) -> None:
        """`made`: `code` for blocks of that size."""
        numbers = np.empty(P.values.size, np.float32)
        pattern = c_int64(len(P.starts) - 1), at(P.starts), at(P.columns)
        made.scale(*pattern, at(P.values), at(left), at(right), at(numbers))
        self._all = *pattern, at(numbers)
        self._add, self._add_transposed = (prepared(made, name, *self._all) for name in ("add", "add_transposed"))

    def add(self, x: Vector, y: Vector) -> None:
        """y += P x, of x with its ghosts."""
        self._add(*self._all, x.place, y.place)

    def add_transposed(self, x: Vector, y: Vector) -> None:
        """y += P^T x, ghosts of y included."""
        self._add_transposed(*self._all, x.place, y.place)


def code(comm: MPI.Comm, rows: int, columns: int) -> CDLL | None:
    """For blocks of that size; None without a compiler (collective)."""
    return built_together(comm, "between", SOURCE.read_text(), [*FASTER, f"-DR={rows}", f"-DC={columns}"])
