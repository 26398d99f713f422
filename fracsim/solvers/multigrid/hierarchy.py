"""Levels of PETSc's multigrid, copied in blocks of a node's dofs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from dolfinx import la
from dolfinx.common import IndexMap
from petsc4py import PETSc
from scipy.sparse import csr_matrix

from ...mesh.dolfinx_compat import make_index_map

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
# Rows of a matrix that are brought into blocks at a time: in double precision all of them would take twice the memory.
ROWS_AT_A_TIME = 1 << 13


@dataclass(frozen=True)
class BlockCSRData:
    """Pattern and values of a block CSR matrix, with rows of this rank.

    Attributes:
        starts: (rows + 1,) first block of each row.
        columns: (blocks,) local number of the column.
        values: (blocks, rows, columns of a block).
    """

    starts: Ints
    columns: npt.NDArray[np.int32]
    values: Values


@dataclass(frozen=True)
class LevelData:
    """A level of PETSc's multigrid.

    Attributes:
        nodes: nodes of this rank, and ghosts.
        size: dofs of a node.
        diagonal: diagonal of its matrix, with ghosts.
        matrix: its matrix; None on the finest and the coarsest level.
        prolongation: rows of the prolongation from the next coarser level, in parts; none on the coarsest level.
    """

    nodes: IndexMap
    size: int
    diagonal: Values
    matrix: BlockCSRData | None
    prolongation: Iterator[BlockCSRData]

    @property
    def scale(self) -> Values:
        """(dofs with ghosts,) diag(A)^(-1/2)."""
        diagonal = np.abs(self.diagonal)
        return np.asarray(1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)))


def copy_levels(gamg: PETSc.PC, finest: IndexMap) -> Iterator[LevelData]:
    """Yield the levels of a multigrid that is set up, from the coarsest on (collective).

    One is copied at a time: together they have more bytes than the tangent. Entries of the finest matrix are not read
    after the first level.

    Args:
        gamg: PETSc's multigrid.
        finest: nodes of the finest level, whose matrix is not copied.
    """
    count = gamg.getMGLevels()
    solvers = [gamg.getMGCoarseSolve(), *(gamg.getMGSmoother(level) for level in range(1, count))]
    matrices = [solver.getOperators()[1] for solver in solvers]
    sizes = [matrix.getBlockSize() for matrix in matrices]
    diagonals = [matrix.getDiagonal().array_r for matrix in matrices]
    prolongation: Iterator[BlockCSRData] = iter(())
    for level, (matrix, size) in enumerate(zip(matrices, sizes, strict=True)):
        copied = [matrix] if 0 < level < count - 1 else []
        to_finer = [gamg.getMGInterpolation(level + 1)] if level < count - 1 else []
        nodes = _level_nodes(matrix, size, [*copied, *to_finer]) if to_finer else finest
        diagonal = la.vector(nodes, size)
        diagonal.array[: nodes.size_local * size] = diagonals[level]
        diagonal.scatter_forward()
        blocks = MatrixEntries(matrix).in_blocks((size, size), nodes) if copied else None
        yield LevelData(nodes, size, diagonal.array.copy(), blocks, prolongation)
        if to_finer:
            prolongation = MatrixEntries(*to_finer).parts((sizes[level + 1], size), nodes)


class MatrixEntries:
    """Single entries of the rows of this rank.

    Attributes:
        columns: (entries,) global numbers.
    """

    def __init__(self, matrix: PETSc.Mat) -> None:
        self._starts, self.columns, self._values = matrix.getValuesCSR()

    def in_blocks(self, size: tuple[int, int], nodes: IndexMap) -> BlockCSRData:
        """Return the matrix in blocks with 0 for missing entries; `nodes`: of its columns."""
        parts = list(self.parts(size, nodes))
        blocks = np.concatenate([np.diff(part.starts) for part in parts])  # of each row
        columns, values = (np.concatenate([getattr(part, name) for part in parts]) for name in ("columns", "values"))
        return BlockCSRData(np.append(0, np.cumsum(blocks)), columns, values)

    def parts(self, size: tuple[int, int], nodes: IndexMap) -> Iterator[BlockCSRData]:
        """Yield its rows in blocks, some at a time (see `in_blocks`)."""
        rows, step = len(self._starts) - 1, ROWS_AT_A_TIME * size[0]
        for first in range(0, max(rows, 1), step):
            yield self._rows_in_blocks(first, min(first + step, rows), size, nodes)

    def _rows_in_blocks(self, first: int, last: int, size: tuple[int, int], nodes: IndexMap) -> BlockCSRData:
        starts = self._starts[first : last + 1]
        entries = slice(starts[0], starts[-1])
        columns = self.columns[entries]
        columns = size[1] * _to_local(columns // size[1], nodes) + columns % size[1]
        shape = last - first, size[1] * (nodes.size_local + nodes.num_ghosts)
        blocks = csr_matrix((self._values[entries], columns, starts - starts[0]), shape=shape).tobsr(size)
        return BlockCSRData(blocks.indptr.astype(np.int64), blocks.indices.astype(np.int32), blocks.data)


def _level_nodes(matrix: PETSc.Mat, size: int, products: list[PETSc.Mat]) -> IndexMap:
    """Return the nodes of the rows of a matrix (collective).

    Args:
        matrix: block matrix.
        size: dofs of a node.
        products: matrices that multiply vectors of these nodes. The values that they read on other ranks are ghosts.
    """
    first, last = (end // size for end in matrix.getOwnershipRange())
    comm, read = matrix.comm.tompi4py(), [np.empty(0, np.int64)]
    for product in products if comm.size > 1 else []:
        columns = MatrixEntries(product).columns // size
        read.append(columns[(columns < first) | (columns >= last)])
    ghosts = np.unique(np.concatenate(read)).astype(np.int64)
    owners = np.searchsorted(matrix.getOwnershipRanges() // size, ghosts, side="right") - 1
    return make_index_map(comm, last - first, ghosts, owners.astype(np.int32))


def _to_local(numbers: Ints, nodes: IndexMap) -> Ints:
    """Return the local numbers of global ones; ghosts are in increasing order."""
    first, last = nodes.local_range
    ghosts = (numbers < first) | (numbers >= last)
    result = numbers - first
    result[ghosts] = last - first + np.searchsorted(nodes.ghosts, numbers[ghosts])
    return result
