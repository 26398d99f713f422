"""Pieces: connected components of the nodes under intact edges, the same at any rank count."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from dolfinx import la

from ..meshes.components import components
from .domain import Domain
from .edges import EdgeGraph
from .ranks import offset, total
from .simplices import local_edges, node_groups


@dataclass(frozen=True)
class Pieces:
    """Bodies of a graph.

    Attributes:
        count: how many there are, numbered from 0 by their lowest node in the input mesh.
        of_node: (nodes,) piece of every owned and ghost node.
    """

    count: int
    of_node: npt.NDArray[np.int64]


def find_pieces(graph: EdgeGraph) -> Pieces:
    """Components within each rank, joined where ranks share nodes: one exchange, however they wind (collective)."""
    domain = graph.domain
    local_count, local = components(_joined(graph), len(domain.nodes))
    first = offset(domain.comm, local_count)
    label = local + first
    ghosts = slice(domain.node_count, None)
    links = np.stack([label[ghosts], _owners_label(domain, label)[ghosts]], axis=1)
    every = np.concatenate(domain.comm.allgather(np.unique(links, axis=0)))
    lowest = np.full(local_count, np.iinfo(np.int64).max)
    np.minimum.at(lowest, local, domain.node_input)
    lowest = np.concatenate(domain.comm.allgather(lowest))
    count, joined = components(every, len(lowest))
    return Pieces(count, _by_lowest(joined, lowest, count)[label])


def hold_together(graph: EdgeGraph, before: npt.NDArray[np.bool_]) -> bool:
    """Whether pieces are those of `before`, flags (edges,) of what was broken then: nothing is whole again, and the
    ends of what has broken since are still joined by a cell of some rank, as behind the tip of a crack (collective)."""
    new = graph.broken & ~before
    cells = np.flatnonzero(new[graph.cell_edges].any(axis=1))
    group = node_groups(graph.domain.dim)[graph.pattern[cells]]
    first, second = local_edges(graph.domain.dim).T
    joined = np.zeros(len(new), bool)
    joined[graph.cell_edges[cells][group[:, first] == group[:, second]]] = True
    other = (before & ~graph.broken) | (new & ~graph.on_any_rank(joined))
    return not total(graph.domain.comm, np.count_nonzero(other))[0]


def _joined(graph: EdgeGraph) -> npt.NDArray[np.int32]:
    """(n, 2) nodes of intact edges. A middle goes with the end of its edge that comes first in the input mesh: where
    the edge is broken it is anywhere between them, and a piece is known by its corners."""
    domain, edges = graph.domain, graph.edge_nodes[~graph.broken]
    if domain.order == 1:
        return edges
    between, ends = domain.middle_ends
    first = np.argmin(domain.node_input[ends], axis=1)
    return np.concatenate([edges, np.stack([between, ends[np.arange(len(ends)), first]], axis=1)])


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
