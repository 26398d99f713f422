"""Cells and points near points, of this rank and of others; the same results on any number of ranks."""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from ...mesh.domain import Domain
from ...mesh.ghost_exchange import sum_at_nodes
from ...mesh.parallel import RankHalo, RemoteRows

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


def local_mesh_size(domain: Domain) -> Values:
    """Return h = (d! V)^(1/d) (cells,), m, V the mean volume of the cells around the corners (collective)."""
    volumes, nodes = domain.volumes, domain.cell_nodes
    rows = sum_at_nodes(domain, nodes, np.column_stack([volumes, np.ones(len(volumes))]))
    at_corners = rows[nodes]
    mean = (at_corners[..., 0] / at_corners[..., 1]).mean(axis=1)
    return np.asarray((factorial(domain.dim) * mean) ** (1 / domain.dim))


@dataclass(frozen=True)
class NeighbourPairs:
    """Pairs of query points and their neighbours, ordered by query point, then by neighbour.

    Attributes:
        first: (pairs,) number of the query point.
        second: (pairs,) number of the neighbour.
        apart: (pairs, d) vector from the query point to the neighbour, m.
        distance: (pairs,) length of that vector, m.
        count: number of query points.
    """

    first: Ints
    second: Ints
    apart: Values
    distance: Values
    count: int

    def sum(self, values: Values) -> Values:
        """Return the sums (points, ...) of values (pairs, ...), added in order."""
        flat = values.reshape(len(values), int(np.prod(values.shape[1:])))
        sums = [np.bincount(self.first, weights=column, minlength=self.count) for column in flat.T]
        # Sums of no pair are integers: convert.
        return np.asarray(sums, float).T.reshape(self.count, *values.shape[1:])

    def any(self, flags: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        """Return whether a point (points,) has any flagged pair (pairs,)."""
        return np.bincount(self.first[flags], minlength=self.count) > 0


def find_pairs(tree: cKDTree, points: Values, radius: Values) -> NeighbourPairs:
    """Return the pairs of points (n, d) and tree points nearer to them than radius (n,), m."""
    tree_points = np.asarray(tree.data)
    if not len(points) or not len(tree_points):
        none = np.empty(0, np.int64)
        return NeighbourPairs(none, none, np.empty((0, tree_points.shape[1])), np.empty(0), len(points))
    # Points are grouped by their radius, in steps of a quarter of an octave. A search with one radius returns arrays,
    # in a tenth of the time of one list for each point.
    size = np.ceil(4 * np.log2(radius)).astype(np.int64)
    keys = []
    for group in np.unique(size):
        rows = np.flatnonzero(size == group)
        near = cKDTree(points[rows]).sparse_distance_matrix(tree, radius[rows].max(), output_type="ndarray")
        point_number = rows[near["i"]]
        inside = near["v"] < radius[point_number]
        # A key that sorts by points, then by tree points.
        keys.append(point_number[inside] * len(tree_points) + near["j"][inside])
    point_number, tree_number = np.divmod(np.sort(np.concatenate(keys)), len(tree_points))
    apart = tree_points[tree_number] - points[point_number]
    return NeighbourPairs(point_number, tree_number, apart, np.sqrt(np.einsum("ni,ni->n", apart, apart)), len(points))


def weighted_mean(sums: Values, weight: Values) -> Values:
    """Return weighted sums divided by the sums of their weights; 0 without weight."""
    return np.divide(sums, weight, out=np.zeros_like(sums), where=weight > 0)


class NearbyCells:
    """Cells of this rank and of others within a distance of them, in the order of the input mesh.

    Attributes:
        number: (near,) numbers in the input mesh, ascending.
        volumes: (near,) m^d.
        centres: (near, d) centroids, m.
    """

    def __init__(self, domain: Domain, reach: float) -> None:
        """Exchange cells (collective); `reach`: largest distance of any later search, m."""
        centroids = domain.nodes[domain.cell_nodes].mean(axis=1)
        halo, self._comm, self._domain = RankHalo(domain.comm, centroids, reach), domain.comm, domain
        rank, index = np.full(len(centroids), float(domain.comm.rank)), np.arange(float(len(centroids)))
        columns = [domain.input_numbering.cells, rank, index, domain.volumes, centroids]
        rows = halo(np.column_stack(columns))
        rows = rows[np.argsort(rows[:, 0], kind="stable")]
        self.number, self._rank, self._index = rows[:, :3].T.astype(np.int64)
        self.volumes, self.centres = rows[:, 3].copy(), rows[:, 4:].copy()
        self._tree = cKDTree(self.centres)

    def find_pairs(self, points: Values, radius: Values) -> NeighbourPairs:
        """Return the pairs of points (n, d) and near cells whose centroids are nearer than radius (n,), m."""
        return find_pairs(self._tree, points, radius)

    def request_values(self, cells: Ints) -> RemoteRows:
        """Return an exchange of the values of near cells (n,) (collective)."""
        return RemoteRows(self._comm, self._rank[cells], self._index[cells])

    def corners(self, cells: Ints) -> tuple[Values, npt.NDArray[np.bool_]]:
        """Return the corners (n, d + 1, d), m, of near cells (n,), and the sides in the body's surface (collective).

        Flags (n, d + 1) of sides have the number of the corner opposite to it.
        """
        exchange = self.request_values(cells)
        owned = exchange.requested
        corners = self._domain.nodes[self._domain.cell_nodes[owned]]
        corners, outside = exchange(corners, self._domain.facets.boundary_sides[owned].astype(float))
        return corners, outside > 0

    def find_cells(self, number: Ints) -> tuple[Ints, npt.NDArray[np.bool_]]:
        """Return the positions (n,) of cells of the input mesh among the near ones, and whether they are there."""
        position = np.minimum(np.searchsorted(self.number, number), max(len(self.number) - 1, 0))
        is_near = self.number[position] == number if len(self.number) else np.zeros(len(number), bool)
        return position, is_near
