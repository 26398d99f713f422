"""Pieces: connected components of the nodes under intact edges, the same at any rank count."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from dolfinx import la
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from .domain import Domain
from .edges import EdgeGraph
from .ranks import offset


@dataclass(frozen=True)
class Pieces:
    """Bodies of a graph.

    Attributes:
        count: how many there are, numbered from 0 by their lowest node in the input mesh.
        of_node: (nodes,) piece of every owned and ghost node.
    """

    count: int
    of_node: npt.NDArray[np.int64]

    def totals(self, domain: Domain, per_node: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """(count, ...) sums over each piece of (owned nodes, ...) values such as mass in kg (collective)."""
        columns = per_node.reshape(domain.node_count, -1)
        owner = self.of_node[: domain.node_count]
        sums = np.empty((self.count, columns.shape[1]))
        for k, column in enumerate(columns.T):
            sums[:, k] = np.bincount(owner, column, minlength=self.count)
        result = np.empty_like(sums)
        domain.comm.Allreduce(sums, result)
        return result.reshape(self.count, *per_node.shape[1:])


def find_pieces(graph: EdgeGraph) -> Pieces:
    """Components within each rank, joined where ranks share nodes: one exchange, however they wind (collective)."""
    domain = graph.domain
    local_count, local = _components(len(domain.nodes), graph.edge_nodes[~graph.broken])
    first = offset(domain.comm, local_count)
    label = local + first
    ghosts = slice(domain.node_count, None)
    links = np.stack([label[ghosts], _owners_label(domain, label)[ghosts]], axis=1)
    every = np.concatenate(domain.comm.allgather(np.unique(links, axis=0)))
    lowest = np.full(local_count, np.iinfo(np.int64).max)
    np.minimum.at(lowest, local, domain.node_input)
    lowest = np.concatenate(domain.comm.allgather(lowest))
    count, joined = _components(len(lowest), every)
    return Pieces(count, _by_lowest(joined, lowest, count)[label])


def _components(count: int, links: npt.NDArray[np.integer]) -> tuple[int, npt.NDArray[np.int64]]:
    ones = np.ones(len(links), np.int8)
    graph = csr_matrix((ones, (links[:, 0], links[:, 1])), shape=(count, count))
    number, label = connected_components(graph, directed=False)
    return int(number), label.astype(np.int64)


def _owners_label(domain: Domain, label: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """The label that the owner of each node gives it."""
    vector = la.vector(domain.space.dofmap.index_map, 1, np.int64)
    vector.array[:] = label
    vector.scatter_forward()
    return vector.array.copy()


def _by_lowest(joined: npt.NDArray[np.int64], lowest: npt.NDArray[np.int64], count: int) -> npt.NDArray[np.int64]:
    """Renumber joined components by the lowest input node that each of them has."""
    least = np.full(count, np.iinfo(np.int64).max)
    np.minimum.at(least, joined, lowest)
    rank = np.empty(count, np.int64)
    rank[np.argsort(least)] = np.arange(count)
    return rank[joined]
