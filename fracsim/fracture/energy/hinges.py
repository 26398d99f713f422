"""Hinges: nodes and edges that alone connect two parts of a body which a crack has parted.

A node belongs to one part only, so that two parts that share a node stay one fragment, and rotate freely about it. The
crack between them has no ligament left, and its tip no energy to receive.

Equations: docs/theory.md#hinges.
"""

from __future__ import annotations

from math import pi

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ...mesh.edge_graph import EdgeGraph
from ...mesh.ghost_exchange import owner_values
from ...mesh.node_cells import node_components
from ...mesh.parallel import allgather, sum_over_ranks
from ..node_retention import NodeAttachment

Flags = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


class HingeRelease:
    """Finds the edges by which parts of a body hang on one another at hinges.

    Parts are facet-connected components of unsplit cells. Those larger than the disc (3D: ball) of a tip come apart;
    smaller ones stay with the part to which most of their edges lead.
    """

    def __init__(self, graph: EdgeGraph, tip_radius: Values, attachment: NodeAttachment | None) -> None:
        """Build the rule (collective).

        Args:
            graph: edges of the body.
            tip_radius: (cells,) radius of the disc of a tip in each cell, m.
            attachment: keeps nodes without an unsplit cell attached; None: they are fragments.
        """
        self._graph, self._attachment = graph, attachment
        domain = graph.domain
        radius = domain.comm.allreduce(float(tip_radius.min(initial=np.inf)), op=MPI.MIN)
        self._min_volume = (pi * radius**2, 4 / 3 * pi * radius**3)[domain.dim - 2]
        self._searched_split = graph.split

    def __call__(self, stress: Values) -> Flags:
        """Flag the edges (edges,) of hinges that are to break; `stress` (cells, 3 or 6) is local, Pa (collective)."""
        graph, domain = self._graph, self._graph.domain
        flags = np.zeros(len(graph.broken), bool)
        # `split` is a new array wherever cells were split
        changed, self._searched_split = graph.split is not self._searched_split, graph.split
        if not domain.comm.allreduce(int(changed)):
            return flags
        count, part = node_components(domain, ~graph.split)
        large = np.flatnonzero(self._volumes(part, count) > self._min_volume)
        if len(large) < 2:
            return flags
        labels = self._node_labels(part, count)[graph.edge_nodes]
        links = labels[: graph.edge_count][~graph.broken[: graph.edge_count]]
        links = np.concatenate(allgather(domain.comm, links[links[:, 0] != links[:, 1]]))
        numbers, body = assign_parts(links, large)
        flags[~graph.broken] = _are_apart(labels[~graph.broken], numbers, body)
        if self._attachment is not None:
            edges = np.flatnonzero(flags)
            flags[edges] = self._attachment(edges, stress, detaches=True)
        return flags

    def _volumes(self, part: Ints, count: int) -> Values:
        """Return the volume of each part: its nodes' shares of unsplit cells, m^3 (2D: m^2) (collective)."""
        graph, domain = self._graph, self._graph.domain
        cells = np.flatnonzero(~graph.split)
        # the part of a cell is the smallest one of its nodes, since shared nodes have the larger part
        number = self._node_labels(part, -1)[graph.cell_nodes[cells]].max(axis=1)
        return sum_over_ranks(domain.comm, np.bincount(number, domain.volumes[cells], count))

    def _node_labels(self, part: Ints, first: int) -> Ints:
        """Return (nodes,) the part of each owned and ghost node; nodes without a part have `first` + their own number.

        With `first` = -1 those have -1.
        """
        domain = self._graph.domain
        labels: Ints = np.full(len(domain.nodes), -1)
        labels[: len(part)] = part
        labels = owner_values(domain.space.dofmap.index_map, labels)
        return labels if first < 0 else np.where(labels < 0, first + domain.input_numbering.nodes, labels)


def assign_parts(links: Ints, large: Ints) -> tuple[Ints, Ints]:
    """Assign small parts to the large ones to which most of their links lead, step by step from the large ones.

    Args:
        links: (n, 2) different parts at the two ends of intact edges.
        large: (m,) parts that stay apart.

    Returns:
        (k,) numbers of parts in ascending order, and (k,) the large part of each, -1 without a way to one.
    """
    numbers, ends = np.unique(np.concatenate([links.reshape(-1), large]), return_inverse=True)
    ends = ends[: links.size].reshape(-1, 2)
    body = np.where(np.isin(numbers, large), numbers, -1)
    directed = np.concatenate([ends, ends[:, ::-1]])
    while True:
        leading = directed[(body[directed[:, 0]] < 0) & (body[directed[:, 1]] >= 0)]
        if not len(leading):
            return numbers, body
        pairs = np.column_stack([leading[:, 0], body[leading[:, 1]]])
        pairs, count = np.unique(pairs, axis=0, return_counts=True)
        # of equally many links those to the larger part, which has the lower number
        order = np.lexsort((pairs[:, 1], -count, pairs[:, 0]))
        row, first = np.unique(pairs[order, 0], return_index=True)
        body[row] = pairs[order[first], 1]


def _are_apart(labels: Ints, numbers: Ints, body: Ints) -> Flags:
    """Return whether the ends (n, 2) of edges belong to different large parts."""
    index = np.minimum(np.searchsorted(numbers, labels), len(numbers) - 1)
    bodies = np.where(numbers[index] == labels, body[index], labels)
    return (labels[:, 0] != labels[:, 1]) & (bodies[:, 0] != bodies[:, 1]) & (bodies >= 0).all(axis=1)
