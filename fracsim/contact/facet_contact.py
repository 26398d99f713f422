"""Contact of facets with small or sharply curved obstacles, between the nodes of the facets.

    F(x) = A [ b(gap) - b(gap') ]

A is the reference area of a facet, gap that of its closest point to the obstacle, gap' the smoothed minimum of its
nodal gaps (closest_point). The nodes have the energy A/c sum_c b(gap_c) of their own (node_contact). Before a plane
F is 0 with all its derivatives, so that nothing counts twice. Before a curved obstacle F > 0, and grows without bound
before the facet is cut.

Equations: docs/theory.md#facets.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from ..array_types import Ints, Values
from .clearance import ProximityCandidates
from .closest_point import FacetClosestPoints, SoftMinGap, find_closest_points, smoothing_error
from .laws import BARRIER, Barrier, GapPotential, TimeAveragedPotential
from .node_contact import ContactForces, LaggedContact, positive_part
from .pose import PosedShape


@dataclass(frozen=True)
class FacetPolicy:
    """Tuned numbers of the contact of facets.

    Attributes:
        smoothing: mu of closest points, in barrier widths.
        max_bow: facets whose middle comes nearer to an obstacle than their nodes by less, in barrier widths, are
            left to their nodes.
        flatness: differences of a facet's gaps, in smoothings, and of its closest points from those before a plane,
            up to which an obstacle is flat over it.
    """

    smoothing: float = 0.1
    max_bow: float = 0.1
    flatness: float = 1e-9


FACETS = FacetPolicy()


def facets_matter(radius: float, edge: float, width: float) -> bool:
    """Whether facets of that edge length come noticeably nearer to an obstacle of that radius than their nodes, m.

    The middle of a triangle with edges a comes nearer to a sphere of radius R by a^2 / (6 R).
    """
    return edge**2 > 6 * radius * FACETS.max_bow * width


@dataclass(frozen=True, eq=False)
class ContactFacets:
    """Facets of a surface.

    Attributes:
        corners: (m, c) points.
        area: (m,) m^2 (2D: m).
        smoothing: mu of closest points, m.
    """

    corners: Ints
    area: Values
    smoothing: float

    @cached_property
    def _candidates(self) -> ProximityCandidates:
        return ProximityCandidates(0.0, self.corners)

    @cached_property
    def max_gap_error(self) -> float:
        """Largest amount by which smoothing makes a gap smaller, m."""
        return smoothing_error(self.corners.shape[1], self.smoothing)

    def closest_points(self, posed: PosedShape, x: Values, facets: Ints) -> FacetClosestPoints:
        """Closest points of facets (k,), with points at x (n, d), m."""
        return find_closest_points(posed, x[self.corners[facets]], self.smoothing)

    def within_reach(self, posed: PosedShape, x: Values, reach: float) -> Ints:
        """(k,) facets that may come nearer than `reach`, m, to an obstacle, with points at x (n, d), m."""
        near, _, corner_bounds, _ = self._tangent_planes(posed, x, np.full(1, reach))
        return near[corner_bounds.min(axis=1, initial=np.inf) < reach]

    def closing_facets(
        self, posed: PosedShape, x: Values, relative: Values, rotation_motion: Values | None, reach: Values
    ) -> Ints:
        """(k,) facets whose gaps a motion may close by more than `BARRIER.min_gap_ratio` allows.

        Args:
            posed: obstacle.
            x: (n, d) points, m.
            relative: (n, d) motion of the points relative to the obstacle, m.
            rotation_motion: (n,) bound of the motion that a rotation of the obstacle adds, m.
            reach: (n,) bound of all motions, m.
        """
        near, distance, corner_bounds, normal = self._tangent_planes(posed, x, reach)
        after = corner_bounds + np.einsum("kcd,kd->kc", relative[self.corners[near]], normal)
        if rotation_motion is not None:
            after = after - rotation_motion[self.corners[near]]
        smallest = np.minimum(corner_bounds, after).min(axis=1, initial=np.inf)
        return near[smallest < BARRIER.min_gap_ratio * distance]

    def _tangent_planes(self, posed: PosedShape, x: Values, reach: Values) -> tuple[Ints, Values, Values, Values]:
        """Facets within reach, and the tangent plane of the distance at their centroids.

        The distance to a convex obstacle lies above its tangent plane.

        Returns:
            (k,) facets within `reach` (m, one value or (n,) of points) as far as their sizes tell; (k,) distances at
            centroids; (k, c) distances of corners on the tangent plane minus `max_gap_error`; (k, d) normals.
        """
        (_, c), d = self.corners.shape, x.shape[1]
        near = self._candidates(posed, x, float(reach.max(initial=0.0)) + self.max_gap_error)
        if not len(near):
            return near, np.empty(0), np.empty((0, c)), np.empty((0, d))
        facet_reach = np.broadcast_to(reach, len(x))[self.corners[near]].max(axis=1, initial=0.0) + self.max_gap_error
        corners = x[self.corners[near]]
        centroid = corners.mean(axis=1)
        radius, distance = np.linalg.norm(corners - centroid[:, None], axis=2), posed.distance(centroid)
        is_near = distance < radius.max(axis=1, initial=0.0) + facet_reach
        distance, normal = distance[is_near], posed.normal(centroid[is_near])
        arms = (corners - centroid[:, None])[is_near]
        corner_bounds = distance[:, None] - self.max_gap_error + np.einsum("kcd,kd->kc", arms, normal)
        return near[is_near], distance, corner_bounds, normal

    def distances(self, posed: PosedShape, x: Values, reach: float) -> Values:
        """(k,) distances of the closest points of facets within `reach`, m."""
        return posed.distance(self.closest_points(posed, x, self.within_reach(posed, x, reach)).position)

    def gaps(self, posed: PosedShape, x: Values, reach: float) -> Values:
        """(m,) gaps to an obstacle, m; infinite beyond `reach`."""
        near, gaps = self.within_reach(posed, x, reach), np.full(len(self.area), np.inf)
        gaps[near] = self.closest_points(posed, x, near).gap
        return gaps


@dataclass(frozen=True, eq=False)
class FacetEnergy:
    """Energy F of facets near an obstacle, and its derivatives.

    Attributes:
        area: (k,) m^2.
        closest: closest points.
        law: b.
        start: (k, c + 2) gaps at the start of the step, of the closest points, the smoothed minima, and the corners, m;
            None: b is not averaged over the step.
    """

    area: Values
    closest: FacetClosestPoints
    law: GapPotential
    start: Values | None

    def _potential(self, column: int | slice) -> GapPotential | TimeAveragedPotential:
        return self.law if self.start is None else TimeAveragedPotential(self.law, self.start[:, column])

    @cached_property
    def _corner_gaps(self) -> Values:
        """(k, c) nodal gaps, m."""
        k, c, d = self.closest.x.shape
        return self.closest.posed.distance(self.closest.x.reshape(-1, d)).reshape(k, c)

    @cached_property
    def _corner_normals(self) -> Values:
        """(k, c, d) unit normals at the nodes."""
        k, c, d = self.closest.x.shape
        return self.closest.posed.normal(self.closest.x.reshape(-1, d)).reshape(k, c, d)

    @cached_property
    def _plane_gap(self) -> SoftMinGap:
        return SoftMinGap(self._corner_gaps, self.closest.smoothing)

    def energy(self) -> Values:
        """(k,) F, J; infinite where a facet is cut."""
        inner = self._potential(0).energy(self.closest.gap)
        plane = self._potential(1).energy(self._plane_gap.gap)
        cut = ~np.isfinite(inner)
        return np.where(cut, np.inf, self.area * (np.where(cut, 0.0, inner) - np.where(cut, 0.0, plane)))

    def forces(self) -> Values:
        """(k, c, d) forces on the corners, N."""
        of_closest = self._potential(0).slope(self.closest.gap)[:, None, None] * self.closest.gradient
        slope = self._potential(1).slope(self._plane_gap.gap)[:, None]
        of_plane = (slope * self._plane_gap.barycentric)[:, :, None] * self._corner_normals
        return np.asarray(-self.area[:, None, None] * (of_closest - of_plane))

    def _hessian(self) -> Values:
        """(k, c d, c d) second derivative of F, N/m."""
        k, c, d = self.closest.x.shape
        n = self.closest.gradient.reshape(k, c * d)
        of_closest = self._potential(0).curvature(self.closest.gap)[:, None, None] * n[:, :, None] * n[:, None, :]
        of_closest = of_closest + self._potential(0).slope(self.closest.gap)[:, None, None] * self.closest.curvature()
        return np.asarray(self.area[:, None, None] * (of_closest - self._plane_hessian()))

    def hessians(self) -> tuple[Values, Values]:
        """(k, c d, c d) second derivatives of F, N/m, and (k, c, d, d) of b at the corners, Pa/m."""
        return self._hessian(), self._corner_hessians()

    def _plane_hessian(self) -> Values:
        """(k, c d, c d) second derivative of b(gap'), Pa/m."""
        k, c, d = self.closest.x.shape
        plane, n = self._plane_gap, self._corner_normals
        slope, lam = self._potential(1).slope(plane.gap)[:, None, None], plane.barycentric
        by_gaps = self._potential(1).curvature(plane.gap)[:, None, None] * lam[:, :, None] * lam[:, None, :]
        blocks = np.einsum("kce,kci,kej->kciej", by_gaps + slope * plane.curvature(), n, n)
        H = self.closest.posed.curvature(self.closest.x.reshape(-1, d)).reshape(k, c, d, d)
        blocks[:, range(c), :, range(c), :] += (slope[..., None] * lam[:, :, None, None] * H).transpose(1, 0, 2, 3)
        return np.asarray(blocks.reshape(k, c * d, c * d))

    def _corner_hessians(self) -> Values:
        """(k, c, d, d) second derivative of b at each node, Pa/m."""
        k, c, d = self.closest.x.shape
        gap, potential = self._corner_gaps, self._potential(slice(2, None))
        n, H = self._corner_normals, self.closest.posed.curvature(self.closest.x.reshape(-1, d)).reshape(k, c, d, d)
        blocks = potential.curvature(gap)[..., None, None] * n[..., :, None] * n[..., None, :]
        return np.asarray(blocks + potential.slope(gap)[..., None, None] * H)


@dataclass(frozen=True, eq=False)
class FacetForces:
    """Forces on facets near an obstacle.

    Attributes:
        corners: (k, c) points.
        closest: closest points.
        area: (k,) m^2.
        energy: (k,) F, J; infinite where a facet is cut.
        forces: (k, c, d) forces on the corners, N.
        make_hessians: returns second derivatives of F (k, c d, c d), N/m, and of b at the corners (k, c, d, d), Pa/m;
            called once, when they are needed.
    """

    corners: Ints
    closest: FacetClosestPoints
    area: Values
    energy: Values
    forces: Values
    make_hessians: Callable[[], tuple[Values, Values]]

    @classmethod
    def from_closest(
        cls, corners: Ints, area: Values, closest: FacetClosestPoints, law: GapPotential, start: Values | None = None
    ) -> FacetForces:
        """Forces on facets with closest points; `start`: as of `FacetEnergy`."""
        kernels = closest.posed.shape.kernels
        if kernels is None or not isinstance(law, Barrier):
            plain = FacetEnergy(area, closest, law, start)
            return cls(corners, closest, area, plain.energy(), plain.forces(), plain.hessians)
        packed = closest.posed.packed, closest.x, closest.barycentric, closest.smoothing
        evaluate = partial(kernels.facet_energy, *packed, law, start, area)
        return cls(corners, closest, area, *evaluate(second=False), partial(evaluate, second=True))

    @cached_property
    def _hessians(self) -> tuple[Values, Values]:
        return self.make_hessians()

    @property
    def hessian(self) -> Values:
        """(k, c d, c d) second derivative of F, N/m."""
        return self._hessians[0]

    @property
    def corner_hessians(self) -> Values:
        """(k, c, d, d) second derivative of b at each node, Pa/m."""
        return self._hessians[1]

    @cached_property
    def stiffness(self) -> Values:
        """(k, c d, c d) part of a tangent, N/m.

        It is positive semi-definite together with the facet's share of the stiffness of its nodes, which
        node_contact adds.
        """
        k, c, d = self.closest.x.shape
        of_nodes = (self.area / c)[:, None, None, None] * self.corner_hessians
        node_stiffness = positive_part(of_nodes.reshape(-1, d, d)).reshape(k, c, d, d)
        return np.asarray(positive_part(self.hessian + _block_diagonal(of_nodes)) - _block_diagonal(node_stiffness))


def evaluate_facets(
    facets: ContactFacets,
    posed: PosedShape,
    x: Values,
    law: GapPotential,
    start: tuple[PosedShape, Values] | None = None,
) -> tuple[FacetForces, float, float]:
    """Forces on facets near an obstacle, the energy that they store, J, and the least gap of a facet, m.

    Facets over which the obstacle is flat have no forces: F is a difference of equal parts. Where the parts are large,
    their round-off would exceed the forces on a body that is touched softly.

    Args:
        facets: all facets.
        posed: obstacle.
        x: (n, d) points, m.
        law: b.
        start: obstacle and points (n, d) at the start of the step, where the barrier is averaged over the step.
    """
    near = facets.within_reach(posed, x, law.width)
    if start is not None:
        near = np.union1d(near, facets.within_reach(*start, law.width))
    closest = facets.closest_points(posed, x, near)
    if not len(near):
        return FacetForces.from_closest(facets.corners[near], facets.area[near], closest, law), 0.0, float("inf")
    least_gap = float(closest.gap.min())
    start_gap, acting = None, closest.gap < law.width  # elsewhere gap' >= gap, and F = 0 with its derivatives
    if start is not None:
        start_gap = facets.closest_points(*start, near).gap
        acting |= start_gap < law.width
    rows = np.flatnonzero(acting)
    plane, closest = _soft_min_gap(posed, x, facets.corners[near[rows]], facets.smoothing), closest.select(rows)
    is_flat = abs(closest.gap - plane.gap) <= FACETS.flatness * facets.smoothing
    is_flat &= abs(closest.barycentric - plane.barycentric).max(axis=1, initial=0.0) <= FACETS.flatness
    gaps = None
    if start is not None and start_gap is not None:
        plane = _soft_min_gap(*start, facets.corners[near[rows]], facets.smoothing)
        gaps = np.column_stack([start_gap[rows], plane.gap, plane.gaps])
        is_flat &= abs(gaps[:, 0] - gaps[:, 1]) <= FACETS.flatness * facets.smoothing
    curved = np.flatnonzero(~is_flat)
    corners, area, closest = facets.corners[near[rows[curved]]], facets.area[near[rows[curved]]], closest.select(curved)
    stored = FacetForces.from_closest(corners, area, closest, law)
    inner = stored if gaps is None else FacetForces.from_closest(corners, area, closest, law, gaps[curved])
    return inner, float(stored.energy.sum()), least_gap


def _soft_min_gap(posed: PosedShape, x: Values, corners: Ints, smoothing: float) -> SoftMinGap:
    """Smoothed minima of the nodal gaps of facets (k, c) to an obstacle, with points at x (n, d), m."""
    return SoftMinGap(posed.distance(x[corners].reshape(-1, x.shape[1])).reshape(corners.shape), smoothing)


def _block_diagonal(blocks: Values) -> Values:
    """(k, c d, c d) block-diagonal matrices of blocks (k, c, d, d)."""
    k, c, d = blocks.shape[:3]
    full = np.zeros((k, c, d, c, d))
    full[:, range(c), :, range(c), :] = blocks.transpose(1, 0, 2, 3)
    return full.reshape(k, c * d, c * d)


def add_facet_friction(
    lagged: LaggedContact, inner: FacetForces, x: Values, sum_at_points: Callable[[Ints, Values], Values] | None = None
) -> LaggedContact:
    """Lagged contact of points, with the normal forces on facets added to their corners.

    Friction acts at points alone. A point within a facet would stick where its corners slip, and Newton's method
    would take many iterations to find which of them do. The point of the obstacle that rubs is the mean of the
    points that press, weighted with their forces.

    Args:
        lagged: contact of points at the start of the step.
        inner: forces on facets then.
        x: (n, d) points then, m.
        sum_at_points: points (k,), values (k, m) of this rank -> their sums over the ranks that share a point
            (collective); None: no point is shared. Direction and point of the obstacle are those of the sums, and each
            rank has a share of the force.
    """
    corners, d = inner.corners.reshape(-1), x.shape[1]
    points = np.union1d(lagged.points, corners)
    point_rows, corner_rows = np.searchsorted(points, lagged.points), np.searchsorted(points, corners)
    force: Values = np.zeros((len(points), d))
    weight: Values = np.zeros(len(points))
    moment: Values = np.zeros((len(points), d))
    force[point_rows], weight[point_rows] = lagged.force[:, None] * lagged.normal, lagged.force
    moment[point_rows] = lagged.force[:, None] * lagged.position
    np.add.at(force, corner_rows, inner.forces.reshape(-1, d))
    corner_force = np.linalg.norm(inner.forces, axis=2)
    np.add.at(weight, corner_rows, corner_force.reshape(-1))
    corner_moment = corner_force[:, :, None] * inner.closest.position[:, None, :]
    np.add.at(moment, corner_rows, corner_moment.reshape(-1, d))
    share: Values = np.ones(len(points))
    if sum_at_points is not None:
        total = sum_at_points(points, np.column_stack([force, weight, moment]))
        share = np.divide(weight, total[:, d], out=np.zeros(len(points)), where=total[:, d] > 0)
        force, weight, moment = total[:, :d], total[:, d], total[:, d + 1 :]
    size = np.linalg.norm(force, axis=1)
    loaded = np.flatnonzero(size * share > 0)
    points, size, position = points[loaded], size[loaded], x[points[loaded]]
    normal, obstacle_point = force[loaded] / size[:, None], moment[loaded] / weight[loaded, None]
    return LaggedContact(points, share[loaded] * size, normal, position, obstacle_point)


def merge_forces(of_points: ContactForces, inner: FacetForces, stored: float, least_gap: float) -> ContactForces:
    """Forces on points and on facets together; `stored`, `least_gap`: energy, J, and least gap, m, of the facets."""
    min_gap = min(of_points.min_gap, least_gap)
    if not len(inner.area):
        return replace(of_points, min_gap=min_gap)
    points = np.union1d(of_points.points, inner.corners.reshape(-1))
    rows, d = np.searchsorted(points, of_points.points), of_points.normal.shape[1]
    normal, friction = np.zeros((2, len(points), d))
    normal[rows], friction[rows] = of_points.normal, of_points.friction
    np.add.at(normal, np.searchsorted(points, inner.corners), inner.forces)

    def hessians() -> tuple[Values, Values]:
        of_normal, of_friction = np.zeros((2, len(points), d, d))
        of_normal[rows], of_friction[rows] = of_points.normal_hessian, of_points.friction_hessian
        return of_normal, of_friction

    potential = of_points.potential + float(inner.energy.sum())
    energy = of_points.energy + stored
    return ContactForces(points, energy, normal, friction, potential, hessians, min_gap, inner)
