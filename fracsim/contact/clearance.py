"""Searches for what is near obstacles, whose results hold for many steps.

Candidates: points and facets of a surface that may be near an obstacle, searched again only after large motions (L.
Verlet 1967, Computer "experiments" on classical fluids I, Physical Review 159, 98: lists of neighbours).

Clearance: a bound of the distance between a body and obstacles; nothing is searched while all is far. A search
measures the gaps g_0 between points of the surface and an obstacle, at displacements u_0 and a pose (c_0, R_0). Since
then a gap has lost at most

    A s + |c - c_0| + ||R - R_0|| r,    A = max_p sum_a |w_pa|,  s = max_a |u_a - u_0a|

Proof: x_p = X_p + sum_a w_pa u_a moves by at most A s; a point of the obstacle is at most r from c; and the distance
between a point and a set changes by no more than both move. Where rotations may change, g_0 is the distance from the
sphere of radius r around c, and the last part is zero for any rotation. A point of a facet with edges up to L is at
most L / sqrt(3) from its nearest corner, and L grows by at most 2 A s.

The smallest gap, for output, is that of one of the points with g_0 <= min g_0 + 2 loss: few of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from operator import le
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI
from scipy.sparse import csr_matrix

from ..array_types import Ints, Values
from ..mesh.domain import Domain
from ..mesh.split_surface.local_surface import NodeExchange
from .obstacle import RigidObstacle
from .pose import Pose, PosedShape

if TYPE_CHECKING:
    from .mesh_obstacles import MeshObstacle  # with ipctk


type Motion = tuple[PosedShape, PosedShape]  # an obstacle at its start and its end


@dataclass(frozen=True)
class ClearancePolicy:
    """Tuned numbers of searches, in mean edges of the mesh.

    Attributes:
        min_clearance: clearance below which an obstacle counts as near, so that searches stay rare.
        surplus: of the gaps of points that are kept for the smallest gap.
    """

    min_clearance: float = 0.1
    surplus: float = 4.0


CLEARANCE = ClearancePolicy()


# --- candidates ---


def bounding_box(x: Values) -> tuple[Values, Values]:
    """(d,) lowest and highest coordinates of points (n, d), m.

    By columns: minima along the first axis take twenty times as long.
    """
    columns = x.T
    return np.array([column.min() for column in columns]), np.array([column.max() for column in columns])


def outline_radius(posed: PosedShape) -> float:
    """Bound of the radius of a shape about its reference point, m; of a half space that of its patch: it never turns.

    The tessellation lies within its shape, by less than a tenth of the radius.
    """
    points, _ = posed.shape.tessellate()
    return 1.1 * float(np.linalg.norm(points, axis=1).max())


@dataclass(frozen=True)
class ProximitySearch:
    """Result of a search, and where it was made.

    Attributes:
        x: (n, d) points then, m.
        posed: obstacle then.
        distance: of what was asked for, m.
        margin: by which what is farther away was found as well, m.
        near: (k,) points or facets found.
        radius: of the shape about its reference point, m.
    """

    x: Values
    posed: PosedShape
    distance: float
    margin: float
    near: Ints
    radius: float

    def is_valid(self, posed: PosedShape, motion: float, distance: float) -> bool:
        """Whether nothing within that distance, m, can be missing; `motion`: largest of the points since then, m.

        A distance changes by no more than the point moves, |t| of the obstacle, and ||R - R_0|| times its radius.
        """
        pose, old_pose = posed.pose, self.posed.pose
        rotation = float(np.linalg.norm(pose.rotation - old_pose.rotation))
        obstacle_motion = float(np.linalg.norm(pose.centre - old_pose.centre)) + (rotation and rotation * self.radius)
        return distance - self.distance + motion + obstacle_motion <= self.margin


class ProximityCandidates:
    """Points, or facets, of a surface that may be near obstacles."""

    def __init__(self, margin: float, corners: Ints | None = None) -> None:
        """Candidates of a surface.

        Args:
            margin: motion, m, after which all are searched again.
            corners: (m, c) points of facets; None: points are searched for.
        """
        self._least_margin, self._corners = margin, corners
        self._searches: dict[int, ProximitySearch] = {}
        self._motion: tuple[Values, ProximitySearch, float] | None = None  # the last that was computed
        self._balls: tuple[Values, Values, Values] | None = None  # points, and centroids and radii of facets

    def __call__(self, posed: PosedShape, x: Values, distance: float) -> Ints:
        """(k,) those nearer than `distance`, m, to an obstacle, with points at x (n, d), m; others too, ascending."""
        last = self._searches.get(id(posed.shape))
        is_known = last is not None and last.posed.shape is posed.shape and last.x.shape == x.shape
        if last is None or not is_known or not last.is_valid(posed, self._max_motion(last, x), distance):
            last = self._searches[id(posed.shape)] = self._search(posed, x, distance)
        return last.near

    def _max_motion(self, last: ProximitySearch, x: Values) -> float:
        """Largest motion of points since a search, m."""
        if self._motion is None or self._motion[0] is not x or self._motion[1] is not last:
            motion = x - last.x
            self._motion = x, last, float(np.sqrt(np.einsum("nd,nd->n", motion, motion).max(initial=0.0)))
        return self._motion[2]

    def _search(self, posed: PosedShape, x: Values, distance: float) -> ProximitySearch:
        margin, bound = max(self._least_margin, distance), posed.distance_bound(x)
        if bound > distance + margin:  # all are far
            return ProximitySearch(x, posed, distance, bound - distance, np.empty(0, np.int64), outline_radius(posed))
        if self._corners is None:
            gap = posed.distance(x)
        else:
            centroid, radius = self._bounding_balls(x)
            margin = max(float(radius.mean()) if len(radius) else 0.0, margin)
            gap = posed.distance(centroid) - radius
        near = np.flatnonzero(gap < distance + margin)
        return ProximitySearch(x, posed, distance, margin, near, outline_radius(posed))

    def _bounding_balls(self, x: Values) -> tuple[Values, Values]:
        """(m, d) centroids of the facets, and (m,) greatest distances of their corners from them, m."""
        if self._balls is None or self._balls[0] is not x:
            assert self._corners is not None
            corners = [x[points] for points in self._corners.T]
            centroid = sum(corners[1:], corners[0]) / len(corners)
            squares = [np.einsum("kd,kd->k", arm, arm) for arm in (corner - centroid for corner in corners)]
            self._balls = x, centroid, np.sqrt(np.maximum.reduce(squares))
        return self._balls[1:]


# --- clearance ---


class ShapeDistance:
    """Distance of points from an analytic obstacle at a pose.

    Attributes:
        radius: r, m.
        rotates: whether its rotation may change.
        max_error: by how much distances may be too large, m.
    """

    max_error = 0.0

    def __init__(self, obstacle: RigidObstacle) -> None:
        self.rotates = obstacle.free or obstacle.spin is not None
        self.radius = outline_radius(obstacle.posed_at(0.0))

    def distance(self, posed: PosedShape, x: Values) -> Values:
        """(n,) distances of points x (n, d), m."""
        return posed.distance(x)

    # (n,) lower bounds of the distances; the least one is exact
    lower_bounds = distance


@dataclass(frozen=True)
class FollowingPoints:
    """Points of a surface on this rank, which follow nodes: x = X + sum_a w_a u_a.

    Attributes:
        reference: (n, d) X, m.
        weights: (n, k) w.
        nodes: (k,) global numbers.
        facets: (m, c) points of facets that touch between their corners; none where points touch alone.
        may_stay: whether a step may leave the surface as it is: no point or facet is retracted or left out.
    """

    reference: Values
    weights: csr_matrix
    nodes: Ints
    facets: Ints
    may_stay: bool = True

    def select(self, rows: Ints) -> FollowingPoints:
        """Some of the points, without facets."""
        return replace(self, reference=self.reference[rows], weights=self.weights[rows], facets=self.facets[:0])

    def positions(self, nodal: Values, count: int | None = None) -> Values:
        """(count, d) positions of the first points for values (k, d) at the nodes, m; None: of all."""
        return np.asarray(self.reference[:count] + self.weights[:count] @ nodal)

    def amplification(self) -> float:
        """A: largest motion of a point where no node moves by more than 1."""
        return float(abs(self.weights).sum(axis=1).max()) if len(self.reference) else 0.0

    def longest_edge(self, x: Values) -> float:
        """L: longest edge of the facets with points at x (n, d), m."""
        if not self.facets.size:
            return 0.0
        corners = [x[column] for column in self.facets.T]
        sides = [a - b for a, b in zip(corners, corners[1:] + corners[:1], strict=True)]
        return float(np.sqrt(max(np.einsum("md,md->m", side, side).max() for side in sides)))


@dataclass(frozen=True)
class GapSearch:
    """Gaps at the search, and what may be lost of them.

    Attributes:
        u: (nodes, d) u_0 of the nodes of this rank's points, m.
        hidden_u: (owned dofs,) u_0 where not all that counts is among the points; None: it is.
        poses: c_0 and R_0 of each obstacle.
        min_gaps: (obstacles,) least g_0 on all ranks, m.
        clearance: (obstacles,) loss that leaves nothing near, m; at most 0: the obstacle is near.
        amplification: A.
        growth: loss of the gaps of points and facets by a motion of 1.
        nearest: lower bounds of g_0, ascending, m, and points of this rank that may be nearest to each obstacle.
        nodal_values: values at the nodes of this rank's points.
    """

    u: Values
    hidden_u: Values | None
    poses: Sequence[Pose]
    min_gaps: Values
    clearance: list[float]
    amplification: float
    growth: float
    nearest: Sequence[tuple[Values, FollowingPoints]]
    nodal_values: NodeExchange


class Clearance:
    """Whether nothing of a body is near any of some obstacles, and its least distance from each (HistoryTerm)."""

    _search: GapSearch | None = None
    # last displacement that was looked at, and the nodal values and their largest motion since the search
    _latest: tuple[Values, Values, float] | None = None

    def __init__(
        self,
        domain: Domain,
        obstacles: Sequence[ShapeDistance | MeshObstacle],
        reach: float,
        points: Callable[[], FollowingPoints],
        hidden: Callable[[Values, Sequence[PosedShape]], Sequence[float]] | None = None,
    ) -> None:
        """Begin without a search.

        Args:
            domain: mesh.
            obstacles: distances from these.
            reach: distance below which a point or facet counts as near, m.
            points: function that returns the points of this rank.
            hidden: function of displacements (owned dofs,), m, and obstacles that returns bounds, m, of the distances
                from each of them of what is not among these points.
        """
        self._domain, self._comm, self._edge = domain, domain.comm, domain.mean_edge_length
        self._obstacles, self._reach, self._points, self._hidden = obstacles, reach, points, hidden

    def discard(self) -> None:
        """Discard the search, as the surface has changed: on all ranks."""
        if self._search is not None:
            self._search.nodal_values.destroy()
        self._search = self._latest = None

    # --- tests ---

    def is_far(self, displacements: Sequence[Values], motions: Sequence[Motion]) -> bool:
        """Whether nothing of the body can be near an obstacle (collective).

        Args:
            displacements: (owned dofs,) of the body, m; those between them count as well.
            motions: obstacles at the start and the end of their motions.
        """
        if self._search is not None:
            search = self._search
            if self._remains_far(search, displacements, motions):
                return True
            # What is near stays so until it has moved by as much as it lacks. Bounds of losses are many times as large
            # as motions, and a search in each iterate costs more than contact.
            moved, min_clearance = self._largest_motion(search, displacements), CLEARANCE.min_clearance * self._edge
            for room, of_pose in zip(search.clearance, _pose_motions(search, motions), strict=True):
                if room == -np.inf or (room <= 0 and moved + of_pose <= min(min_clearance - room, self._edge)):
                    return False
        search = self._measure(displacements[-1], [end for _, end in motions])
        return self._remains_far(search, displacements, motions)

    def least_gap(self, number: int, u: Values, posed: Sequence[PosedShape]) -> float:
        """Least distance of this rank's points from an obstacle, m; infinite where others are nearer (collective).

        Args:
            number: of the obstacle.
            u: (owned dofs,) displacement, m. An array that `is_far` was asked about must not have changed since.
            posed: all obstacles.
        """
        search, loss, obstacle = self._search, np.inf, self._obstacles[number]
        if search is not None:
            loss = search.amplification * self._node_motion(search, u)[1]
            loss += _pose_motion(search.poses[number], posed[number].pose, obstacle.radius)
        if search is None or loss > 0.5 * CLEARANCE.surplus * self._edge:
            search, loss = self._measure(u, posed), 0.0
        (gaps, points), (nodal, _) = search.nearest[number], self._node_motion(search, u)
        if not (count := int(gaps.searchsorted(search.min_gaps[number] + 2 * loss, "right"))):
            return np.inf
        return float(obstacle.distance(posed[number], points.positions(nodal, count)).min())

    def _remains_far(self, search: GapSearch, displacements: Sequence[Values], motions: Sequence[Motion]) -> bool:
        """Whether no gap can have lost its clearance since the search (collective)."""
        of_body = search.growth * self._largest_motion(search, displacements)
        losses = [of_body + of_pose for of_pose in _pose_motions(search, motions)]
        return all(map(le, losses, search.clearance))

    def _largest_motion(self, search: GapSearch, displacements: Sequence[Values]) -> float:
        """Bound of the motion of any node since the search, m (collective)."""
        return max([self._node_motion(search, u)[1] for u in displacements])

    def _node_motion(self, search: GapSearch, u: Values) -> tuple[Values, float]:
        """(nodes, d) values at the nodes of this rank's points, and a bound of the motion of any node, m (collective).

        The bound is sqrt(d) times the largest component, which takes a tenth of the time of the largest length.
        """
        if self._latest is None or self._latest[0] is not u:
            nodal = search.nodal_values(u)
            largest = _largest_component(nodal - search.u)
            if search.hidden_u is not None:
                largest = max(largest, _largest_component(u - search.hidden_u))
            if self._comm.size > 1:
                largest = self._comm.allreduce(largest, op=MPI.MAX)
            self._latest = u, nodal, float(np.sqrt(self._domain.dim)) * largest
        return self._latest[1:]

    # --- searches ---

    def _measure(self, u: Values, posed: Sequence[PosedShape]) -> GapSearch:
        """Measure the gaps of all points (collective)."""
        self.discard()
        points, obstacles, count = self._points(), self._obstacles, len(posed)
        nodal_values = NodeExchange(self._domain, points.nodes)
        nodal = nodal_values(u).copy()
        x = points.positions(nodal)
        placed = list(zip(obstacles, posed, strict=True))
        gaps = [obstacle.lower_bounds(shape, x) if len(x) else np.empty(0) for obstacle, shape in placed]
        spheres = [
            np.linalg.norm(x - shape.pose.centre, axis=1) - obstacle.radius if obstacle.rotates else of_obstacle
            for (obstacle, shape), of_obstacle in zip(placed, gaps, strict=True)
        ]
        hidden = [np.inf] * count if self._hidden is None else self._hidden(u, posed)
        minima = [values.min(initial=np.inf) for values in gaps]
        minima += [g.min(initial=np.inf) - obstacle.max_error for g, obstacle in zip(spheres, obstacles, strict=True)]
        room = np.inf if points.may_stay else -np.inf
        bounds = np.array([*minima, *hidden, -points.amplification(), -points.longest_edge(x), room])
        self._comm.Allreduce(MPI.IN_PLACE, bounds, MPI.MIN)
        min_gaps, sphere, of_hidden = bounds[: 3 * count].reshape(3, count)
        amplification, edge, room = -bounds[-3], -bounds[-2], bounds[-1]
        clearance = np.minimum(np.minimum(sphere - edge / np.sqrt(3), of_hidden) - self._reach, room)
        clearance = np.where(clearance > CLEARANCE.min_clearance * self._edge, clearance, np.minimum(clearance, 0.0))
        growth = amplification * (1 + 2 / np.sqrt(3)) if edge else amplification
        surplus = CLEARANCE.surplus * self._edge
        nearest = []
        for bound, min_gap in zip(gaps, min_gaps, strict=True):
            near = np.flatnonzero(bound <= min_gap + surplus)
            near = near[np.argsort(bound[near], kind="stable")]
            nearest.append((bound[near], points.select(near)))
        hidden_u = u.copy() if np.isfinite(of_hidden).any() else None
        poses, limits = [shape.pose for shape in posed], [float(limit) for limit in clearance]
        self._search = GapSearch(nodal, hidden_u, poses, min_gaps, limits, amplification, growth, nearest, nodal_values)
        return self._search

    # --- state: the surface may have been another one in the snapshot (HistoryTerm) ---

    def snapshot(self) -> object:
        """Result of the last search."""
        return self._search

    def restore(self, memory: object) -> None:
        """Discard the search unless it is that of the snapshot (not collective)."""
        if memory is not self._search:
            self.discard()

    def to_checkpoint(self) -> dict[str, Values]:
        """No arrays."""
        return {}

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Discard the search."""
        self.discard()


def _largest_component(vectors: Values) -> float:
    return max(float(vectors.max(initial=0.0)), -float(vectors.min(initial=0.0)))


def _pose_motions(search: GapSearch, motions: Sequence[Motion]) -> list[float]:
    """(obstacles,) motions of the centres since the search, m."""
    return [
        max(_pose_motion(pose, start.pose, 0.0), _pose_motion(pose, end.pose, 0.0))
        for pose, (start, end) in zip(search.poses, motions, strict=True)
    ]


def _pose_motion(start: Pose, end: Pose, radius: float) -> float:
    """Bound of the motion of the points of an obstacle of a radius, m, from one pose to another, m."""
    if end is start:
        return 0.0
    moved = float(np.linalg.norm(end.centre - start.centre))
    return moved + radius * float(np.linalg.norm(end.rotation - start.rotation)) if radius else moved
