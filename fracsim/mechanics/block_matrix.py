"""Tangent in blocks of the d dofs of a node: products with it, and with couplings beside it.

PETSc's own matrix of blocks multiplies as fast, but to give it the values takes as long as fifteen products. Products
are therefore made where DOLFINx has summed the blocks (block_matrix.c). Ties and contact couple nodes anywhere, outside
the pattern of the blocks, and stay beside them.
"""

from __future__ import annotations

from ctypes import CDLL
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt
from dolfinx import la
from dolfinx.common import IndexMap
from mpi4py import MPI
from petsc4py import PETSc

from ..mesh.c_library import FAST_FLAGS, compile_on_all_ranks
from ..mesh.dolfinx_compat import create_vector
from ..mesh.parallel import allgather, sum_over_ranks
from .extra_couplings import dofs_of_nodes

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Reals = npt.NDArray[np.floating[Any]]

SOURCE = Path(__file__).with_suffix(".c")


class NodeCoupling(Protocol):
    """Stiffness between nodes anywhere, which is added to a matrix in blocks.

    Attributes:
        nodes: (m,) local numbers of the coupled nodes that this rank owns.
    """

    nodes: Ints

    @property
    def diagonal_blocks(self) -> Values:
        """(m, d, d) blocks on the diagonal at the nodes of this rank, N/m."""

    def multiply(self, x: Reals) -> Values:
        """(m, d) product at the nodes of this rank with their x (m, d) (collective)."""

    def owned_rows(self, nodes: Ints, node_map: IndexMap) -> csr_matrix:
        """(d n, dofs of all ranks) rows of owned nodes (n,); `node_map`: nodes of the body (collective)."""


class BlockMatrix:
    """Square matrix in blocks, whose owned rows are complete.

    Attributes:
        matrix: DOLFINx's matrix with the blocks.
        couplings: stiffness between nodes anywhere that is added to it.
    """

    def __init__(self, matrix: la.MatrixCSR, code: CDLL) -> None:
        """`code`: library of `compile_block_product` for the size of the blocks."""
        self.matrix, self._code = matrix, code
        self.couplings: list[NodeCoupling] = []
        columns = matrix.index_map(1)
        self._rows = matrix.index_map(0).size_local
        self._ghosted = create_vector(columns, matrix.block_size[1]) if columns.comm.size > 1 else None

    def mult(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Product y = K x (collective)."""
        self._multiply_blocks(x, y)
        if self.couplings:
            y_nodes, x_nodes = (vector.reshape(-1, self.matrix.block_size[0]) for vector in (y.array_w, x.array_r))
            for coupling in self.couplings:
                y_nodes[coupling.nodes] += coupling.multiply(x_nodes[coupling.nodes])

    def _multiply_blocks(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        if (ghosted := self._ghosted) is None:
            self._multiply_local(x, y)
            return
        ghosted.array_w[:] = x.array_r
        ghosted.ghostUpdate(PETSc.InsertMode.INSERT, PETSc.ScatterMode.FORWARD)
        with ghosted.localForm() as local:
            self._multiply_local(local, y)

    def _multiply_local(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        matrix = self.matrix
        self._code.multiply(self._rows, matrix.indptr, matrix.indices, matrix.data, x.array_r, y.array_w)

    def owned_rows(self, nodes: Ints) -> csr_matrix:
        """(d n, dofs of all ranks) rows of owned nodes (n,), with their couplings (collective)."""
        from scipy.sparse import csr_matrix

        K, d, columns = self.matrix, self.matrix.block_size[0], self.matrix.index_map(1)
        lengths = K.indptr[nodes + 1] - K.indptr[nodes]
        starts = np.concatenate([[0], np.cumsum(lengths)])
        block = np.repeat(K.indptr[nodes] - starts[:-1], lengths) + np.arange(starts[-1])
        axes = np.arange(d)
        row = d * np.repeat(np.arange(len(nodes)), lengths)[:, None, None] + axes[:, None]
        column = d * columns.local_to_global(K.indices[block])[:, None, None] + axes
        values = K.data.reshape(-1, d, d)[block]
        entries = tuple(np.broadcast_to(index, values.shape).reshape(-1) for index in (row, column))
        result = csr_matrix((values.reshape(-1), entries), shape=(d * len(nodes), d * columns.size_global))
        for coupling in self.couplings:
            result = result + coupling.owned_rows(nodes, columns)
        return result

    def destroy(self) -> None:
        """Free the blocks, also where a solver of PETSc refers to this object still."""
        if self._ghosted is not None:
            self._ghosted.destroy()
        del self.matrix


def compile_block_product(comm: MPI.Comm, size: int) -> CDLL | None:
    """Library of products with blocks of size x size numbers; None without a compiler (collective)."""
    return compile_on_all_ranks(comm, "products", SOURCE.read_text(encoding="utf-8"), [*FAST_FLAGS, f"-DD={size}"])


class TieMatrix:
    """Stiffness K between n nodes anywhere, equal along each axis: what `TieTerm.tie_matrix` returns.

    Attributes:
        K: (n, n) N/m, the same on all ranks.
        nodes: (m,) local numbers of the nodes that this rank owns.
        indices: (m,) their indices among the n.
    """

    def __init__(self, comm: MPI.Comm, K: csr_matrix, indices: Ints, nodes: Ints, free: Values) -> None:
        """`free`: (m, d) 1 for free dofs of `nodes`, 0 for prescribed ones."""
        self.K, self.nodes, self.indices, self._comm, self._free = K, nodes, indices, comm, free

    @property
    def diagonal_blocks(self) -> Values:
        """(m, d, d) blocks of K on the diagonal at the nodes of this rank, N/m."""
        diagonal = self.K.diagonal()[self.indices][:, None] * self._free
        return np.asarray(diagonal[:, :, None] * np.eye(diagonal.shape[1]))

    def multiply(self, x: Reals) -> Values:
        """(m, d) K x at the nodes of this rank, of their x (m, d) (collective)."""
        x_all = np.zeros((self.K.shape[0], x.shape[1]))
        x_all[self.indices] = x * self._free
        return np.asarray((self.K @ sum_over_ranks(self._comm, x_all))[self.indices] * self._free)

    def owned_rows(self, nodes: Ints, node_map: IndexMap) -> csr_matrix:
        """(d n, dofs of all ranks) rows of owned nodes (n,); `node_map`: nodes of the body (collective)."""
        from scipy.sparse import csr_matrix

        d = self._free.shape[1]
        global_numbers = node_map.local_to_global(self.nodes.astype(np.int32))
        # global number and free axes of the n nodes, on all ranks
        table = np.zeros((self.K.shape[0], d + 1))
        table[self.indices] = np.concatenate([global_numbers[:, None], self._free], axis=1)
        table = sum_over_ranks(self._comm, table)
        position = np.full(node_map.size_local, -1)
        position[nodes] = np.arange(len(nodes))
        row_of = np.full(len(table), -1)
        row_of[self.indices] = position[self.nodes]
        K, axes = self.K.tocoo(), np.arange(d)
        inside = row_of[K.row] >= 0
        row, column = row_of[K.row[inside]], table[K.col[inside], 0].astype(np.int64)
        values = K.data[inside][:, None] * table[K.row[inside], 1:] * table[K.col[inside], 1:]
        entries = tuple((d * index[:, None] + axes).reshape(-1) for index in (row, column))
        return csr_matrix((values.reshape(-1), entries), shape=(d * len(nodes), d * node_map.size_global))


class CouplingMatrix:
    """Stiffness between nodes anywhere, of a matrix over the dofs, as contact has it.

    Attributes:
        nodes: (m,) local numbers of the coupled nodes that this rank owns.
    """

    def __init__(self, matrix: PETSc.Mat) -> None:
        """Take the entries of a matrix over the dofs of all ranks, N/m (collective)."""
        from scipy.sparse import csr_matrix

        d, self._comm = matrix.getBlockSize(), matrix.comm.tompi4py()
        starts, columns, values = matrix.getValuesCSR()
        local = csr_matrix((values, columns, starts), shape=(len(starts) - 1, matrix.getSize()[1]))
        self.nodes: Ints = np.unique(np.flatnonzero(np.diff(starts)) // d)
        owned = self.nodes + matrix.getOwnershipRange()[0] // d  # global numbers
        coupled = np.union1d(owned, columns // d)
        # global numbers of all coupled nodes, and the indices of this rank's among them
        self._numbers: Ints = np.unique(np.concatenate(allgather(self._comm, coupled)))
        self._indices = np.searchsorted(self._numbers, owned)
        rows, columns = (dofs_of_nodes(nodes, d) for nodes in (self.nodes, self._numbers))
        self._K = csr_matrix(local[rows][:, columns])
        self._shape = len(self.nodes), d

    @property
    def diagonal_blocks(self) -> Values:
        """(m, d, d) blocks on the diagonal at the nodes of this rank, N/m."""
        (m, d), K = self._shape, self._K.tocoo()
        blocks = np.zeros((m, d, d))
        inside = K.col // d == self._indices[K.row // d]
        row, column = K.row[inside], K.col[inside]
        blocks[row // d, row % d, column % d] = K.data[inside]
        return blocks

    def multiply(self, x: Reals) -> Values:
        """(m, d) product at the nodes of this rank with their x (m, d) (collective)."""
        if self._comm.size > 1:
            x_all = np.zeros((len(self._numbers), self._shape[1]))
            x_all[self._indices] = x
            x = sum_over_ranks(self._comm, x_all)
        return np.asarray(self._K @ x.reshape(-1)).reshape(self._shape)

    def owned_rows(self, nodes: Ints, node_map: IndexMap) -> csr_matrix:
        """(d n, dofs of all ranks) rows of owned nodes (n,); `node_map`: nodes of the body."""
        from scipy.sparse import csr_matrix

        d, K = self._shape[1], self._K.tocoo()
        position = np.full(node_map.size_local, -1)
        position[nodes] = np.arange(len(nodes))
        row = position[self.nodes][K.row // d]
        inside = row >= 0
        row, column = row[inside], self._numbers[K.col[inside] // d]
        entries = d * row + K.row[inside] % d, d * column + K.col[inside] % d
        return csr_matrix((K.data[inside], entries), shape=(d * len(nodes), d * node_map.size_global))
