"""The input mesh as a level set sees it: points, edges, the triangles of a cell."""

from __future__ import annotations

from functools import cache, cached_property

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix

from ...mesh.simplices import is_split, local_edges
from ...mesh.topology import MeshTopology
from ...meshes.data import MeshData
from ...meshes.topology import signed_measures

Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
Values = npt.NDArray[np.float64]


class Cells:
    """Cells by their nodes.

    Attributes:
        cells: (C, k) nodes.    corners: (k, C) the same.
    """

    cells: Ints
    corners: Ints

    def __init__(self, cells: Ints) -> None:
        self.cells, self.corners = cells, np.ascontiguousarray(cells.T)

    def crossed(self, sides: Flags) -> Ints:
        """Cells with nodes on both sides (N,)."""
        first = sides[self.corners[0]]
        differs = sides[self.corners[1]] != first
        for column in self.corners[2:]:  # five times as fast as any(axis=1)
            differs |= sides[column] != first
        return np.flatnonzero(differs)

    def touching(self, nodes: Flags) -> Flags:
        """(C,) whether cells have one of the nodes flagged (N,)."""
        result = nodes[self.corners[0]]
        for column in self.corners[1:]:
            result |= nodes[column]
        return result


class Body(MeshTopology, Cells):
    """A mesh as level sets cut it. A shell is cut where its middle surface is, across its whole thickness.

    Attributes:
        centroids: (C, d) m.    layer: triangles of a shell, whose nodes are there twice; None of a solid.
        tolerance: m; nodes as near as this to a surface lie on it.
    """

    def __init__(self, mesh: MeshData) -> None:
        MeshTopology.__init__(self, mesh)
        Cells.__init__(self, mesh.cells)
        self.volumes: Values = signed_measures(mesh.points, mesh.cells)
        self.layer = None if mesh.shell is None else Cells(mesh.shell.triangles)
        if mesh.shell is not None:
            self.points = mesh.shell.middle
        self.centroids: Values = self.points[mesh.cells].mean(axis=1)
        self.tolerance = 1e-7 * float(np.mean(self.volumes)) ** (1 / mesh.dim)

    @cached_property
    def around(self) -> csr_matrix:
        """(N, C) cells around each node."""
        cell = np.repeat(np.arange(len(self.cells)), self.cells.shape[1])
        return csr_matrix(
            (np.ones(len(cell), np.int8), (self.cells.ravel(), cell)), (len(self.points), len(self.cells))
        )

    def whole(self, cells: Ints, broken: Flags) -> Flags:
        """(n,) which of the cells have not come apart."""
        bits = 1 << np.arange(self.cell_edges.shape[1])
        return np.asarray(~is_split(self.dim)[broken[self.cell_edges[cells]] @ bits])


@cache
def triangles(dim: int) -> Ints:
    """(t, 3) local edges of the triangles of a cell: itself in 2D, its four facets in 3D."""
    edges = local_edges(dim)
    if dim == 2:
        return np.arange(3)[None]
    return np.array([np.flatnonzero(np.all(edges != facet, axis=1)) for facet in range(4)])
