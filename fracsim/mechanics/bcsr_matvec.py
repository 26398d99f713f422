"""Products with a matrix in blocks of a node's dofs, where DOLFINx has summed it.

PETSc's own matrix of blocks multiplies as quickly, but to hand it the values takes as long as fifteen products.
"""

from __future__ import annotations

from ctypes import CDLL, c_int64
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from dolfinx import la
from mpi4py import MPI
from petsc4py import PETSc

from ..mesh.c_library import FAST_FLAGS, at, compile_on_all_ranks

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

    from .tie_matrix import TieMatrix

Ints = npt.NDArray[np.int64]

SOURCE = Path(__file__).with_suffix(".c")


class BlockMatrix:
    """Those with a square matrix, owned rows of which are complete.

    Attributes:
        matrix: what is multiplied with.    beside: what is added to it.
    """

    def __init__(self, matrix: la.MatrixCSR, code: CDLL) -> None:
        """`code`: what `compiled` gives for the size of its blocks."""
        self.matrix, self._code = matrix, code
        self.ties: list[TieMatrix] = []
        columns = matrix.index_map(1)
        self._rows = matrix.index_map(0).size_local
        self._everywhere = la.create_petsc_vector(columns, matrix.block_size[1]) if columns.comm.size > 1 else None

    def mult(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = K x (collective)."""
        self._multiply_blocks(x, y)
        if self.ties:
            to, by_nodes = (each.reshape(-1, self.matrix.block_size[0]) for each in (y.array_w, x.array_r))
            for each in self.ties:
                to[each.nodes] += each.multiply(by_nodes[each.nodes])

    def _multiply_blocks(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        if (everywhere := self._everywhere) is None:
            self._multiply(x, y)
            return
        everywhere.array_w[:] = x.array_r
        everywhere.ghostUpdate(PETSc.InsertMode.INSERT, PETSc.ScatterMode.FORWARD)
        with everywhere.localForm() as local:
            self._multiply(local, y)

    def _multiply(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        matrix = self.matrix
        arrays = matrix.indptr, matrix.indices, matrix.data, x.array_r, y.array_w
        self._code.multiply(c_int64(self._rows), *map(at, arrays))

    def owned_rows(self, nodes: Ints) -> csr_matrix:
        """(d n, dofs of all ranks) those of owned nodes (n,), with what is beside them (collective)."""
        from scipy.sparse import csr_matrix

        K, d, columns = self.matrix, self.matrix.block_size[0], self.matrix.index_map(1)
        lengths = K.indptr[nodes + 1] - K.indptr[nodes]
        starts = np.concatenate([[0], np.cumsum(lengths)])
        block = np.repeat(K.indptr[nodes] - starts[:-1], lengths) + np.arange(starts[-1])
        axes = np.arange(d)
        row = d * np.repeat(np.arange(len(nodes)), lengths)[:, None, None] + axes[:, None]
        column = d * columns.local_to_global(K.indices[block])[:, None, None] + axes
        values = K.data.reshape(-1, d, d)[block]
        at = tuple(np.broadcast_to(each, values.shape).reshape(-1) for each in (row, column))
        result = csr_matrix((values.reshape(-1), at), shape=(d * len(nodes), d * columns.size_global))
        for each in self.ties:
            result = result + each.owned_rows(nodes, columns)
        return result

    def destroy(self) -> None:
        """Give the memory of PETSc's objects back."""
        if self._everywhere is not None:
            self._everywhere.destroy()


def compile_block_product(comm: MPI.Comm, size: int) -> CDLL | None:
    """What `Products` takes for blocks of size x size numbers; None without a compiler (collective)."""
    return compile_on_all_ranks(comm, "products", SOURCE.read_text(), [*FAST_FLAGS, f"-DD={size}"])
