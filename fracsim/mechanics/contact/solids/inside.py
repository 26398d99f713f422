"""How deep closed surfaces of triangles lie in one another."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from ....meshes.surfaces.enclosed import AT_ONCE, parts, windings

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
type Closed = tuple[Values, Ints]  # points (n, 3), m, and triangles (k, 3)

MOST = 30 * AT_ONCE  # pairs of a point and a triangle that are looked at


def depth(one: Closed, other: Closed, *, cut: bool) -> float | None:
    """How deep a corner of either lies in the other, m; None where neither has any there.

    `cut`: whether they are known to cut each other; where they do not, a part of one is in the other as a whole.
    """
    deepest = [_depth_in(x, into, cut=cut) for x, into in ((one, other), (other, one))]
    found = [each for each in deepest if each is not None]
    return max(found) if found else None


def crosses(one: Closed, other: Closed) -> bool:
    """Whether a triangle of one surface cuts or touches one of the other. Without ipctk: not known, False."""
    try:
        import ipctk
    except ImportError:
        return False
    points = np.concatenate([one[0], other[0]])
    triangles = np.concatenate([one[1], other[1] + len(one[0])]).astype(np.int32)
    mesh = ipctk.CollisionMesh.build_from_full_mesh(points, ipctk.edges(triangles), triangles)
    side = np.repeat(np.array([0, 1], np.int32), [len(one[0]), len(other[0])])
    mesh.can_collide = ipctk.make_vertex_patches_filter(side[np.unique(triangles)])
    return bool(ipctk.has_intersections(mesh, mesh.vertices(points), ipctk.LBVH()))


def _depth_in(surface: Closed, other: Closed, *, cut: bool) -> float | None:
    x, corners = surface[0][_asked(surface, cut=cut)], other[0][other[1]]
    x = x[((x > corners.min(axis=(0, 1))) & (x < corners.max(axis=(0, 1)))).all(axis=1)]
    x = x[:: 1 + len(x) * len(corners) // MOST]
    x = x[is_inside(x, corners)] if len(x) else x
    return float(distances(x, corners).max()) if len(x) else None


def _asked(surface: Closed, *, cut: bool) -> Ints:
    """Corners: all, or one of each part that hangs together."""
    points, triangles = surface
    used = np.unique(triangles)
    if cut:
        return used
    pairs = triangles[:, [0, 0]].ravel(), triangles[:, 1:].ravel()
    part = connected_components(csr_matrix((np.ones(len(pairs[0])), pairs), (len(points),) * 2))[1]
    return used[np.unique(part[used], return_index=True)[1]]


def is_inside(x: Values, corners: Values) -> Flags:
    """(n,) whether triangles (k, 3, 3) wind around points x (n, 3) once or more."""
    return windings(x, corners) > 0.5


def distances(x: Values, corners: Values) -> Values:
    """(n,) of points x (n, 3) to the nearest of triangles (k, 3, 3), m: to its plane over it, to its sides else."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)

    def nearest(x: Values) -> Values:
        to = x[:, None, None] - corners[None]  # from each corner
        over, least = np.ones(to.shape[:2], bool), np.full(to.shape[:2], np.inf)
        for k in range(3):
            side = corners[:, (k + 1) % 3] - corners[:, k]
            along = np.clip(np.einsum("nki,ki->nk", to[:, :, k], side) / np.einsum("ki,ki->k", side, side), 0.0, 1.0)
            least = np.minimum(least, np.linalg.norm(to[:, :, k] - along[:, :, None] * side, axis=2))
            over &= np.einsum("nki,ki->nk", to[:, :, k], np.cross(normal, side)) >= 0
        height = abs(np.einsum("nki,ki->nk", to[:, :, 0], normal))
        return np.asarray(np.where(over, height, least).min(axis=1))

    return np.concatenate([nearest(part) for part in parts(x, len(corners))])
