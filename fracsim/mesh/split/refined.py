"""The surface of cells with quadratic displacement, for what touches it: each cell taken for 4 (2D) or 8 straight ones
between its corners and the middles of its edges.

On the straight cells alone the middles would be free of contact: between two plates they bulge by a twentieth of an
edge, and a block is pressed with seven eighths of the force.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ...meshes.data import MeshData
from ...meshes.topology import oriented
from ..dolfinx_calls import exterior_facets
from ..domain import Domain
from ..middles import with_middles
from ..simplices import local_edges

Ints = npt.NDArray[np.int64]

# pairs of corners: (i, i) is a corner, (i, j) the middle between; the octahedron in a tetrahedron is cut along one axis
SMALL = {
    1: [[(0, 0), (0, 1)], [(0, 1), (1, 1)]],
    2: [
        [(0, 0), (0, 1), (0, 2)], [(1, 1), (1, 2), (0, 1)], [(2, 2), (0, 2), (1, 2)], [(0, 1), (1, 2), (0, 2)],
    ],
    3: [
        [(0, 0), (0, 1), (0, 2), (0, 3)], [(1, 1), (0, 1), (1, 2), (1, 3)],
        [(2, 2), (0, 2), (1, 2), (2, 3)], [(3, 3), (0, 3), (1, 3), (2, 3)],
        [(0, 1), (2, 3), (0, 2), (0, 3)], [(0, 1), (2, 3), (0, 3), (1, 3)],
        [(0, 1), (2, 3), (1, 3), (1, 2)], [(0, 1), (2, 3), (1, 2), (0, 2)],
    ],
}  # fmt: skip


def refined(domain: Domain, outside: str) -> MeshData:
    """This rank's cells cut up, over all nodes of the displacement; `outside`: the group of the body's boundary."""
    between = _between(domain.cell_nodes, domain.cell_middles)
    cells = _all_cut(between)
    cell, opposite = exterior_facets(domain.mesh, domain._exterior).reshape(-1, 2).T
    corners = np.array([[j for j in range(domain.dim + 1) if j != i] for i in range(domain.dim + 1)])[opposite]
    facets = _cut(between, cell[:, None], corners, domain.dim - 1)
    return MeshData(domain.nodes, oriented(domain.nodes, cells)[0], {outside: facets})


def refined_input(domain: Domain) -> MeshData | None:
    """The input mesh on rank 0, where displacement is quadratic with its cells cut up, without groups; its points are
    those that `Domain.node_input` numbers. None elsewhere."""
    if domain.middles is None or domain.source is None:
        return domain.source
    whole = with_middles(domain.source, domain.middles, written=False)
    cells = _all_cut(_between(*np.split(whole.cells, [domain.dim + 1], axis=1)))
    return MeshData(whole.points, oriented(whole.points, cells)[0])


def _between(corners: npt.NDArray[np.integer], middles: npt.NDArray[np.integer]) -> Ints:
    """(cells, d + 1, d + 1) the corner i of each cell at (i, i), the middle of the edge ij at (i, j)."""
    count = corners.shape[1]
    result = np.empty((len(corners), count, count), np.int64)
    result[:, range(count), range(count)] = corners
    i, j = local_edges(count - 1).T
    result[:, i, j] = result[:, j, i] = middles
    return result


def _all_cut(between: Ints) -> Ints:
    """(cells 2^d, d + 1) nodes of the parts of all cells, those of one cell after another."""
    count = between.shape[1]
    return _cut(between, np.arange(len(between))[:, None], np.arange(count)[None, :], count - 1)


def _cut(between: Ints, cells: npt.NDArray[np.integer], corners: npt.NDArray[np.integer], dim: int) -> Ints:
    """(n 2^dim, dim + 1) nodes of the parts of simplices of cells (n, 1) with local corners (n or 1, dim + 1)."""
    parts = np.array(SMALL[dim])  # (2^dim, dim + 1, 2)
    first, second = corners[:, parts[..., 0]], corners[:, parts[..., 1]]
    return between[cells[:, :, None], first, second].reshape(-1, dim + 1)
