"""What lies around a place: sums over the cells within a distance, the same at any number of ranks."""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial

import numpy as np
import numpy.typing as npt
from dolfinx import la
from scipy.spatial import cKDTree

from ...mesh.domain import Domain
from ...mesh.halo import Halo

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]

MANY = 1000  # places from which on all cells are wanted


def local_size(domain: Domain) -> Values:
    """(cells,) h = (d! V)^(1/d) in m, V the mean volume of the cells around the nodes of each cell (collective)."""
    volumes, nodes = domain.volumes, domain.cell_nodes
    sums = la.vector(domain.space.dofmap.index_map, 2, np.float64)
    rows = sums.array.reshape(-1, 2)
    np.add.at(rows, nodes.ravel(), np.repeat(np.column_stack([volumes, np.ones(len(volumes))]), nodes.shape[1], axis=0))
    sums.scatter_reverse(la.InsertMode.add)
    sums.scatter_forward()
    return np.asarray((factorial(domain.dim) * (rows[:, 0] / rows[:, 1])[nodes].mean(axis=1)) ** (1 / domain.dim))


@dataclass(frozen=True)
class Pairs:
    """Cells near places: pair k is of place `place[k]` and cell `cell[k]` of the rows that `Around.exchange` gives.

    Attributes:
        apart: (pairs, d) from the place to the cell's centre, m.    distance: (pairs,) its length, m.
        count: number of places.
    """

    place: Ints
    cell: Ints
    apart: Values
    distance: Values
    count: int

    def sum(self, values: Values) -> Values:
        """(places, ...) sums of (pairs, ...) values, in the order of the input mesh."""
        result = np.zeros((self.count, *values.shape[1:]))
        np.add.at(result, self.place, values)
        return result

    def any(self, flags: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        """(places,) whether any pair (pairs,) is flagged."""
        return np.bincount(self.place[flags], minlength=self.count) > 0


class Around:
    """The cells of this rank and those of others that are near them.

    Attributes:
        volumes: (near,) m^d.    centres: (near, d) m.
    """

    def __init__(self, domain: Domain, reach: float) -> None:
        """`reach`: farthest that anybody will look, m (collective)."""
        own = domain.nodes[domain.cell_nodes].mean(axis=1)
        self._halo = Halo(domain.comm, own, reach)
        number = self._halo(domain.cell_input[:, None].astype(float))[:, 0]
        self._order = np.argsort(number, kind="stable")  # sums are in the order of the input mesh
        self.centres = self._halo(own)
        self.volumes = self._halo(domain.volumes[:, None])[:, 0]
        self._tree = cKDTree(self.centres[self._order])
        self._own, self._reach, self._comm = cKDTree(own), reach, domain.comm

    def exchange(self, values: Values) -> Values:
        """(near, n) rows of owned and near cells, in this order, from those of owned ones (cells, n) (collective)."""
        return self._halo(values)

    def wanted(self, places: Values) -> Ints:
        """Owned cells near the places (n, d) that any rank looks at (collective)."""
        every = np.concatenate(self._comm.allgather(places))
        if len(every) > MANY:
            return np.arange(self._own.n)
        near = np.zeros(self._own.n, bool)
        for found in self._own.query_ball_point(every, self._reach, return_sorted=False) if len(every) else ():
            near[found] = True
        return np.flatnonzero(near)

    def pairs(self, places: Values, radius: Values) -> Pairs:
        """Cells whose centres lie within `radius` (n,) of places (n, d)."""
        found = self._tree.query_ball_point(places, radius, return_sorted=True) if len(places) else []
        place = np.repeat(np.arange(len(places)), [len(each) for each in found])
        cell = self._order[np.concatenate([np.empty(0, np.int64), *map(np.asarray, found)]).astype(np.int64)]
        apart = self.centres[cell] - places[place]
        return Pairs(place, cell, apart, np.linalg.norm(apart, axis=1), len(places))
