"""Facets of the cells of a rank: named groups, the boundary of the body, and pairs of neighbouring cells."""

from __future__ import annotations

from functools import cached_property

import dolfinx
import numpy as np
import numpy.typing as npt

from ..meshes.topology import distinct_rows
from .dolfinx_compat import find_facets

Ints = npt.NDArray[np.int32]


class Facets:
    """Facets of the owned cells of a mesh.

    Attributes:
        groups: local facet indices of each named group.
    """

    def __init__(self, mesh: dolfinx.mesh.Mesh, groups: dict[str, Ints]) -> None:
        """`mesh`: with facets and their connectivity to cells."""
        self._topology, self.groups = mesh.topology, groups

    @property
    def cell_facets(self) -> Ints:
        """(cells, d + 1) local facets of each owned cell."""
        d = self._topology.dim
        facets = self._topology.connectivity(d, d - 1).array.reshape(-1, d + 1)
        return np.asarray(facets[: self._topology.index_map(d).size_local])

    @cached_property
    def neighbours(self) -> Ints:
        """(n, 2) pairs of owned cells that share a facet."""
        facets = self.cell_facets
        order = np.argsort(facets, axis=None, kind="stable")
        twice = np.flatnonzero(np.diff(facets.reshape(-1)[order]) == 0)
        pairs = np.stack([order[twice], order[twice + 1]], axis=1) // facets.shape[1]
        return pairs.astype(np.int32)

    @cached_property
    def boundary(self) -> Ints:
        """(n,) local facets on the boundary of the body; borders between ranks do not belong to it."""
        return dolfinx.mesh.exterior_facet_indices(self._topology)

    @cached_property
    def boundary_sides(self) -> npt.NDArray[np.bool_]:
        """(cells, d + 1) whether the facet opposite to each node of the owned cells is a boundary facet."""
        index_map = self._topology.index_map(self._topology.dim - 1)
        flags = np.zeros(index_map.size_local + index_map.num_ghosts, bool)
        flags[self.boundary] = True
        return flags[self.cell_facets]


def find_group_facets(
    mesh: dolfinx.mesh.Mesh, names: list[str], nodes: list[npt.NDArray[np.int64]] | None
) -> dict[str, Ints]:
    """Local facets of each group, given on rank 0 by the input nodes of their facets (collective).

    `names`: of the groups; `nodes`: (facets, d) input nodes of each group, None on other ranks.
    """
    result: dict[str, Ints] = {}
    # DOLFINx needs as long to find the facets of one group as those of all: each facet is sent once, with a bit for
    # each group. A signed 32-bit integer has 31 bits without the sign.
    groups_per_call = 31
    for first in range(0, len(names), groups_per_call):
        batch = slice(first, first + groups_per_call)
        rows, bits = _group_bits(mesh.topology.dim, None if nodes is None else nodes[batch])
        facets, groups = find_facets(mesh, rows, bits)
        result |= {name: facets[groups >> bit & 1 == 1] for bit, name in enumerate(names[batch])}
    return result


def _group_bits(dim: int, nodes: list[npt.NDArray[np.int64]] | None) -> tuple[npt.NDArray[np.int64], Ints]:
    """(n, d) sorted nodes of the distinct facets of all groups, and (n,) a number whose bit k is set in group k."""
    groups = nodes or []
    rows, _, inverse = distinct_rows(np.sort(np.concatenate([np.empty((0, dim), np.int64), *groups]), axis=1))
    bits = np.zeros(len(rows), np.int32)
    group_bit = np.repeat(1 << np.arange(len(groups), dtype=np.int32), [len(facets) for facets in groups])
    np.bitwise_or.at(bits, inverse, group_bit)
    return rows, bits
