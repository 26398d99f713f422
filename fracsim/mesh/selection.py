"""Nodes and facets of a distributed mesh that a selector of the study selects."""

from __future__ import annotations

import dolfinx
import numpy as np
import numpy.typing as npt
from dolfinx import fem

from ..errors import InputError
from .domain import Domain
from .parallel import sum_over_ranks
from .selectors import RELATIVE_TOLERANCE, Group, PointsInBox, PointsOnPlane, Selector, check_group

Ints = npt.NDArray[np.int32]


def select_nodes(domain: Domain, selector: Selector, key: str = "on") -> Ints:
    """Owned and ghost nodes of a selector; InputError with the key if there are none (collective)."""
    if isinstance(selector, Group):
        facets = _group_facets(domain, selector, key)
        nodes = fem.locate_dofs_topological(domain.space, domain.dim - 1, facets)
    else:
        nodes = _nodes_within(domain, selector)
    if sum_over_ranks(domain.comm, len(nodes))[0] == 0:
        raise InputError(f"{key}: {selector} selects no node; the body lies in {domain.bounds}")
    return nodes


def select_facets(domain: Domain, selector: Selector, key: str = "on") -> Ints:
    """Local boundary facets of a group, or boundary facets with all nodes in a box or on a plane (collective)."""
    if isinstance(selector, Group):
        facets = np.intersect1d(_group_facets(domain, selector, key), domain.facets.boundary)
    else:
        facets = _facets_within(domain, _nodes_within(domain, selector))
    if sum_over_ranks(domain.comm, len(facets))[0] == 0:
        raise InputError(f"{key}: {selector} selects no boundary facet; the body lies in {domain.bounds}")
    return facets


def nearest_node(domain: Domain, point: npt.NDArray[np.float64], key: str = "point") -> Ints:
    """(1,) the owned node nearest to a point (d,), m, on one rank; (0,) on all others (collective).

    Of nodes at equal distance the lowest one of the input mesh is taken. InputError if the point lies outside the
    bounding box.
    """
    size, owned = domain.bounds.diagonal, slice(domain.node_count)
    low, high = domain.bounds.lower - RELATIVE_TOLERANCE * size, domain.bounds.upper + RELATIVE_TOLERANCE * size
    if np.any(point < low) or np.any(point > high):
        raise InputError(f"{key} = {np.asarray(point).tolist()} lies outside the body, which spans {domain.bounds}")
    distance = np.linalg.norm(domain.nodes[owned] - point, axis=1)
    best = (np.inf, np.iinfo(np.int64).max, -1)
    if len(distance):
        # distances that differ by round-off count as equal, so that the node does not depend on the partition
        rounded, numbers = np.round(distance / (1e-12 * size)), domain.input_numbering.nodes[owned]
        node = np.lexsort((numbers, rounded))[0]
        best = (float(rounded[node]), int(numbers[node]), int(node))
    winner = min(domain.comm.allgather(best[:2]))
    return np.array([best[2]] if best[:2] == winner else [], np.int32)


def _group_facets(domain: Domain, group: Group, key: str) -> Ints:
    """Local facets of a named group; InputError lists the groups of the mesh if it is unknown."""
    check_group(group.name, domain.facets.groups, key)
    return domain.facets.groups[group.name]


def _nodes_within(domain: Domain, selector: PointsInBox | PointsOnPlane) -> Ints:
    return np.flatnonzero(selector.selects(domain.nodes, domain.bounds.diagonal)).astype(np.int32)


def _facets_within(domain: Domain, nodes: Ints) -> Ints:
    """Boundary facets all of whose corners are among the nodes."""
    boundary = domain.facets.boundary
    geometry = dolfinx.mesh.entities_to_geometry(domain.mesh, domain.dim - 1, boundary)
    chosen = np.zeros(len(domain.nodes), bool)
    chosen[nodes] = True
    of_geometry = np.zeros(len(domain.mesh.geometry.x), bool)
    of_geometry[domain.corner_geometry] = chosen[domain.cell_nodes]
    return boundary[of_geometry[geometry[:, : domain.dim]].all(axis=1)]
