"""The graph of a mesh: nodes joined by the edges of simplices, some of them broken.

What the pattern of a cell's broken edges means is looked up in `simplices`.

Equations: docs/theory.md#edge-damage.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
import numpy.typing as npt
from dolfinx import la
from dolfinx.common import IndexMap

from .domain import Domain, Ints
from .incidence import Incidence
from .parallel import allgather, gather, sum_over_ranks
from .simplices import intact_edges, is_split, local_edges


class EdgeGraph:
    """Damage of the edges of a distributed mesh, and the patterns of its cells.

    Attributes:
        cell_edges: (cells, k) local edge index of each cell's local edges, k = 3 or 6.
        cell_nodes: (cells, d + 1) local node index.
        integrity: (edges,) of owned and ghost edges, from 1 (whole) to 0 (broken), never rising; the same on every rank
            that has the edge.
        broken: (edges,) bool, integrity is 0.
        pattern: (cells,) uint8, bit k set where local edge k is broken.
        damaged: (cells,) bool, whether any edge is less than whole.
        split: (cells,) bool, whether the cell has come apart; another array once any has.
        kept: (edges,) bool, those that join their ends though all their cells have come apart; None: there are none.
    """

    retained: npt.NDArray[np.bool_] | None = None

    def __init__(self, domain: Domain) -> None:
        topology = domain.mesh.topology
        topology.create_entities(1)
        topology.create_connectivity(domain.dim, 1)
        edges = local_edges(domain.dim)
        self.domain = domain
        self.index_map = topology.index_map(1)
        self.edge_count = int(self.index_map.size_local)
        connectivity = topology.connectivity(domain.dim, 1).array
        self.cell_edges: Ints = connectivity[: domain.cell_count * len(edges)].reshape(-1, len(edges))
        self.cell_nodes = domain.cell_nodes
        self.integrity = np.ones(self.edge_count + self.index_map.num_ghosts)
        self.broken = np.zeros(len(self.integrity), bool)
        self.pattern = np.zeros(domain.cell_count, np.uint8)
        self.damaged = np.zeros(domain.cell_count, bool)
        self.split = np.zeros(domain.cell_count, bool)
        self._idle_looked_for = self.split  # among the edges of these cells
        self._shared = la.vector(self.index_map, 1, np.int32)

    @cached_property
    def edge_nodes(self) -> Ints:
        """(edges, 2) local nodes of owned and ghost edges."""
        result = np.full((len(self.broken), 2), -1, np.int32)
        result[self.cell_edges] = self.cell_nodes[:, local_edges(self.domain.dim)]
        return result

    @cached_property
    def edge_cells(self) -> Incidence:
        """Cells that have any of some edges."""
        return Incidence(self.cell_edges, len(self.broken))

    @cached_property
    def node_edges(self) -> Incidence:
        """Edges, owned and ghost, that have any of some nodes as an end."""
        return Incidence(self.edge_nodes, len(self.domain.nodes))

    def any_over_ranks(self, flags: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        """(edges,) flags raised on any rank that has the edge (collective)."""
        if self.domain.comm.size == 1:
            return flags
        self._shared.array[:] = flags
        self._shared.scatter_reverse(la.InsertMode.add)
        self._shared.scatter_forward()
        return self._shared.array > 0

    def break_edges(self, flags: npt.NDArray[np.bool_]) -> int:
        """Break the intact edges flagged on any rank; returns how many broke in all (collective)."""
        new = self.any_over_ranks(flags) & ~self.broken
        count = int(sum_over_ranks(self.domain.comm, np.count_nonzero(new[: self.edge_count]))[0])
        if count:
            self.integrity[new] = 0.0
            self._note_broken(new)
        return count

    def weaken(self, integrity: npt.NDArray[np.float64]) -> tuple[int, int]:
        """Lower integrity to the least (edges,) that any rank gives an edge (collective).

        Returns how many edges broke, and how many lost anything.
        """
        least = np.minimum(self.integrity, self.min_over_ranks(integrity))
        less, new = least < self.integrity, (least == 0) & ~self.broken
        self.integrity[:] = least
        self._note_broken(new)
        self.damaged |= less[self.cell_edges].any(axis=1)
        counts = [np.count_nonzero(flags[: self.edge_count]) for flags in (new, less)]
        broken, weakened = sum_over_ranks(self.domain.comm, np.array(counts))
        return int(broken), int(weakened)

    def set_integrity(self, integrity: npt.NDArray[np.float64]) -> None:
        """Be as an earlier time left it: (edges,), owned and ghost."""
        self.integrity[:] = integrity
        self.broken[:], self.pattern[:] = False, 0
        self.split = self._idle_looked_for = np.zeros(len(self.pattern), bool)
        self._note_broken(self.integrity == 0)
        self.damaged[:] = (self.integrity[self.cell_edges] < 1).any(axis=1)

    def _note_broken(self, new: npt.NDArray[np.bool_]) -> None:
        """Edges (edges,) are broken from here on."""
        self.broken |= new
        touched = self.edge_cells(np.flatnonzero(new))
        bits = 1 << np.arange(self.cell_edges.shape[1])
        self.pattern[touched] = self.broken[self.cell_edges[touched]] @ bits
        self.damaged[touched] = True
        self.split = self.split.copy()  # whoever has asked for it has what was
        self.split[touched] = is_split(self.domain.dim)[self.pattern[touched]]

    def min_over_ranks(self, values: npt.NDArray[np.float64], of: IndexMap | None = None) -> npt.NDArray[np.float64]:
        """(n,) the least value that any rank gives an edge, or an entity of another index map (collective)."""
        if self.domain.comm.size == 1:
            return values
        of = of or self.index_map
        every, first = allgather(self.domain.comm, values[of.size_local :]), of.local_range[0]
        result = la.vector(of, 1, np.float64)
        result.array[:] = values
        for ghosts, ghost_values in zip(allgather(self.domain.comm, of.ghosts), every, strict=True):
            own = (ghosts >= first) & (ghosts < first + of.size_local)
            np.minimum.at(result.array, ghosts[own] - first, ghost_values[own])
        result.scatter_forward()
        return np.asarray(result.array)

    def break_unloaded_edges(self) -> int:
        """Break the edges all of whose cells, on all ranks, have come apart; returns how many (collective).

        Such an edge carries no force and could never break, yet would join its ends in the graph however far they drift
        apart. Mechanics do not change: chi of its cells is 0 and they enter no average. What is `kept` is not broken.
        """
        looked_for = self._idle_looked_for if self.retained is None else np.zeros(len(self.split), bool)
        self._idle_looked_for = self.split
        apart = np.zeros(len(self.broken), bool)
        apart[self.cell_edges[self.split & ~looked_for]] = True
        may = self.any_over_ranks(apart & ~self.broken)
        carried = np.zeros(len(self.broken), bool) if self.retained is None else self.retained.copy()
        cells = self.edge_cells(np.flatnonzero(may))
        carried[self.cell_edges[cells[~self.split[cells]]]] = True
        return self.break_edges(may & ~self.any_over_ranks(carried))

    @property
    def broken_count(self) -> int:
        """Broken edges that this rank owns."""
        return int(np.count_nonzero(self.broken[: self.edge_count]))

    def intact(self, cells: npt.NDArray[np.integer]) -> npt.NDArray[np.bool_]:
        """(n, k) whether each local edge of the cells is intact."""
        return np.asarray(intact_edges(self.domain.dim)[self.pattern[cells]])

    def cell_integrity(self, cells: npt.NDArray[np.integer]) -> npt.NDArray[np.float64]:
        """(n, k) integrity of each local edge of the cells."""
        return self.integrity[self.cell_edges[cells]]

    def edge_keys(self, edges: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """(n, 2) input-mesh nodes of local edges, the lower first: a name of the edge that no partition changes."""
        return np.sort(self.domain.node_input[self.edge_nodes[edges]], axis=1)

    def gather_broken(
        self, values: npt.NDArray[np.float64] | None = None
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]] | None:
        """(n, 2) sorted keys of all broken edges on rank 0 and, of (edges, m) values of local ones, their (n, m) rows.

        None on the other ranks (collective).
        """
        return self._gather(self.broken, np.empty((len(self.broken), 0)) if values is None else values)

    def gather_weakened(
        self, values: npt.NDArray[np.float64] | None = None
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]] | None:
        """(n, 2) sorted keys of all edges that are not whole on rank 0, and of (edges, m) values of local ones their
        rows, or their (n, 1) integrity; None on the other ranks (collective)."""
        return self._gather(self.integrity < 1, self.integrity[:, None] if values is None else values)

    def restore_integrity(self, keys: npt.NDArray[np.int64], integrity: npt.NDArray[np.float64]) -> None:
        """Be as `gather_weakened` said, given on every rank."""
        values = np.ones(len(self.integrity))
        local, place = self.find_keys(keys)
        values[local] = integrity[place, 0]
        self.set_integrity(values)

    def _gather(
        self, flags: npt.NDArray[np.bool_], values: npt.NDArray[np.float64]
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]] | None:
        own = np.flatnonzero(flags[: self.edge_count])
        parts = gather(self.domain.comm, (self.edge_keys(own), values[own]))
        if parts is None:
            return None
        keys, rows = (np.concatenate(each) for each in zip(*parts, strict=True))
        order = np.lexsort(keys.T[::-1])
        return keys[order], rows[order]

    def broken_keys(self) -> npt.NDArray[np.int64] | None:
        """(n, 2) sorted keys of all broken edges on rank 0, None elsewhere (collective)."""
        gathered = self.gather_broken()
        return None if gathered is None else gathered[0]

    def find_keys(self, keys: npt.NDArray[np.int64]) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Local edges whose keys are among the (n, 2) sorted ones, and the row of each of them there."""
        known, order = self._by_key
        wanted = _one_number(keys)
        at = np.minimum(np.searchsorted(known, wanted), max(len(known) - 1, 0))
        place = np.flatnonzero(known[at] == wanted) if len(known) else np.empty(0, np.int64)
        local = order[at[place]]
        rising = np.argsort(local)
        return local[rising], place[rising]

    @cached_property
    def _by_key(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """(edges,) keys of owned and ghost edges as one number each, rising, and the local edges."""
        keys = _one_number(self.edge_keys(np.arange(len(self.broken))))
        order = np.argsort(keys)
        return keys[order], order

    def flags_of_keys(self, keys: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
        """(edges,) flags of the local edges whose keys are among those given, in any order."""
        flags = np.zeros(len(self.broken), bool)
        flags[self.find_keys(keys[np.lexsort(keys.T[::-1])])[0]] = True
        return flags


def _one_number(keys: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """(n,) keys (n, 2) as one number each, in the same order."""
    return np.asarray((keys[:, 0] << 32) + keys[:, 1], np.int64)
