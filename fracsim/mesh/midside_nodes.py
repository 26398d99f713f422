"""Midside nodes of quadratic displacement: which edges they are on, and what they are called whatever the partition.

    N_i = l_i (2 l_i - 1) at corners,   N_ij = 4 l_i l_j at the middle of the edge ij,   l barycentric

A middle is at rest half-way between the ends of its edge, or on the round face that it belongs to. In the input mesh it
comes after all points, in the order of the (lower, higher) ends of its edge.

Equations: docs/theory.md#quadratic-displacement.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..meshes.data import MeshData
from ..meshes.topology import edges_of
from .parallel import bcast
from .simplices import local_edges

Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class MidsideNodes:
    """The edges of an input mesh.

    Attributes:
        points: how many points the input mesh has.    keys: (m,) lower end times `points` plus higher end, sorted.
        bent: whether some are not half-way.
    """

    points: int
    keys: Ints
    curved: bool = False

    @property
    def ends(self) -> Ints:
        """(m, 2) input points that each middle lies between, the lower first."""
        return np.stack([self.keys // self.points, self.keys % self.points], axis=1)

    def index_between(self, ends: Ints) -> Ints:
        """Index after all input points of the middles between (..., 2) input points."""
        return self.points + np.searchsorted(self.keys, ends.min(axis=-1) * self.points + ends.max(axis=-1))


# local edges in the order in which VTK and XDMF have their middles: (0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)
FILE_EDGE_ORDER = {2: [2, 0, 1], 3: [5, 2, 4, 3, 1, 0]}


def with_midside_nodes(data: MeshData, middles: MidsideNodes, *, written: bool) -> MeshData:
    """The mesh with the middles as points, and cells of 6 (2D) or 10 nodes, `written` as files have them, or in the
    order of local edges."""
    between = data.points[middles.ends].mean(axis=1) if data.middles is None else data.middles
    ends = data.cells[:, local_edges(data.dim)[FILE_EDGE_ORDER[data.dim] if written else slice(None)]]
    cells = np.hstack([data.cells, middles.index_between(ends)])
    return replace(data, points=np.concatenate([data.points, between]), cells=cells)


def find_midside_nodes(comm: MPI.Comm, data: MeshData | None) -> MidsideNodes:
    """Of a mesh that rank 0 holds, on every rank (collective)."""
    made = None
    if data is not None:
        low, high = edges_of(data.cells).T
        made = MidsideNodes(len(data.points), low * len(data.points) + high, data.middles is not None)
    result: MidsideNodes = bcast(comm, made)
    return result
