"""Shape that is a closed surface of triangles: volume, inertia, refinement, and penetration of two such surfaces."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from ..array_types import Flags, Ints, Values
from ..errors import InputError
from ..meshes.surfaces.triangle_geometry import BATCH_SIZE, batches, enclosed_volumes, winding_numbers
from ..meshes.topology import distinct_rows
from .closest_point import closest_points_of_facets
from .shape_base import Tessellation


@dataclass(frozen=True)
class TriangleMeshPolicy:
    """Limits of work with closed surfaces.

    Attributes:
        max_triangles: about as many triangles result from a refinement at most.
        max_edge_ratio: edge of an obstacle in edges of the body, beyond which a study is refused.
        max_products: pairs of a point and a triangle in a penetration test; beyond, points are left out evenly.
        min_winding: winding number from which on a point is inside.
    """

    max_triangles: int = 100_000
    max_edge_ratio: float = 1e6
    max_products: int = 30 * BATCH_SIZE
    min_winding: float = 0.5


LIMITS = TriangleMeshPolicy()


@dataclass(frozen=True, eq=False)
class TriangleMeshShape:
    """Volume inside a closed surface of triangles; its reference point is the origin.

    It is a Shape as far as poses and output are concerned. Contact is that of its triangles (mesh_obstacles), not of a
    distance function.

    Attributes:
        points: (n, 3) m.
        triangles: (k, 3) with outward normals.
    """

    kind: ClassVar[str] = "mesh"
    points: Values
    triangles: Ints
    dim: int = 3
    convex: bool = False
    rotation_invariant: bool = False
    min_radius: float = 0.0
    max_inset: float = 0.0
    kernels: None = None

    def tessellate(self) -> Tessellation:
        """Points and triangles."""
        return self.points, self.triangles.astype(np.int32)

    @property
    def volume(self) -> float:
        """Enclosed volume, m^3."""
        return float(enclosed_volumes(self.points, self.triangles).sum())

    def distance(self, x: Values) -> Values:
        """Raise NotImplementedError: there is no distance function."""
        raise NotImplementedError("solids are felt by their triangles")

    normal = curvature = distance

    def inset(self, by: float) -> TriangleMeshShape:
        """The shape itself: its triangles stay."""
        return self

    @property
    def centre(self) -> Values:
        """(3,) centroid of the volume, m."""
        volumes, centroids = self._tetrahedra()
        return np.asarray(volumes @ centroids / volumes.sum())

    def inertia(self, density: float) -> Values:
        """(3, 3) moment of inertia rho (tr S 1 - S) about the reference point, kg m^2, S = int x x^T dV.

        S of a tetrahedron of the origin and corners a, b, c with sum s is V / 20 (a a^T + b b^T + c c^T + s s^T).
        """
        volumes, _ = self._tetrahedra()
        corners = self.points[self.triangles]
        sums = corners.sum(axis=1)
        S = np.einsum("k,kci,kcj->ij", volumes, corners, corners) + np.einsum("k,ki,kj->ij", volumes, sums, sums)
        S = S / 20
        return np.asarray(density * (np.trace(S) * np.eye(3) - S))

    def translated(self, offset: Values) -> TriangleMeshShape:
        """Shape with all points moved by `offset` (3,), m."""
        return replace(self, points=self.points + offset)

    def _tetrahedra(self) -> tuple[Values, Values]:
        """(k,) signed volumes, m^3, and (k, 3) centroids, m, of tetrahedra of triangles and the reference point."""
        corners = self.points[self.triangles]
        return np.linalg.det(corners) / 6, corners.sum(axis=1) / 4


def refine_triangles(points: Values, triangles: Ints, edge: float) -> tuple[Values, Ints]:
    """Closed surface with edges no longer than `edge`, m; edges are halved in both triangles at once.

    Longer edges remain where there would be more than about `LIMITS.max_triangles` triangles.

    Args:
        points: (n, 3) m.
        triangles: (k, 3).
        edge: m.
    """
    sides = points[triangles[:, 1:]] - points[triangles[:, :1]]
    area = float(np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).sum() / 2)
    edge = max(edge, 2.0 * float(np.sqrt(area / LIMITS.max_triangles)))
    while True:
        ends, _, side = distinct_rows(np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], 2).reshape(-1, 2)))
        is_long = np.linalg.norm(points[ends[:, 1]] - points[ends[:, 0]], axis=1) > edge
        if not is_long.any():
            return points, triangles
        middle = np.full(len(ends), -1)
        middle[is_long] = len(points) + np.arange(is_long.sum())
        points = np.concatenate([points, points[ends[is_long]].mean(axis=1)])
        triangles = _split_triangles(triangles, middle[side.reshape(-1, 3)])


def _split_triangles(triangles: Ints, middle: Ints) -> Ints:
    """Triangles (k, 3) split at the points `middle` (k, 3) of the edges that begin at each corner; -1: not split."""
    pieces = [triangles[(middle < 0).all(axis=1)]]
    for first in range(3):
        (a, b, c), (ab, bc, ca) = (np.roll(columns, -first, axis=1).T for columns in (triangles, middle))
        has_ab, has_bc_ca = (ab >= 0) & (bc < 0) & (ca < 0), (ab < 0) & (bc >= 0) & (ca >= 0)
        pieces += [np.column_stack(corners)[has_ab] for corners in ((a, ab, c), (ab, b, c))]
        pieces += [np.column_stack(corners)[has_bc_ca] for corners in ((c, ca, bc), (a, b, bc), (a, bc, ca))]
    (a, b, c), (ab, bc, ca), has_all = triangles.T, middle.T, (middle >= 0).all(axis=1)
    pieces += [np.column_stack(corners)[has_all] for corners in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    return np.concatenate(pieces)


type ClosedSurface = tuple[Values, Ints]  # points (n, 3), m, and triangles (k, 3)


def penetration_depth(first: ClosedSurface, second: ClosedSurface, *, cut: bool) -> float | None:
    """Largest depth of a corner of either surface in the other, m; None if no corner is inside.

    Args:
        first: a surface.
        second: another one.
        cut: whether the surfaces are known to intersect; otherwise a part of one is inside the other as a whole.
    """
    depths = [_depth_inside(surface, target, cut=cut) for surface, target in ((first, second), (second, first))]
    inside = [depth for depth in depths if depth is not None]
    return max(inside) if inside else None


def refuse_overlap(name: str, body: ClosedSurface, obstacle: ClosedSurface, *, cut: bool) -> None:
    """Raise InputError where an obstacle cuts the body at rest (`cut`), or one is inside the other."""
    depth = penetration_depth(body, obstacle, cut=cut)
    if cut or depth is not None:
        verb = "cuts" if depth is None else "overlaps"
        by = "" if depth is None else f", by {depth:.4g} m"
        raise InputError(f"{name} {verb} the body at the start{by}; move it away or make it smaller")


def surfaces_intersect(first: ClosedSurface, second: ClosedSurface) -> bool:
    """Whether a triangle of one surface intersects or touches one of the other. Without ipctk: not known, False."""
    try:
        import ipctk
    except ImportError:
        return False
    points = np.concatenate([first[0], second[0]])
    triangles = np.concatenate([first[1], second[1] + len(first[0])]).astype(np.int32)
    mesh = ipctk.CollisionMesh.build_from_full_mesh(points, ipctk.edges(triangles), triangles)
    side = np.repeat(np.array([0, 1], np.int32), [len(first[0]), len(second[0])])
    mesh.can_collide = ipctk.make_vertex_patches_filter(side[np.unique(triangles)])
    return bool(ipctk.has_intersections(mesh, mesh.vertices(points), ipctk.LBVH()))


def _depth_inside(surface: ClosedSurface, target: ClosedSurface, *, cut: bool) -> float | None:
    x, corners = surface[0][_tested_points(surface, cut=cut)], target[0][target[1]]
    x = x[((x > corners.min(axis=(0, 1))) & (x < corners.max(axis=(0, 1)))).all(axis=1)]
    x = x[:: 1 + len(x) * len(corners) // LIMITS.max_products]
    x = x[is_inside(x, corners)] if len(x) else x
    return float(surface_distances(x, corners).max()) if len(x) else None


def _tested_points(surface: ClosedSurface, *, cut: bool) -> Ints:
    """Points to test: all, or one of each connected part."""
    points, triangles = surface
    used = np.unique(triangles)
    if cut:
        return used
    pairs = triangles[:, [0, 0]].ravel(), triangles[:, 1:].ravel()
    part = connected_components(csr_matrix((np.ones(len(pairs[0])), pairs), (len(points),) * 2))[1]
    return used[np.unique(part[used], return_index=True)[1]]


def is_inside(x: Values, corners: Values) -> Flags:
    """(n,) whether triangles (k, 3, 3) wind around points x (n, 3) once or more."""
    return winding_numbers(x, corners) > LIMITS.min_winding


def surface_distances(x: Values, corners: Values) -> Values:
    """(n,) distances of points x (n, 3) to the nearest of triangles (k, 3, 3), m."""

    def min_distances(x: Values) -> Values:
        offset = closest_points_of_facets(np.repeat(x, len(corners), axis=0), np.tile(corners, (len(x), 1, 1)))[1]
        return np.asarray(np.linalg.norm(offset, axis=1).reshape(len(x), -1).min(axis=1))

    return np.concatenate([min_distances(part) for part in batches(x, len(corners))])
