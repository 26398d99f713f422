"""Cells around nodes: how many there are, and the facet-connected components that they belong to."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from dolfinx import la

from ..meshes.topology import components
from .domain import Domain
from .ghost_exchange import min_over_ranks, owner_values
from .parallel import allgather, rank_offset

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


class NodeCellCount:
    """Counts the flagged cells around each node, over the cells of all ranks."""

    def __init__(self, domain: Domain) -> None:
        self._cell_nodes = domain.cell_nodes
        self._sum = la.vector(domain.space.dofmap.index_map, 1, np.float64)

    def __call__(self, flags: Flags) -> Values:
        """(nodes,) number of flagged cells around each owned and ghost node; `flags` (cells,) (collective)."""
        self._sum.array[:] = 0.0
        np.add.at(self._sum.array, self._cell_nodes[flags], 1.0)
        self._sum.scatter_reverse(la.InsertMode.add)
        self._sum.scatter_forward()
        return np.asarray(self._sum.array.copy())


def with_neighbours(domain: Domain, nodes: Flags) -> Flags:
    """(owned nodes,) flags of flagged owned nodes (n,) and of all nodes that share a cell with one (collective)."""
    index_map = domain.space.dofmap.index_map
    flags = np.zeros(index_map.size_local + index_map.num_ghosts)
    flags[: domain.node_count] = nodes
    touched: Flags = np.any(owner_values(index_map, flags)[domain.cell_nodes] > 0, axis=1)
    return np.asarray(NodeCellCount(domain)(touched)[: domain.node_count] > 0)


def node_components(domain: Domain, flags: Flags) -> tuple[int, Ints]:
    """The number of facet-connected components of the flagged cells, and (owned nodes,) that of each node (collective).

    Components are numbered from the largest one. A node of several components has the largest, a node of none has -1.
    `flags`: (owned cells,).
    """
    cells = np.flatnonzero(flags)
    count, component = _local_components(domain, cells)
    lowest: Ints = np.full(count, np.iinfo(np.int64).max)
    size: Ints = np.bincount(component, minlength=count)
    np.minimum.at(lowest, component, domain.input_numbering.cells[cells])
    joined, size, lowest = _join_over_ranks(domain, cells, component, count, size, lowest)
    # equally large components by their lowest cell in the input mesh, at any partition
    number = np.empty(len(size), np.int64)
    number[np.lexsort((lowest, -size))] = np.arange(len(size))
    return len(size), _lowest_number(domain, cells, number[joined[component]])


def _local_components(domain: Domain, cells: Ints) -> tuple[int, Ints]:
    """The number of components on this rank, and (n,) that of each of the cells (n,)."""
    index = np.full(domain.cell_count, -1)
    index[cells] = np.arange(len(cells))
    # cells that share only a node or an edge are not connected: they rotate freely about it
    links = index[domain.facets.neighbours]
    return components(links[(links >= 0).all(axis=1)], len(cells))


def _join_over_ranks(
    domain: Domain, cells: Ints, component: Ints, count: int, size: Ints, lowest: Ints
) -> tuple[Ints, Ints, Ints]:
    """Components joined over the facets that ranks share (collective).

    Returns (count,) the joined component of each component of this rank, and the sizes and lowest cells of all joined
    components.
    """
    comm = domain.comm
    if comm.size == 1:
        return np.arange(count), size, lowest
    first, index_map = rank_offset(comm, count), domain.mesh.topology.index_map(domain.dim - 1)
    label = np.full(index_map.size_local + index_map.num_ghosts, -1)
    label[domain.facets.cell_facets[cells]] = (first + component)[:, None]
    ghosts = slice(index_map.size_local, None)
    links = np.stack([label[ghosts], owner_values(index_map, label)[ghosts]], axis=1)
    links = np.unique(links[(links >= 0).all(axis=1)], axis=0)
    links = np.concatenate(allgather(comm, links))
    sizes, lowest_cells = (np.concatenate(allgather(comm, values)) for values in (size, lowest))
    total, joined = components(links, len(sizes))
    joined_lowest = np.full(total, np.iinfo(np.int64).max)
    np.minimum.at(joined_lowest, joined, lowest_cells)
    joined_size = np.bincount(joined, weights=sizes, minlength=total).astype(np.int64)
    return joined[first : first + count], joined_size, joined_lowest


def _lowest_number(domain: Domain, cells: Ints, number: Ints) -> Ints:
    """(owned nodes,) lowest number among the cells (n,) around each node, -1 if there is none (collective)."""
    none, owned = np.iinfo(np.int64).max, domain.node_count
    lowest = np.full(len(domain.nodes), none)
    nodes = domain.all_cell_nodes[cells]
    np.minimum.at(lowest, nodes.reshape(-1), np.repeat(number, nodes.shape[1]))
    of_owned = min_over_ranks(domain.space.dofmap.index_map, lowest)[:owned]
    return np.where(of_owned == none, -1, of_owned)
