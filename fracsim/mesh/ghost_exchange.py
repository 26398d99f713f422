"""Values of what ranks share: owners of nodes, edges and facets send values to ghosts, and keys name other entities."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from dolfinx import la
from dolfinx.common import IndexMap
from mpi4py import MPI

from .parallel import RowRouting, exchange_rows

if TYPE_CHECKING:
    from .domain import Domain


def owner_values(index_map: IndexMap, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """(n,) values of owned and ghost entities, those of ghosts from their owners."""
    result = la.vector(index_map, 1, values.dtype)
    result.array[:] = values
    result.scatter_forward()
    return np.asarray(result.array)


def min_over_ranks(index_map: IndexMap, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """(n,) minimum of values of owned and ghost entities over the ranks that have the entity."""
    comm = index_map.comm
    if comm.size == 1:
        return values
    # each ghost goes to its owner alone
    order = np.argsort(index_map.owners, kind="stable")
    sent, received = np.bincount(index_map.owners, minlength=comm.size), np.empty(comm.size, np.int64)
    comm.Alltoall(sent, received)
    ghosts, ghost_values = (
        exchange_rows(comm, rows[order], sent, received) for rows in (index_map.ghosts, values[index_map.size_local :])
    )
    result = values.copy()
    np.minimum.at(result, ghosts - index_map.local_range[0], ghost_values)
    return owner_values(index_map, result)


def sum_at_nodes(
    domain: Domain, nodes: npt.NDArray[np.integer[Any]], values: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """(owned and ghost nodes, k) sums over all ranks of values (n, k), each for its nodes (n, ...) (collective)."""
    sums = la.vector(domain.space.dofmap.index_map, values.shape[1], np.float64)
    result, repeats = sums.array.reshape(-1, values.shape[1]), int(np.prod(nodes.shape[1:]))
    for total, column in zip(result.T, values.T, strict=True):
        total[:] = np.bincount(nodes.reshape(-1), np.repeat(column, repeats), len(result))
    # Sums of ghost nodes are added to their owners, then copied back.
    sums.scatter_reverse(la.InsertMode.add)
    sums.scatter_forward()
    return np.asarray(result)


def with_ghosts(domain: Domain, owned: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """(owned and ghost dofs,) values of the displacement space from its owned dofs.

    On one rank the result is `owned` itself: do not write to it.
    """
    if domain.comm.size == 1:
        return owned
    result = la.vector(domain.space.dofmap.index_map, domain.dim, np.float64)
    result.array[: len(owned)] = owned
    result.scatter_forward()
    return np.asarray(result.array)


def with_straight_edges(domain: Domain, owned: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """(owned dofs,) values with midside nodes at the mean of the ends of their edges."""
    if domain.order == 1:
        return owned
    # an end of the edge of an owned midside node may be a ghost
    nodal = with_ghosts(domain, owned).reshape(-1, domain.dim).copy()
    domain.cell_midside_nodes.straighten_edges(nodal)
    return nodal.reshape(-1)[: len(owned)]


class KeyLookup:
    """Positions of keys among n distinct ones."""

    def __init__(self, keys: npt.NDArray[np.int64]) -> None:
        """`keys`: (n,)."""
        self._order = np.argsort(keys)
        self._sorted = keys[self._order]

    def __call__(self, keys: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """(...) position of each key; -1: it is not among them."""
        if not len(self._sorted):
            return np.full(keys.shape, -1)
        position = np.minimum(np.searchsorted(self._sorted, keys), len(self._sorted) - 1)
        return np.where(self._sorted[position] == keys, self._order[position], -1)


def find_saved_keys(
    comm: MPI.Comm, keys: npt.NDArray[np.int64], saved: npt.NDArray[np.number[Any]]
) -> npt.NDArray[np.int64]:
    """(k,) positions of saved keys (k,), equal on all ranks, among those of this rank; -1: not here (collective).

    Raises ValueError if no rank has one of them.
    """
    positions = KeyLookup(keys)(saved.astype(np.int64))
    is_found = positions >= 0
    comm.Allreduce(MPI.IN_PLACE, is_found, MPI.LOR)
    if not is_found.all():
        raise ValueError(f"{np.count_nonzero(~is_found)} of {len(saved)} keys are of no point or element")
    return positions


class KeyedReduction:
    """Sums, minima and the like over the ranks of values with equal keys.

    The values of a key meet on the rank whose number is the remainder of the key.
    """

    def __init__(self, comm: MPI.Comm, keys: npt.NDArray[np.int64]) -> None:
        """`keys`: (n,) of this rank (collective)."""
        self._comm = comm
        if comm.size == 1:
            return
        self._routing = RowRouting(comm, keys % comm.size)
        arrived = self._routing.send(keys)
        self._by_key = np.argsort(arrived, kind="stable")
        is_first = np.diff(arrived[self._by_key], prepend=-1) != 0
        self._first = np.flatnonzero(is_first)
        self._group = np.empty(len(arrived), np.int64)
        self._group[self._by_key] = np.cumsum(is_first) - 1

    def __call__(self, values: npt.NDArray[Any], operation: np.ufunc) -> npt.NDArray[Any]:
        """(n, ...) results of an operation on the values (n, ...) of each key on all ranks (collective)."""
        if self._comm.size == 1:
            return values
        arrived = self._routing.send(values)
        if len(arrived):
            arrived = operation.reduceat(arrived[self._by_key], self._first, axis=0)[self._group]
        return self._routing.send_back(arrived)
