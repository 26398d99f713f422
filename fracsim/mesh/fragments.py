"""Pieces: connected components of the nodes under intact edges, the same at any rank count."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from dolfinx import la

from ..meshes.components import components
from .domain import Domain
from .edge_graph import EdgeGraph
from .parallel import allgather, offset


@dataclass(frozen=True)
class Fragments:
    """Bodies of a graph.

    Attributes:
        count: how many there are, numbered from 0 by their lowest node in the input mesh.
        of_node: (nodes,) piece of every owned and ghost node.
        lowest: (count,) the input node that each is numbered by.
    """

    count: int
    node_fragment: npt.NDArray[np.int64]
    lowest_node: npt.NDArray[np.int64]


def find_fragments(graph: EdgeGraph) -> Fragments:
    """Components within each rank, joined where ranks share nodes: one exchange, however they wind (collective)."""
    domain = graph.domain
    local_count, local = components(_joined(graph), len(domain.nodes))
    first = offset(domain.comm, local_count)
    label = local + first
    ghosts = slice(domain.node_count, None)
    links = np.stack([label[ghosts], _owners_label(domain, label)[ghosts]], axis=1)
    every = np.concatenate(allgather(domain.comm, np.unique(links, axis=0)))
    lowest = np.full(local_count, np.iinfo(np.int64).max)
    np.minimum.at(lowest, local, domain.node_input)
    lowest = np.concatenate(allgather(domain.comm, lowest))
    count, joined = components(every, len(lowest))
    least = np.full(count, np.iinfo(np.int64).max)
    np.minimum.at(least, joined, lowest)
    order = np.argsort(least)
    rank = np.empty(count, np.int64)
    rank[order] = np.arange(count)
    return Fragments(count, rank[joined][label], least[order])


def midside_parents(domain: Domain) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
    """(m,) middles of edges and (m,) the ends that they go with, those that come first in the input mesh: where an edge
    is broken its middle is anywhere between its ends, and a piece is known by its corners."""
    between, ends = domain.midside_edges
    return between, ends[np.arange(len(ends)), np.argmin(domain.node_input[ends], axis=1)]


def _joined(graph: EdgeGraph) -> npt.NDArray[np.int32]:
    """(n, 2) nodes of intact edges, and middles with what they follow."""
    edges = graph.edge_nodes[~graph.broken]
    return (
        edges if graph.domain.order == 1 else np.concatenate([edges, np.stack(midside_parents(graph.domain), axis=1)])
    )


def _owners_label(domain: Domain, label: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """The label that the owner of each node gives it."""
    vector = la.vector(domain.space.dofmap.index_map, 1, np.int64)
    vector.array[:] = label
    vector.scatter_forward()
    return vector.array.copy()
