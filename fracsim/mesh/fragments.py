"""Fragments: connected components of the nodes under intact edges, numbered alike at any rank count."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from ..meshes.topology import components, distinct_rows, links_in
from .domain import Domain
from .ghost_exchange import owner_values
from .parallel import allgather, rank_offset

if TYPE_CHECKING:
    from .edge_graph import EdgeGraph


@dataclass(frozen=True)
class Fragments:
    """Fragments of a body, in the order of their lowest nodes in the input mesh.

    Attributes:
        count: number of fragments.
        node_fragment: (nodes,) fragment of every owned and ghost node.
        lowest_node: (count,) lowest node of each fragment in the input mesh.
    """

    count: int
    node_fragment: npt.NDArray[np.int64]
    lowest_node: npt.NDArray[np.int64]


def find_fragments(graph: EdgeGraph) -> Fragments:
    """The fragments of a graph (collective)."""
    return find_components(graph.domain, graph.edge_nodes.take(np.flatnonzero(~graph.broken), axis=0))


def find_bodies(domain: Domain) -> Fragments:
    """The bodies of a mesh, which share no node (collective)."""
    return find_components(domain, links_in(domain.cell_nodes))


def find_components(domain: Domain, edges: npt.NDArray[np.integer]) -> Fragments:
    """The fragments that edges (n, 2) between local nodes connect; midside nodes follow an end (collective)."""
    # components within this rank
    local_count, local = components(_with_midside_nodes(domain, edges), len(domain.nodes))
    # links between components of different ranks: a shared node has the labels of its owner and of this rank
    first = rank_offset(domain.comm, local_count)
    label = local + first
    ghosts = slice(domain.node_count, None)
    owners_label = owner_values(domain.space.dofmap.index_map, label)
    links = np.stack([label[ghosts], owners_label[ghosts]], axis=1)
    all_links = np.concatenate(allgather(domain.comm, distinct_rows(links)[0]))
    # fragments in the order of their lowest nodes, so that their numbers do not depend on the partition
    lowest = np.full(local_count, np.iinfo(np.int64).max)
    np.minimum.at(lowest, local, domain.input_numbering.nodes)
    lowest = np.concatenate(allgather(domain.comm, lowest))
    count, joined = components(all_links, len(lowest))
    lowest_joined = np.full(count, np.iinfo(np.int64).max)
    np.minimum.at(lowest_joined, joined, lowest)
    order = np.argsort(lowest_joined)
    number = np.empty(count, np.int64)
    number[order] = np.arange(count)
    return Fragments(count, number[joined][label], lowest_joined[order])


def midside_parents(domain: Domain) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
    """(m,) midside nodes, and (m,) the end of the edge of each of them whose fragment the node belongs to."""
    # the end that comes first in the input mesh: a broken edge does not tell the fragment of its midside node
    midside = domain.cell_midside_nodes
    ends = midside.ends
    return midside.nodes, ends[np.arange(len(ends)), np.argmin(domain.input_numbering.nodes[ends], axis=1)]


def _with_midside_nodes(domain: Domain, edges: npt.NDArray[np.integer]) -> npt.NDArray[np.integer]:
    """(n, 2) nodes of edges, and midside nodes with the ends that they belong to."""
    return edges if domain.order == 1 else np.concatenate([edges, np.stack(midside_parents(domain), axis=1)])
