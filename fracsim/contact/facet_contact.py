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
from .closest_point import Deepest, IfFlat, before_the_core, deepest, most_above
from .laws import Along, Repulsion
from .node_contact import Grip, Touch, positive
from .pose import Placed

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
OUTLINE = 1.1  # an outline is drawn within its shape
Flags = npt.NDArray[np.bool_]
SOFTEN = 0.1  # of the width of the barrier, of deepest places
FLAT = 0.1  # of the width: facets that bend away from an obstacle by less are as good as flat


@dataclass(frozen=True)
class _Look:
    """Where points (n, d) and an obstacle were, and the facets (k,) that were within a distance of it, m, but for
    `margin`."""

    x: Values
    placed: Placed
    within: float
    margin: float
    found: Ints

    def holds(self, placed: Placed, x: Values, within: float) -> bool:
        """Whether no facet within that distance, m, can be missing."""
        off = x - self.x
        moved = float(np.sqrt(np.einsum("nd,nd->n", off, off).max(initial=0.0)))
        now, then = placed.pose, self.placed.pose
        turned = float(np.linalg.norm(now.rotation - then.rotation))
        carried = float(np.linalg.norm(now.centre - then.centre)) + (turned and turned * _radius(placed))
        return within - self.within + moved + carried <= self.margin


@dataclass(frozen=True, eq=False)
class Candidates:
    """Of facets with these corners (m, c)."""

    corners: Ints
    _looks: dict[int, _Look] = field(default_factory=dict)

    def __call__(self, placed: Placed, x: Values, within: float) -> Ints:
        """(k,) all that have a place nearer than `within` m to an obstacle with points at x (n, d), and others."""
        last = self._looks.get(id(placed.shape))
        if last is None or last.placed.shape is not placed.shape or not last.holds(placed, x, within):
            last = self._looks[id(placed.shape)] = self._look(placed, x, within)
        return last.found

    def _look(self, placed: Placed, x: Values, within: float) -> _Look:
        corners = x[self.corners]
        middle = corners.mean(axis=1)
        arms = corners - middle[:, None]
        around = np.sqrt(np.einsum("kcd,kcd->kc", arms, arms).max(axis=1, initial=0.0))
        margin = max(float(around.mean()) if len(around) else 0.0, within)
        return _Look(x, placed, within, margin, np.flatnonzero(placed.distance(middle) - around < within + margin))


def _radius(placed: Placed) -> float:
    """m, of a shape about its reference point."""
    points, _ = placed.shape.outline()
    return OUTLINE * float(np.linalg.norm(points, axis=1).max())


def matters(radius: float, edge: float, width: float) -> bool:
    """Whether facets with edges of that length, m, may come nearer to an obstacle of that least radius of curvature,
    m, than their corners: by a^2 / (6 R) in the middle of a triangle."""
    return edge**2 > 6 * radius * FLAT * width


@dataclass(frozen=True, eq=False)
class Facets:
    """Facets of a surface: numbers of their corners (m, c) among its points, and their areas (m,), m^2 (2D: m).

    `soften`: m, of their deepest places; shares of these, where they were last, are where they are looked for first.
    """

    corners: Ints
    area: Values
    soften: float

    @cached_property
    def _last(self) -> Values:
        """(m, c) shares; nan: not known yet."""
        return np.full(self.corners.shape, np.nan)

    @cached_property
    def _candidates(self) -> Candidates:
        return Candidates(self.corners)

    @property
    def kept(self) -> float:
        """m, by how much a gap is taken for smaller than it is, at most."""
        return most_above(self.corners.shape[1], self.soften)

    def look(self, placed: Placed, x: Values, which: Ints) -> Deepest:
        """The deepest places of facets (k,) with points at x (n, d), m."""
        corners, start = x[self.corners[which]], self._last[which]
        if (new := np.isnan(start[:, 0])).any():
            start[new] = before_the_core(placed, corners[new], self.soften)
        at = deepest(placed, corners, self.soften, start)
        self._last[which] = at.share
        return at

    def near(self, placed: Placed, x: Values, reach: float) -> Ints:
        """(k,) those that may come nearer than `reach` m to an obstacle, with points at x (n, d), m."""
        near, _, over, _ = self._tangents(placed, x, np.full(1, reach))
        return near[over.min(axis=1, initial=np.inf) < reach]

    def closing(self, placed: Placed, x: Values, relative: Values, swept: Values | None, reach: Values) -> Ints:
        """(k,) those whose gaps a motion may close by more than is safe (barrier), on the ways `relative` (n, d) of the
        points to an obstacle, m, that its turn adds `swept` (n,) to at most; all no longer than `reach` (n,)."""
        near, distance, over, normal = self._tangents(placed, x, reach)
        after = over + np.einsum("kcd,kd->kc", relative[self.corners[near]], normal)
        if swept is not None:
            after = after - swept[self.corners[near]]
        return near[np.minimum(over, after).min(axis=1, initial=np.inf) < KEPT * distance]

    def _tangents(self, placed: Placed, x: Values, reach: Values) -> tuple[Ints, Values, Values, Values]:
        """Facets (k,) within `reach` m of an obstacle, of all or of points (n,), as far as their sizes tell;
        distances (k,) and normals (k, d) at their middles, and those (k, c) of their corners less `kept` were it flat:
        the distance to what is convex is more."""
        (_, c), d = self.corners.shape, x.shape[1]
        if placed.beyond(x) >= reach.max(initial=0.0) + self.kept:
            return np.empty(0, np.int64), np.empty(0), np.empty((0, c)), np.empty((0, d))
        near = self._candidates(placed, x, float(reach.max(initial=0.0)) + self.kept)
        within = np.broadcast_to(reach, len(x))[self.corners[near]].max(axis=1, initial=0.0) + self.kept
        corners = x[self.corners[near]]
        middle = corners.mean(axis=1)
        around, distance = np.linalg.norm(corners - middle[:, None], axis=2), placed.distance(middle)
        left = distance < around.max(axis=1, initial=0.0) + within
        distance, normal, arms = distance[left], placed.normal(middle[left]), (corners - middle[:, None])[left]
        return near[left], distance, distance[:, None] - self.kept + np.einsum("kcd,kd->kc", arms, normal), normal

    def distances(self, placed: Placed, x: Values, reach: float) -> Values:
        """(k,) of the deepest places of those that are near, m."""
        return placed.distance(self.look(placed, x, self.near(placed, x, reach)).place)

    def are_open(self, every: Sequence[Placed], x: Values) -> Flags:
        """(m,) those that none of several obstacles cuts."""
        found = np.ones(len(self.area), bool)
        for placed in every:
            near = self.near(placed, x, 0.0)
            found[near] &= self.look(placed, x, near).gap > 0
        return found

    def gaps(self, placed: Placed, x: Values, reach: float) -> Values:
        """(m,) to an obstacle, m; infinite of those that are not near."""
        near, found = self.near(placed, x, reach), np.full(len(self.area), np.inf)
        found[near] = self.look(placed, x, near).gap
        return found


@dataclass(frozen=True, eq=False)
class Between:
    """F of facets near an obstacle.

    Attributes:
        corners: (k, c) points.    area: (k,).    at: their deepest places.
        law, if_flat, of_corners: b of the gaps of these, of gap', and of all their corners.
    """

    corners: Ints
    area: Values
    at: Deepest
    law: Repulsion | Along
    if_flat: Repulsion | Along
    of_corners: Repulsion | Along

    @cached_property
    def _gaps(self) -> Values:
        """(k, c) of the corners, m."""
        k, c, d = self.at.x.shape
        return self.at.placed.distance(self.at.x.reshape(-1, d)).reshape(k, c)

    @cached_property
    def _normals(self) -> Values:
        """(k, c, d) at the corners."""
        k, c, d = self.at.x.shape
        return self.at.placed.normal(self.at.x.reshape(-1, d)).reshape(k, c, d)

    @cached_property
    def _flat(self) -> IfFlat:
        return IfFlat(self._gaps, self.at.soften)

    @property
    def energy(self) -> Values:
        """(k,) J; infinite where a facet is cut."""
        inner, flat = self.law.energy(self.at.gap), self.if_flat.energy(self._flat.gap)
        cut = ~np.isfinite(inner)
        return np.where(cut, np.inf, self.area * (np.where(cut, 0.0, inner) - np.where(cut, 0.0, flat)))

    @cached_property
    def forces(self) -> Values:
        """(k, c, d) on the corners, N."""
        own = self.law.slope(self.at.gap)[:, None, None] * self.at.by_corner
        slope = self.if_flat.slope(self._flat.gap)[:, None]
        return np.asarray(-self.area[:, None, None] * (own - (slope * self._flat.share)[:, :, None] * self._normals))

    @cached_property
    def exact(self) -> Values:
        """(k, c d, c d) second derivative of F, N/m."""
        k, c, d = self.at.x.shape
        n = self.at.by_corner.reshape(k, c * d)
        own = self.law.curvature(self.at.gap)[:, None, None] * n[:, :, None] * n[:, None, :]
        own = own + self.law.slope(self.at.gap)[:, None, None] * self.at.curvature()
        return np.asarray(self.area[:, None, None] * (own - self._bent_if_flat()))

    def _bent_if_flat(self) -> Values:
        """(k, c d, c d) second derivative of b(gap'), Pa/m."""
        k, c, d = self.at.x.shape
        flat, n = self._flat, self._normals
        slope, share = self.if_flat.slope(flat.gap)[:, None, None], flat.share
        twice = self.if_flat.curvature(flat.gap)[:, None, None] * share[:, :, None] * share[:, None, :]
        bent = np.einsum("kce,kci,kej->kciej", twice + slope * flat.curvature(), n, n)
        H = self.at.placed.curvature(self.at.x.reshape(-1, d)).reshape(k, c, d, d)
        bent[:, range(c), :, range(c), :] += (slope[..., None] * share[:, :, None, None] * H).transpose(1, 0, 2, 3)
        return np.asarray(bent.reshape(k, c * d, c * d))

    def _of_corners(self) -> Values:
        """(k, c, d, d) second derivative of b at each corner, Pa/m."""
        k, c, d = self.at.x.shape
        gap = self._gaps.reshape(-1)
        n, H = self._normals.reshape(-1, d), self.at.placed.curvature(self.at.x.reshape(-1, d))
        bent = self.of_corners.curvature(gap)[:, None, None] * n[:, :, None] * n[:, None, :]
        return np.asarray(bent + self.of_corners.slope(gap)[:, None, None] * H).reshape(k, c, d, d)

    @cached_property
    def stiffness(self) -> Values:
        """(k, c d, c d) for a tangent: positive semi-definite together with the share of the facet in the stiffness of
        its corners, which have that already (node_contact)."""
        k, c, d = self.at.x.shape
        own = (self.area / c)[:, None, None, None] * self._of_corners()
        kept = positive(own.reshape(-1, d, d)).reshape(k, c, d, d)
        return np.asarray(positive(self.exact + _diagonal(own)) - _diagonal(kept))


def between(
    facets: Facets, placed: Placed, x: Values, law: Repulsion, start: tuple[Placed, Values] | None = None
) -> tuple[Between, float]:
    """What acts on facets with points at x (n, d), and the energy that it stores, J; `start`: the obstacle and the
    points as the step began, where the barrier acts along the way (laws)."""
    near = facets.near(placed, x, law.width)
    if start is not None:
        near = np.union1d(near, facets.near(*start, law.width))
    corners, area = facets.corners[near], facets.area[near]
    at = facets.look(placed, x, near)
    stored = Between(corners, area, at, law, law, law)
    if start is None:
        return stored, float(stored.energy.sum())
    then = deepest(start[0], start[1][corners], facets.soften, at.share).gap
    of_corners = start[0].distance(start[1][corners].reshape(-1, x.shape[1]))
    flat = IfFlat(of_corners.reshape(corners.shape), facets.soften).gap
    laws = (Along(law, gap) for gap in (then, flat, of_corners))
    return Between(corners, area, at, *laws), float(stored.energy.sum())


def _diagonal(blocks: Values) -> Values:
    """(k, c d, c d) of blocks (k, c, d, d)."""
    k, c, d = blocks.shape[:3]
    full = np.zeros((k, c, d, c, d))
    full[:, range(c), :, range(c), :] = blocks.transpose(1, 0, 2, 3)
    return full.reshape(k, c * d, c * d)


def gripped_between(held: Grip, inner: Between, x: Values) -> Grip:
    """`held`: points alone, of the start of a step at x (n, d), m; with what acts on facets then."""
    corners, d = inner.corners.reshape(-1), x.shape[1]
    points = np.union1d(held.points, corners)
    if len(points) == 0:
        return held
    at, of = np.searchsorted(points, held.points), np.searchsorted(points, corners)
    force, weight, under = np.zeros((len(points), d)), np.zeros(len(points)), np.zeros((len(points), d))
    force[at], weight[at] = held.force[:, None] * held.normal, held.force
    under[at] = held.force[:, None] * held.start
    np.add.at(force, of, inner.forces.reshape(-1, d))
    pressed = np.linalg.norm(inner.forces, axis=2)
    np.add.at(weight, of, pressed.reshape(-1))
    np.add.at(under, of, (pressed[:, :, None] * inner.at.place[:, None, :]).reshape(-1, d))
    size = np.linalg.norm(force, axis=1)
    kept = np.flatnonzero(size > 0)
    points, size, start = points[kept], size[kept], x[points[kept]]
    return Grip(points, size, force[kept] / size[:, None], start, under[kept] / weight[kept, None])


def joined(found: Touch, inner: Between, stored: float) -> Touch:
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
        exact[place], stick[place] = found.exact, found.stick
        return exact, stick

    potential = found.potential + float(inner.energy.sum())
    return Touch(points, found.energy + stored, normal, rubbed, potential, parts, inner)
