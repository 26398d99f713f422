"""Parts: whole cells that are joined by facets. Parts that share a node or an edge alone turn about it freely."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from dolfinx import la

from ..meshes.components import components
from .domain import Domain
from .parallel import allgather, offset

Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


def node_components(domain: Domain, whole: Flags) -> tuple[int, Ints]:
    """How many parts the cells flagged (owned cells,) make, and for each owned node the largest around it; -1: none
    (collective).

    Parts are numbered from the largest on, equally large ones by their lowest cell in the input mesh.
    """
    cells = np.flatnonzero(whole)
    count, part = _parts(domain, cells)
    lowest: Ints = np.full(count, np.iinfo(np.int64).max)
    size: Ints = np.bincount(part, minlength=count)
    np.minimum.at(lowest, part, domain.cell_input[cells])
    every, size, lowest = _joined(domain, cells, part, count, size, lowest)
    number = np.empty(len(size), np.int64)
    number[np.lexsort((lowest, -size))] = np.arange(len(size))
    return len(size), _largest(domain, cells, number[every[part]])


def _parts(domain: Domain, cells: Ints) -> tuple[int, Ints]:
    """How many parts there are on this rank, and that of each cell (n,)."""
    number = np.full(domain.cell_count, -1)
    number[cells] = np.arange(len(cells))
    links = number[domain.facet_neighbours]
    return components(links[(links >= 0).all(axis=1)], len(cells))


def _joined(domain: Domain, cells: Ints, part: Ints, count: int, size: Ints, lowest: Ints) -> tuple[Ints, Ints, Ints]:
    """Parts of all ranks, joined where ranks share facets: (count,) the joined one of each of this rank's, and the
    sizes and lowest cells of all joined ones (collective)."""
    comm = domain.comm
    if comm.size == 1:
        return np.arange(count), size, lowest
    first, facets = offset(comm, count), domain.mesh.topology.index_map(domain.dim - 1)
    label = la.vector(facets, 1, np.int64)
    label.array[:] = -1
    label.array[domain.cell_facets[cells]] = (first + part)[:, None]
    mine = label.array[facets.size_local :].copy()
    label.scatter_forward()
    links = np.stack([mine, label.array[facets.size_local :]], axis=1)
    links = np.concatenate(allgather(comm, links[(links >= 0).all(axis=1)]))
    sizes, lowests = (np.concatenate(allgather(comm, each)) for each in (size, lowest))
    total, joined = components(links, len(sizes))
    least = np.full(total, np.iinfo(np.int64).max)
    np.minimum.at(least, joined, lowests)
    return joined[first : first + count], np.bincount(joined, weights=sizes, minlength=total).astype(np.int64), least


def _largest(domain: Domain, cells: Ints, number: Ints) -> Ints:
    """(owned nodes,) the lowest number of the parts around it, -1 where there is none, of cells (n,) and their numbers
    (collective)."""
    none, owned = np.iinfo(np.int64).max, domain.node_count
    lowest = np.full(len(domain.nodes), none)
    nodes = domain.all_cell_nodes[cells]
    np.minimum.at(lowest, nodes.reshape(-1), np.repeat(number, nodes.shape[1]))
    if domain.comm.size > 1:
        names = domain.space.dofmap.index_map.ghosts
        ghosts, numbers = (np.concatenate(allgather(domain.comm, each)) for each in (names, lowest[owned:]))
        here = ghosts - domain.space.dofmap.index_map.local_range[0]
        mine = (here >= 0) & (here < owned)
        np.minimum.at(lowest, here[mine], numbers[mine])
    return np.where(lowest[:owned] == none, -1, lowest[:owned])
