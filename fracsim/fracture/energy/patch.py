"""Gradients of fields in some cells, and values in their middles: matrices that are kept, a product a component."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix

Ints = npt.NDArray[np.integer]
Values = npt.NDArray[np.float64]


class Patch:
    """Some cells. What comes out has its components one after the other in memory, each of them in one piece.

    Attributes:
        steepness: (n,) sum |grad lambda_i| of the barycentric coordinates, 1/m.
    """

    def __init__(self, nodes: Ints, slopes: Values) -> None:
        """`nodes`: (n, d + 1) of cells.    `slopes`: (n, d + 1, d) of their barycentric coordinates, 1/m."""
        count, corners, self._d = slopes.shape
        found, index = np.unique(nodes, return_inverse=True)
        index, size = index.reshape(-1), len(found)
        self._dofs = np.arange(self._d)[:, None] + self._d * found
        axes = slopes.transpose(2, 0, 1).ravel()  # a block of rows an axis
        self._slopes = csr_matrix(
            (axes, np.tile(index, self._d), corners * np.arange(self._d * count + 1)), (self._d * count, size)
        )
        self.steepness: Values = np.sqrt(np.einsum("nki,nki->nk", slopes, slopes)).sum(axis=1)
        share = np.full(index.size, 1 / corners)
        self._mean = csr_matrix((share, index, corners * np.arange(count + 1)), (count, size))

    def corners(self, field: Values) -> Values:
        """(d, corners) of a field of nodes (all * d,), at the corners of the cells."""
        return field[self._dofs]

    def gradients(self, corners: Values) -> Values:
        """(n, d, d) of a field, H_ij = du_i / dX_j of the displacement."""
        rows = np.array([self._slopes @ each for each in corners])
        return rows.reshape(self._d, self._d, -1).transpose(2, 0, 1)

    def middles(self, corners: Values) -> Values:
        """(n, d) of a field."""
        return np.array([self._mean @ each for each in corners]).T
