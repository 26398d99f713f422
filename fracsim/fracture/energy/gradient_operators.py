"""Gradients and values of nodal fields at points of some cells, as sparse matrices that are kept.

A linear cell has one point, its centroid. A quadratic cell has the points of the stress quadrature, of equal weights
(mechanics.jit): products of fields are evaluated at points, and a cell gets their mean.
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


class GradientOperators:
    """Operators at the m = n `count` points of n cells, cell by cell; results have each component contiguous.

    Attributes:
        count: number of points of a cell.
    """

    @classmethod
    def of_cells(cls, domain: Domain, cells: Ints, slopes: Values) -> Self:
        """Build the operators of cells (n,) from the gradients (n, d + 1, d) of barycentric coordinates, 1/m."""
        if domain.order == 1:
            corners = domain.dim + 1
            return cls(domain.cell_nodes[cells], slopes[:, None], np.full((1, corners), 1 / corners))
        values, by_coordinate = quadratic_shape_functions(domain.mesh)
        gradients = np.einsum("pka,nai->npki", by_coordinate, slopes[:, 1:])
        return cls(domain.all_cell_nodes[cells], gradients, values)

    def __init__(self, nodes: Ints, gradients: Values, values: Values) -> None:
        """Assemble the matrices.

        Args:
            nodes: (n, k) nodes of cells.
            gradients: (n, count, k, d) gradients of the shape functions, 1/m.
            values: (count, k) shape functions.
        """
        cells, self.count, width, self._d = gradients.shape
        rows = cells * self.count
        # Columns are the nodes of these cells alone.
        unique_nodes, index = np.unique(nodes, return_inverse=True)
        index, size = np.repeat(index.reshape(cells, 1, width), self.count, axis=1).reshape(-1), len(unique_nodes)
        self._dofs = np.arange(self._d)[:, None] + self._d * unique_nodes
        # One block of rows for each axis.
        # Row pointers are multiples of the number of nodes of a cell.
        by_axis = gradients.transpose(3, 0, 1, 2).ravel()
        self._gradients = csr_matrix(
            (by_axis, np.tile(index, self._d), width * np.arange(self._d * rows + 1)), (self._d * rows, size)
        )
        self._values = csr_matrix((np.tile(values.ravel(), cells), index, width * np.arange(rows + 1)), (rows, size))

    def gather_nodal_values(self, field: Values) -> Values:
        """Return the values (d, nodes of the cells) of a nodal field (all nodes * d,)."""
        return field[self._dofs]

    def evaluate_gradients(self, nodal: Values) -> Values:
        """Return the gradients (m, d, d) of a field, H_ij = du_i / dX_j of a displacement."""
        rows = np.array([self._gradients @ component for component in nodal])
        return rows.reshape(self._d, self._d, -1).transpose(2, 0, 1)

    def evaluate_values(self, nodal: Values) -> Values:
        """Return the values (m, d) of a field."""
        return np.array([self._values @ component for component in nodal]).T

    def repeat_at_points(self, cell_values: Values) -> Values:
        """Return the values (m,) of cells (n,) at their points."""
        return cell_values if self.count == 1 else np.repeat(cell_values, self.count)

    def average_over_points(self, point_values: Values) -> Values:
        """Return the means (n, ...) over each cell of values at points (m, ...)."""
        if self.count == 1:
            return point_values
        return np.asarray(point_values.reshape(-1, self.count, *point_values.shape[1:]).mean(axis=1))
