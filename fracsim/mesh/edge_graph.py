"""Edge damage of a distributed mesh: the graph of its nodes and edges, with the integrity of each edge.

The broken edges of a cell are one integer, its pattern; `simplices` has tables of what each pattern means.

Equations: docs/theory.md#edge-damage.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import cached_property

import numpy as np
import numpy.typing as npt
from dolfinx import la

from .domain import Domain, Ints
from .ghost_exchange import min_over_ranks
from .parallel import MAX_GATHERED_ROWS, gather, sum_over_ranks
from .simplices import intact_edges, is_split, local_edges

# Nodes in a row have some seven times as many edges with their lower end there, on all ranks.
NODES_PER_RANGE = 1 << 12
# keys (n, 2) of edges, and rows (n, m) of values
type EdgeRows = tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]


class Incidence:
    """Rows of a table (n, k) of numbers, looked up by the numbers in them: for instance the cells at an edge.

    Numbers lie between 0 and `count` - 1. A lookup costs time in proportion to the rows that it returns.
    """

    def __init__(self, table: npt.NDArray[np.integer], count: int) -> None:
        numbers = table.ravel()
        # rows sorted by the number in them; _end[i]: one past the last row of number i
        self._rows = (np.argsort(numbers, kind="stable") // table.shape[1]).astype(np.int32)
        # the last entry is the start of number 0, which _end[i - 1] reads for i = 0
        self._end = np.append(np.cumsum(np.bincount(numbers, minlength=count)), 0)

    def __call__(self, numbers: npt.NDArray[np.integer]) -> npt.NDArray[np.int64]:
        """(m,) rows that contain any of the numbers (n,), ascending, without repetition."""
        end = self._end[numbers]
        counts = end - self._end[numbers - 1]
        last = np.cumsum(counts)
        # positions in `_rows`: consecutive ones for each number
        positions = np.repeat(end - last, counts)
        positions += np.arange(len(positions))
        return np.unique(self._rows[positions]).astype(np.int64)


class EdgeKeys:
    """Names of edges that do not depend on the partition: the numbers of their ends in the input mesh, the lower first.

    `keys` (n, 2) below are such pairs.
    """

    def __init__(self, domain: Domain, edge_nodes: Ints, owned_count: int) -> None:
        """`edge_nodes`: (edges, 2) local nodes of owned and ghost edges; `owned_count`: number of owned ones."""
        self._comm, self._node_numbers = domain.comm, domain.input_numbering.nodes
        self._all_nodes = int(domain.space.dofmap.index_map.size_global)
        self._edge_nodes, self._owned_count = edge_nodes, owned_count

    def of_edges(self, edges: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """(n, 2) keys of local edges (n,)."""
        return np.sort(self._node_numbers[self._edge_nodes[edges]], axis=1)

    def find_edges(self, keys: npt.NDArray[np.int64]) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Local edges whose keys are among `keys` (n, 2), ascending, and the row of each in `keys`."""
        local_keys, order = self._by_key
        wanted = _encode(keys)
        if not len(local_keys):
            return np.empty(0, np.int64), np.empty(0, np.int64)
        position = np.minimum(np.searchsorted(local_keys, wanted), len(local_keys) - 1)
        rows = np.flatnonzero(local_keys[position] == wanted)
        local = order[position[rows]]
        ascending = np.argsort(local)
        return local[ascending], rows[ascending]

    @cached_property
    def _by_key(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """(edges,) keys of owned and ghost edges as one number each, ascending, and the local edges in that order."""
        keys = _encode(self.of_edges(np.arange(len(self._edge_nodes))))
        order = np.argsort(keys)
        return keys[order], order

    def edge_flags(self, keys: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
        """(edges,) flags of the local edges whose keys are among `keys` (n, 2), in any order."""
        flags = np.zeros(len(self._edge_nodes), bool)
        flags[self.find_edges(keys[np.lexsort(keys.T[::-1])])[0]] = True
        return flags

    def gather(self, flags: npt.NDArray[np.bool_], values: npt.NDArray[np.float64]) -> EdgeRows | None:
        """(n, 2) sorted keys of all flagged edges, and the (n, m) rows of their `values` (edges, m), on rank 0.

        None on the other ranks (collective).
        """
        owned = np.flatnonzero(flags[: self._owned_count])
        return self._gather(self.of_edges(owned), values[owned])

    def _gather(self, keys: npt.NDArray[np.int64], rows: npt.NDArray[np.float64]) -> EdgeRows | None:
        """Sorted keys (n, 2) of all ranks, and their rows (n, m), on rank 0, None elsewhere (collective)."""
        parts = gather(self._comm, (keys, rows))
        if parts is None:
            return None
        keys, rows = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        order = np.lexsort(keys.T[::-1])
        return keys[order], rows[order]

    def gather_blocks(self, flags: npt.NDArray[np.bool_], values: npt.NDArray[np.float64]) -> Iterator[EdgeRows | None]:
        """What `gather` returns in blocks that follow one another, so that rank 0 holds one at a time (collective)."""
        owned = np.flatnonzero(flags[: self._owned_count])
        keys = self.of_edges(owned)
        # all edges whose lower nodes are in a range of numbers belong to one block
        of_edge, ranges = keys[:, 0] // NODES_PER_RANGE, self._all_nodes // NODES_PER_RANGE + 1
        counts = sum_over_ranks(self._comm, np.bincount(of_edge, minlength=ranges))
        block = (np.cumsum(counts) - counts) // MAX_GATHERED_ROWS
        for number in range(int(block[-1]) + 1):
            in_block = block[of_edge] == number
            yield self._gather(keys[in_block], values[owned[in_block]])


def _encode(keys: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """(n,) keys (n, 2) as one 64-bit number each, which sort as the keys do."""
    return np.asarray((keys[:, 0] << 32) + keys[:, 1], np.int64)


class EdgeGraph:
    """Integrity of the edges of a distributed mesh, and the patterns of broken edges of its cells.

    Attributes:
        cell_edges: (cells, k) local edge numbers of each cell, k = 3 (2D) or 6 (3D).
        cell_nodes: (cells, d + 1) local node numbers of each cell.
        integrity: (edges,) of owned and ghost edges, from 1 (intact) to 0 (broken). Integrity never increases, and is
            the same on every rank that has the edge.
        broken: (edges,) whether integrity is 0.
        pattern: (cells,) uint8, bit k is set where local edge k is broken.
        damaged: (cells,) whether integrity of any edge is below 1.
        split: (cells,) whether the intact edges no longer connect all nodes of the cell. A new array is made at each
            change, so that a reference to an old one keeps the old state.
        retained: (edges,) edges that join their ends although all their cells are split; None: there are none.
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
        # state of `split` at the last call of break_unloaded_edges
        self._searched_split = self.split
        self._shared = la.vector(self.index_map, 1, np.int32)

    @cached_property
    def edge_nodes(self) -> Ints:
        """(edges, 2) local nodes of owned and ghost edges."""
        result = np.full((len(self.broken), 2), -1, np.int32)
        result[self.cell_edges] = self.cell_nodes[:, local_edges(self.domain.dim)]
        return result

    @cached_property
    def keys(self) -> EdgeKeys:
        """Names of the edges that do not depend on the partition."""
        return EdgeKeys(self.domain, self.edge_nodes, self.edge_count)

    @cached_property
    def edge_cells(self) -> Incidence:
        """Lookup of the cells that contain given edges."""
        return Incidence(self.cell_edges, len(self.broken))

    def any_over_ranks(self, flags: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        """(edges,) flags that are set on any rank that has the edge (collective)."""
        if self.domain.comm.size == 1:
            return flags
        self._shared.array[:] = flags
        # DOLFINx adds at the owner or inserts, and has no logical or: a sum above 0 is one.
        self._shared.scatter_reverse(la.InsertMode.add)
        self._shared.scatter_forward()
        return self._shared.array > 0

    def break_edges(self, flags: npt.NDArray[np.bool_]) -> int:
        """Set the integrity of the edges flagged on any rank to 0.

        Returns the number of edges that were intact before, over all ranks (collective).
        """
        new = self.any_over_ranks(flags) & ~self.broken
        count = int(sum_over_ranks(self.domain.comm, np.count_nonzero(new[: self.edge_count]))[0])
        if count:
            self.integrity[new] = 0.0
            self._mark_broken(new)
        return count

    def weaken(self, integrity: npt.NDArray[np.float64]) -> tuple[int, int]:
        """Reduce integrity to the minimum over ranks of `integrity` (edges,), where that is less (collective).

        Returns the number of edges that broke, and of edges whose integrity decreased, over all ranks.
        """
        reduced = np.minimum(self.integrity, min_over_ranks(self.index_map, integrity))
        less, new = reduced < self.integrity, (reduced == 0) & ~self.broken
        self.integrity[:] = reduced
        self._mark_broken(new)
        self.damaged |= less[self.cell_edges].any(axis=1)
        counts = [np.count_nonzero(flags[: self.edge_count]) for flags in (new, less)]
        broken, weakened = sum_over_ranks(self.domain.comm, np.array(counts))
        return int(broken), int(weakened)

    def set_integrity(self, integrity: npt.NDArray[np.float64]) -> None:
        """Replace the integrity (edges,) of owned and ghost edges, as a rejected step or a checkpoint requires."""
        self.integrity[:] = integrity
        self.broken[:], self.pattern[:] = False, 0
        self.split = self._searched_split = np.zeros(len(self.pattern), bool)
        self._mark_broken(self.integrity == 0)
        self.damaged[:] = (self.integrity[self.cell_edges] < 1).any(axis=1)

    def _mark_broken(self, new: npt.NDArray[np.bool_]) -> None:
        """Mark the flagged edges (edges,) as broken and update the patterns of their cells."""
        self.broken |= new
        touched = self.edge_cells(np.flatnonzero(new))
        bits = 1 << np.arange(self.cell_edges.shape[1])
        self.pattern[touched] = self.broken[self.cell_edges[touched]] @ bits
        self.damaged[touched] = True
        # a copy, since others compare with the array of the state before
        self.split = self.split.copy()
        self.split[touched] = is_split(self.domain.dim)[self.pattern[touched]]

    def retain_edges(self, retained: npt.NDArray[np.bool_]) -> None:
        """Retain flagged edges (edges,): they do not break although all their cells are split."""
        self.retained = retained

    def break_unloaded_edges(self) -> int:
        """Break the edges all of whose cells, on all ranks, are split, except retained ones (collective).

        Returns the number of edges.
        """
        # Such an edge carries no force, so that no criterion would break it, yet it would connect its ends in the
        # graph. The mechanics do not change: chi of its cells is 0 and no average contains them.
        searched = self._searched_split if self.retained is None else np.zeros(len(self.split), bool)
        self._searched_split = self.split
        in_split_cell = np.zeros(len(self.broken), bool)
        in_split_cell[self.cell_edges[self.split & ~searched]] = True
        candidates = self.any_over_ranks(in_split_cell & ~self.broken)
        carried = np.zeros(len(self.broken), bool) if self.retained is None else self.retained.copy()
        cells = self.edge_cells(np.flatnonzero(candidates))
        carried[self.cell_edges[cells[~self.split[cells]]]] = True
        return self.break_edges(candidates & ~self.any_over_ranks(carried))

    @property
    def broken_count(self) -> int:
        """Number of broken edges that this rank owns."""
        return int(np.count_nonzero(self.broken[: self.edge_count]))

    def intact(self, cells: npt.NDArray[np.integer]) -> npt.NDArray[np.bool_]:
        """(n, k) whether each local edge of the cells is intact."""
        return np.asarray(intact_edges(self.domain.dim)[self.pattern[cells]])

    def first_broken_edge(self, cells: npt.NDArray[np.integer]) -> npt.NDArray[np.int64]:
        """(n,) lowest broken local edge of each cell, by which a crack entered a cell that holds a crack tip."""
        return np.argmax(~self.intact(cells), axis=1)

    def cell_integrity(self, cells: npt.NDArray[np.integer]) -> npt.NDArray[np.float64]:
        """(n, k) integrity of each local edge of the cells."""
        return self.integrity[self.cell_edges[cells]]

    def gather_broken(self, values: npt.NDArray[np.float64] | None = None) -> EdgeRows | None:
        """(n, 2) sorted keys of all broken edges, and the (n, m) rows of their `values` (edges, m), on rank 0.

        None on the other ranks (collective).
        """
        return self.keys.gather(self.broken, np.empty((len(self.broken), 0)) if values is None else values)

    def broken_rows(self, values: npt.NDArray[np.float64]) -> EdgeRows:
        """(n, 2) keys of the broken edges of this rank, and the (n, m) rows of their `values` (edges, m)."""
        broken = np.flatnonzero(self.broken)
        return self.keys.of_edges(broken), values[broken]

    @property
    def weakened_count(self) -> int:
        """Number of edges with integrity below 1 that this rank owns."""
        return int(np.count_nonzero(self.integrity[: self.edge_count] < 1))

    def weakened_blocks(self, values: npt.NDArray[np.float64] | None = None) -> Iterator[EdgeRows | None]:
        """All edges with integrity below 1 in blocks of rising keys on rank 0, None elsewhere (collective).

        Each with the rows of its `values` (edges, m), by default the integrity (edges, 1).
        """
        return self.keys.gather_blocks(self.integrity < 1, self.integrity[:, None] if values is None else values)

    def restore_integrity(self, blocks: Iterable[EdgeRows]) -> int:
        """Set the integrity of the edges of blocks, given on every rank, and 1 elsewhere: what `weakened_blocks` gave.

        Returns the number of these edges that this rank owns.
        """
        values, count = np.ones(len(self.integrity)), 0
        for keys, integrity in blocks:
            local, rows = self.keys.find_edges(keys)
            values[local] = integrity[rows, 0]
            count += int(np.count_nonzero(local < self.edge_count))
        self.set_integrity(values)
        return count

    def broken_keys(self) -> npt.NDArray[np.int64] | None:
        """(n, 2) sorted keys of all broken edges on rank 0, None elsewhere (collective)."""
        gathered = self.gather_broken()
        return None if gathered is None else gathered[0]
