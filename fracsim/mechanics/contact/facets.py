"""What an obstacle does to facets between their corners: their deepest place has a barrier, too.

    F(x) = A [ b(gap) - b(gap') ]

A the reference area of a facet, gap that of its deepest place (deepest), gap' what it would be from the gaps of its
corners before an obstacle that is flat (flat). The corners' own energy A/c sum_c b(gap_c) is that of points (touch).
Before what is flat F is 0 with all its derivatives, and nothing is counted twice; before what is round F > 0, and grows
without bound before the facet is cut. (The largest of the b(gap_c), smoothly, in place of b(gap') is the same for a
facet that lies flat, but not for one that is about to tilt: it made tangents of large flat faces indefinite.)

Equations: docs/theory.md#facets.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from .along import Along
from .barrier import KEPT
from .candidates import Candidates
from .deepest import Deepest, before_the_core, deepest, most_above
from .flat import IfFlat
from .law import Repulsion
from .placed import Placed
from .touch import positive

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

SOFTEN = 0.1  # of the width of the barrier, of deepest places
FLAT = 0.1  # of the width: facets that bend away from an obstacle by less are as good as flat


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
        its corners, which have that already (touch)."""
        k, c, d = self.at.x.shape
        own = (self.area / c)[:, None, None, None] * self._of_corners()
        kept = positive(own.reshape(-1, d, d)).reshape(k, c, d, d)
        return np.asarray(positive(self.exact + _diagonal(own)) - _diagonal(kept))


def between(
    facets: Facets, placed: Placed, x: Values, law: Repulsion, start: tuple[Placed, Values] | None = None
) -> tuple[Between, float]:
    """What acts on facets with points at x (n, d), and the energy that it stores, J; `start`: the obstacle and the
    points as the step began, where the barrier acts along the way (along)."""
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
