"""Elements of a surface that cut each other."""

from __future__ import annotations

import ipctk
import numpy as np
import numpy.typing as npt

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

NONE: Ints = np.empty((0, 2), np.int64)


def crossings(mesh: ipctk.CollisionMesh, x: Values) -> Ints:
    """(k, 2) elements at x (n, d), m, of which neither is a neighbour of the other."""
    phase = ipctk.LBVH()
    phase.build(x, mesh.edges, mesh.faces, 0.0)
    return _of_triangles(phase, mesh, x) if x.shape[1] == 3 else _of_segments(phase, mesh, x)


def _of_segments(phase: ipctk.LBVH, mesh: ipctk.CollisionMesh, x: Values) -> Ints:
    near = _pairs([(each.edge0_id, each.edge1_id) for each in phase.detect_edge_edge_candidates()])
    (a, b), (c, d) = (x[mesh.edges[near[:, k]]].transpose(1, 0, 2) for k in range(2))
    return near[_part(a, b, c, d) & _part(c, d, a, b)]


def _part(a: Values, b: Values, c: Values, d: Values) -> Flags:
    """(k,) whether the line through a and b parts c from d, (k, 2) each."""
    (way_x, way_y), to = (b - a).T, [(each - a).T for each in (c, d)]
    side = [way_x * y - way_y * x for x, y in to]
    return np.asarray(side[0] * side[1] <= 0)


def _of_triangles(phase: ipctk.LBVH, mesh: ipctk.CollisionMesh, x: Values) -> Ints:
    near = _pairs([(each.edge_id, each.face_id) for each in phase.detect_edge_face_candidates()])
    near = near[_pierced(x[mesh.edges[near[:, 0]]], x[mesh.faces[near[:, 1]]])]
    which, triangle = _around(mesh.faces_to_edges, near[:, 0])
    return np.unique(np.sort(np.column_stack([triangle, near[which, 1]]), axis=1), axis=0)


def _around(edges: Ints, of: Ints) -> tuple[Ints, Ints]:
    """All triangles at the edges `of` (k,): (m,) which of the k, and (m,) the triangle; `edges` (triangles, 3)."""
    order = np.argsort(edges, axis=None, kind="stable")
    sorted_edges = edges.reshape(-1)[order]
    first, end = np.searchsorted(sorted_edges, of, "left"), np.searchsorted(sorted_edges, of, "right")
    which = np.repeat(np.arange(len(of)), count := end - first)
    at = np.arange(len(which)) + np.repeat(first - np.cumsum(count) + count, count)
    return which, order[at] // edges.shape[1]


def _pierced(ends: Values, corners: Values) -> Flags:
    """(k,) whether edges (k, 2, 3) go through triangles (k, 3, 3): their ends are on both sides, and the edge turns the
    same way about all three sides."""
    start, way = ends[:, 0], ends[:, 1] - ends[:, 0]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    above = [np.einsum("ij,ij->i", ends[:, k] - corners[:, 0], normal) for k in range(2)]
    turns = [
        np.einsum("ij,ij->i", way, np.cross(corners[:, k] - start, corners[:, (k + 1) % 3] - start)) for k in range(3)
    ]
    same = np.all(np.array(turns) >= 0, axis=0) | np.all(np.array(turns) <= 0, axis=0)
    return np.asarray((above[0] * above[1] <= 0) & (above[0] != above[1]) & same)


def _pairs(found: list[tuple[int, int]]) -> Ints:
    return np.array(found, np.int64).reshape(-1, 2)
