"""Pieces once more edges have broken: what a break parts is looked for around it.

From the ends of the edges that broke one goes along whole edges, some steps far. What is reached falls into parts. A
part that goes no further, and has no node that another rank has as well, is a piece. All others may hang together
beyond; where a piece of before has one of them at most on each rank, they do: whoever goes through that piece and comes
to an edge that has broken is in that part, and past all that has come off is in it again.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from dolfinx import la
from mpi4py import MPI

from ..meshes.components import components
from .domain import Domain
from .edges import EdgeGraph
from .pieces import Pieces, find_pieces, followed
from .ranks import total

Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
FAR = (3, 12)  # edges that one goes, where need be


class Parting:
    """Follows the pieces of a graph as its edges break.

    Attributes:
        pieces: of the last look.
    """

    def __init__(self, graph: EdgeGraph) -> None:
        self._graph, self._domain = graph, graph.domain
        self._shared = _on_other_ranks(graph.domain)
        self._place = np.full(len(self._shared), -1)  # of nodes among those that are reached, while it lasts
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
        graph, place = self._graph, self._place
        nodes, links, rim = [ends], [], ends
        place[ends], count = np.arange(len(ends)), len(ends)
        for _ in range(far):
            edges = graph.edges_at.each(rim)
            links.append(graph.edge_nodes[edges[~graph.broken[edges]]])
            rim = links[-1].ravel()
            rim = rim[place[rim] < 0]
            place[rim] = np.arange(len(rim))
            rim = rim[place[rim] == np.arange(len(rim))]  # each once
            place[rim] = np.arange(count, count + len(rim))
            nodes.append(rim)
            count += len(rim)
        parts, part = components(place[np.concatenate(links)], count)
        every, goes_on = np.concatenate(nodes), np.zeros(parts, bool)
        place[every] = -1
        goes_on[part[self._shared[every]]] = True
        goes_on[part[count - len(rim) :]] = True
        return every, part, goes_on

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
