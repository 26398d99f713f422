"""Pieces once more edges have broken: what a break parts is looked for around it.

From the ends of the edges that broke one goes along whole edges, some steps far. What is reached falls into parts. A
part that goes no further, and has no node that another rank has as well, is a piece. All others may hang together
beyond; where a piece of before has one of them at most on each rank, they do: whoever goes through that piece and comes
to an edge that has broken is in that part, and past all that has come off is in it again.
"""

from __future__ import annotations

from ctypes import Structure, byref, c_int64, c_void_p
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from dolfinx import la
from mpi4py import MPI

from .compiled import address, at, library
from .domain import Domain
from .edges import EdgeGraph
from .pieces import Pieces, find_pieces, followed
from .ranks import total

Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
FAR = (3, 12, 48)  # edges that one goes, where need be
SOURCE = Path(__file__).with_suffix(".c")


class _Given(Structure):
    """As parting.c has it."""

    _fields_ = tuple((name, c_void_p) for name in ("nodes", "broken", "edges", "end", "shared"))


@dataclass(frozen=True)
class _Room:
    """For what is reached, and for places of nodes (nodes,) among it: -1 but while it lasts."""

    nodes: Ints
    place: Ints
    part: Ints
    goes_on: Flags

    @classmethod
    def of(cls, nodes: int) -> _Room:
        return cls(np.empty(nodes, np.int64), np.full(nodes, -1), np.empty(nodes, np.int64), np.empty(nodes, bool))


class Parting:
    """Follows the pieces of a graph as its edges break.

    Attributes:
        pieces: of the last look.
    """

    def __init__(self, graph: EdgeGraph) -> None:
        self._graph, self._domain = graph, graph.domain
        self._shared = _on_other_ranks(graph.domain)
        self._room = _Room.of(len(self._shared))
        self._code = library(SOURCE).reached
        self._code.restype = c_int64
        self._look_everywhere()

    def look(self) -> Pieces:
        """The pieces of now (collective)."""
        graph = self._graph
        new, whole_again = graph.broken & ~self._broken, np.any(self._broken & ~graph.broken)
        count, healed = total(graph.domain.comm, np.array([np.count_nonzero(new), whole_again]))
        if healed:
            self._look_everywhere()
        elif count:
            self._look_around(np.unique(graph.edge_nodes[new]))
        return self.pieces

    def _look_everywhere(self) -> None:
        self.pieces, self._broken = find_pieces(self._graph), self._graph.broken.copy()

    def _look_around(self, ends: Ints) -> None:
        """The pieces once edges between some of the nodes `ends` have broken (collective)."""
        of_node, comm = self.pieces.of_node, self._domain.comm
        for far in FAR:
            nodes, part, goes_on = self._reached(ends, far)
            first = np.unique(part, return_index=True)[1]
            open_in = np.bincount(of_node[nodes[first]][goes_on], minlength=1)
            if comm.allreduce(int(open_in.max()), op=MPI.MAX) <= 1:
                self._part(nodes, part, goes_on)
                self._broken = self._graph.broken.copy()
                return
        self._look_everywhere()

    def _reached(self, ends: Ints, far: int) -> tuple[Ints, Ints, Flags]:
        """(n,) nodes at most `far` whole edges from `ends`, (n,) the part each is in, and (parts,) which of these go on
        or may do so on another rank."""
        graph, room, parts = self._graph, self._room, c_int64()
        room.nodes[: len(ends)] = ends
        edges = graph.edges_at
        given = _Given(*map(address, (graph.edge_nodes, graph.broken, edges.rows, edges.end, self._shared)))
        sizes = byref(given), c_int64(len(ends)), c_int64(far)
        count = self._code(*sizes, *map(at, (room.nodes, room.place, room.part, room.goes_on)), byref(parts))
        return room.nodes[:count], room.part[:count], room.goes_on[: parts.value]

    def _part(self, nodes: Ints, part: Ints, goes_on: Flags) -> None:
        """Parts (parts,) of nodes (n,) that do not go on are pieces of their own (collective)."""
        before, domain = self.pieces, self._domain
        off = nodes[~goes_on[part]]
        if not total(domain.comm, len(off))[0]:
            return
        number = (np.cumsum(~goes_on) - 1)[part[~goes_on[part]]]
        low = np.full(int(np.count_nonzero(~goes_on)), np.iinfo(np.int64).max)
        np.minimum.at(low, number, domain.node_input[off])
        every = domain.comm.allgather(low)
        first = before.count + sum(map(len, every[: domain.comm.rank]))
        label = before.of_node.copy()
        label[off] = first + number
        lowest = np.concatenate([self._lowest_of_rest(before.of_node[off], label), *every])
        count = int(np.count_nonzero(lowest < np.iinfo(np.int64).max))
        order = np.argsort(lowest, kind="stable")
        rank = np.empty(len(order), np.int64)
        rank[order] = np.arange(len(order))
        of_node = rank[label]
        if domain.order == 2:
            between, end = followed(domain)
            of_node[between] = of_node[end]
        self.pieces = Pieces(count, of_node, lowest[order][:count])

    def _lowest_of_rest(self, parted: Ints, label: Ints) -> Ints:
        """(pieces,) the lowest input node that is left of each piece of before, where nodes of the pieces `parted` have
        other labels now (collective)."""
        domain, lowest = self._domain, self.pieces.lowest.copy()
        changed = np.unique(np.concatenate(domain.comm.allgather(np.unique(parted))))
        left = np.full(len(lowest), np.iinfo(np.int64).max)
        of_changed = np.zeros(label.max(initial=len(lowest)) + 1, bool)
        of_changed[changed] = True
        corners = np.arange(len(label))[domain.corners]
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
