"""A shape that is a closed surface of triangles.

Triangles cut until no side is longer than asked for: contact is felt, and weighed, at points of both sides.

How deep closed surfaces of triangles lie in one another.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from ..meshes.surfaces.enclosed import AT_ONCE, enclosed_volumes, parts, windings
from ..meshes.topology import distinct_rows
from .tessellation import Tessellation

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
MAX_TRIANGLES = 100_000  # triangles
Flags = npt.NDArray[np.bool_]
MAX_PRODUCTS = 30 * AT_ONCE  # pairs of a point and a triangle that are looked at


@dataclass(frozen=True, eq=False)
class TriangleMeshShape:
    """What points (n, 3), m, and triangles (k, 3), their normals outwards, enclose; its reference point is the origin.

    It stands where a Shape does as far as it is placed and drawn; it is felt by its triangles (mesh_obstacles), not by
    a distance.
    """

    kind: ClassVar[str] = "mesh"
    points: Values
    triangles: Ints
    dim: int = 3
    convex: bool = False
    rotation_invariant: bool = False
    min_radius: float = 0.0

    def tessellate(self) -> Tessellation:
        """Its triangles."""
        return self.points, self.triangles.astype(np.int32)

    @property
    def volume(self) -> float:
        """m^3."""
        return float(enclosed_volumes(self.points, self.triangles).sum())

    def distance(self, x: Values) -> Values:
        """NotImplementedError."""
        raise NotImplementedError("solids are felt by their triangles")

    def normal(self, x: Values) -> Values:
        """As `distance`."""
        return self.distance(x)

    def curvature(self, x: Values) -> Values:
        """As `distance`."""
        return self.distance(x)

    @property
    def centre(self) -> Values:
        """(3,) of its mass, from the reference point, m."""
        each, middle = self._tetrahedra()
        return np.asarray(each @ middle / each.sum())

    def inertia(self, density: float) -> Values:
        """(3, 3) rho (tr S 1 - S) about the reference point, S = int x x^T dV: of the tetrahedron between it and a
        triangle, with corners a, b, c and sum s, V / 20 (a a^T + b b^T + c c^T + s s^T)."""
        each, _ = self._tetrahedra()
        corners = self.points[self.triangles]
        whole = corners.sum(axis=1)
        S = (np.einsum("k,kci,kcj->ij", each, corners, corners) + np.einsum("k,ki,kj->ij", each, whole, whole)) / 20
        return np.asarray(density * (np.trace(S) * np.eye(3) - S))

    def translated(self, offset: Values) -> TriangleMeshShape:
        """The same with its reference point elsewhere: all points by `offset` (3,), m."""
        return replace(self, points=self.points + offset)

    def _tetrahedra(self) -> tuple[Values, Values]:
        """(k,) signed volumes of those between triangles and the reference point, m^3, and (k, 3) their middles, m."""
        corners = self.points[self.triangles]
        return np.linalg.det(corners) / 6, corners.sum(axis=1) / 4


def refine_triangles(points: Values, triangles: Ints, edge: float) -> tuple[Values, Ints]:
    """The surface of points (n, 3), m, and triangles (k, 3) with sides no longer than `edge`, m, or so long that
    there are about MOST triangles: sides are halved, in both triangles at once, so that it stays closed."""
    sides = points[triangles[:, 1:]] - points[triangles[:, :1]]
    area = float(np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).sum() / 2)
    edge = max(edge, 2.0 * float(np.sqrt(area / MAX_TRIANGLES)))
    while True:
        ends, _, side = distinct_rows(np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], 2).reshape(-1, 2)))
        far = np.linalg.norm(points[ends[:, 1]] - points[ends[:, 0]], axis=1) > edge
        if not far.any():
            return points, triangles
        middle = np.full(len(ends), -1)
        middle[far] = len(points) + np.arange(far.sum())
        points = np.concatenate([points, points[ends[far]].mean(axis=1)])
        triangles = _cut(triangles, middle[side.reshape(-1, 3)])


def _cut(triangles: Ints, middle: Ints) -> Ints:
    """Triangles (k, 3) cut at the points `middle` (k, 3) of the sides that begin at each corner; -1: not there."""
    parts = [triangles[(middle < 0).all(axis=1)]]
    for first in range(3):
        (a, b, c), (ab, bc, ca) = (np.roll(each, -first, axis=1).T for each in (triangles, middle))
        one, two = (ab >= 0) & (bc < 0) & (ca < 0), (ab < 0) & (bc >= 0) & (ca >= 0)
        parts += [np.column_stack(each)[one] for each in ((a, ab, c), (ab, b, c))]
        parts += [np.column_stack(each)[two] for each in ((c, ca, bc), (a, b, bc), (a, bc, ca))]
    (a, b, c), (ab, bc, ca), every = triangles.T, middle.T, (middle >= 0).all(axis=1)
    parts += [np.column_stack(each)[every] for each in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    return np.concatenate(parts)


type ClosedSurface = tuple[Values, Ints]  # points (n, 3), m, and triangles (k, 3)


def penetration_depth(one: ClosedSurface, other: ClosedSurface, *, cut: bool) -> float | None:
    """How deep a corner of either lies in the other, m; None where neither has any there.

    `cut`: whether they are known to cut each other; where they do not, a part of one is in the other as a whole.
    """
    deepest = [_depth_in(x, into, cut=cut) for x, into in ((one, other), (other, one))]
    found = [each for each in deepest if each is not None]
    return max(found) if found else None


def surfaces_intersect(one: ClosedSurface, other: ClosedSurface) -> bool:
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


def _depth_in(surface: ClosedSurface, other: ClosedSurface, *, cut: bool) -> float | None:
    x, corners = surface[0][_asked(surface, cut=cut)], other[0][other[1]]
    x = x[((x > corners.min(axis=(0, 1))) & (x < corners.max(axis=(0, 1)))).all(axis=1)]
    x = x[:: 1 + len(x) * len(corners) // MAX_PRODUCTS]
    x = x[is_inside(x, corners)] if len(x) else x
    return float(surface_distances(x, corners).max()) if len(x) else None


def _asked(surface: ClosedSurface, *, cut: bool) -> Ints:
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


def surface_distances(x: Values, corners: Values) -> Values:
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
