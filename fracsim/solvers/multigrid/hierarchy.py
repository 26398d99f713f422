"""Levels of PETSc's multigrid, copied in blocks of a node's dofs."""

from __future__ import annotations

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


@dataclass(frozen=True)
class BlockCSRData:
    """Pattern and values of a block CSR matrix, with the rows of this rank.

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
        prolongation: prolongation from the next coarser level; None on the coarsest level.
    """

    nodes: IndexMap
    size: int
    diagonal: Values
    matrix: BlockCSRData | None
    prolongation: BlockCSRData | None


def copy_levels(gamg: PETSc.PC, finest: IndexMap) -> list[LevelData]:
    """Return the levels of a multigrid that is set up, from the coarsest on (collective).

    Args:
        gamg: PETSc's multigrid.
        finest: nodes of the finest level, whose matrix is not copied.
    """
    count = gamg.getMGLevels()
    solvers = [gamg.getMGCoarseSolve(), *(gamg.getMGSmoother(level) for level in range(1, count))]
    matrices = [solver.getOperators()[1] for solver in solvers]
    sizes = [matrix.getBlockSize() for matrix in matrices]
    prolongations = [None, *(MatrixEntries(gamg.getMGInterpolation(level)) for level in range(1, count))]
    result: list[LevelData] = []
    for level, (matrix, size) in enumerate(zip(matrices, sizes, strict=True)):
        owned = MatrixEntries(matrix) if 0 < level < count - 1 else None
        read = [item.columns // size for item in (owned, prolongations[level + 1]) if item] if level < count - 1 else []
        nodes = _level_nodes(matrix, size, read) if read else finest
        diagonal, prolongation = la.vector(nodes, size), prolongations[level]
        diagonal.array[: nodes.size_local * size] = matrix.getDiagonal().array_r
        diagonal.scatter_forward()
        result.append(LevelData(
            nodes, size, diagonal.array.copy(), owned.in_blocks((size, size), nodes) if owned else None,
            prolongation.in_blocks((size, sizes[level - 1]), result[-1].nodes) if prolongation else None,
        ))  # fmt: skip
    return result


class MatrixEntries:
    """Single entries of the rows of this rank.

    Attributes:
        columns: (entries,) global numbers.
    """

    def __init__(self, matrix: PETSc.Mat) -> None:
        self._starts, self.columns, self._values = matrix.getValuesCSR()

    def in_blocks(self, size: tuple[int, int], nodes: IndexMap) -> BlockCSRData:
        """Return the matrix in blocks with 0 for missing entries; `nodes`: of its columns."""
        columns = size[1] * _to_local(self.columns // size[1], nodes) + self.columns % size[1]
        shape = len(self._starts) - 1, size[1] * (nodes.size_local + nodes.num_ghosts)
        blocks = csr_matrix((self._values, columns, self._starts), shape=shape).tobsr(size)
        return BlockCSRData(blocks.indptr.astype(np.int64), blocks.indices.astype(np.int32), blocks.data)


def _level_nodes(matrix: PETSc.Mat, size: int, read: list[Ints]) -> IndexMap:
    """Return the nodes of the rows of a matrix (collective).

    Args:
        matrix: block matrix.
        size: dofs of a node.
        read: global numbers of nodes whose values are read; those of other ranks are ghosts.
    """
    first, last = (end // size for end in matrix.getOwnershipRange())
    ghosts = np.unique(np.concatenate([item[(item < first) | (item >= last)] for item in read])).astype(np.int64)
    owners = np.searchsorted(matrix.getOwnershipRanges() // size, ghosts, side="right") - 1
    return make_index_map(matrix.comm.tompi4py(), last - first, ghosts, owners.astype(np.int32))


def _to_local(numbers: Ints, nodes: IndexMap) -> Ints:
    """Return the local numbers of global ones; ghosts are in increasing order."""
    first, last = nodes.local_range
    ghosts = (numbers < first) | (numbers >= last)
    result = numbers - first
    result[ghosts] = last - first + np.searchsorted(nodes.ghosts, numbers[ghosts])
    return result
