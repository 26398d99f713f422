"""Triangle-mesh obstacles, and contact of the surface of a body with itself or with one of them.

Each obstacle has pairs of its own with the body: its friction, its force, its gap. The points of an obstacle are no
unknowns: x (n, d) are those of the body, and pairs have the points (n + m, d) of the body and of the obstacle.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import ipctk
import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from ..array_types import Ints, Values
from .clearance import bounding_box
from .ipc_pairs import IpcPairs, PairShare
from .laws import BARRIER
from .obstacle import RigidObstacle
from .pose import Pose, PosedShape
from .sample_points import IpcFriction
from .triangle_mesh_shape import ClosedSurface

if TYPE_CHECKING:
    from .penalty_pairs import PenaltyPairs


@dataclass(frozen=True)
class MeshObstaclePolicy:
    """Tuned numbers of triangle-mesh obstacles.

    Attributes:
        query_points: points nearest to an obstacle's bounding box that bound its distance first.
        max_rotation: rotation of an obstacle in one piece of a motion, rad.
        min_fraction: of a piece, below which nothing moves.
        gap_share: distance of the barrier between obstacles in their gap at the start, where that is the smaller one.
        unlimited: part of the search distance from which on a safe distance counts as unlimited.
    """

    query_points: int = 500
    max_rotation: float = 0.3
    min_fraction: float = 1e-4
    gap_share: float = 0.5
    unlimited: float = 0.999


MESH = MeshObstaclePolicy()


def free_fraction_on_arcs(
    free_fraction: Callable[[Values, Values], float], positions: Callable[[float], Values], rotation: float
) -> float:
    """Fraction of a motion with a rotation without a collision; arcs are divided into chords that end on them.

    Args:
        free_fraction: fraction of the straight motion between two positions (n, 3) without a collision.
        positions: (n, 3) points, m, after a fraction of the motion.
        rotation: angle of the whole motion, rad.
    """
    pieces = 1 + int(rotation / MESH.max_rotation)
    for piece in range(pieces):
        first, fraction, chord = piece / pieces, 1.0, 0.0
        start = positions(first)
        while chord < 1 and fraction > MESH.min_fraction:
            chord = free_fraction(start, positions(first + fraction / pieces))
            fraction *= 1.0 if chord == 1 else (1 - BARRIER.min_gap_ratio) * chord
        if chord < 1:
            return first
        if fraction < 1:
            return first + fraction / pieces
    return 1.0


class MeshObstacle:
    """Triangle-mesh obstacle at a pose (as clearance.ShapeDistance, by its vertices).

    Attributes:
        name: in messages.
        points: (m, 3) in its own frame, m.
        triangles: (k, 3).
        friction: coefficient of friction.
        rotates: whether its rotation may change.
        radius: largest distance of a point from the reference point, m.
        max_error: largest distance of a point of a triangle from its nearest corner, m.
        edge: mean length of edges, m.
        pose: current pose.
    """

    def __init__(self, name: str, points: Values, triangles: Ints, friction: float, *, rotates: bool = True) -> None:
        self.name, self.points, self.triangles, self.friction = name, points, triangles, friction
        self.rotates, self.radius = rotates, float(np.linalg.norm(points, axis=1).max())
        sides = points[triangles] - points[np.roll(triangles, 1, axis=1)]
        lengths = np.linalg.norm(sides, axis=2)
        self.max_error, self.edge = float(lengths.max() / np.sqrt(3)), float(lengths.mean())
        self._tree, self._box = cKDTree(points), (points.min(axis=0), points.max(axis=0))
        self.pose = Pose.at_point(np.zeros(3))
        self._positions: Values | None = points
        self._bounds: tuple[Values, Values] | None = self._box

    @classmethod
    def of(cls, obstacle: RigidObstacle, friction: float) -> MeshObstacle:
        """Obstacle of a triangle mesh, with a coefficient of friction."""
        points, triangles = obstacle.shape.tessellate()
        return cls(obstacle.name, points, triangles.astype(np.int64), friction)

    def move_to(self, pose: Pose) -> None:
        """Move to a pose; points are computed when they are asked for, as most obstacles are far in most steps."""
        if not pose.equals(self.pose):
            self.pose, self._positions, self._bounds = pose, None, None

    @property
    def positions(self) -> Values:
        """(m, 3) its points at the current pose, m."""
        if self._positions is None:
            self._positions = self.positions_at(self.pose)
        return self._positions

    @property
    def surface(self) -> ClosedSurface:
        """Points at the current pose, m, and triangles."""
        return self.positions, self.triangles

    @property
    def arms(self) -> Values:
        """(m, 3) its points about the reference point, m."""
        return self.positions - self.pose.centre

    def positions_at(self, pose: Pose) -> Values:
        """(m, 3) its points at a pose, m."""
        return pose.points_to_space(self.points)

    def triangle_ranks(self, ranks: int) -> Ints:
        """(k,) rank that has each triangle: slabs of equally many along the longest axis."""
        centroids = self.points[self.triangles].mean(axis=1)
        axis = int(np.ptp(centroids, axis=0).argmax())
        result = np.empty(len(centroids), np.int64)
        result[np.argsort(centroids[:, axis], kind="stable")] = np.arange(len(centroids)) * ranks // len(centroids)
        return result

    def spheres_are_far(self, pose: Pose, other: MeshObstacle, other_pose: Pose, distance: float) -> bool:
        """Whether the bounding spheres of two obstacles at poses are farther apart than `distance`, m."""
        between = float(np.linalg.norm(pose.centre - other_pose.centre))
        return between - self.radius - other.radius >= distance

    def is_far(self, x: Values, distance: float) -> bool:
        """Whether its bounding box is farther than `distance` from that of points x (n, 3), m."""
        if self._bounds is None:
            self._bounds = bounding_box(self.positions)
        (low, high), (x_low, x_high) = self._bounds, bounding_box(x)
        return bool(np.any(x_low - high > distance) or np.any(low - x_high > distance))

    def distance(self, posed: PosedShape, x: Values) -> Values:
        """(n,) distances of points x (n, 3) from its vertices at a pose, m."""
        return np.asarray(self._tree.query(posed.pose.to_body(x))[0])

    def lower_bounds(self, posed: PosedShape, x: Values) -> Values:
        """(n,) distances from its vertices, m; of points that are not the nearest from its bounding box."""
        return self._lower_bounds(posed.pose.to_body(x))

    def vertex_distance(self, x: Values) -> float:
        """Least distance from points x (n, 3) to its vertices, m: at most half an edge more than to its surface."""
        return float(self._lower_bounds(self.pose.to_body(x)).min())

    def _lower_bounds(self, x: Values) -> Values:
        distance: Values = np.linalg.norm(np.maximum(np.maximum(self._box[0] - x, x - self._box[1]), 0.0), axis=1)
        first = np.argpartition(distance, min(MESH.query_points, len(x)) - 1)[: MESH.query_points]
        distance[first] = self._tree.query(x[first])[0]
        # points whose box distance is larger cannot be nearer
        near = np.flatnonzero(distance < distance[first].min())
        distance[near] = self._tree.query(x[near])[0]
        return distance


class SurfacePart[P: (IpcPairs, PenaltyPairs)]:
    """Contact of the surface of a body with itself, or with one obstacle; x (n, d) of the body, m.

    Attributes:
        pairs: barrier or penalty of the points (n + m, d) of the body and of the obstacle.
        reach: distance within which it acts, m.
        mesh: the obstacle; None: the body with itself.
        body_points: (k,) points of the body's elements.
        friction: coefficient.
    """

    def __init__(
        self, pairs: P, elements: Ints, reach: float, friction: float, mesh: MeshObstacle | None = None
    ) -> None:
        """`elements`: (k, d) of the body; they precede those of the obstacle."""
        self.pairs: P = pairs
        self.reach, self.friction, self.mesh = reach, friction, mesh
        self.body_points, self._element_count = np.unique(elements), len(elements)

    def is_far(self, x: Values) -> bool:
        """Whether no point of the body can be in contact with the obstacle."""
        if self.mesh is None:
            return False
        return not len(self.body_points) or self.mesh.is_far(x[self.body_points], self.reach)

    def points(self, x: Values, pose: Pose | None = None) -> Values:
        """(n + m, d) points, with the obstacle at a pose, m; None: the current one."""
        if self.mesh is None:
            return x
        return np.concatenate([x, self.mesh.positions if pose is None else self.mesh.positions_at(pose)])

    def gradient(self, x: Values) -> Values:
        """(n, d) derivatives of the energy by the points of the body, N."""
        return np.zeros_like(x) if self.is_far(x) else self.pairs.gradient(self.points(x))[: len(x)]

    def gap(self, x: Values) -> float:
        """Least distance from the obstacle, m; beyond contact that of vertices."""
        if self.mesh is None or not len(self.body_points):
            return np.inf
        gap = np.inf if self.is_far(x) else self.pairs.min_gap(self.points(x))
        return gap if gap < np.inf else max(self.mesh.vertex_distance(x[self.body_points]), self.reach)

    def cut_elements(self, x: Values) -> Ints:
        """(k,) elements of the body that others of it, or the obstacle, intersect."""
        if self.is_far(x):
            return np.empty(0, np.int64)
        pairs = self.pairs.intersections(self.points(x))
        if self.mesh is not None:
            pairs = pairs[(pairs < self._element_count).sum(axis=1) == 1]
        return np.unique(pairs[pairs < self._element_count])


class BarrierPart(SurfacePart[IpcPairs]):
    """Part with a barrier, and with lagged friction if it is given."""

    @classmethod
    def build(
        cls,
        X: Values,
        elements: Ints,
        mesh: MeshObstacle | None = None,
        *,
        distance: float,
        stiffness: float,
        edge: float,
        friction: float = 0.0,
        share: PairShare | None = None,
    ) -> BarrierPart:
        """Part of a surface.

        Args:
            X: (n, d) reference positions of the body, m.
            elements: (k, d) of the body.
            mesh: the obstacle, whose coefficient of friction counts; None: the body with itself.
            distance: at which contact begins, m.
            stiffness: of the barrier, Pa.
            edge: mean length of edges of the body, m.
            friction: coefficient.
            share: of this rank in the pairs; None: all of them.
        """
        if mesh is None:
            pairs = IpcPairs(
                X, elements, distance=distance, stiffness=stiffness, friction=friction, share=share, edge=edge
            )
            return cls(pairs, elements, distance, friction)
        # the obstacle in its own frame, so that the measures of its elements are constant
        n, m = len(X), len(mesh.points)
        points, triangles = np.concatenate([X, mesh.points]), np.concatenate([elements, mesh.triangles + n])
        # the mean of both bounds the pieces of a motion: an obstacle may be coarser than the body
        edges, patch = np.repeat([edge, mesh.edge], [n, m]), np.repeat(np.array([0, 1], np.int32), [n, m])
        share = None if share is None else share.with_others(m)
        pairs = IpcPairs(
            points, triangles, distance=distance, stiffness=stiffness, friction=mesh.friction, share=share,
            patch=patch, edge=edges,
        )  # fmt: skip
        return cls(pairs, elements, distance, mesh.friction, mesh)

    def energy(self, x: Values) -> float:
        """Energy of the barrier, J."""
        return 0.0 if self.is_far(x) else self.pairs.energy(self.points(x))

    def full_gradient(self, x: Values, friction: IpcFriction | None = None) -> Values:
        """(n + m, d) derivatives of the energy, and of the potential of friction, by all points, N."""
        points = self.points(x)
        gradient = np.zeros_like(points) if self.is_far(x) else self.pairs.gradient(points)
        return gradient if friction is None else gradient + friction.gradient(points)

    def full_hessian(self, x: Values, friction: IpcFriction | None = None, *, exact: bool = False) -> csr_matrix:
        """(n d + m d, n d + m d) second derivatives by all points, N/m; as of IpcPairs."""
        points = self.points(x)
        H = csr_matrix((points.size,) * 2) if self.is_far(x) else self.pairs.hessian(points, exact=exact)
        return H if friction is None else csr_matrix(H + friction.hessian(points, exact=exact))

    def lag_friction(self, x: Values, slip: float) -> IpcFriction | None:
        """Friction of a step that starts at x; None: there is none.

        `slip`: from which on friction has its full size, m.
        """
        if not self.friction or self.is_far(x):
            return None
        friction = self.pairs.lag_friction(points := self.points(x), points, slip)
        return friction if friction.parts else None

    def free_fraction(self, x: Values, end: Values, start_pose: Pose | None = None) -> float:
        """Fraction of the straight motion from x to `end` (n, d) without a collision (collective).

        `start_pose`: pose of the obstacle at the start; it is at the end now.
        """
        if self.mesh is None or start_pose is None:
            return self.pairs.free_fraction(x, end)
        q, motion = start_pose.increment_to(self.mesh.pose), end - x
        if not q[3:].any():
            return self.pairs.free_fraction(self.points(x, start_pose), self.points(end))

        def positions(fraction: float) -> Values:
            return self.points(x + fraction * motion, start_pose.incremented(fraction * q))

        return free_fraction_on_arcs(self.pairs.free_fraction, positions, float(np.linalg.norm(q[3:])))

    def safe_distances(self, x: Values, limit: float) -> Values:
        """(n,) distances that each point of the body may move by itself, m; infinite from `limit` on.

        Of this rank's points.
        """
        collision_mesh = self.pairs.collision_mesh
        vertices, candidates = collision_mesh.vertices(self.points(x)), ipctk.Candidates()
        candidates.build(collision_mesh, vertices, limit, ipctk.LBVH())
        safe = candidates.compute_per_vertex_safe_distances(collision_mesh, vertices, limit)
        distances = np.array(collision_mesh.to_full_dof(np.repeat(safe, 3))[: 3 * len(x) : 3])
        unlimited = np.ones(len(x), bool)
        unlimited[self.body_points] = distances[self.body_points] >= MESH.unlimited * limit
        return np.where(unlimited, np.inf, distances)
