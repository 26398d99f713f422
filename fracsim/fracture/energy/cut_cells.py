"""The cells that cracks cut, known on every rank: few beside those of the body, and news only where cracks grow."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from scipy.spatial import cKDTree

from ...mesh.edge_graph import EdgeGraph
from ...mesh.parallel import allgather
from .crack_front import WIDTH, Front

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


class Crack:
    """Rows of the cells of all ranks with a broken edge, in the order of the input mesh.

    Attributes:
        number: (n,) of the cell in the input mesh.    split: (n,) whether it has come apart.    centre: (n, d) m.
        middle: (n, d) mean of the places where the cell is cut, m.
        polygon: (n, WIDTH) of split cells (crack_front); in the plane (n, 0).
    """

    def __init__(self, graph: EdgeGraph, front: Front, centres: Values) -> None:
        """`centres`: (cells, d) of this rank's cells, m."""
        self._graph, self._front, self._centres = graph, front, centres
        self._pattern = np.zeros_like(graph.pattern)
        self._d = d = graph.domain.dim
        self._rows = np.empty((0, 2 + 2 * d + (WIDTH if d == 3 else 0)))

    @property
    def number(self) -> Ints:
        return np.asarray(self._rows[:, 0], np.int64)

    @property
    def split(self) -> npt.NDArray[np.bool_]:
        return np.asarray(self._rows[:, 1] > 0)

    @property
    def centre(self) -> Values:
        return self._rows[:, 2 : 2 + self._d]

    @property
    def middle(self) -> Values:
        return self._rows[:, 2 + self._d : 2 + 2 * self._d]

    @property
    def polygon(self) -> Values:
        return self._rows[:, 2 + 2 * self._d :]

    @cached_property
    def tree(self) -> cKDTree:
        """Of the centres of all these cells."""
        return cKDTree(self.centre)

    def changed(self) -> bool:
        """Whether cells of any rank are cut otherwise than when it was told last (collective)."""
        return bool(self._graph.domain.comm.allreduce(not np.array_equal(self._pattern, self._graph.pattern), MPI.LOR))

    def update(self, cut: Values) -> tuple[Ints, Values]:
        """Cells are cut otherwise, edges at `cut` (edges,): which ones, (n,) in the input mesh, and (n, d) where, m
        (collective)."""
        cells = np.flatnonzero(self._pattern != self._graph.pattern)
        self._pattern[cells] = self._graph.pattern[cells]
        rows = np.concatenate(allgather(self._graph.domain.comm, self._of(cells, cut)))
        number = rows[:, 0].astype(np.int64)
        kept = self._rows[~np.isin(self.number, number)]
        every = np.concatenate([kept, rows[rows[:, 1] >= 0]])
        self._rows = every[np.argsort(every[:, 0], kind="stable")]
        self.__dict__.pop("tree", None)
        return number, rows[:, 2 : 2 + self._d]

    def _of(self, cells: Ints, cut: Values) -> Values:
        """Rows of cells of this rank; those without a broken edge have -1 for `split`."""
        graph, d = self._graph, self._d
        split = np.where(graph.pattern[cells] > 0, graph.split[cells].astype(float), -1.0)
        rows = np.zeros((len(cells), self._rows.shape[1]))
        rows[:, 0], rows[:, 1], rows[:, 2 : 2 + d] = graph.domain.cell_input[cells], split, self._centres[cells]
        some = np.flatnonzero(split >= 0)
        rows[some, 2 + d : 2 + 2 * d] = self._front.middles(cells[some], cut)
        if d == 3:
            some = np.flatnonzero(split > 0)
            rows[some, 2 + 2 * d :] = self._front.rows(cells[some], cut)
        return rows
