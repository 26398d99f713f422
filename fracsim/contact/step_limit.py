"""Step limits of points and facets before obstacles, first guesses, and the motion of obstacles in a step.

Conservative advancement: from a gap g a point may move on by (g - g_min) / speed, where the speed bounds how fast its
gap closes. First guesses that would cross an obstacle are stopped in front of it. Obstacles that would crush a jammed
body are held, and advance as far as the body allows.

Equations: docs/theory.md#step-limits.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ..array_types import Flags, Ints, Values
from ..mesh.parallel import max_over_ranks, sum_over_ranks
from .clearance import ProximityCandidates
from .closest_point import FacetClosestPoints, find_closest_points
from .contact_surface import ContactSurface
from .facet_contact import ContactFacets
from .laws import BARRIER
from .pose import Pose, PosedShape, rotate_vectors
from .shape_base import lengths

if TYPE_CHECKING:
    from .mesh_obstacles import BarrierPart
    from .self_contact import BarrierBodySurface


@dataclass(frozen=True)
class StepLimitPolicy:
    """Tuned numbers of step limits.

    Attributes:
        max_iterations: of conservative advancement. Each ends with safe fractions.
        min_progress: relative change of a fraction at which the advancement ends.
        closest_point_tolerance: remaining derivative by barycentric coordinates, in smoothings mu, on the way.
        reach: points nearer to an obstacle than this times their motion are looked at.
        max_rounds: rounds in which points that depend on several nodes are stopped before obstacles.
        min_weight: sum of weights of stopped points from which on a node is moved back.
        mesh_rounds: like max_rounds, before triangle meshes.
        max_pieces: pieces of a motion before triangle meshes, each of an edge's length.
        search_margin: factor of the search distance for safe motions before triangle meshes.
        max_search_edges: largest search distance for these, in edges.
    """

    max_iterations: int = 50
    min_progress: float = 1e-3
    closest_point_tolerance: float = 1e-4
    reach: float = 1.2
    max_rounds: int = 20
    min_weight: float = 1e-3
    mesh_rounds: int = 5
    max_pieces: int = 50
    search_margin: float = 1.01
    max_search_edges: float = 2.0


LIMITS = StepLimitPolicy()


def safe_fractions(gap: Callable[[Values], Values], speed: Callable[[Values], Values], count: int) -> Values:
    """(count,) fractions in (0, 1] of a motion that leave `BARRIER.min_gap_ratio` of every gap all along the way.

    Args:
        gap: fractions (n,) -> gaps (n,) there, m, obstacles having moved by the same fractions.
        speed: fractions (n,) -> bounds (n,) of the closing speed from there to the end, m per whole motion.
        count: n.

    Raises:
        ValueError: if a gap is closed at the start.
    """
    fraction = np.zeros(count)
    distance = gap(fraction)
    if not (distance > 0).all():
        raise ValueError(f"{int((~(distance > 0)).sum())} gaps are closed before the motion: no share of it is safe")
    min_gap = BARRIER.min_gap_ratio * distance
    for _ in range(LIMITS.max_iterations):
        # round-off may put a gap just below its minimum: no step back
        excess = np.maximum(distance - min_gap, 0)
        advance = excess / np.maximum(np.maximum(speed(fraction), excess), np.finfo(float).tiny)
        fraction = np.minimum(fraction + advance, 1.0)
        if ((fraction == 1) | (advance < LIMITS.min_progress * fraction)).all():
            break
        distance = gap(fraction)
    return fraction


@dataclass(frozen=True, eq=False)
class PointMotion:
    """Motion of points, straight or carried by a body, and of an obstacle whose pose is incremented by s q.

    s is the fraction of the motion.

    Attributes:
        obstacle: at the start.
        x: (n, d) points at the start, m.
        motion: (n, d) of the points, m.
        increment: (p,) q.
        carrier: (d,) centre, m, and (r,) rotation, rad, of a body that turns the points about it; None: nothing does.
    """

    obstacle: PosedShape
    x: Values
    motion: Values
    increment: Values
    carrier: tuple[Values, Values] | None = None

    def safe_fraction(self) -> float:
        """Fraction of the motion that leaves a tenth of each gap; 0 where one is closed."""
        if not len(self.x):
            return 1.0
        if not (self.gap(np.zeros(len(self.x))) > 0).all():
            return 0.0
        return float(safe_fractions(self.gap, self.speed, len(self.x)).min())

    def gap(self, fraction: Values) -> Values:
        """(n,) distances after fractions (n,) of the motion, m."""
        return self.obstacle.shape.distance(self._body_positions(fraction))

    def speed(self, fraction: Values) -> Values:
        """(n,) bounds of the closing speed from `fraction` to the end, m per whole motion.

        Relative to the centre a point moves straight, by v. The distance to a convex body lies above its tangent
        plane: a gap loses at most -n . v, n its normal at `fraction`. So a point that slides along a plane may move
        on. The distance to a hollow body is Lipschitz alone: |v|. A rotation by w adds |w| times the distance from
        the centre, that of the points as well as that of the obstacle.
        """
        v = self._relative
        if self.obstacle.shape.convex:
            n = self.obstacle.shape.normal(self._body_positions(fraction))
            closing = np.maximum(-np.einsum("ni,ni->n", n, self._to_body(v, fraction)), 0)
        else:
            closing = np.linalg.norm(v, axis=1)
        return closing + self._rotation_speed

    @cached_property
    def _relative(self) -> Values:
        return self.motion - self.increment[: self.obstacle.pose.dim]

    @cached_property
    def _rotation(self) -> Values:
        return self.increment[self.obstacle.pose.dim :]

    @cached_property
    def _rotation_speed(self) -> Values:
        """(n,) |w| times the largest distance from the centre on the way; of points that move straight at an end."""
        angle = np.linalg.norm(self._rotation)
        if self.carrier is None:
            ends = [np.linalg.norm(self._from_centre(np.full(len(self.x), end)), axis=1) for end in (0.0, 1.0)]
            return np.asarray(angle * np.maximum(*ends))
        centre, rotation = self.carrier
        radius, between = np.linalg.norm(self.x - centre, axis=1), np.linalg.norm(centre - self.obstacle.pose.centre)
        farthest = between + np.linalg.norm(self._relative, axis=1) + radius
        return np.asarray(np.linalg.norm(rotation) * radius + angle * farthest)

    def _body_positions(self, fraction: Values) -> Values:
        """(n, d) points in the frame of the obstacle; cached, as gap and speed need the same ones."""
        cached = vars(self).get("cached")
        if cached is None or cached[0] is not fraction:
            cached = vars(self)["cached"] = fraction, self._to_body(self._from_centre(fraction), fraction)
        return cached[1]

    def _from_centre(self, fraction: Values) -> Values:
        x = self.x
        if self.carrier is not None:
            centre, rotation = self.carrier
            x = centre + rotate_vectors(x - centre, fraction[:, None] * rotation)
        return np.asarray(x - self.obstacle.pose.centre + fraction[:, None] * self._relative)

    def _to_body(self, vectors: Values, fraction: Values) -> Values:
        """(n, d) vectors in the frame that the obstacle has at each fraction."""
        return np.asarray(rotate_vectors(vectors, -fraction[:, None] * self._rotation) @ self.obstacle.pose.rotation)


class FacetMotion:
    """Motion of facets past a convex obstacle that rotates.

    On the way closest points are found with a coarse tolerance: L (closest_point) lies above its tangent plane at any
    point. The obstacle stays where it was, and corners move relative to it.
    """

    def __init__(self, closest: FacetClosestPoints, relative: Values, rotation: Values) -> None:
        """Motion of facets.

        Args:
            closest: closest points at the start.
            relative: (k, c, d) straight motion of the corners relative to the obstacle, m.
            rotation: (r,) of the obstacle, rad.
        """
        self._start, self._relative, self._rotation = closest.x, relative, rotation
        self._fraction: Values = np.zeros(len(closest.x))
        self._closest = closest
        self._centre, self._angle = closest.posed.pose.centre, float(np.linalg.norm(rotation))

    @property
    def count(self) -> int:
        """Number k of facets."""
        return len(self._start)

    def select(self, facets: Ints) -> FacetMotion:
        """Motion of some of the facets, at the start."""
        closest = self._closest
        return FacetMotion(closest.select(facets), self._relative[facets], self._rotation)

    def _closest_at(self, fraction: Values) -> FacetClosestPoints:
        if not np.array_equal(fraction, self._fraction):
            x, closest = self._start + fraction[:, None, None] * self._relative, self._closest
            if self._angle:
                x = self._centre + self._rotated_back(x - self._centre, fraction)
            self._fraction, tolerance = fraction.copy(), LIMITS.closest_point_tolerance
            self._closest = find_closest_points(closest.posed, x, closest.smoothing, closest.barycentric, tolerance)
        return self._closest

    def _rotated_back(self, vectors: Values, fraction: Values) -> Values:
        """(k, c, d) vectors relative to the obstacle at each fraction, in the axes that it had at the start."""
        (k, c, d), w = vectors.shape, -fraction[:, None] * self._rotation
        return rotate_vectors(vectors.reshape(-1, d), np.repeat(w, c, axis=0)).reshape(k, c, d)

    def gap(self, fraction: Values) -> Values:
        """(k,) lower bounds of gaps after fractions (k,) of the motion, m."""
        closest = self._closest_at(fraction)
        return closest.gap + np.minimum(closest.corner_rise.min(axis=1), 0.0)

    def speed(self, fraction: Values) -> Values:
        """(k,) bounds of the closing speed from `fraction` to the end, m per whole motion.

        A corner is above the tangent plane by its rise: if it approaches by v, the facet may move on by the fraction
        (gap + rise) / v. A rotation by w adds |w| times the distance from the centre.
        """
        closest, gap = self._closest_at(fraction), np.maximum(self.gap(fraction), np.finfo(float).tiny)[:, None]
        v = self._rotated_back(self._relative, fraction) if self._angle else self._relative
        closing = np.maximum(-np.einsum("kcd,kd->kc", v, closest.normal), 0.0)
        if self._angle:
            closing += self._angle * self._max_distance()
        height = np.maximum(closest.gap[:, None] + closest.corner_rise, gap)
        return np.asarray((closing * gap / height).max(axis=1))

    def _max_distance(self) -> Values:
        """(k, c) largest distance of corners from the centre on the way, which is at one of its ends, m."""
        ends = self._start - self._centre, self._start - self._centre + self._relative
        return np.maximum(*(np.linalg.norm(end, axis=2) for end in ends))


# obstacle at the start, increment (p,) of its pose, and facets on which it acts
type ObstacleMotion = tuple[PosedShape, Values, ContactFacets | None]


def safe_motion_fractions(
    posed: PosedShape,
    x: Values,
    motion: Values,
    q: Values,
    facets: ContactFacets | None = None,
    candidates: ProximityCandidates | None = None,
    min_gap: float = 0.0,
) -> Values:
    """(n,) fractions in [0, 1] of motions that leave a tenth of each gap to an obstacle; 0 where a gap is closed.

    Args:
        posed: obstacle at the start.
        x: (n, d) points at the start, m.
        motion: (n, d) of the points, m.
        q: (p,) increment of the obstacle's pose.
        facets: facets on which the obstacle acts; corners get the fractions of their facets as well.
        candidates: search for points near the obstacle; None: all are tested.
        min_gap: lower bound of all gaps at the start, m.
    """
    rotation = (q := posed.effective_increment(q))[posed.pose.dim :]
    relative = motion - q[: posed.pose.dim]
    reach, rotation_motion = lengths(relative), None
    if rotation.any():
        rotation_motion = np.linalg.norm(rotation) * (np.linalg.norm(x - posed.pose.centre, axis=1) + reach)
        reach = reach + rotation_motion
    max_reach, fraction = LIMITS.reach * float(reach.max(initial=0.0)), np.ones(len(x))
    if max_reach < min_gap:
        return fraction
    if candidates is not None:
        tested = candidates(posed, x, max_reach)
    elif posed.distance_bound(x) > max_reach:
        return fraction
    else:
        tested = np.arange(len(x))
    gap = posed.distance(x[tested])
    fraction[tested[gap <= 0]] = 0.0
    near = tested[(gap > 0) & (gap < LIMITS.reach * reach[tested])]
    if len(near):
        points = PointMotion(posed, x[near], motion[near], q)
        fraction[near] = safe_fractions(points.gap, points.speed, len(near))
    if facets is not None:
        near = facets.closing_facets(posed, x, relative, rotation_motion, LIMITS.reach * reach)
        if len(near):
            closest, corners = facets.closest_points(posed, x, near), facets.corners[near]
            facet_fraction = _facet_fractions(FacetMotion(closest, relative[corners], rotation))
            np.minimum.at(fraction, corners, facet_fraction[:, None])
    return fraction


def _facet_fractions(facets: FacetMotion) -> Values:
    """(k,) fractions of the motions of facets that leave a tenth of their gaps."""
    gap = facets.gap(np.zeros(facets.count))
    fraction, is_open = np.zeros(len(gap)), np.flatnonzero(gap > 0)
    if len(is_open):
        facets = facets.select(is_open)
        fraction[is_open] = safe_fractions(facets.gap, facets.speed, len(is_open))
    return fraction


def stop_before_obstacles(
    surface: ContactSurface, motions: Sequence[ObstacleMotion], start: Values, end: Values
) -> Values:
    """First guess with every point stopped where it would cross an obstacle; the obstacle then takes it along.

    Each point by itself: to shorten the step of the whole body would leave a driven obstacle inside it. A point of a
    crack face depends on several nodes, which are moved back with it (collective).

    Args:
        surface: points.
        motions: motions of the obstacles.
        start: (owned dofs,) displacements at the start, m.
        end: (owned dofs,) first guess of those at the end, m.
    """
    x = surface.positions(start)
    for _ in range(LIMITS.max_rounds):
        correction, stopped = _corrections(surface.area, motions, x, surface.interpolate(end - start))
        if not surface.comm.allreduce(int(stopped.any())):
            return end
        weight = surface.nodal_forces(np.repeat(stopped[:, None], x.shape[1], axis=1).astype(float))
        change = surface.nodal_forces(correction)
        counts = np.abs(weight) > LIMITS.min_weight
        end = end + np.where(counts, change / np.where(counts, weight, 1.0), 0.0)
    return end


def _corrections(area: Values, motions: Sequence[ObstacleMotion], x: Values, motion: Values) -> tuple[Values, Flags]:
    """(n, d) corrections of the motions of points, m, and (n,) whether a point is stopped."""
    correction, stopped = np.zeros_like(x), np.zeros(len(x), bool)
    for posed, q, facets in motions:
        fraction = np.where(area > 0, safe_motion_fractions(posed, x, motion, q, facets), 1.0)
        limited = fraction < 1
        correction[limited] = ((fraction - 1)[:, None] * (motion - q[: x.shape[1]]))[limited]
        stopped |= limited
    return correction, stopped


def stop_before_meshes(
    surface: BarrierBodySurface, parts: Sequence[BarrierPart], start: Values, end: Values, start_poses: Sequence[Pose]
) -> Values:
    """First guess with points stopped where they would cross a triangle mesh; the same array where none would.

    Collective.

    Args:
        surface: surface of the body.
        parts: contact with obstacles, which are at the end of their motion.
        start: (owned dofs,) displacements at the start, m.
        end: (owned dofs,) first guess of displacements at the end, m.
        start_poses: of the obstacles at the start.
    """
    x, local = surface.positions(start), surface.current
    weights = abs(local.point_map.weights).T
    for _ in range(LIMITS.mesh_rounds):
        x_end = surface.positions(end)
        items = list(zip(parts, start_poses, strict=True))
        if all([part.free_fraction(x, x_end, pose) == 1 for part, pose in items]):
            return end
        correction = np.sum([_mesh_corrections(*item, surface.mean_edge, x, x_end) for item in items], axis=0)
        correction[~local.own_points] = 0.0
        is_stopped = correction.any(axis=1)
        if not sum_over_ranks(local.comm, is_stopped.sum())[0]:
            return end
        # of each node the mean over its points that are stopped
        weight = surface.sum_at_nodes(weights @ np.repeat(is_stopped[:, None].astype(float), x.shape[1], axis=1))
        counts, change = weight > LIMITS.min_weight, surface.sum_at_nodes(weights @ correction)
        end = end + np.where(counts, change / np.where(counts, weight, 1.0), 0.0)
    return end


def _mesh_corrections(part: BarrierPart, start_pose: Pose, edge: float, x: Values, end: Values) -> Values:
    """(n, 3) differences of safe motions of points and their motions from x to `end`, m (collective).

    `edge`: mean length of edges of the body, m.

    In the frame of the obstacle a point stops where it comes as near to it as a tenth of its distance; piece by piece,
    each point by itself.
    """
    # motion relative to the obstacle
    assert part.mesh is not None
    motion, comm = end - part.mesh.pose.points_to_space(start_pose.to_body(x)), part.pairs.comm
    largest = max_over_ranks(comm, float(lengths(motion).max(initial=0.0)))
    count = min(max(1, int(np.ceil(largest / edge))), LIMITS.max_pieces)
    # safe and unlimited positions, before the obstacle at its end
    safe_x, free_x = end - motion, end - motion
    is_moving = np.ones(len(x), bool)
    open_ratio = 1 - BARRIER.min_gap_ratio
    for piece in range(count):
        step = end - motion * (1 - (piece + 1) / count) - free_x
        length = lengths(step)
        reach = LIMITS.search_margin * max_over_ranks(comm, float(length.max(initial=0.0))) / open_ratio
        is_moving &= length <= open_ratio * part.safe_distances(safe_x, min(reach, LIMITS.max_search_edges * edge))
        safe_x = safe_x + np.where(is_moving[:, None], step, 0.0)
        free_x = free_x + step
    return np.where(is_moving[:, None], 0.0, safe_x - end)


type PoseMotion = tuple[PosedShape, Values]  # an obstacle at its start, and the increment (p,) of its pose
