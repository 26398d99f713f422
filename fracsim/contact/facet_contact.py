"""What an obstacle does to facets between their corners: their deepest place has a barrier, too.

    F(x) = A [ b(gap) - b(gap') ]

A the reference area of a facet, gap that of its deepest place (closest_point), gap' what it would be from the gaps of
its corners before an obstacle that is flat (closest_point). The corners' own energy A/c sum_c b(gap_c) is that of
points (node_contact). Before what is flat F is 0 with all its derivatives, and nothing is counted twice; before what is
round F > 0, and grows without bound before the facet is cut. (The largest of the b(gap_c), smoothly, in place of
b(gap') is the same for a facet that lies flat, but not for one that is about to tilt: it made tangents of large flat
faces indefinite.)

Equations: docs/theory.md#facets.

Facets that may be near an obstacle: looked for among all only when points or the obstacle have gone far.

A distance to an obstacle changes by no more than the point moves, |t| of its reference point and ||R - R_0|| times the
radius of the obstacle about that.

Friction on facets: what presses on them between their corners counts at these, as much as each bears of it.

The force on a corner is that at the point itself and its share of those of the facets around it; its size and direction
are the normal force and the normal that friction of the step is lagged with. So all that presses rubs, with the moment
of what presses. What slides under a corner is the obstacle where it presses: the mean of these places, by their forces.

What an obstacle does to points, joined with what it does to the facets between them (facet_contact).

Friction acts at the points alone. A place on a facet sticks where its corners do not, and with the slip that passes for
sticking so small Newton's method hunts for which of them do: 20 to 50 iterations a step in place of 3 to 5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from .barrier import KEPT
from .closest_point import FacetClosestPoints, SoftMinGap, find_closest_points, initial_barycentric, smoothing_error
from .laws import GapPotential, TimeAveragedPotential
from .node_contact import ContactForces, LaggedContact, positive_part
from .pose import PosedShape

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
OUTLINE = 1.1  # an outline is drawn within its shape
Flags = npt.NDArray[np.bool_]
SOFTEN = 0.1  # of the width of the barrier, of deepest places
FLAT = 0.1  # of the width: facets that bend away from an obstacle by less are as good as flat


@dataclass(frozen=True)
class _SearchState:
    """Where points (n, d) and an obstacle were, and the facets (k,) that were within a distance of it, m, but for
    `margin`."""

    x: Values
    posed: PosedShape
    distance: float
    margin: float
    facets: Ints

    def is_valid(self, placed: PosedShape, x: Values, within: float) -> bool:
        """Whether no facet within that distance, m, can be missing."""
        off = x - self.x
        moved = float(np.sqrt(np.einsum("nd,nd->n", off, off).max(initial=0.0)))
        now, then = placed.pose, self.posed.pose
        turned = float(np.linalg.norm(now.rotation - then.rotation))
        carried = float(np.linalg.norm(now.centre - then.centre)) + (turned and turned * _radius(placed))
        return within - self.distance + moved + carried <= self.margin


@dataclass(frozen=True, eq=False)
class FacetCandidates:
    """Of facets with these corners (m, c)."""

    corners: Ints
    _states: dict[int, _SearchState] = field(default_factory=dict)

    def __call__(self, placed: PosedShape, x: Values, within: float) -> Ints:
        """(k,) all that have a place nearer than `within` m to an obstacle with points at x (n, d), and others."""
        last = self._states.get(id(placed.shape))
        if last is None or last.posed.shape is not placed.shape or not last.is_valid(placed, x, within):
            last = self._states[id(placed.shape)] = self._search(placed, x, within)
        return last.facets

    def _search(self, placed: PosedShape, x: Values, within: float) -> _SearchState:
        corners = x[self.corners]
        middle = corners.mean(axis=1)
        arms = corners - middle[:, None]
        around = np.sqrt(np.einsum("kcd,kcd->kc", arms, arms).max(axis=1, initial=0.0))
        margin = max(float(around.mean()) if len(around) else 0.0, within)
        return _SearchState(
            x, placed, within, margin, np.flatnonzero(placed.distance(middle) - around < within + margin)
        )


def _radius(placed: PosedShape) -> float:
    """m, of a shape about its reference point."""
    points, _ = placed.shape.tessellate()
    return OUTLINE * float(np.linalg.norm(points, axis=1).max())


def facets_matter(radius: float, edge: float, width: float) -> bool:
    """Whether facets with edges of that length, m, may come nearer to an obstacle of that least radius of curvature,
    m, than their corners: by a^2 / (6 R) in the middle of a triangle."""
    return edge**2 > 6 * radius * FLAT * width


@dataclass(frozen=True, eq=False)
class ContactFacets:
    """Facets of a surface: numbers of their corners (m, c) among its points, and their areas (m,), m^2 (2D: m).

    `soften`: m, of their deepest places; shares of these, where they were last, are where they are looked for first.
    """

    corners: Ints
    area: Values
    smoothing: float

    @cached_property
    def _last_barycentric(self) -> Values:
        """(m, c) shares; nan: not known yet."""
        return np.full(self.corners.shape, np.nan)

    @cached_property
    def _candidates(self) -> FacetCandidates:
        return FacetCandidates(self.corners)

    @property
    def max_gap_error(self) -> float:
        """m, by how much a gap is taken for smaller than it is, at most."""
        return smoothing_error(self.corners.shape[1], self.smoothing)

    def closest_points(self, placed: PosedShape, x: Values, which: Ints) -> FacetClosestPoints:
        """The deepest places of facets (k,) with points at x (n, d), m."""
        corners, start = x[self.corners[which]], self._last_barycentric[which]
        if (new := np.isnan(start[:, 0])).any():
            start[new] = initial_barycentric(placed, corners[new], self.smoothing)
        at = find_closest_points(placed, corners, self.smoothing, start)
        self._last_barycentric[which] = at.barycentric
        return at

    def within_reach(self, placed: PosedShape, x: Values, reach: float) -> Ints:
        """(k,) those that may come nearer than `reach` m to an obstacle, with points at x (n, d), m."""
        near, _, over, _ = self._tangents(placed, x, np.full(1, reach))
        return near[over.min(axis=1, initial=np.inf) < reach]

    def closing_facets(
        self, placed: PosedShape, x: Values, relative: Values, swept: Values | None, reach: Values
    ) -> Ints:
        """(k,) those whose gaps a motion may close by more than is safe (barrier), on the ways `relative` (n, d) of the
        points to an obstacle, m, that its turn adds `swept` (n,) to at most; all no longer than `reach` (n,)."""
        near, distance, over, normal = self._tangents(placed, x, reach)
        after = over + np.einsum("kcd,kd->kc", relative[self.corners[near]], normal)
        if swept is not None:
            after = after - swept[self.corners[near]]
        return near[np.minimum(over, after).min(axis=1, initial=np.inf) < KEPT * distance]

    def _tangents(self, placed: PosedShape, x: Values, reach: Values) -> tuple[Ints, Values, Values, Values]:
        """Facets (k,) within `reach` m of an obstacle, of all or of points (n,), as far as their sizes tell;
        distances (k,) and normals (k, d) at their middles, and those (k, c) of their corners less `kept` were it flat:
        the distance to what is convex is more."""
        (_, c), d = self.corners.shape, x.shape[1]
        if placed.distance_bound(x) >= reach.max(initial=0.0) + self.max_gap_error:
            return np.empty(0, np.int64), np.empty(0), np.empty((0, c)), np.empty((0, d))
        near = self._candidates(placed, x, float(reach.max(initial=0.0)) + self.max_gap_error)
        within = np.broadcast_to(reach, len(x))[self.corners[near]].max(axis=1, initial=0.0) + self.max_gap_error
        corners = x[self.corners[near]]
        middle = corners.mean(axis=1)
        around, distance = np.linalg.norm(corners - middle[:, None], axis=2), placed.distance(middle)
        left = distance < around.max(axis=1, initial=0.0) + within
        distance, normal, arms = distance[left], placed.normal(middle[left]), (corners - middle[:, None])[left]
        return (
            near[left],
            distance,
            distance[:, None] - self.max_gap_error + np.einsum("kcd,kd->kc", arms, normal),
            normal,
        )

    def distances(self, placed: PosedShape, x: Values, reach: float) -> Values:
        """(k,) of the deepest places of those that are near, m."""
        return placed.distance(self.closest_points(placed, x, self.within_reach(placed, x, reach)).position)

    def are_open(self, every: Sequence[PosedShape], x: Values) -> Flags:
        """(m,) those that none of several obstacles cuts."""
        found = np.ones(len(self.area), bool)
        for placed in every:
            near = self.within_reach(placed, x, 0.0)
            found[near] &= self.closest_points(placed, x, near).gap > 0
        return found

    def gaps(self, placed: PosedShape, x: Values, reach: float) -> Values:
        """(m,) to an obstacle, m; infinite of those that are not near."""
        near, found = self.within_reach(placed, x, reach), np.full(len(self.area), np.inf)
        found[near] = self.closest_points(placed, x, near).gap
        return found


@dataclass(frozen=True, eq=False)
class FacetForces:
    """F of facets near an obstacle.

    Attributes:
        corners: (k, c) points.    area: (k,).    at: their deepest places.
        law, if_flat, of_corners: b of the gaps of these, of gap', and of all their corners.
    """

    corners: Ints
    area: Values
    closest: FacetClosestPoints
    potential: GapPotential | TimeAveragedPotential
    plane_potential: GapPotential | TimeAveragedPotential
    corner_potential: GapPotential | TimeAveragedPotential

    @cached_property
    def _corner_gaps(self) -> Values:
        """(k, c) of the corners, m."""
        k, c, d = self.closest.x.shape
        return self.closest.posed.distance(self.closest.x.reshape(-1, d)).reshape(k, c)

    @cached_property
    def _corner_normals(self) -> Values:
        """(k, c, d) at the corners."""
        k, c, d = self.closest.x.shape
        return self.closest.posed.normal(self.closest.x.reshape(-1, d)).reshape(k, c, d)

    @cached_property
    def _plane_gap(self) -> SoftMinGap:
        return SoftMinGap(self._corner_gaps, self.closest.smoothing)

    @property
    def energy(self) -> Values:
        """(k,) J; infinite where a facet is cut."""
        inner, flat = self.potential.energy(self.closest.gap), self.plane_potential.energy(self._plane_gap.gap)
        cut = ~np.isfinite(inner)
        return np.where(cut, np.inf, self.area * (np.where(cut, 0.0, inner) - np.where(cut, 0.0, flat)))

    @cached_property
    def forces(self) -> Values:
        """(k, c, d) on the corners, N."""
        own = self.potential.slope(self.closest.gap)[:, None, None] * self.closest.gradient
        slope = self.plane_potential.slope(self._plane_gap.gap)[:, None]
        return np.asarray(
            -self.area[:, None, None] * (own - (slope * self._plane_gap.barycentric)[:, :, None] * self._corner_normals)
        )

    @cached_property
    def hessian(self) -> Values:
        """(k, c d, c d) second derivative of F, N/m."""
        k, c, d = self.closest.x.shape
        n = self.closest.gradient.reshape(k, c * d)
        own = self.potential.curvature(self.closest.gap)[:, None, None] * n[:, :, None] * n[:, None, :]
        own = own + self.potential.slope(self.closest.gap)[:, None, None] * self.closest.curvature()
        return np.asarray(self.area[:, None, None] * (own - self._plane_hessian()))

    def _plane_hessian(self) -> Values:
        """(k, c d, c d) second derivative of b(gap'), Pa/m."""
        k, c, d = self.closest.x.shape
        flat, n = self._plane_gap, self._corner_normals
        slope, share = self.plane_potential.slope(flat.gap)[:, None, None], flat.barycentric
        twice = self.plane_potential.curvature(flat.gap)[:, None, None] * share[:, :, None] * share[:, None, :]
        bent = np.einsum("kce,kci,kej->kciej", twice + slope * flat.curvature(), n, n)
        H = self.closest.posed.curvature(self.closest.x.reshape(-1, d)).reshape(k, c, d, d)
        bent[:, range(c), :, range(c), :] += (slope[..., None] * share[:, :, None, None] * H).transpose(1, 0, 2, 3)
        return np.asarray(bent.reshape(k, c * d, c * d))

    def _corner_hessians(self) -> Values:
        """(k, c, d, d) second derivative of b at each corner, Pa/m."""
        k, c, d = self.closest.x.shape
        gap = self._corner_gaps.reshape(-1)
        n, H = self._corner_normals.reshape(-1, d), self.closest.posed.curvature(self.closest.x.reshape(-1, d))
        bent = self.corner_potential.curvature(gap)[:, None, None] * n[:, :, None] * n[:, None, :]
        return np.asarray(bent + self.corner_potential.slope(gap)[:, None, None] * H).reshape(k, c, d, d)

    @cached_property
    def stiffness(self) -> Values:
        """(k, c d, c d) for a tangent: positive semi-definite together with the share of the facet in the stiffness of
        its corners, which have that already (node_contact)."""
        k, c, d = self.closest.x.shape
        own = (self.area / c)[:, None, None, None] * self._corner_hessians()
        kept = positive_part(own.reshape(-1, d, d)).reshape(k, c, d, d)
        return np.asarray(positive_part(self.hessian + _diagonal(own)) - _diagonal(kept))


def evaluate_facets(
    facets: ContactFacets,
    placed: PosedShape,
    x: Values,
    law: GapPotential,
    start: tuple[PosedShape, Values] | None = None,
) -> tuple[FacetForces, float]:
    """What acts on facets with points at x (n, d), and the energy that it stores, J; `start`: the obstacle and the
    points as the step began, where the barrier acts along the way (laws)."""
    near = facets.within_reach(placed, x, law.width)
    if start is not None:
        near = np.union1d(near, facets.within_reach(*start, law.width))
    corners, area = facets.corners[near], facets.area[near]
    at = facets.closest_points(placed, x, near)
    stored = FacetForces(corners, area, at, law, law, law)
    if start is None:
        return stored, float(stored.energy.sum())
    then = find_closest_points(start[0], start[1][corners], facets.smoothing, at.barycentric).gap
    of_corners = start[0].distance(start[1][corners].reshape(-1, x.shape[1]))
    flat = SoftMinGap(of_corners.reshape(corners.shape), facets.smoothing).gap
    laws = (TimeAveragedPotential(law, gap) for gap in (then, flat, of_corners))
    return FacetForces(corners, area, at, *laws), float(stored.energy.sum())


def _diagonal(blocks: Values) -> Values:
    """(k, c d, c d) of blocks (k, c, d, d)."""
    k, c, d = blocks.shape[:3]
    full = np.zeros((k, c, d, c, d))
    full[:, range(c), :, range(c), :] = blocks.transpose(1, 0, 2, 3)
    return full.reshape(k, c * d, c * d)


def add_facet_friction(held: LaggedContact, inner: FacetForces, x: Values) -> LaggedContact:
    """`held`: points alone, of the start of a step at x (n, d), m; with what acts on facets then."""
    corners, d = inner.corners.reshape(-1), x.shape[1]
    points = np.union1d(held.points, corners)
    if len(points) == 0:
        return held
    at, of = np.searchsorted(points, held.points), np.searchsorted(points, corners)
    force, weight, under = np.zeros((len(points), d)), np.zeros(len(points)), np.zeros((len(points), d))
    force[at], weight[at] = held.force[:, None] * held.normal, held.force
    under[at] = held.force[:, None] * held.position
    np.add.at(force, of, inner.forces.reshape(-1, d))
    pressed = np.linalg.norm(inner.forces, axis=2)
    np.add.at(weight, of, pressed.reshape(-1))
    np.add.at(under, of, (pressed[:, :, None] * inner.closest.position[:, None, :]).reshape(-1, d))
    size = np.linalg.norm(force, axis=1)
    kept = np.flatnonzero(size > 0)
    points, size, start = points[kept], size[kept], x[points[kept]]
    return LaggedContact(points, size, force[kept] / size[:, None], start, under[kept] / weight[kept, None])


def merge_forces(found: ContactForces, inner: FacetForces, stored: float) -> ContactForces:
    """A touch with what facets feel, which store J, added to their corners, and their stiffness between these."""
    if not len(inner.area):
        return found
    points = np.union1d(found.points, inner.corners.reshape(-1))
    place, d = np.searchsorted(points, found.points), found.normal.shape[1]
    normal, rubbed = np.zeros((2, len(points), d))
    normal[place], rubbed[place] = found.normal, found.friction
    np.add.at(normal, np.searchsorted(points, inner.corners), inner.forces)

    def parts() -> tuple[Values, Values]:
        exact, stick = np.zeros((2, len(points), d, d))
        exact[place], stick[place] = found.normal_hessian, found.friction_hessian
        return exact, stick

    potential = found.potential + float(inner.energy.sum())
    return ContactForces(points, found.energy + stored, normal, rubbed, potential, parts, inner)
