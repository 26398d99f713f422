"""Nodes that a pass leaves without a whole cell stay joined to the neighbour that holds them best: none is a crumb.

A node all of whose cells have come apart carries nothing: on its own it would be a piece, on any mesh, and no debris.
Of the edges that still held it before the pass one does not break: the one that is loaded least, by what its cells feel
themselves. Where nodes hang on one another each group of them keeps the least loaded edge that leads out of it, until
it hangs on a node with a whole cell, and on no more than one: what a crack parts is not joined by it (Boruvka's rule
for a spanning forest). So cells that have come apart stay so, and mechanics follow from what a joined node hangs on
(mechanics.tethers).

Nodes whose motion is prescribed are held by it, and by one another where no edge between them fails: a group of two and
more of them, what is left on a grip that something has snapped off, may be a piece of its own.

Equations: docs/theory.md#node-retention.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..mechanics.stress import Stress
from ..mesh.around import CellsAround
from ..mesh.edges import EdgeGraph
from ..mesh.ranks import allgather, total
from ..mesh.simplices import is_split
from ..meshes.components import components
from .edge_stress import Simplices
from .strength import Strength

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
HELD = -np.inf  # the load of an edge that joins already, or both ends of which move as they are told


class Joining:
    """Spares, of edges that fail, those that nodes without a whole cell stay joined by."""

    def __init__(
        self, stress: Stress, graph: EdgeGraph, strength: Strength, held: Flags, *, cracks: bool = False
    ) -> None:
        """`held`: (nodes,) whose motion is prescribed, ghosts too; `cracks` cut what fails: it joins last."""
        self._cells, self._graph, self._strength, self._held = Simplices.of(stress), graph, strength, held
        self._cracks = cracks
        self._both: Flags = np.asarray(held[graph.edge_nodes].all(axis=1))
        self._around = CellsAround(graph.domain)

    def __call__(self, edges: npt.NDArray[np.integer], stress: Values) -> Flags:
        """(n,) which of the edges (n,) that fail do so, and which idle ones the graph keeps, under the stress (cells,
        3 or 6) that cells feel themselves, Pa (collective)."""
        graph = self._graph
        fails = np.zeros(len(graph.broken), bool)
        fails[edges] = True
        fails = graph.on_any_rank(fails) & ~graph.broken
        if total(graph.domain.comm, np.count_nonzero(fails))[0]:
            whole = np.zeros(len(fails), bool)
            whole[graph.cell_edges[~graph.split]] = True
            joined = ~graph.broken & ~graph.on_any_rank(whole)
            kept = (self._both & ~fails) | joined | self._found(fails, joined, stress)
            graph.kept, fails = kept, fails & ~kept
        return np.asarray(fails[edges])

    def _found(self, fails: Flags, joined: Flags, stress: Values) -> Flags:
        """(edges,) that nodes are to be joined by once edges (edges,) break; `joined`: by which some are."""
        graph = self._graph
        bits = 1 << np.arange(graph.cell_edges.shape[1])
        after = ~is_split(graph.domain.dim)[graph.pattern | (fails[graph.cell_edges] @ bits).astype(np.uint8)]
        without = self._around(after) == 0
        if not total(graph.domain.comm, np.count_nonzero(without & (self._around(~graph.split) > 0)))[0]:
            return np.zeros(len(fails), bool)
        at = np.flatnonzero(~graph.broken & without[graph.edge_nodes].any(axis=1))
        load = self._loads(at, without, stress)
        if self._cracks:
            load[fails[at]] = np.finfo(float).max
        load[joined[at] | (self._both & ~fails)[at]] = HELD
        keys, ends = graph.edge_keys(at), graph.edge_nodes[at]
        swapped = graph.domain.node_input[ends[:, 0]] != keys[:, 0]
        ends[swapped] = ends[swapped, ::-1]
        parts = allgather(graph.domain.comm, (keys, load, without[ends], self._held[ends]))
        return graph.flags_of_keys(_forest(*(np.concatenate(each) for each in zip(*parts, strict=True))))

    def _loads(self, edges: Ints, without: Flags, stress: Values) -> Values:
        """(n,) the greatest load over strength of edges (n,) in cells of this rank that have been whole, by what these
        feel themselves; -max where there is none."""
        graph = self._graph
        cells = np.flatnonzero(~graph.split & without[graph.cell_nodes].any(axis=1))
        along = self._cells.normal_stress(cells, stress[cells])
        result = np.full(len(graph.broken), -np.finfo(float).max)
        np.maximum.at(result, graph.cell_edges[cells], along / self._strength(cells, graph.cell_edges[cells]))
        return np.asarray(result[edges])


def _forest(keys: Ints, load: Values, without: Flags, held: Flags) -> Ints:
    """(m, 2) keys of the edges that join, of edges with keys (n, 2), some of them more than once, and of their ends
    (n, 2) which are `without` a whole cell and whose motion is prescribed."""
    order = np.lexsort((-load, keys[:, 1], keys[:, 0]))  # of one edge the greatest load that a rank has for it
    keys, first = np.unique(keys[order], axis=0, return_index=True)
    load, without, held = load[order][first], without[order][first], held[order][first]
    nodes, ends = np.unique(keys, return_inverse=True)
    ends = ends.reshape(-1, 2)
    whole, moved = np.ones(len(nodes), bool), np.zeros(len(nodes), bool)
    whole[ends], moved[ends] = ~without, held
    chosen = load == HELD
    rank = np.empty(len(load), np.int64)
    rank[np.argsort(load, kind="stable")] = np.arange(len(load))
    while True:
        count, part = components(ends[chosen], len(nodes))
        size, prescribed = np.bincount(part, minlength=count), np.bincount(part, moved, count) > 0
        hangs = (np.bincount(part, whole, count) == 0) & ~(prescribed & (size > 1))
        way = part[ends]
        out = (way[:, 0] != way[:, 1])[:, None] & hangs[way]
        best = np.full(count, len(load))
        np.minimum.at(best, way[out], np.broadcast_to(rank[:, None], way.shape)[out])
        new = ((best[way] == rank[:, None]) & out).any(axis=1)
        if not new.any():
            return np.asarray(keys[chosen])
        chosen |= new
