"""Barrier, friction and collision detection between the surface of a body and triangle-mesh obstacles.

The points of an obstacle are no unknowns: x (n, 3) are those of the body, and the force on an obstacle is minus the sum
of its forces on them. Each obstacle has pairs of its own with the body: its friction, its force, its gap.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import ipctk
import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from .clearance import bounding_box
from .ipc_pairs import IpcPairs, PairShare
from .laws import BARRIER
from .pose import Pose, PosedShape
from .sample_points import IpcFriction
from .triangle_mesh_shape import ClosedSurface

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


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
        self.move_to(Pose.at_point(np.zeros(3)))

    def move_to(self, pose: Pose) -> None:
        """Move to a pose; points are computed when they are asked for, as most obstacles are far in most steps."""
        self.pose = pose
        self._positions: Values | None = None
        self._bounds: tuple[Values, Values] | None = None

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


class MeshObstaclePairs:
    """Pairs of a body's surface and one obstacle.

    Points are (n + m, 3): those of the body, then those of the obstacle.

    Attributes:
        mesh: the obstacle.
        body_count: n.
        edge: mean length of edges of the body, m.
        contact: barrier between the elements of both.
    """

    def __init__(
        self,
        rest_positions: Values,
        elements: Ints,
        mesh: MeshObstacle,
        *,
        distance: float,
        stiffness: float,
        edge: float,
        share: PairShare | None = None,
    ) -> None:
        """Pairs of both surfaces.

        Args:
            rest_positions: (n, 3) of the body, m.
            elements: (k, 3) of the body.
            mesh: the obstacle, whose coefficient of friction counts.
            distance: at which contact begins, m.
            stiffness: of the barrier, Pa.
            edge: mean length of edges of the body, m.
            share: of this rank in the pairs; None: all of them.
        """
        self.mesh, self.edge, self._reach = mesh, edge, distance
        self.body_count, self._element_count = len(rest_positions), len(elements)
        self._body_points = np.unique(elements)
        # the obstacle in its own frame, so that the measures of its elements are constant
        points = np.concatenate([rest_positions, mesh.points])
        triangles = np.concatenate([elements, mesh.triangles + len(rest_positions)])
        patches = np.repeat(np.array([0, 1], np.int32), [len(rest_positions), len(mesh.points)])
        parameters = {"distance": distance, "stiffness": stiffness, "friction": mesh.friction}
        share = None if share is None else share.with_others(len(mesh.points))
        # the mean of both bounds the pieces of a motion: an obstacle may be coarser than the body
        edges = np.repeat([edge, mesh.edge], [len(rest_positions), len(mesh.points)])
        self.contact = IpcPairs(points, triangles, **parameters, share=share, patch=patches, edge=edges)

    def with_mesh(self, x: Values) -> Values:
        """(n + m, 3) points of the body at x (n, 3), and of the obstacle at its current pose, m."""
        return np.concatenate([x, self.mesh.positions])

    def is_far(self, x: Values) -> bool:
        """Whether no point of the body at x (n, 3) can be within the barrier."""
        return not len(self._body_points) or self.mesh.is_far(x[self._body_points], self._reach)

    def body_gradient(self, x: Values) -> Values:
        """(n, 3) dE/dx with the body at x (n, 3), N: minus the forces of the obstacle on the body."""
        return self.full_gradient(x)[: self.body_count]

    def full_gradient(self, x: Values) -> Values:
        """(n + m, 3) dE/dx by the points of the body and of the obstacle, N."""
        points = self.with_mesh(x)
        return np.zeros_like(points) if self.is_far(x) else self.contact.gradient(points)

    def moving_free_fraction(self, x: Values, end: Values, start_pose: Pose) -> float:
        """Fraction of the motions of body and obstacle without a collision.

        Args:
            x: (n, 3) points of the body at the start, m.
            end: (n, 3) points of the body at the end of their straight motion, m.
            start_pose: pose of the obstacle at the start; it is at the end now.
        """
        end_pose, q, motion = self.mesh.pose, start_pose.increment_to(self.mesh.pose), end - x
        if not q[3:].any():
            return self.contact.free_fraction(self._points_at(x, start_pose), self._points_at(end, end_pose))

        def positions(fraction: float) -> Values:
            return self._points_at(x + fraction * motion, start_pose.incremented(fraction * q))

        return free_fraction_on_arcs(self.contact.free_fraction, positions, float(np.linalg.norm(q[3:])))

    def _points_at(self, x: Values, pose: Pose) -> Values:
        return np.concatenate([x, self.mesh.positions_at(pose)])

    def cut_elements(self, x: Values) -> Ints:
        """(k,) elements of the body at x (n, 3) that the obstacle intersects."""
        if self.is_far(x):
            return np.empty(0, np.int64)
        pairs = np.sort(self.contact.intersections(self.with_mesh(x)), axis=1)
        of_both = (pairs[:, 0] < self._element_count) & (pairs[:, 1] >= self._element_count)
        return np.unique(pairs[of_both, 0])

    def gap(self, x: Values) -> float:
        """Least distance with the body at x (n, 3), m; beyond the barrier that of vertices."""
        if not len(self._body_points):
            return float("inf")
        gap = float("inf") if self.is_far(x) else self.contact.min_gap(self.with_mesh(x))
        return gap if gap < float("inf") else max(self.mesh.vertex_distance(x[self._body_points]), self._reach)

    def safe_distances(self, x: Values, limit: float) -> Values:
        """(n,) distances that each point of the body at x (n, 3) may move by itself, m; infinite from `limit` on.

        Of this rank's points.
        """
        collision_mesh = self.contact.collision_mesh
        vertices, candidates = collision_mesh.vertices(self.with_mesh(x)), ipctk.Candidates()
        candidates.build(collision_mesh, vertices, limit, ipctk.LBVH())
        safe = candidates.compute_per_vertex_safe_distances(collision_mesh, vertices, limit)
        distances = np.array(collision_mesh.to_full_dof(np.repeat(safe, 3))[: 3 * self.body_count : 3])
        unlimited = np.ones(self.body_count, bool)
        unlimited[self._body_points] = distances[self._body_points] >= MESH.unlimited * limit
        return np.where(unlimited, np.inf, distances)


class AllMeshPairs:
    """Pairs of a body's surface and several obstacles; x (n, 3) of the body, m.

    Attributes:
        pairs: of each obstacle.
    """

    def __init__(self, pairs: Sequence[MeshObstaclePairs]) -> None:
        self.pairs = pairs

    def select(self, numbers: Sequence[int]) -> AllMeshPairs:
        """Pairs of some of the obstacles."""
        return AllMeshPairs([self.pairs[number] for number in numbers])

    def _near(self, x: Values) -> Sequence[MeshObstaclePairs]:
        return [pairs for pairs in self.pairs if not pairs.is_far(x)]

    def energy(self, x: Values) -> float:
        """Energy E, J."""
        return sum(pairs.contact.energy(pairs.with_mesh(x)) for pairs in self._near(x))

    def gradient(self, x: Values) -> Values:
        """(n, 3) dE/dx, N."""
        return np.sum([pairs.body_gradient(x) for pairs in self.pairs], axis=0)

    def hessian(self, x: Values, *, exact: bool = False) -> csr_matrix:
        """(3 n, 3 n) d2E/dx2, N/m; as for IpcPairs."""
        H, size = csr_matrix((x.size, x.size)), x.size
        for pairs in self._near(x):
            H = H + pairs.contact.hessian(pairs.with_mesh(x), exact=exact)[:size, :size]
        return csr_matrix(H)

    def set_stiffness(self, stiffness: float) -> None:
        """Set the stiffness of the barriers, Pa."""
        for pairs in self.pairs:
            pairs.contact.set_stiffness(stiffness)

    def clear_caches(self) -> None:
        """Discard the candidates of collision detection."""
        for pairs in self.pairs:
            pairs.contact.clear_caches()

    def min_gap(self, x: Values) -> float:
        """Least distance within the barrier, m; infinite where there is none."""
        return min((pairs.contact.min_gap(pairs.with_mesh(x)) for pairs in self._near(x)), default=np.inf)

    def moving_free_fraction(self, x: Values, end: Values, start_poses: Sequence[Pose]) -> float:
        """Fraction of the motions of body and obstacles without a collision; obstacles come from `start_poses`."""
        items = zip(self.pairs, start_poses, strict=True)
        return min((pairs.moving_free_fraction(x, end, pose) for pairs, pose in items), default=1.0)

    def lag_friction(self, x: Values, start: Values, slip: float) -> MeshFriction:
        """Friction with pressures and tangents at x and obstacles at their current poses; as of IpcPairs."""
        rubbing = [pairs for pairs in self._near(x) if pairs.mesh.friction]
        friction = [pairs.contact.lag_friction(pairs.with_mesh(x), pairs.with_mesh(start), slip) for pairs in rubbing]
        return MeshFriction(rubbing, friction)


@dataclass(frozen=True)
class MeshFriction:
    """Lagged friction with several obstacles; x (n, 3) of the body, m.

    Attributes:
        pairs: of obstacles with friction.
        friction: of each.
    """

    pairs: Sequence[MeshObstaclePairs]
    friction: list[IpcFriction]

    def energy(self, x: Values) -> float:
        """Potential, J; as of IpcFriction."""
        return sum(
            friction.energy(pairs.with_mesh(x)) for pairs, friction in zip(self.pairs, self.friction, strict=True)
        )

    def full_gradient(self, pairs: MeshObstaclePairs, x: Values) -> Values:
        """(n + m, 3) derivatives of the friction with one obstacle by the points of both, N."""
        points, friction = pairs.with_mesh(x), self.friction_with(pairs)
        return np.zeros_like(points) if friction is None else friction.gradient(points)

    def friction_with(self, pairs: MeshObstaclePairs) -> IpcFriction | None:
        """Friction with one obstacle; None: without friction."""
        items = zip(self.pairs, self.friction, strict=True)
        return next((friction for item_pairs, friction in items if item_pairs is pairs), None)

    def gradient(self, x: Values) -> Values:
        """(n, 3) derivatives by the points of the body, N."""
        gradients = (self.full_gradient(pairs, x)[: len(x)] for pairs in self.pairs)
        return np.sum([np.zeros_like(x), *gradients], axis=0)

    def hessian(self, x: Values, *, exact: bool = False) -> csr_matrix:
        """(3 n, 3 n) second derivatives by the points of the body, N/m."""
        H, size = csr_matrix((x.size, x.size)), x.size
        for pairs, friction in zip(self.pairs, self.friction, strict=True):
            H = H + friction.hessian(pairs.with_mesh(x), exact=exact)[:size, :size]
        return csr_matrix(H)
