"""The contact surface of cells with quadratic displacement: midside nodes are points of it too.

On the straight cells alone midside nodes would penetrate freely: by a twentieth of an edge between two plates, with 7/8
of the force. The parts of a cell with broken edges follow its corners alone.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from ...meshes.data import MeshData
from ...meshes.topology import orient_cells
from ..domain import Domain
from ..simplices import local_edges
from .closed_surface import SplitSurface, boundary_corners
from .entity_numbering import CRACK, EntityNumbering
from .local_surface import OUTSIDE, local_mesh
from .surface_motion import PointParents

Ints = npt.NDArray[np.int64]

# (i, i) is corner i, (i, j) the midside node between; the octahedron in a tetrahedron is divided along one axis
SUBDIVISION = {
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


def with_midside_points(surface: SplitSurface, domain: Domain, pattern: npt.NDArray[np.integer]) -> SplitSurface:
    """The surface with boundary facets of undamaged cells divided into 2 segments (2D) or 4 triangles (3D).

    Midside nodes are numbered after all points of the surface. Each is its own only parent.
    """
    on_boundary = (surface.edge < 0) & (surface.origin != CRACK) & (pattern[surface.cell] == 0)
    facets, cell = surface.elements[on_boundary], surface.cell[on_boundary]
    i, j = local_edges(domain.dim - 1).T
    parent = surface.parents.first_parent
    between = _midside_nodes(domain, cell, parent[facets[:, i]], parent[facets[:, j]])
    nodes, number = np.unique(between, return_inverse=True)
    smaller = _subdivide(_node_table(facets, len(surface.points) + number.reshape(between.shape)))
    unchanged, parts = ~on_boundary, len(SUBDIVISION[domain.dim - 1])
    count = np.concatenate([np.diff(surface.parents.start), np.ones(len(nodes), np.int64)])
    points = np.concatenate([surface.points, domain.nodes[nodes]])
    parents = np.concatenate([surface.parents.parents, nodes])
    return replace(
        surface,
        points=points,
        parents=PointParents.from_positions(parents, count, points, domain.nodes),
        elements=np.concatenate([surface.elements[unchanged], smaller]),
        cell=np.concatenate([surface.cell[unchanged], np.repeat(cell, parts)]),
        edge=np.concatenate([surface.edge[unchanged], np.full(len(smaller), -1)]),
        origin=np.concatenate([surface.origin[unchanged], np.repeat(surface.origin[on_boundary], parts)]),
    )


def _midside_nodes(domain: Domain, cell: Ints, low: Ints, high: Ints) -> Ints:
    """(m, n) midside nodes between the nodes `low` and `high` (m, n) of the cells (m,)."""
    # ends: (m, edges, 2)
    ends = domain.cell_nodes[cell][:, local_edges(domain.dim)]
    pair = np.sort(np.stack([low, high], axis=-1), axis=-1)
    same = (pair[:, :, None] == np.sort(ends, axis=-1)[:, None]).all(axis=-1)
    return np.asarray(
        np.take_along_axis(domain.cell_midside_nodes.of_edges[cell], same.argmax(axis=-1), axis=1), np.int64
    )


def subdivided_local_mesh(domain: Domain) -> MeshData:
    """The cells of this rank, divided where displacement is quadratic, with the boundary of the body as a group.

    Its points are the nodes of this rank.
    """
    mesh = local_mesh(domain)
    if domain.order == 1:
        return mesh
    topology = EntityNumbering(mesh)
    outside = np.flatnonzero([OUTSIDE in topology.origins[origin] for origin in topology.origin])
    facets, (i, j) = boundary_corners(topology, outside), local_edges(domain.dim - 1).T
    between = _midside_nodes(domain, topology.boundary[outside, 0], facets[:, i], facets[:, j])
    cells = _subdivide(_node_table(mesh.cells, domain.cell_midside_nodes.of_edges))
    groups = {OUTSIDE: _subdivide(_node_table(facets, between))}
    return MeshData(mesh.points, orient_cells(mesh.points, cells)[0], groups)


def _node_table(corners: npt.NDArray[np.integer], middles: npt.NDArray[np.integer]) -> Ints:
    """(cells, d + 1, d + 1) corner i of each cell at (i, i), the midside node of edge ij at (i, j)."""
    count = corners.shape[1]
    result = np.empty((len(corners), count, count), np.int64)
    result[:, range(count), range(count)] = corners
    i, j = local_edges(count - 1).T
    result[:, i, j] = result[:, j, i] = middles
    return result


def _subdivide(between: Ints) -> Ints:
    """(cells 2^d, d + 1) nodes of the parts of all simplices, in the order of the simplices."""
    # parts: (2^d, d + 1, 2)
    parts = np.array(SUBDIVISION[between.shape[1] - 1])
    return between[:, parts[..., 0], parts[..., 1]].reshape(-1, between.shape[1])
