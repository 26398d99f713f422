"""Pieces once more edges have broken: what a break parts is looked for around it.

From the ends of the edges that broke one goes along whole edges, some steps far. What is reached falls into parts. A
part that goes no further, and has no node that another rank has as well, is a piece. All others may hang together
beyond. Parts that hung together by what is reached, before the edges broke, are a cluster; where each has one at most
that goes on, on each rank, nothing else has come apart: whoever goes through a piece of before and comes to an edge
that has broken is in that part of its cluster, and past all that has come off is in it again.
"""

from __future__ import annotations

from ctypes import Structure, byref, c_int64
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from dolfinx import la
from mpi4py import MPI

from .c_library import Int32, Int64, Uint8, load_library, struct_pointer
from .domain import Domain
from .edge_graph import EdgeGraph
from .fragments import Fragments, find_fragments, midside_parents
from .parallel import concatenate_over_ranks, max_over_ranks, offset, sum_over_ranks

Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
FAR = 48  # edges that one goes at most
SOURCE = Path(__file__).with_suffix(".c")


class _GraphArrays(Structure):
    """As incremental_fragments.c has it."""

    _fields_ = (("nodes", Int32), ("broken", Uint8), ("edges", Int64), ("end", Int64), ("shared", Uint8))


class _WorkArrays(Structure):
    """For what is reached of so many nodes, as incremental_fragments.c has it, and its arrays."""

    _fields_ = (
        *((name, Int64) for name in ("nodes", "place", "part", "cluster")),
        ("goes_on", Uint8),
        ("of_part", Int64),
    )

    def __init__(self, nodes: int) -> None:
        self.reached, self.parts, self._clusters, self.of_parts = (np.empty(nodes, np.int64) for _ in range(4))
        self.open = np.empty(nodes, bool)
        self._place = np.full(nodes, -1)
        arrays = self.reached, self._place, self.parts, self._clusters, self.open, self.of_parts
        super().__init__(*map(struct_pointer, arrays))


@dataclass(frozen=True)
class _SearchResult:
    """Nodes (n,), the part of each, whether parts (parts,) go on or may do so on another rank, and the piece of before
    that each is of; `settled`: those that do not go on are all that has come off on this rank."""

    nodes: Ints
    part: Ints
    goes_on: Flags
    piece: Ints
    settled: bool


class IncrementalFragments:
    """Follows the pieces of a graph as its edges break.

    Attributes:
        pieces: of the last look.
    """

    def __init__(self, graph: EdgeGraph) -> None:
        self._graph, self._domain = graph, graph.domain
        self._shared = _on_other_ranks(graph.domain)
        self._room = _WorkArrays(len(self._shared))
        edges = graph.node_edges
        self._kept = graph.edge_nodes, graph.broken, edges.rows, edges.end, self._shared
        self._given = _GraphArrays(*map(struct_pointer, self._kept))
        self._code = load_library(SOURCE).reached
        self._look_everywhere()

    def update(self) -> Fragments:
        """The pieces of now (collective)."""
        graph = self._graph
        changed = np.flatnonzero(graph.broken != self._broken)
        count, healed = sum_over_ranks(
            graph.domain.comm, np.array([len(changed), np.count_nonzero(self._broken[changed])])
        )
        if healed:
            self._look_everywhere()
        elif count:
            self._look_around(changed)
        return self.pieces

    def _look_everywhere(self) -> None:
        self.pieces, self._broken = find_fragments(self._graph), self._graph.broken.copy()

    def _look_around(self, edges: Ints) -> None:
        """The pieces once edges (n,) have broken (collective)."""
        found = self._reached(edges)
        if max_over_ranks(self._domain.comm, int(not found.settled)):
            self._look_everywhere()
        else:
            self._part(found)
            self._broken[edges] = True

    def _reached(self, edges: Ints) -> _SearchResult:
        """What is around the ends of edges (n,), as far as need be."""
        room, parts, settled = self._room, c_int64(), c_int64()
        given = (
            byref(self._given),
            byref(room),
            c_int64(len(edges)),
            edges,
            c_int64(FAR),
            self.pieces.node_fragment,
        )
        count = self._code(*given, byref(parts), byref(settled))
        of_parts = room.open[: parts.value], room.of_parts[: parts.value]
        return _SearchResult(room.reached[:count], room.parts[:count], *of_parts, bool(settled.value))

    def _part(self, found: _SearchResult) -> None:
        """Parts that do not go on are pieces of their own (collective)."""
        before, domain, comm = self.pieces, self._domain, self._domain.comm
        off = np.flatnonzero(~found.goes_on)
        if not sum_over_ranks(comm, len(off))[0]:
            return
        numbers = np.full(len(found.goes_on), -1)
        numbers[off] = np.arange(len(off))
        of_node = numbers[found.part]
        nodes, number = found.nodes[of_node >= 0], of_node[of_node >= 0]
        low = np.full(len(off), np.iinfo(np.int64).max)
        np.minimum.at(low, number, domain.node_input[nodes])
        label = before.node_fragment.copy()
        label[nodes] = before.count + offset(comm, len(off)) + number
        rest, gone = before.lowest_node, np.count_nonzero(low == before.lowest_node[found.piece[off]])
        if sum_over_ranks(comm, gone)[0]:
            rest = self._lowest_of_rest(found.piece[off], label)
        lowest = np.concatenate([rest, concatenate_over_ranks(comm, low)])
        count = int(np.count_nonzero(lowest < np.iinfo(np.int64).max))
        order = np.argsort(lowest, kind="stable")
        rank = np.empty(len(order), np.int64)
        rank[order] = np.arange(len(order))
        of_node = rank[label]
        if domain.order == 2:
            between, end = midside_parents(domain)
            of_node[between] = of_node[end]
        self.pieces = Fragments(count, of_node, lowest[order][:count])

    def _lowest_of_rest(self, parted: Ints, label: Ints) -> Ints:
        """(pieces,) the lowest input node that is left of each piece of before, where nodes of the pieces `parted` have
        other labels now (collective)."""
        domain, lowest = self._domain, self.pieces.lowest_node.copy()
        changed = np.unique(concatenate_over_ranks(domain.comm, np.unique(parted)))
        left = np.full(len(lowest), np.iinfo(np.int64).max)
        of_changed = np.zeros(label.max(initial=len(lowest)) + 1, bool)
        of_changed[changed] = True
        corners = np.arange(len(label))[domain.owned_corners]
        corners = corners[of_changed[label[corners]]]
        np.minimum.at(left, label[corners], domain.node_input[corners])
        lowest[changed] = left[changed]
        domain.comm.Allreduce(MPI.IN_PLACE, lowest, MPI.MIN)
        return lowest


def _on_other_ranks(domain: Domain) -> Flags:
    """(nodes,) that more than one rank has."""
    vector = la.vector(domain.space.dofmap.index_map, 1, np.int32)
    vector.array[domain.node_count :] = 1
    vector.scatter_reverse(la.InsertMode.add)
    vector.scatter_forward()
    return np.asarray(vector.array > 0)
