"""Gradients of fields in some cells, and values in their middles: matrices that are kept, a product a component."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix

Ints = npt.NDArray[np.integer]
Values = npt.NDArray[np.float64]


class Patch:
    """Some cells. What comes out has its components one after the other in memory, each of them in one piece."""

    def __init__(self, nodes: Ints, slopes: Values) -> None:
        """`nodes`: (n, d + 1) of cells.    `slopes`: (n, d + 1, d) of their barycentric coordinates, 1/m."""
        count, corners, self._d = slopes.shape
        self._nodes, index = np.unique(nodes, return_inverse=True)
        index, size = index.reshape(-1), len(self._nodes)
        axes = slopes.transpose(2, 0, 1).ravel()  # a block of rows an axis
        self._slopes = csr_matrix(
            (axes, np.tile(index, self._d), corners * np.arange(self._d * count + 1)), (self._d * count, size)
        )
        share = np.full(index.size, 1 / corners)
        self._mean = csr_matrix((share, index, corners * np.arange(count + 1)), (count, size))

    def _columns(self, field: Values) -> Values:
        """(d, nodes) of a field of nodes (all * d,)."""
        return np.ascontiguousarray(field.reshape(-1, self._d)[self._nodes].T)

    def gradients(self, field: Values) -> Values:
        """(n, d, d) of a field of nodes (nodes * d,), H_ij = du_i / dX_j of the displacement."""
        rows = np.array([self._slopes @ each for each in self._columns(field)])
        return rows.reshape(self._d, self._d, -1).transpose(2, 0, 1)

    def middles(self, field: Values) -> Values:
        """(n, d) of a field of nodes (nodes * d,)."""
        return np.array([self._mean @ each for each in self._columns(field)]).T
