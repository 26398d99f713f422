"""Edges of the input mesh and their numbers, on the rank that holds the mesh."""

from __future__ import annotations

from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from ..meshes.data import Indices, MeshData
from ..meshes.topology import distinct_rows, sorted_rows
from .simplices import local_edges

# Kept as long as the mesh: 32 bits number two thousand million entities, in half the memory of 64.
Numbers = npt.NDArray[np.int32]
_EDGE_NUMBERS: WeakKeyDictionary[MeshData, tuple[Numbers, Numbers]] = WeakKeyDictionary()


class MeshTopology:
    """A mesh of N nodes and C cells with its E edges; numbers are computed once for each mesh.

    Attributes:
        dim: 2 or 3.
        points: (N, d) reference coordinates X, m.
        cells: (C, d + 1) nodes.
        edges: (E, 2) nodes, the lower first, in ascending order.
        cell_edges: (C, k) edges of each cell in the order of simplices.local_edges.
    """

    def __init__(self, mesh: MeshData) -> None:
        self.dim, self.points, self.cells = mesh.dim, mesh.points, mesh.cells
        if mesh not in _EDGE_NUMBERS:
            _EDGE_NUMBERS[mesh] = _number_edges(mesh)
        self.edges, self.cell_edges = _EDGE_NUMBERS[mesh]

    def find_edges(self, keys: Indices) -> Indices:
        """(n,) numbers of the edges between pairs of nodes `keys` (n, 2), in either order; all edges exist."""
        factor = np.array([len(self.points), 1])
        return np.searchsorted(self.edges @ factor, np.sort(keys, axis=1) @ factor)

    def edge_flags(self, keys: Indices) -> npt.NDArray[np.bool_]:
        """(E,) flags of the edges between pairs of nodes `keys` (n, 2)."""
        flags = np.zeros(len(self.edges), bool)
        flags[self.find_edges(keys)] = True
        return flags


def _number_edges(mesh: MeshData) -> tuple[Numbers, Numbers]:
    """(E, 2) distinct edges, and (C, k) the edges of each cell."""
    ends = mesh.cells[:, local_edges(mesh.dim)]
    edges, _, inverse = distinct_rows(sorted_rows(ends.reshape(-1, 2)))
    return edges.astype(np.int32), inverse.reshape(ends.shape[:2]).astype(np.int32)
