"""The surface of cells with quadratic displacement, for what touches it: the middles of edges are points of it too.

On the straight cells alone the middles would be free of contact: between two plates they bulge by a twentieth of an
edge, and a block is pressed with seven eighths of the force. A cell with broken edges has no middles that its parts
could follow: they follow its corners.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from ...meshes.data import MeshData
from ...meshes.topology import oriented
from ..domain import Domain
from ..midside_nodes import with_midside_nodes
from ..simplices import local_edges
from .closed_surface import SplitSurface
from .entity_numbering import CRACK
from .surface_motion import PointParents

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


def with_midside_points(made: SplitSurface, domain: Domain, pattern: npt.NDArray[np.integer]) -> SplitSurface:
    """The surface of this rank's straight cells with 2 segments (2D) or 4 triangles for each facet of the body's own
    boundary whose cell is whole: the middles come after all its points, and follow themselves alone."""
    on_boundary = (made.edge < 0) & (made.origin != CRACK) & (pattern[made.cell] == 0)
    facets, cell = made.elements[on_boundary], made.cell[on_boundary]
    i, j = local_edges(domain.dim - 1).T
    between = _middle_of(domain, cell, made.parents.first_parent[facets[:, i]], made.parents.first_parent[facets[:, j]])
    nodes, place = np.unique(between, return_inverse=True)
    smaller = _all_cut(_between(facets, len(made.points) + place.reshape(between.shape)))
    rest, each = ~on_boundary, len(SMALL[domain.dim - 1])
    count = np.concatenate([np.diff(made.parents.start), np.ones(len(nodes), np.int64)])
    points = np.concatenate([made.points, domain.nodes[nodes]])
    parents = np.concatenate([made.parents.parents, nodes])
    return replace(
        made,
        points=points,
        parents=PointParents.of(parents, count, points, domain.nodes),
        elements=np.concatenate([made.elements[rest], smaller]),
        cell=np.concatenate([made.cell[rest], np.repeat(cell, each)]),
        edge=np.concatenate([made.edge[rest], np.full(len(smaller), -1)]),
        origin=np.concatenate([made.origin[rest], np.repeat(made.origin[on_boundary], each)]),
    )


def _middle_of(domain: Domain, cell: Ints, low: Ints, high: Ints) -> Ints:
    """(m, n) nodes of the middles between the nodes `low` and `high` (m, n) of cells (m,)."""
    ends = domain.cell_nodes[cell][:, local_edges(domain.dim)]  # (m, edges, 2)
    pair = np.sort(np.stack([low, high], axis=-1), axis=-1)
    same = (pair[:, :, None] == np.sort(ends, axis=-1)[:, None]).all(axis=-1)
    return np.asarray(np.take_along_axis(domain.cell_midside_nodes[cell], same.argmax(axis=-1), axis=1), np.int64)


def refined_input(domain: Domain) -> MeshData | None:
    """The input mesh on rank 0, where displacement is quadratic with its cells cut up, without groups; its points are
    those that `Domain.node_input` numbers. None elsewhere."""
    if domain.midside_nodes is None or domain.source is None:
        return domain.source
    whole = with_midside_nodes(domain.source, domain.midside_nodes, written=False)
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
    """(cells 2^d, d + 1) nodes of the parts of all simplices, those of one after another."""
    parts = np.array(SMALL[between.shape[1] - 1])  # (2^d, d + 1, 2)
    return between[:, parts[..., 0], parts[..., 1]].reshape(-1, between.shape[1])
