"""Nodes that a pass would leave without a whole cell stay with the neighbours that hold them best.

A node all of whose cells have come apart carries nothing and is a crumb of its own, on any mesh: no debris, but an
artefact of it. So of the edges that fail those of one cell are spared for each such node: of the cell

    with the fewest failing edges that the node is no end of, so that the others are of one side,
    and of those the one that is loaded least,

as a surface that would leave a node without a whole cell passes on its other side (docs/theory.md#node-retention).
What holds nodes of both sides is pulled apart by them and feels so itself, whatever the average says: beyond `limit`
times its strength a cell holds no longer, and what it held may be a crumb all the same.

Nodes that a pass leaves without a whole cell stay joined to the neighbour that holds them best: none is a crumb.

A node all of whose cells have come apart carries nothing: on its own it would be a piece, on any mesh, and no debris.
Of the edges that still held it before the pass one does not break: the one that is loaded least, by what its cells feel
themselves. Where nodes hang on one another each group of them keeps the least loaded edge that leads out of it, until
it hangs on a node with a whole cell, and on no more than one: what a crack parts is not joined by it (Boruvka's rule
for a spanning forest). So cells that have come apart stay so, and mechanics follow from what a joined node hangs on
(mechanics.node_ties).

Nodes whose motion is prescribed are held by it, and by one another where no edge between them fails: a group of two and
more of them, what is left on a grip that something has snapped off, may be a piece of its own.

Equations: docs/theory.md#node-retention.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..mechanics.stress import Stress
from ..mesh.edge_graph import EdgeGraph
from ..mesh.node_cells import NodeCellCount
from ..mesh.parallel import allgather, sum_over_ranks
from ..mesh.simplices import is_split, local_edges
from ..meshes.components import components
from .criterion import OverloadedEdges
from .edge_stress import Simplices
from .strength import Strength

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
LIMIT = 5.0  # of the strength, by what a cell feels itself
DIGITS = 9  # of loads that are told apart: equal ones go by the numbers of the input, whatever the ranks
ROUNDS = 2  # nodes beside a crack, then those that only what was spared for them holds
HELD = -np.inf  # the load of an edge that joins already, or both ends of which move as they are told


class Holding:
    """A criterion without the edges that keep a node from being a crumb.

    Attributes:
        strength: of each edge in each cell.
    """

    cut = carried = None

    def __init__(self, failing: OverloadedEdges, stress: Stress, graph: EdgeGraph, limit: float = LIMIT) -> None:
        self._failing, self._cells, self._graph, self._limit = failing, Simplices.of(stress), graph, limit
        self.strength = failing.strength
        domain = graph.domain
        self._map = domain.space.dofmap.index_map
        self._around = NodeCellCount(domain)
        pairs = local_edges(domain.dim)
        self._of_node = np.array([(pairs == node).any(axis=1) for node in range(domain.dim + 1)])  # (d + 1, edges)

    def __call__(self, stress: Values, psi: Values) -> tuple[Ints, Values]:
        """(n,) local edges that fail and are not spared, and their loads (collective)."""
        graph = self._graph
        edges, load = self._failing(stress, psi)
        fails = np.zeros(len(graph.broken), bool)
        fails[edges] = True
        fails = graph.any_over_ranks(fails) & ~graph.broken
        if graph.domain.comm.allreduce(int(fails.any())):
            for _ in range(ROUNDS):
                fails &= ~self._spared(fails, stress)
        kept = fails[edges]
        return edges[kept], load[kept]

    def moving(self, v: Values, a: Values, now: float, dt: float) -> None:
        """Stress is all that counts."""

    def memory(self) -> object:
        """Nothing."""
        return None

    def recall(self, memory: object) -> None:
        """Nothing."""

    def _spared(self, fails: Flags, stress: Values) -> Flags:
        """(edges,) those of the cells that keep a node, of the edges that are to fail (edges,) (collective)."""
        graph = self._graph
        of_cell = fails[graph.cell_edges]
        before = ~graph.split
        bits = 1 << np.arange(graph.cell_edges.shape[1])
        after = before & ~is_split(graph.domain.dim)[graph.pattern | (of_cell @ bits).astype(np.uint8)]
        endangered = (self._around(before) > 0) & (self._around(after) == 0)
        cells = np.flatnonzero(before & endangered[graph.cell_nodes].any(axis=1))
        own = self._own_load(cells, stress, of_cell[cells])
        cells, own = cells[own < self._limit], own[own < self._limit]
        spared = np.zeros(len(fails), bool)
        spared[graph.cell_edges[self._chosen(cells, own, of_cell[cells], endangered)]] = True
        return graph.any_over_ranks(spared)

    def _own_load(self, cells: Ints, stress: Values, fails: Flags) -> Values:
        """(n,) the greatest load over strength of the failing edges (n, edges) of cells, by what these feel
        themselves."""
        along = self._cells.normal_stress(cells, stress[cells])
        strength = self.strength(cells, self._graph.cell_edges[cells])
        return np.asarray(np.where(fails, along / strength, 0.0).max(axis=1, initial=0.0))

    def _chosen(self, cells: Ints, own: Values, fails: Flags, endangered: Flags) -> Ints:
        """Of cells (n,) under their own loads (n,) those that keep a node: one for each that there is one for."""
        nodes = self._graph.cell_nodes[cells].astype(np.int64)
        across = (fails[:, None] & ~self._of_node).sum(axis=2)  # (n, d + 1): failing edges beside the node's own
        share = np.round(own / self._limit, DIGITS)  # in a uniform field cells are equal but for round-off
        key = np.where(endangered[nodes], across + 0.5 * share[:, None], np.inf)
        at = np.isfinite(key) & (key == self._least(nodes, key)[nodes])
        first = np.where(at, self._graph.domain.cell_input[cells][:, None].astype(float), np.inf)  # of equals one
        return np.asarray(cells[(at & (first == self._least(nodes, first)[nodes])).any(axis=1)])

    def _least(self, nodes: Ints, values: Values) -> Values:
        """(nodes,) the least of `values` (n, d + 1) at `nodes` on all ranks."""
        result = np.full(self._map.size_local + self._map.num_ghosts, np.inf)
        np.minimum.at(result, nodes, values)
        return self._graph.min_over_ranks(result, self._map)


class Joining:
    """Spares, of edges that fail, those that nodes without a whole cell stay joined by."""

    def __init__(
        self, stress: Stress, graph: EdgeGraph, strength: Strength, held: Flags, *, cracks: bool = False
    ) -> None:
        """`held`: (nodes,) whose motion is prescribed, ghosts too; `cracks` cut what fails: it joins last."""
        self._cells, self._graph, self._strength, self._held = Simplices.of(stress), graph, strength, held
        self._cracks = cracks
        self._both: Flags = np.asarray(held[graph.edge_nodes].all(axis=1))
        self._around = NodeCellCount(graph.domain)

    def __call__(self, edges: npt.NDArray[np.integer], stress: Values) -> Flags:
        """(n,) which of the edges (n,) that fail do so, and which idle ones the graph keeps, under the stress (cells,
        3 or 6) that cells feel themselves, Pa (collective)."""
        graph = self._graph
        fails = np.zeros(len(graph.broken), bool)
        fails[edges] = True
        fails = graph.any_over_ranks(fails) & ~graph.broken
        if sum_over_ranks(graph.domain.comm, np.count_nonzero(fails))[0]:
            whole = np.zeros(len(fails), bool)
            whole[graph.cell_edges[~graph.split]] = True
            joined = ~graph.broken & ~graph.any_over_ranks(whole)
            kept = (self._both & ~fails) | joined | self._found(fails, joined, stress)
            graph.retained, fails = kept, fails & ~kept
        return np.asarray(fails[edges])

    def _found(self, fails: Flags, joined: Flags, stress: Values) -> Flags:
        """(edges,) that nodes are to be joined by once edges (edges,) break; `joined`: by which some are."""
        graph = self._graph
        bits = 1 << np.arange(graph.cell_edges.shape[1])
        after = ~is_split(graph.domain.dim)[graph.pattern | (fails[graph.cell_edges] @ bits).astype(np.uint8)]
        without = self._around(after) == 0
        if not sum_over_ranks(graph.domain.comm, np.count_nonzero(without & (self._around(~graph.split) > 0)))[0]:
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
