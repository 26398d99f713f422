"""Elements of a surface that cut each other."""

from __future__ import annotations

import ipctk
import numpy as np
import numpy.typing as npt

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

NONE: Ints = np.empty((0, 2), np.int64)


def crossings(mesh: ipctk.CollisionMesh, x: Values) -> Ints:
    """(k, 2) elements at x (n, d), m; one by one, which is no matter: overlaps are few, or end the run."""
    phase = ipctk.LBVH()
    phase.build(x, mesh.edges, mesh.faces, 0.0)
    return _of_triangles(phase, mesh, x) if x.shape[1] == 3 else _of_segments(phase, mesh, x)


def _of_segments(phase: ipctk.LBVH, mesh: ipctk.CollisionMesh, x: Values) -> Ints:
    near = [(each.edge0_id, each.edge1_id) for each in phase.detect_edge_edge_candidates()]
    ends = x[mesh.edges]
    cut = [pair for pair in near if ipctk.segment_segment_intersect(*ends[pair[0]], *ends[pair[1]])]
    return np.array(cut, np.int64).reshape(-1, 2)


def _of_triangles(phase: ipctk.LBVH, mesh: ipctk.CollisionMesh, x: Values) -> Ints:
    near = [(each.edge_id, each.face_id) for each in phase.detect_edge_face_candidates()]
    ends, corners = x[mesh.edges], x[mesh.faces]
    cut = [pair for pair in near if ipctk.is_edge_intersecting_triangle(*ends[pair[0]], *corners[pair[1]])]
    pairs: Ints = np.array(cut, np.int64).reshape(-1, 2)
    of_edge = np.empty(len(mesh.edges), np.int64)  # a triangle of each edge
    of_edge[mesh.faces_to_edges.ravel()] = np.repeat(np.arange(len(mesh.faces)), 3)
    pairs[:, 0] = of_edge[pairs[:, 0]]
    return np.unique(np.sort(pairs, axis=1), axis=0)
