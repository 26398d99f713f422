"""Surfaces and their maps where one rank holds the whole mesh: plain twins of those of ranks."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix

from fracsim.mesh.simplices import is_split
from fracsim.mesh.split_surface.closed_surface import SplitSurface, SurfacePoints
from fracsim.mesh.split_surface.entity_numbering import EntityNumbering
from fracsim.mesh.split_surface.fragment_surface import OpenEdges, build_surface_of_open_edges, moves_alike
from fracsim.mesh.split_surface.mesh_part import WholeMesh
from fracsim.mesh.split_surface.surface_map import SurfaceMap, gradient_entries

Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Patterns = npt.NDArray[np.integer]


def build_fragment_surface(topology: EntityNumbering, pattern: Patterns, cut: Values | None = None) -> SplitSurface:
    """The split surface of damage patterns (C,) without crack faces within fragments and without loose nodes.

    Edges between fragments, and to loose nodes, are open. `cut`: (E,) as in build_surface_of_open_edges.
    """
    return build_surface_of_open_edges(topology, _open_edges(topology, pattern), cut)


def _open_edges(topology: EntityNumbering, pattern: Patterns) -> OpenEdges:
    part = WholeMesh(topology)
    return OpenEdges.find(part.comm, topology, pattern, part.least, lambda broken: part.find_fragments(broken)[1])


def has_same_fragments(topology: EntityNumbering, pattern: Patterns, before: Patterns) -> bool:
    """Whether the surface of fragments is the same for two damage patterns (C,), and moves alike with the nodes."""
    return moves_alike(topology, *(_open_edges(topology, of_time) for of_time in (pattern, before)))


def make_surface_map(
    surface: SplitSurface | SurfacePoints, topology: EntityNumbering, pattern: npt.NDArray[np.integer], places: Values
) -> SurfaceMap:
    """The map of points at reference positions `places` (n, d), m, on a rank that holds the whole mesh."""
    d, count, follow = topology.dim, len(places), surface.parents
    parents = np.diff(follow.start)
    rows = np.repeat(np.arange(count), parents)
    share, arm = np.repeat(1.0 / parents, parents), places[rows] - topology.points[follow.parents]
    mean = csr_matrix((share, (rows, follow.parents)), shape=(count, follow.nodes))
    armed = np.zeros(follow.nodes, bool)
    armed[follow.parents[np.any(arm != 0, axis=1)]] = True
    corners = topology.cells[~is_split(d)[pattern] & armed[topology.cells].any(axis=1)]
    X = topology.points[corners]
    volume = np.abs(np.linalg.det(X[:, 1:] - X[:, :1]))
    around = np.bincount(corners.reshape(-1), np.repeat(volume, d + 1), minlength=follow.nodes)
    matrix_rows, matrix_columns, values = gradient_entries(X, volume[:, None] / around[corners], corners)
    gradients = csr_matrix((values, (matrix_rows, matrix_columns)), shape=(d * follow.nodes, follow.nodes))
    of_arm = (d * follow.parents[:, None] + np.arange(d)).reshape(-1)
    arms = csr_matrix(((share[:, None] * arm).reshape(-1), (np.repeat(rows, d), of_arm)),
                      shape=(count, d * follow.nodes))  # fmt: skip
    middle = np.asarray(mean @ topology.points)
    return SurfaceMap(mean, middle, (arms @ gradients).tocsr(), places - middle)
