"""Closest points of triangles and segments to a convex obstacle, smoothed.

    G(x) = min over barycentric l of   D(y) + mu/2 |l - 1/c|^2,      y = sum_c l_c x_c,   l_c >= 0,  sum l_c = 1

D is the signed distance of the obstacle, x (c, d) the corners of a triangle (c = 3) or a segment (c = 2). Without the
second term the closest point would jump from one end of a flat obstacle to the other as a facet tilts.

Equations: docs/theory.md#facets.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..array_types import Flags, Ints, Values
from .pose import PosedShape


@dataclass(frozen=True)
class ClosestPointPolicy:
    """Tuned numbers of the search for closest points.

    Attributes:
        max_iterations: of Newton's method.
        max_trials: of a line search.
        slope_reduction: part of the initial slope at which a line search ends.
        flat_distance: distance, in facet sizes, from which on an obstacle counts as flat for the compiled guess.
        min_change: change of barycentric coordinates that counts as none.
        tolerance: remaining derivative by barycentric coordinates, in smoothings mu.
        round_off: that of a derivative, in largest coordinates, below which the search ends.
    """

    max_iterations: int = 40
    max_trials: int = 40
    slope_reduction: float = 0.1
    flat_distance: float = 1e3
    min_change: float = 1e-13
    tolerance: float = 1e-10
    round_off: float = 4 * float(np.finfo(float).eps)


SEARCH = ClosestPointPolicy()


def minimise_on_simplex(Q: Values, slope: Values, barycentric: Values) -> Values:
    """(k, c) minimisers m of slope . (m - l) + (m - l) . Q (m - l) / 2 over m >= 0, sum m = 1.

    The minimum over all changes, if that is inside; else the minimum over the side where the value is lowest.

    Args:
        Q: (k, c, c), positive definite for changes that sum to 0; c = 2 (segments) or 3 (triangles).
        slope: (k, c).
        barycentric: (k, c) l.
    """
    c = barycentric.shape[1]
    b = slope - np.einsum("kce,ke->kc", Q, barycentric)
    first = np.arange(c if c == 3 else 1)
    last = (first + 1) % c
    diagonal, coupling = np.einsum("kcc->kc", Q), Q[:, first, last]
    # along each side the value is a parabola in t, from its first to its last corner
    linear = coupling - diagonal[:, first] + b[:, last] - b[:, first]
    quadratic = diagonal[:, first] + diagonal[:, last] - 2 * coupling
    t = np.clip(np.divide(-linear, quadratic, out=np.zeros_like(linear), where=quadratic > 0), 0.0, 1.0)
    value = diagonal[:, first] / 2 + b[:, first] + t * (linear + t * quadratic / 2)
    side, row = value.argmin(axis=1), np.arange(len(value))
    on_side = np.zeros_like(barycentric)
    on_side[row, first[side]], on_side[row, last[side]] = 1 - t[row, side], t[row, side]
    if c == 2:
        return on_side
    # interior minimum, in coordinates from the first corner along the sides to the two others
    mixed = diagonal[:, 0] - coupling[:, 0] - coupling[:, 2] + coupling[:, 1]
    linear_back = coupling[:, 2] - diagonal[:, 0] + b[:, 2] - b[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        det = quadratic[:, 0] * quadratic[:, 2] - mixed**2
        m1 = (mixed * linear_back - quadratic[:, 2] * linear[:, 0]) / det
        m2 = (mixed * linear[:, 0] - quadratic[:, 0] * linear_back) / det
        interior = np.stack([1 - m1 - m2, m1, m2], axis=1)
    return np.where(np.all(interior > 0, axis=1, keepdims=True), interior, on_side)


def closest_points_of_facets(x: Values, corners: Values) -> tuple[Values, Values]:
    """Points of facets that are closest to points.

    Args:
        x: (k, d) points, m.
        corners: (k, c, d) of triangles or segments, m.

    Returns:
        (k, c) barycentric coordinates, and (k, d) vectors from there to the points, m.
    """
    (k, c, _), arms = corners.shape, corners - x[:, None]
    slope = np.einsum("kcd,kd->kc", arms, arms.mean(axis=1))
    barycentric = minimise_on_simplex(arms @ arms.transpose(0, 2, 1), slope, np.full((k, c), 1 / c))
    return barycentric, -np.einsum("kcd,kc->kd", arms, barycentric)


@dataclass(frozen=True, eq=False)
class FacetClosestPoints:
    """Closest points of facets to an obstacle, with derivatives of the smoothed gap G.

        dG/dx_c = l_c n(y),      d2G/dx2 = L_xx - L_xl S L_lx

    L is the function that l minimises, n the normal of the distance, S the inverse of L_ll over the l that are free.

    Attributes:
        posed: the obstacle.
        x: (k, c, d) corners, m.
        smoothing: mu, m.
        barycentric: (k, c) l.
    """

    posed: PosedShape
    x: Values
    smoothing: float
    barycentric: Values

    def select(self, rows: Ints | Flags) -> FacetClosestPoints:
        """Closest points of some of the facets."""
        return FacetClosestPoints(self.posed, self.x[rows], self.smoothing, self.barycentric[rows])

    @cached_property
    def position(self) -> Values:
        """(k, d) y, m."""
        return np.asarray(np.einsum("kc,kcd->kd", self.barycentric, self.x))

    @cached_property
    def gap(self) -> Values:
        """(k,) G minus its largest possible excess over the minimum distance, m."""
        c, mu = self.x.shape[1], self.smoothing
        offset = self.barycentric - 1 / c
        value = self.posed.distance(self.position) + mu / 2 * np.einsum("kc,kc->k", offset, offset)
        return np.asarray(value - smoothing_error(c, mu))

    @cached_property
    def normal(self) -> Values:
        """(k, d) unit normals n of the distance at the closest points."""
        return self.posed.normal(self.position)

    @cached_property
    def gradient(self) -> Values:
        """(k, c, d) dG/dx."""
        return np.asarray(self.barycentric[:, :, None] * self.normal[:, None, :])

    @cached_property
    def corner_rise(self) -> Values:
        """(k, c) rise of the tangent plane of L from the closest point to each corner, m.

        It may be negative where the closest point was found with a coarse tolerance.
        """
        slope = np.einsum("kcd,kd->kc", self.x - self.x[:, :1], self.normal)
        slope = slope + self.smoothing * (self.barycentric - 1 / self.x.shape[1])
        return np.asarray(slope - np.einsum("kc,kc->k", self.barycentric, slope)[:, None])

    def curvature(self) -> Values:
        """(k, c d, c d) d2G/dx2, 1/m."""
        k, c, d = self.x.shape
        H, free = self.posed.curvature(self.position), self.barycentric > 0
        H_arms = np.einsum("kij,kcj->kci", H, self.x - self.position[:, None])
        Q = np.einsum("kci,kei->kce", self.x - self.position[:, None], H_arms) + self.smoothing * np.eye(c)
        free_pairs = free[:, :, None] & free[:, None, :]
        # bordered matrix of the constraint that changes of l sum to 0
        bordered = np.zeros((k, c + 1, c + 1))
        bordered[:, :c, :c] = np.where(free_pairs, Q, np.eye(c) * ~free[:, :, None])
        bordered[:, :c, c] = bordered[:, c, :c] = free
        S = np.where(free_pairs, np.linalg.inv(bordered)[:, :c, :c], 0.0)
        mixed = np.einsum("kc,kei->kcie", self.barycentric, H_arms) + np.einsum("ce,ki->kcie", np.eye(c), self.normal)
        mixed = mixed.reshape(k, c * d, c)
        direct = np.einsum("kc,ke,kij->kciej", self.barycentric, self.barycentric, H).reshape(k, c * d, c * d)
        return np.asarray(direct - mixed @ S @ mixed.transpose(0, 2, 1))


def smoothing_error(corners: int, smoothing: float) -> float:
    """Largest excess of G over the minimum distance of a facet, mu/2 (1 - 1/c), m."""
    return smoothing / 2 * (1 - 1 / corners)


def find_closest_points(
    posed: PosedShape,
    x: Values,
    smoothing: float,
    start: Values | None = None,
    tolerance: float = SEARCH.tolerance,
) -> FacetClosestPoints:
    """Closest points of facets by Newton's method with a line search on the simplex.

    Args:
        posed: convex obstacle.
        x: (k, c, d) corners, m.
        smoothing: mu, m.
        start: (k, c) barycentric coordinates to start from; None: a guess of the compiled functions, else centroids.
        tolerance: remaining derivative by barycentric coordinates, in smoothings mu.
    """
    kernels = posed.shape.kernels
    guess = 1 / x.shape[1] if kernels is None else np.nan
    barycentric = np.full(x.shape[:2], guess) if start is None else start.copy()
    if kernels is not None:
        kernels.find_closest_points(posed.packed, x, smoothing, tolerance, barycentric)
        return FacetClosestPoints(posed, x, smoothing, barycentric)
    max_residual = np.maximum(tolerance * smoothing, SEARCH.round_off * abs(x).max(axis=(1, 2), initial=0.0))
    active = np.arange(len(x))
    for _ in range(SEARCH.max_iterations):
        points = FacetClosestPoints(posed, x[active], smoothing, barycentric[active])
        rise = points.corner_rise
        remaining = np.where(points.barycentric > 0, abs(rise), -rise).max(axis=1) > max_residual[active]
        if not remaining.any():
            break
        active, points = active[remaining], points.select(remaining)
        step = _newton_step(points)
        barycentric[active] += step
        active = active[abs(step).max(axis=1) > SEARCH.min_change]
    return FacetClosestPoints(posed, x, smoothing, barycentric)


def _newton_step(points: FacetClosestPoints) -> Values:
    """(k, c) changes of barycentric coordinates: Newton steps, halved until the convex L is not steep beyond them."""
    posed, x, mu, barycentric = points.posed, points.x, points.smoothing, points.barycentric
    arms = x - points.position[:, None]
    Q = arms @ posed.curvature(points.position) @ arms.transpose(0, 2, 1) + mu * np.eye(x.shape[1])
    step = minimise_on_simplex(Q, points.corner_rise, barycentric) - barycentric
    max_rate = np.maximum(-SEARCH.slope_reduction * np.einsum("kc,kc->k", points.corner_rise, step), 0.0)
    # no descent: on a middle line of the obstacle, where its distance is not smooth
    step[max_rate == 0] = 0.0
    for _ in range(SEARCH.max_trials):
        end = FacetClosestPoints(posed, x, mu, barycentric + step)
        rate = np.einsum("kc,kc->k", end.corner_rise, step)
        if not (too_far := rate > max_rate).any():
            break
        step[too_far], max_rate[too_far] = step[too_far] / 2, max_rate[too_far] / 2
    return step


@dataclass(frozen=True, eq=False)
class SoftMinGap:
    """Smoothed minimum of the nodal gaps of facets; equal to G, with all derivatives, in front of a plane.

        G'(g) = min over barycentric l of   sum_c l_c g_c + mu/2 |l - 1/c|^2
        dG'/dg_c = l_c,      d2G'/dg2 = -(1 - 1 1^T / n) / mu   over the n coordinates above 0

    Before a convex obstacle G <= G'.

    Attributes:
        gaps: (k, c) nodal gaps, m.
        smoothing: mu, m.
    """

    gaps: Values
    smoothing: float

    @cached_property
    def barycentric(self) -> Values:
        """(k, c) l."""
        k, c = self.gaps.shape
        return minimise_on_simplex(np.tile(self.smoothing * np.eye(c), (k, 1, 1)), self.gaps, np.full((k, c), 1 / c))

    @cached_property
    def gap(self) -> Values:
        """(k,) G' minus its largest possible excess over the minimum, m."""
        c = self.gaps.shape[1]
        offset = self.barycentric - 1 / c
        excess = self.smoothing / 2 * np.einsum("kc,kc->k", offset, offset) - smoothing_error(c, self.smoothing)
        return np.asarray(np.einsum("kc,kc->k", self.barycentric, self.gaps) + excess)

    def curvature(self) -> Values:
        """(k, c, c) d2G'/dg2, 1/m."""
        free = self.barycentric > 0
        free_pairs = free[:, :, None] & free[:, None, :]
        count = free.sum(axis=1)[:, None, None]
        return np.asarray(np.where(free_pairs, 1 / count - np.eye(self.gaps.shape[1]), 0.0) / self.smoothing)
