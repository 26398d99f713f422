"""What lies around a place: the cells within a distance, the same at any number of ranks.

Values of a few cells, on whatever rank they are: the ranks that own them work them out.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial, prod

import numpy as np
import numpy.typing as npt
from dolfinx import la
from mpi4py import MPI
from scipy.spatial import cKDTree

from ...mesh.domain import Domain
from ...mesh.parallel import RankHalo, alltoall
from ...mesh.small_matrices import barycentric_gradients

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


class Asked:
    """Cells that this rank asks for, and those that others ask of it.

    Attributes:
        own: (m,) cells of this rank that any rank asks for; on one rank in the order in which they are.
    """

    def __init__(self, comm: MPI.Comm, rank: Ints, index: Ints) -> None:
        """`rank`, `index`: (n,) who owns each of the cells that are asked for, and its number there (collective)."""
        self._comm = comm
        if comm.size == 1:
            self.own: Ints = index
            return
        self._order = np.argsort(rank, kind="stable")
        here = [index[rank == each] for each in range(comm.size)]
        there = alltoall(comm, here)
        self.own = np.unique(np.concatenate(there))
        self._send = [np.searchsorted(self.own, each) for each in there]

    def __call__(self, *fields: Values) -> list[Values]:
        """(n, ...) values of the cells asked for, from those (m, ...) of `own`; from other ranks they come with one
        component after the other in memory (collective)."""
        if self._comm.size == 1:
            return list(fields)
        tails = [each.shape[1:] for each in fields]
        rows = np.concatenate([each.reshape(len(each), prod(tail)).T for each, tail in zip(fields, tails, strict=True)])
        arrived = np.concatenate(alltoall(self._comm, [rows[:, each] for each in self._send]), axis=1)
        result = np.empty_like(arrived)
        result[:, self._order] = arrived
        parts = np.split(result, np.cumsum([prod(tail) for tail in tails])[:-1])
        shaped = [part.reshape(*tail, result.shape[1]) for part, tail in zip(parts, tails, strict=True)]
        return [np.moveaxis(each, -1, 0) for each in shaped]


def local_size(domain: Domain) -> Values:
    """(cells,) h = (d! V)^(1/d) in m, V the mean volume of the cells around the nodes of each cell (collective)."""
    volumes, nodes = domain.volumes, domain.cell_nodes
    sums = la.vector(domain.space.dofmap.index_map, 2, np.float64)
    rows = sums.array.reshape(-1, 2)
    np.add.at(rows, nodes.ravel(), np.repeat(np.column_stack([volumes, np.ones(len(volumes))]), nodes.shape[1], axis=0))
    sums.scatter_reverse(la.InsertMode.add)
    sums.scatter_forward()
    around = rows[nodes]  # of corners: no cell has brought anything to the middle of an edge
    return np.asarray((factorial(domain.dim) * (around[..., 0] / around[..., 1]).mean(axis=1)) ** (1 / domain.dim))


def surface_of(domain: Domain) -> tuple[Values, Values]:
    """(cells, d) int n dA over the facets that cells of this rank have in the body's surface, outwards, and (cells, d)
    the mean of the middles of these facets, m."""
    corners, outside = domain.nodes[domain.cell_nodes], domain.boundary_sides
    areas = -domain.dim * domain.volumes[:, None, None] * barycentric_gradients(corners)
    middles = (corners.sum(axis=1, keepdims=True) - corners) / domain.dim
    count = np.maximum(outside.sum(axis=1), 1)[:, None]
    vector, place = (np.einsum("nk,nki->ni", outside, each) for each in (areas, middles))
    return vector, place / count


@dataclass(frozen=True)
class Pairs:
    """Things near places: pair k is of place `place[k]` and thing `other[k]`, by places, then in order of the things.

    Attributes:
        apart: (pairs, d) from the place to the thing, m.    distance: (pairs,) its length, m.
        count: number of places.
    """

    place: Ints
    other: Ints
    apart: Values
    distance: Values
    count: int

    def sum(self, values: Values) -> Values:
        """(places, ...) sums of (pairs, ...) values, one after the other."""
        flat = values.reshape(len(values), int(np.prod(values.shape[1:])))
        sums = [np.bincount(self.place, weights=column, minlength=self.count) for column in flat.T]
        return np.asarray(sums, float).T.reshape(self.count, *values.shape[1:])  # float: those of nothing are not

    def any(self, flags: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        """(places,) whether any pair (pairs,) is flagged."""
        return np.bincount(self.place[flags], minlength=self.count) > 0


def pairs_within(tree: cKDTree, places: Values, radius: Values) -> Pairs:
    """Points of a tree nearer than `radius` (n,) to places (n, d).

    Places are taken together by the size of their radius to a quarter: one search has one radius, and what it finds
    stays in arrays, which takes a tenth of the time of one list a place.
    """
    points = np.asarray(tree.data)
    if not len(places) or not len(points):
        none = np.empty(0, np.int64)
        return Pairs(none, none, np.empty((0, points.shape[1])), np.empty(0), len(places))
    size = np.ceil(4 * np.log2(radius)).astype(np.int64)
    found = []
    for each in np.unique(size):
        rows = np.flatnonzero(size == each)
        near = cKDTree(places[rows]).sparse_distance_matrix(tree, radius[rows].max(), output_type="ndarray")
        place = rows[near["i"]]
        inside = near["v"] < radius[place]
        found.append(place[inside] * len(points) + near["j"][inside])
    place, other = np.divmod(np.sort(np.concatenate(found)), len(points))
    apart = points[other] - places[place]
    return Pairs(place, other, apart, np.sqrt(np.einsum("ni,ni->n", apart, apart)), len(places))


def over(sums: Values, weight: Values) -> Values:
    """Sums over their weights; 0 where there is none."""
    return np.divide(sums, weight, out=np.zeros_like(sums), where=weight > 0)


class Around:
    """The cells of this rank and those of others that are near them, in the order of the input mesh.

    Attributes:
        number: (near,) of cells in the input mesh, rising.    volumes: (near,) m^d.    centres: (near, d) m.
        outside: (near, d) int n dA over what cells have of the body's surface, m^(d-1).    there: (near, d) its middle.
    """

    def __init__(self, domain: Domain, reach: float) -> None:
        """`reach`: farthest that anybody will look, m (collective)."""
        own = domain.nodes[domain.cell_nodes].mean(axis=1)
        halo, self._comm = RankHalo(domain.comm, own, reach), domain.comm
        rank, index = np.full(len(own), float(domain.comm.rank)), np.arange(float(len(own)))
        known = halo(np.column_stack([domain.cell_input, rank, index, domain.volumes, own, *surface_of(domain)]))
        known = known[np.argsort(known[:, 0], kind="stable")]
        self.number, self._rank, self._index = known[:, :3].T.astype(np.int64)
        self.volumes = known[:, 3].copy()
        self.centres, self.outside, self.there = (each.copy() for each in np.split(known[:, 4:], 3, axis=1))
        self._tree = cKDTree(self.centres)

    def pairs(self, places: Values, radius: Values) -> Pairs:
        """Cells, by their place among those near, whose centres are nearer than `radius` (n,) to places (n, d)."""
        return pairs_within(self._tree, places, radius)

    def asked(self, cells: Ints) -> Asked:
        """A way to the values of cells (n,), by their place among those near (collective)."""
        return Asked(self._comm, self._rank[cells], self._index[cells])

    def those_of(self, number: Ints) -> tuple[Ints, npt.NDArray[np.bool_]]:
        """Where cells (n,) of the input mesh are among those near, and (n,) whether they are."""
        place = np.minimum(np.searchsorted(self.number, number), max(len(self.number) - 1, 0))
        return place, self.number[place] == number if len(self.number) else np.zeros(len(number), bool)
