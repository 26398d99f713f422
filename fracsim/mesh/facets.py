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
        cells = self._topology.connectivity(self._topology.dim - 1, self._topology.dim)
        first = cells.offsets[:-1][np.diff(cells.offsets) == 2]
        return np.stack([cells.array[first], cells.array[first + 1]], axis=1)

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


def find_group_facets(mesh: dolfinx.mesh.Mesh, groups: dict[str, npt.NDArray[np.int64]]) -> dict[str, Ints]:
    """Local facets of each group (collective).

    `groups`: (facets, d) input nodes of some facets of each group; equal facets are on one rank.
    """
    result: dict[str, Ints] = {}
    names = list(groups)
    # DOLFINx needs as long to find the facets of one group as those of all: each facet is sent once, with a bit for
    # each group. A signed 32-bit integer has 31 bits without the sign.
    groups_per_call = 31
    for first in range(0, len(names), groups_per_call):
        batch = names[first : first + groups_per_call]
        rows, bits = _group_bits(mesh.topology.dim, [groups[name] for name in batch])
        facets, flags = find_facets(mesh, rows, bits)
        result |= {name: facets[flags >> bit & 1 == 1] for bit, name in enumerate(batch)}
    return result


def _group_bits(dim: int, groups: list[npt.NDArray[np.int64]]) -> tuple[npt.NDArray[np.int64], Ints]:
    """(n, d) sorted nodes of the distinct facets of all groups, and (n,) a number whose bit k is set in group k."""
    rows, _, inverse = distinct_rows(np.sort(np.concatenate([np.empty((0, dim), np.int64), *groups]), axis=1))
    bits = np.zeros(len(rows), np.int32)
    group_bit = np.repeat(1 << np.arange(len(groups), dtype=np.int32), [len(facets) for facets in groups])
    np.bitwise_or.at(bits, inverse, group_bit)
    return rows, bits
