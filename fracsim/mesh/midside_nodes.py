"""Midside nodes of quadratic displacement: the edges that they lie on, and their numbers at any partition.

    N_i = l_i (2 l_i - 1) at corners,   N_ij = 4 l_i l_j at the midside node of edge ij,   l barycentric coordinates

The reference position is half-way between the ends of the edge, or on the curved boundary of the body. Midside nodes
are numbered after all points of the input mesh, in the order of the (lower, higher) ends of their edges.

Equations: docs/theory.md#quadratic-displacement.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..meshes.data import MeshData
from ..meshes.topology import edges_of
from .parallel import bcast
from .simplices import local_edges

if TYPE_CHECKING:
    from .domain import Domain

Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class MidsideNodes:
    """The midside nodes of an input mesh, one for each edge.

    Attributes:
        points: number of points of the input mesh.
        keys: (m,) lower end times `points` plus higher end of each edge, sorted.
        curved: whether any midside node is not half-way between the ends of its edge.
    """

    points: int
    keys: Ints
    curved: bool = False

    @property
    def ends(self) -> Ints:
        """(m, 2) input points at the ends of each edge, the lower first."""
        return np.stack([self.keys // self.points, self.keys % self.points], axis=1)

    def index_between(self, ends: Ints) -> Ints:
        """(...,) numbers of the midside nodes between pairs of input points `ends` (..., 2)."""
        return self.points + np.searchsorted(self.keys, ends.min(axis=-1) * self.points + ends.max(axis=-1))


class CellMidsideNodes:
    """Midside nodes of the owned cells, in the numbering of this rank; none if displacement is linear.

    Attributes:
        of_edges: (cells, 3 or 6) node on each local edge of each cell; (cells, 0) for linear displacement.
        nodes: (m,) distinct midside nodes, ghosts included.
        ends: (m, 2) corners at the ends of the edge of each of them.
    """

    def __init__(self, cell_nodes: npt.NDArray[np.int32], dim: int) -> None:
        """`cell_nodes`: (cells, n) corners, then midside nodes; `dim`: 2 or 3."""
        corners = cell_nodes[:, : dim + 1]
        self.of_edges = np.ascontiguousarray(cell_nodes[:, dim + 1 :])
        self.nodes, first = np.unique(self.of_edges, return_index=True)
        self.ends = corners[:, local_edges(dim)].reshape(-1, 2)[first]

    def straighten_edges(self, values: npt.NDArray[np.float64]) -> None:
        """Set values (nodes, d) at midside nodes to the mean of the ends of their edges."""
        values[self.nodes] = values[self.ends].mean(axis=1)


def with_midside_nodes(data: MeshData, middles: MidsideNodes) -> MeshData:
    """The mesh with midside nodes as points, and cells of 6 (2D) or 10 (3D) nodes: corners, then local edges."""
    between = data.points[middles.ends].mean(axis=1) if data.middles is None else data.middles
    cells = np.hstack([data.cells, middles.index_between(data.cells[:, local_edges(data.dim)])])
    return replace(data, points=np.concatenate([data.points, between]), cells=cells)


def file_cell_nodes(domain: Domain) -> Ints:
    """(cells, n) numbers in the input mesh of the nodes of the owned cells, in the order of VTK and XDMF."""
    nodes = domain.input_numbering.nodes[domain.all_cell_nodes]
    if domain.order == 1:
        return nodes
    # edges of VTK and XDMF: (0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)
    file_order = {2: [2, 0, 1], 3: [5, 2, 4, 3, 1, 0]}[domain.dim]
    corners, midside = np.split(nodes, [domain.dim + 1], axis=1)
    return np.hstack([corners, midside[:, file_order]])


def find_midside_nodes(comm: MPI.Comm, data: MeshData | None) -> MidsideNodes:
    """The midside nodes, on every rank, of a mesh that rank 0 holds (collective)."""
    result = None
    if data is not None:
        low, high = edges_of(data.cells).T
        result = MidsideNodes(len(data.points), low * len(data.points) + high, data.middles is not None)
    midside_nodes: MidsideNodes = bcast(comm, result)
    return midside_nodes
