"""Nodes that a pass would leave without a whole cell stay with the neighbours that hold them best.

A node all of whose cells have come apart carries nothing and is a crumb of its own, on any mesh: no debris, but an
artefact of it. So of the edges that fail those of one cell are spared for each such node: of the cell

    with the fewest failing edges that the node is no end of, so that the others are of one side,
    and of those the one that is loaded least,

as a surface that would leave a node without a whole cell passes on its other side (docs/theory.md#node-retention).
What holds nodes of both sides is pulled apart by them and feels so itself, whatever the average says: beyond `limit`
times its strength a cell holds no longer, and what it held may be a crumb all the same.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..mechanics.stress import Stress
from ..mesh.around import CellsAround
from ..mesh.edges import EdgeGraph
from ..mesh.simplices import is_split, local_edges
from .criterion import OverloadedEdges
from .edge_stress import Simplices

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
LIMIT = 5.0  # of the strength, by what a cell feels itself
DIGITS = 9  # of loads that are told apart: equal ones go by the numbers of the input, whatever the ranks
ROUNDS = 2  # nodes beside a crack, then those that only what was spared for them holds


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
        self._around = CellsAround(domain)
        pairs = local_edges(domain.dim)
        self._of_node = np.array([(pairs == node).any(axis=1) for node in range(domain.dim + 1)])  # (d + 1, edges)

    def __call__(self, stress: Values, psi: Values) -> tuple[Ints, Values]:
        """(n,) local edges that fail and are not spared, and their loads (collective)."""
        graph = self._graph
        edges, load = self._failing(stress, psi)
        fails = np.zeros(len(graph.broken), bool)
        fails[edges] = True
        fails = graph.on_any_rank(fails) & ~graph.broken
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
        return graph.on_any_rank(spared)

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
        return self._graph.least(result, self._map)
