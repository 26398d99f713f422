"""The levels of PETSc's multigrid, copied out of it, in blocks of a node's dofs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from dolfinx import la
from dolfinx.common import IndexMap
from petsc4py import PETSc
from scipy.sparse import csr_matrix

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class BlockCSRData:
    """Those in the rows of this rank.

    Attributes:
        starts: (rows + 1,) of rows.    columns: (blocks,) local numbers.    values: (blocks, rows, columns of one).
    """

    starts: Ints
    columns: npt.NDArray[np.int32]
    values: Values


@dataclass(frozen=True)
class LevelData:
    """A level.

    Attributes:
        nodes: those of this rank, and ghosts.    size: dofs of a node.    diagonal: of its matrix, ghosts too.
        own: its matrix.    between: what carries from the next coarser level to it.
    """

    nodes: IndexMap
    size: int
    diagonal: Values
    matrix: BlockCSRData | None
    prolongation: BlockCSRData | None


def copy_levels(body: PETSc.PC, finest: IndexMap) -> list[LevelData]:
    """Those of multigrid that is set up, from the coarsest on; `finest`: nodes of the finest, the matrix of which is
    not copied, nor is that of the coarsest (collective)."""
    count = body.getMGLevels()
    solvers = [body.getMGCoarseSolve(), *(body.getMGSmoother(level) for level in range(1, count))]
    matrices = [solver.getOperators()[1] for solver in solvers]
    sizes = [matrix.getBlockSize() for matrix in matrices]
    between = [None, *(_Entries(body.getMGInterpolation(level)) for level in range(1, count))]
    result: list[LevelData] = []
    for level, (matrix, size) in enumerate(zip(matrices, sizes, strict=True)):
        owned = _Entries(matrix) if 0 < level < count - 1 else None
        read = [item.columns // size for item in (owned, between[level + 1]) if item] if level < count - 1 else []
        nodes = _nodes(matrix, size, read) if read else finest
        diagonal, to = la.vector(nodes, size), between[level]
        diagonal.array[: nodes.size_local * size] = matrix.getDiagonal().array_r
        diagonal.scatter_forward()
        result.append(LevelData(
            nodes, size, diagonal.array.copy(), owned.in_blocks((size, size), nodes) if owned else None,
            to.in_blocks((size, sizes[level - 1]), result[-1].nodes) if to else None,
        ))  # fmt: skip
    return result


class _Entries:
    """Single entries of the rows of this rank.

    Attributes:
        columns: (entries,) global numbers.
    """

    def __init__(self, matrix: PETSc.Mat) -> None:
        self._starts, self.columns, self._values = matrix.getValuesCSR()

    def in_blocks(self, size: tuple[int, int], nodes: IndexMap) -> BlockCSRData:
        """The same in blocks; `nodes`: of the columns. What a block has no entry for is 0."""
        columns = size[1] * _local(self.columns // size[1], nodes) + self.columns % size[1]
        shape = len(self._starts) - 1, size[1] * (nodes.size_local + nodes.num_ghosts)
        blocks = csr_matrix((self._values, columns, self._starts), shape=shape).tobsr(size)
        return BlockCSRData(blocks.indptr.astype(np.int64), blocks.indices.astype(np.int32), blocks.data)


def _nodes(matrix: PETSc.Mat, size: int, read: list[Ints]) -> IndexMap:
    """Those of the rows of a matrix; ghosts are what else is `read`, by global numbers (collective)."""
    first, last = (end // size for end in matrix.getOwnershipRange())
    ghosts = np.unique(np.concatenate([item[(item < first) | (item >= last)] for item in read])).astype(np.int64)
    owners = np.searchsorted(matrix.getOwnershipRanges() // size, ghosts, side="right") - 1
    return IndexMap(matrix.comm.tompi4py(), last - first, ghosts, owners.astype(np.int32))


def _local(numbers: Ints, nodes: IndexMap) -> Ints:
    """Local numbers of global ones, those of ghosts in rising order."""
    first, last = nodes.local_range
    ghosts = (numbers < first) | (numbers >= last)
    result = numbers - first
    result[ghosts] = last - first + np.searchsorted(nodes.ghosts, numbers[ghosts])
    return result
