"""Gradients and values of fields at points of some cells: matrices that are kept, a product a component.

A cell has one point, its middle, and with quadratic displacement those where stress is integrated, of equal weights
(mechanics.jit): what is made of fields is made there, and a cell has the mean of it.
"""

from __future__ import annotations

from typing import Self

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix

from ...mechanics.jit import quadratic_shape_functions
from ...mesh.domain import Domain

Ints = npt.NDArray[np.integer]
Values = npt.NDArray[np.float64]


class Patch:
    """The points of some cells, those of a cell one after the other: m = n `count` of them. What comes out has its
    components one after the other in memory, each of them in one piece.

    Attributes:
        count: points of a cell.    steepness: (m,) sum |grad N_k| over the functions N_k of nodes, 1/m.
        most: max sum |N_k| over all points: no value there is more than that many times as large as those of nodes.
    """

    @classmethod
    def of(cls, domain: Domain, cells: Ints, slopes: Values) -> Self:
        """Of cells (n,); `slopes`: (n, d + 1, d) of their barycentric coordinates, 1/m."""
        if domain.order == 1:
            corners = domain.dim + 1
            return cls(domain.cell_nodes[cells], slopes[:, None], np.full((1, corners), 1 / corners))
        values, by_coordinate = quadratic_shape_functions(domain.mesh)
        each = np.einsum("pka,nai->npki", by_coordinate, slopes[:, 1:])
        return cls(domain.all_cell_nodes[cells], each, values)

    def __init__(self, nodes: Ints, slopes: Values, shares: Values) -> None:
        """`nodes`: (n, k) of cells.    `slopes`: (n, count, k, d) of the functions of nodes, 1/m.    `shares`: (count,
        k) these themselves."""
        cells, self.count, width, self._d = slopes.shape
        rows = cells * self.count
        found, index = np.unique(nodes, return_inverse=True)
        index, size = np.repeat(index.reshape(cells, 1, width), self.count, axis=1).reshape(-1), len(found)
        self._dofs = np.arange(self._d)[:, None] + self._d * found
        axes = slopes.transpose(3, 0, 1, 2).ravel()  # a block of rows an axis
        self._slopes = csr_matrix(
            (axes, np.tile(index, self._d), width * np.arange(self._d * rows + 1)), (self._d * rows, size)
        )
        self.steepness: Values = np.sqrt(np.einsum("npki,npki->npk", slopes, slopes)).sum(axis=2).ravel()
        self.most = float(np.abs(shares).sum(axis=1).max())
        self._shares = csr_matrix((np.tile(shares.ravel(), cells), index, width * np.arange(rows + 1)), (rows, size))

    def at_nodes(self, field: Values) -> Values:
        """(d, nodes) of a field of nodes (all * d,), at those of the cells."""
        return field[self._dofs]

    def gradients(self, nodes: Values) -> Values:
        """(m, d, d) of a field, H_ij = du_i / dX_j of the displacement."""
        rows = np.array([self._slopes @ each for each in nodes])
        return rows.reshape(self._d, self._d, -1).transpose(2, 0, 1)

    def values(self, nodes: Values) -> Values:
        """(m, d) of a field."""
        return np.array([self._shares @ each for each in nodes]).T

    def everywhere(self, cells: Values) -> Values:
        """(m,) of values of cells (n,)."""
        return cells if self.count == 1 else np.repeat(cells, self.count)

    def means(self, points: Values) -> Values:
        """(n, ...) over each cell of values at points (m, ...)."""
        if self.count == 1:
            return points
        return np.asarray(points.reshape(-1, self.count, *points.shape[1:]).mean(axis=1))
