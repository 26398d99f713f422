"""Node retention: no node becomes a single-node fragment because all of its cells were split.

A node all of whose cells are split carries nothing and would be a fragment of its own on any mesh. It is no debris but
an artefact of the mesh. Two rules avoid it:

- `CellRetention` spares the failing edges of one cell for each such node, so that the node keeps an unsplit cell.
- `NodeAttachment` spares one edge, so that the node stays attached to its best loaded neighbour (mechanics.node_ties).

Equations: docs/theory.md#node-retention.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..mechanics.stress import Stress
from ..mesh.edge_graph import EdgeGraph
from ..mesh.ghost_exchange import min_over_ranks
from ..mesh.node_cells import NodeCellCount
from ..mesh.parallel import allgather, sum_over_ranks
from ..mesh.simplices import is_split, local_edges
from ..meshes.topology import components
from .criterion import OverloadedEdges
from .edge_stress import EdgeStressOperator
from .strength import EdgeStrength

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class RetentionParameters:
    """Parameters of cell retention.

    Attributes:
        max_cell_load: load over strength, by the local stress of a cell, beyond which the cell is split all the same:
            its nodes are pulled apart by both sides of the crack, whatever the average says.
        load_digits: decimal digits of loads that are compared. Equal loads are ordered by the numbers of the input
            mesh, so that rounding does not decide in a uniform field.
        rounds: first the nodes beside a crack are retained, then those that depend on cells spared for them.
    """

    max_cell_load: float = 5.0
    load_digits: int = 9
    rounds: int = 2


RETENTION = RetentionParameters()
# Load of an edge that attaches already, or both ends of which are prescribed: it comes first in every comparison.
ATTACHED = -np.inf


def _flag_unsplit_after(graph: EdgeGraph, fails: Flags, cells: Ints | slice) -> Flags:
    """Flag those of `cells` (m,) that are not split once the edges in `fails` (edges,) break as well."""
    bits = 1 << np.arange(graph.cell_edges.shape[1])
    pattern = graph.pattern[cells] | (fails[graph.cell_edges[cells]] @ bits).astype(np.uint8)
    return ~is_split(graph.domain.dim)[pattern]


def _flag_losing_last_cell(graph: EdgeGraph, cells_around: NodeCellCount, fails: Flags) -> Flags:
    """Flag the nodes (nodes,) all of whose unsplit cells are split once `fails` (edges,) break (collective)."""
    # Few edges fail in a pass: the cells around all nodes are not counted.
    cells = graph.edge_cells(np.flatnonzero(fails))
    cells = cells[~graph.split[cells]]
    lost = np.zeros(len(graph.split), bool)
    lost[cells[~_flag_unsplit_after(graph, fails, cells)]] = True
    lost_count = cells_around(lost)
    loses = lost_count > 0
    return loses & (cells_around(~graph.split & loses[graph.cell_nodes].any(axis=1)) == lost_count)


class CellRetention:
    """A criterion without the failing edges of cells that nodes need to keep an unsplit cell.

    Of the cells of such a node that one is spared which has the fewest failing edges that do not end in the node, and
    of equal ones the least loaded. So the crack passes on the other side of the node.

    Attributes:
        strength: strength of each edge in each cell, Pa.
    """

    cut_positions = tip_states = None

    def __init__(
        self,
        failing: OverloadedEdges,
        stress: Stress,
        graph: EdgeGraph,
        max_cell_load: float = RETENTION.max_cell_load,
    ) -> None:
        """Restrict the criterion `failing`; `max_cell_load` as in `RetentionParameters` (collective)."""
        self._failing, self._graph, self._max_cell_load = failing, graph, max_cell_load
        self._edge_stress = EdgeStressOperator.from_stress(stress)
        self.strength = failing.strength
        domain = graph.domain
        self._node_map = domain.space.dofmap.index_map
        self._cells_around = NodeCellCount(domain)
        pairs = local_edges(domain.dim)
        # (d + 1, edges) local edges that end in each local node
        self._node_edges = np.array([(pairs == node).any(axis=1) for node in range(domain.dim + 1)])

    def __call__(self, stress: Values, psi: Values) -> tuple[Ints, Values]:
        """Find the local edges (n,) that fail and are not spared, and their loads (n,) (collective)."""
        graph = self._graph
        edges, load = self._failing(stress, psi)
        fails = np.zeros(len(graph.broken), bool)
        fails[edges] = True
        fails = graph.any_over_ranks(fails) & ~graph.broken
        if graph.domain.comm.allreduce(int(fails.any())):
            for _ in range(RETENTION.rounds):
                fails &= ~self._spared_edges(fails, stress)
        still_fails = fails[edges]
        return edges[still_fails], load[still_fails]

    def set_motion(self, v: Values, a: Values, now: float, dt: float) -> None:
        """Do nothing: the criterion depends on the stress alone."""

    def snapshot(self) -> object:
        """Return None: the criterion has no history."""
        return None

    def restore(self, saved: object) -> None:
        """Do nothing: the criterion has no history."""

    def restore_cuts(self, cut_positions: Values, tip_states: Values | None) -> None:
        """Do nothing: the criterion does not determine cuts."""

    def _spared_edges(self, fails: Flags, stress: Values) -> Flags:
        """Flag the edges (edges,) of the cells that retain a node, given the failing edges (collective)."""
        graph = self._graph
        endangered = _flag_losing_last_cell(graph, self._cells_around, fails)
        cells = np.flatnonzero(~graph.split & endangered[graph.cell_nodes].any(axis=1))
        load = self._cell_load(cells, stress, fails[graph.cell_edges[cells]])
        # A cell under too large a load cannot retain a node.
        cells, load = cells[load < self._max_cell_load], load[load < self._max_cell_load]
        spared = np.zeros(len(fails), bool)
        chosen = self._choose_cells(cells, load, fails[graph.cell_edges[cells]], endangered)
        spared[graph.cell_edges[chosen]] = True
        return graph.any_over_ranks(spared)

    def _cell_load(self, cells: Ints, stress: Values, fails: Flags) -> Values:
        """Return the largest load over strength (n,) of the failing edges (n, edges) of cells, by local stress."""
        normal_stress = self._edge_stress.normal_stress(cells, stress[cells])
        strength = self.strength(cells, self._graph.cell_edges[cells])
        return np.asarray(np.where(fails, normal_stress / strength, 0.0).max(axis=1, initial=0.0))

    def _choose_cells(self, cells: Ints, load: Values, fails: Flags, endangered: Flags) -> Ints:
        """Choose, of cells (n,) under loads (n,), one for each endangered node that has any."""
        nodes = self._graph.cell_nodes[cells].astype(np.int64)
        # (n, d + 1) failing edges of the cell that do not end in the node: they are of the crack's other side
        across = (fails[:, None] & ~self._node_edges).sum(axis=2)
        share = np.round(load / self._max_cell_load, RETENTION.load_digits)
        key = np.where(endangered[nodes], across + 0.5 * share[:, None], np.inf)
        is_best = np.isfinite(key) & (key == self._least_at_nodes(nodes, key)[nodes])
        # Of cells with equal keys the first of the input mesh is chosen.
        number = np.where(is_best, self._graph.domain.input_numbering.cells[cells][:, None].astype(float), np.inf)
        is_first = number == self._least_at_nodes(nodes, number)[nodes]
        return np.asarray(cells[(is_best & is_first).any(axis=1)])

    def _least_at_nodes(self, nodes: Ints, values: Values) -> Values:
        """Return the least (nodes,) of `values` (n, d + 1) at `nodes` (n, d + 1) over all ranks."""
        result = np.full(self._node_map.size_local + self._node_map.num_ghosts, np.inf)
        np.minimum.at(result, nodes, values)
        return min_over_ranks(self._node_map, result)


class NodeAttachment:
    """Spares one failing edge for each node without an unsplit cell, by which the node stays attached.

    It is the least loaded edge, by the local stress of its cells, of those that attached the node before the pass.
    Nodes that are attached to one another form a group. Each group keeps the least loaded edge that leads out of it,
    until it is attached to a node with an unsplit cell, and no more than one, so that no edge joins the two sides of a
    crack (Boruvka's rule for a spanning forest). Nodes with prescribed motion are attached by it, and by one another
    where no edge between them fails; two or more of them may be a fragment of their own.
    """

    def __init__(
        self, stress: Stress, graph: EdgeGraph, strength: EdgeStrength, prescribed: Flags, *, cracks: bool = False
    ) -> None:
        """Build the rule.

        Args:
            stress: stress of the body.
            graph: edges of the body; the spared ones are stored in it.
            strength: strength of edges.
            prescribed: (nodes,) nodes whose motion is prescribed, with ghosts.
            cracks: failing edges are cut by cracks, so that other edges are spared first.
        """
        self._edge_stress, self._graph = EdgeStressOperator.from_stress(stress), graph
        self._strength, self._prescribed, self._cracks = strength, prescribed, cracks
        self._is_prescribed_edge: Flags = np.asarray(prescribed[graph.edge_nodes].all(axis=1))
        self._cells_around = NodeCellCount(graph.domain)

    def __call__(self, edges: npt.NDArray[np.integer], stress: Values, *, detaches: bool = False) -> Flags:
        """Flag, of the edges (n,) that fail, those that break; store the spared ones in the graph (collective).

        Args:
            edges: (n,) failing edges.
            stress: local stress (cells, 3 or 6), Pa.
            detaches: edges that attach nodes already may break, too: other edges attach these nodes to their parts.
        """
        graph = self._graph
        fails = np.zeros(len(graph.broken), bool)
        fails[edges] = True
        fails = graph.any_over_ranks(fails) & ~graph.broken
        if sum_over_ranks(graph.domain.comm, np.count_nonzero(fails))[0]:
            in_unsplit_cell = np.ones(len(fails), bool)
            in_unsplit_cell[graph.cell_edges[graph.split]] = False
            beside = graph.edge_cells(np.flatnonzero(~in_unsplit_cell))
            in_unsplit_cell[graph.cell_edges[beside[~graph.split[beside]]]] = True
            # Intact edges without an unsplit cell attach nodes already.
            attaching = ~graph.broken & ~graph.any_over_ranks(in_unsplit_cell)
            if detaches:
                attaching &= ~fails
            spared = self._attaching_edges(fails, attaching, stress)
            retained = (self._is_prescribed_edge & ~fails) | attaching | spared
            graph.retain_edges(retained)
            fails &= ~retained
        return np.asarray(fails[edges])

    def _attaching_edges(self, fails: Flags, attaching: Flags, stress: Values) -> Flags:
        """Flag the edges (edges,) that attach nodes once `fails` (edges,) break; `attaching` do so already."""
        graph = self._graph
        loses = _flag_losing_last_cell(graph, self._cells_around, fails)
        if not sum_over_ranks(graph.domain.comm, np.count_nonzero(loses))[0]:
            return np.zeros(len(fails), bool)
        without_cell = self._cells_around(_flag_unsplit_after(graph, fails, slice(None))) == 0
        candidates = np.flatnonzero(~graph.broken & without_cell[graph.edge_nodes].any(axis=1))
        load = self._edge_loads(candidates, without_cell, stress)
        # An edge that a crack cuts attaches a node only if no other edge can.
        if self._cracks:
            load[fails[candidates]] = np.finfo(float).max
        load[attaching[candidates] | (self._is_prescribed_edge & ~fails)[candidates]] = ATTACHED
        keys, ends = graph.keys.of_edges(candidates), graph.edge_nodes[candidates]
        swapped = graph.domain.input_numbering.nodes[ends[:, 0]] != keys[:, 0]
        ends[swapped] = ends[swapped, ::-1]
        parts = allgather(graph.domain.comm, (keys, load, without_cell[ends], self._prescribed[ends]))
        return graph.keys.edge_flags(_spanning_forest(*(np.concatenate(column) for column in zip(*parts, strict=True))))

    def _edge_loads(self, edges: Ints, without_cell: Flags, stress: Values) -> Values:
        """Return the largest load over strength (n,) of edges in unsplit cells of this rank; -max without any."""
        graph = self._graph
        cells = np.flatnonzero(~graph.split & without_cell[graph.cell_nodes].any(axis=1))
        normal_stress = self._edge_stress.normal_stress(cells, stress[cells])
        result = np.full(len(graph.broken), -np.finfo(float).max)
        np.maximum.at(result, graph.cell_edges[cells], normal_stress / self._strength(cells, graph.cell_edges[cells]))
        return np.asarray(result[edges])


def _spanning_forest(keys: Ints, load: Values, without_cell: Flags, prescribed: Flags) -> Ints:
    """Return the keys (m, 2) of the least loaded edges that attach all nodes (Boruvka's algorithm).

    Args:
        keys: (n, 2) end nodes of candidate edges, which several ranks may give.
        load: (n,) their loads.
        without_cell: (n, 2) which ends have no unsplit cell.
        prescribed: (n, 2) which ends have a prescribed motion.
    """
    # Of the rows of one edge the largest load counts.
    order = np.lexsort((-load, keys[:, 1], keys[:, 0]))
    keys, first = np.unique(keys[order], axis=0, return_index=True)
    load, without_cell, prescribed = load[order][first], without_cell[order][first], prescribed[order][first]
    nodes, ends = np.unique(keys, return_inverse=True)
    ends = ends.reshape(-1, 2)
    has_cell, is_prescribed = np.ones(len(nodes), bool), np.zeros(len(nodes), bool)
    has_cell[ends], is_prescribed[ends] = ~without_cell, prescribed
    chosen = load == ATTACHED
    # Ranks order equal loads by their keys.
    rank = np.empty(len(load), np.int64)
    rank[np.argsort(load, kind="stable")] = np.arange(len(load))
    while True:
        count, group = components(ends[chosen], len(nodes))
        size, has_prescribed = np.bincount(group, minlength=count), np.bincount(group, is_prescribed, count) > 0
        unattached = (np.bincount(group, has_cell, count) == 0) & ~(has_prescribed & (size > 1))
        groups = group[ends]
        leads_out = (groups[:, 0] != groups[:, 1])[:, None] & unattached[groups]
        best = np.full(count, len(load))
        np.minimum.at(best, groups[leads_out], np.broadcast_to(rank[:, None], groups.shape)[leads_out])
        # Each group adds its least loaded edge that leads out.
        new = ((best[groups] == rank[:, None]) & leads_out).any(axis=1)
        if not new.any():
            return np.asarray(keys[chosen])
        chosen |= new
