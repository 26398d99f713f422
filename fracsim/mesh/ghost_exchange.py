"""Values of nodes, edges and facets that ranks share: owners send values to ghosts, or receive them (collective)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from dolfinx import la
from dolfinx.common import IndexMap

from .parallel import allgather

if TYPE_CHECKING:
    from .domain import Domain


def owner_values(index_map: IndexMap, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """(n,) values of owned and ghost entities, those of ghosts from their owners."""
    result = la.vector(index_map, 1, values.dtype)
    result.array[:] = values
    result.scatter_forward()
    return np.asarray(result.array)


def min_over_ranks(index_map: IndexMap, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """(n,) minimum of values of owned and ghost entities over the ranks that have the entity."""
    comm = index_map.comm
    if comm.size == 1:
        return values
    first, owned_count = index_map.local_range[0], index_map.size_local
    # every rank has the ghosts of all ranks, and takes those that it owns
    ghosts, ghost_values = (np.concatenate(allgather(comm, rows)) for rows in (index_map.ghosts, values[owned_count:]))
    owned = (ghosts >= first) & (ghosts < first + owned_count)
    result = values.copy()
    np.minimum.at(result, ghosts[owned] - first, ghost_values[owned])
    return owner_values(index_map, result)


def with_ghosts(domain: Domain, owned: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """(owned and ghost dofs,) values of the displacement space from its owned dofs.

    On one rank the result is `owned` itself: do not write to it.
    """
    if domain.comm.size == 1:
        return owned
    result = la.vector(domain.space.dofmap.index_map, domain.dim, np.float64)
    result.array[: len(owned)] = owned
    result.scatter_forward()
    return np.asarray(result.array)


def with_straight_edges(domain: Domain, owned: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """(owned dofs,) values with midside nodes at the mean of the ends of their edges."""
    if domain.order == 1:
        return owned
    # an end of the edge of an owned midside node may be a ghost
    nodal = with_ghosts(domain, owned).reshape(-1, domain.dim).copy()
    domain.cell_midside_nodes.straighten_edges(nodal)
    return nodal.reshape(-1)[: len(owned)]
