"""The place on a facet that is nearest to a convex obstacle, or deepest in it.

    G(x) = min over shares l of   D(y) + mu/2 |l - 1/c|^2,      y = sum_c l_c x_c,   l_c >= 0,  sum l_c = 1

D the signed distance, x (c, d) the corners of a triangle (c = 3) or a segment (c = 2). Without the last term the place
would jump from one end of a flat obstacle to the other as the facet tilts; with it the shares are unique and change
steadily, and G, the least of a convex function, has the derivatives

    dG/dx_c = l_c n(y),      d2G/dx2 = L_xx - L_xl S L_lx

n the normal of the distance, L the function above, S the inverse of L_ll over shares that may change. It is never more
than mu/2 (1 - 1/c) above the least distance of the facet.

The least of a quadratic over shares: a step of Newton's method to the deepest place of a facet.

What the deepest place of a facet would be before an obstacle that is flat: the least of its corners' gaps, softened.

    G'(g) = min over shares l of   sum_c l_c g_c + mu/2 |l - 1/c|^2,      l_c >= 0,  sum l_c = 1

As `deepest`, with distances that are linear between the corners: there G = G' with all derivatives, and before a convex
obstacle G <= G'.

    dG'/dg_c = l_c,      d2G'/dg2 = - (1 - 1 1^T / n) / mu   over the n shares above 0
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from .pose import PosedShape

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
ITERATIONS, LOOKS = 40, 40
ENOUGH = 0.1  # of the slope along a step: what is left where it ends
FAR = 1e3  # of its size, from which on an obstacle is as good as flat for a facet
STILL = 1e-13  # of all shares: a step that is none
FOUND = 1e-11  # of the size of a facet: what is left of a derivative by shares


def minimise_on_simplex(Q: Values, slope: Values, share: Values) -> Values:
    """(k, c) shares m where slope . (m - l) + (m - l) . Q (m - l) / 2 is least, m >= 0, sum m = 1, l = `share` (k, c);
    of segments (c = 2) or triangles (c = 3), Q (k, c, c) positive definite for changes that sum to 0.

    Inside, if the least of all changes is there; else on that side where it is lowest.
    """
    c = share.shape[1]
    b = slope - np.einsum("kce,ke->kc", Q, share)
    first = np.arange(c if c == 3 else 1)
    last = (first + 1) % c
    ends, across = np.einsum("kcc->kc", Q), Q[:, first, last]
    fall = across - ends[:, first] + b[:, last] - b[:, first]
    bent = ends[:, first] + ends[:, last] - 2 * across
    t = np.clip(np.divide(-fall, bent, out=np.zeros_like(fall), where=bent > 0), 0.0, 1.0)
    value = ends[:, first] / 2 + b[:, first] + t * (fall + t * bent / 2)
    best, every = value.argmin(axis=1), np.arange(len(value))
    least = np.zeros_like(share)
    least[every, first[best]], least[every, last[best]] = 1 - t[every, best], t[every, best]
    if c == 2:
        return least
    # from the first corner along the sides to the others
    mixed = ends[:, 0] - across[:, 0] - across[:, 2] + across[:, 1]
    back = across[:, 2] - ends[:, 0] + b[:, 2] - b[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        det = bent[:, 0] * bent[:, 2] - mixed**2
        m1 = (mixed * back - bent[:, 2] * fall[:, 0]) / det
        m2 = (mixed * fall[:, 0] - bent[:, 0] * back) / det
        inner = np.stack([1 - m1 - m2, m1, m2], axis=1)
    return np.where(np.all(inner > 0, axis=1, keepdims=True), inner, least)


@dataclass(frozen=True, eq=False)
class FacetClosestPoints:
    """The places on facets with corners x (k, c, d).

    Attributes:
        placed: the obstacle.    soften: mu, m.    share: (k, c) l.
    """

    posed: PosedShape
    x: Values
    smoothing: float
    barycentric: Values

    @cached_property
    def position(self) -> Values:
        """(k, d) y, m."""
        return np.asarray(np.einsum("kc,kcd->kd", self.barycentric, self.x))

    @cached_property
    def gap(self) -> Values:
        """(k,) G less the most that it can be above the least distance, m."""
        return _height(self.posed, self.x, self.barycentric, self.smoothing) - smoothing_error(
            self.x.shape[1], self.smoothing
        )

    @cached_property
    def normal(self) -> Values:
        """(k, d) n."""
        return self.posed.normal(self.position)

    @property
    def gradient(self) -> Values:
        """(k, c, d) dG/dx."""
        return np.asarray(self.barycentric[:, :, None] * self.normal[:, None, :])

    @cached_property
    def corner_rise(self) -> Values:
        """(k, c) by how much the tangent of L rises from the place to each corner, m: where a place is found roughly it
        may fall."""
        slope = _slope(self.x, self.normal, self.barycentric, self.smoothing)
        return np.asarray(slope - np.einsum("kc,kc->k", self.barycentric, slope)[:, None])

    def curvature(self) -> Values:
        """(k, c d, c d) d2G/dx2, 1/m."""
        k, c, d = self.x.shape
        H, free = self.posed.curvature(self.position), self.barycentric > 0
        out = np.einsum("kij,kcj->kci", H, self.x - self.position[:, None])
        Q = np.einsum("kci,kei->kce", self.x - self.position[:, None], out) + self.smoothing * np.eye(c)
        both = free[:, :, None] & free[:, None, :]
        bordered = np.zeros((k, c + 1, c + 1))
        bordered[:, :c, :c] = np.where(both, Q, np.eye(c) * ~free[:, :, None])
        bordered[:, :c, c] = bordered[:, c, :c] = free
        S = np.where(both, np.linalg.inv(bordered)[:, :c, :c], 0.0)
        mixed = np.einsum("kc,kei->kcie", self.barycentric, out) + np.einsum("ce,ki->kcie", np.eye(c), self.normal)
        mixed = mixed.reshape(k, c * d, c)
        direct = np.einsum("kc,ke,kij->kciej", self.barycentric, self.barycentric, H).reshape(k, c * d, c * d)
        return np.asarray(direct - mixed @ S @ mixed.transpose(0, 2, 1))


def smoothing_error(corners: int, soften: float) -> float:
    """m, the most that G can be above the least distance."""
    return soften / 2 * (1 - 1 / corners)


def find_closest_points(
    placed: PosedShape, x: Values, soften: float, start: Values | None = None, found: float = FOUND
) -> FacetClosestPoints:
    """Of facets with corners x (k, c, d); `start`: shares (k, c) to look first at, `found`: what is left of derivatives
    by shares, of the size of a facet.

    By Newton's method, each step of which goes towards the least of a quadratic over all shares, as far as L goes down.
    """
    small = found * np.linalg.norm(x[:, 1] - x[:, 0], axis=1)
    share = initial_barycentric(placed, x, soften) if start is None else start.copy()
    slope, left = _Slope(placed, x, soften)(share), np.arange(len(x))
    for _ in range(ITERATIONS):
        rise = _over(slope[left], share[left])
        left = left[np.where(share[left] > 0, abs(rise), -rise).max(axis=1) > small[left]]
        if not len(left):
            break
        now, corners = share[left], x[left]
        step = minimise_on_simplex(_bent(placed, corners, now, soften), slope[left], now) - now
        part, slope[left] = _down(_Slope(placed, corners, soften), now, step, slope[left])
        share[left] = now + part[:, None] * step
        left = left[part * abs(step).max(axis=1) > STILL]
    return FacetClosestPoints(placed, x, soften, share)


def initial_barycentric(placed: PosedShape, x: Values, soften: float) -> Values:
    """(k, c) shares of the places of facets nearest to that point of the core of an obstacle, which its least radius
    rounds, that is nearest to their middles: before a ball the deepest, but for what is softened."""
    k, c, _ = x.shape
    middle = x.mean(axis=1)
    arms = x - middle[:, None]
    size = np.linalg.norm(arms, axis=2).max(axis=1, initial=0.0)
    away = np.minimum(placed.distance(middle) + placed.shape.min_radius, FAR * size)
    bent = np.einsum("kci,kei->kce", arms, arms) + soften * (abs(away) + soften)[:, None, None] * np.eye(c)
    fall = away[:, None] * np.einsum("kcd,kd->kc", arms, placed.normal(middle))
    return minimise_on_simplex(bent, fall, np.full((k, c), 1 / c))


def _bent(placed: PosedShape, x: Values, share: Values, soften: float) -> Values:
    """(k, c, c) second derivative of L by the shares, but for what is the same of all."""
    place = np.einsum("kc,kcd->kd", share, x)
    arms = x - place[:, None]
    return np.asarray(arms @ placed.curvature(place) @ arms.transpose(0, 2, 1) + soften * np.eye(x.shape[1]))


@dataclass(frozen=True)
class _Slope:
    """Derivative of L by shares (k, c), but for what is the same of all."""

    placed: PosedShape
    x: Values
    soften: float

    def __call__(self, share: Values, of: Ints | slice = slice(None)) -> Values:
        x = self.x[of]
        return _slope(x, self.placed.normal(np.einsum("kc,kcd->kd", share, x)), share, self.soften)


def _over(slope: Values, share: Values) -> Values:
    """(k, c) how L rises towards each corner."""
    return np.asarray(slope - np.einsum("kc,kc->k", slope, share)[:, None])


def _down(look: _Slope, share: Values, step: Values, slope: Values) -> tuple[Values, Values]:
    """(k,) parts of steps (k, c) after which L, a convex function, is no longer steep along them; and the slopes (k, c)
    there."""
    part, after = np.ones(len(share)), look(share + step)
    # right to the last digits where it is almost nothing: steps sum to 0 but for round-off
    falls, rises = (np.einsum("kc,kc->k", _over(each, share), step) for each in (slope, after))
    low, high, at_low, at_high = np.zeros(len(share)), np.ones(len(share)), falls.copy(), rises
    left = np.flatnonzero((rises > -ENOUGH * falls) & (falls < 0))
    for count in range(LOOKS):
        if not len(left):
            break
        falsely = low[left] - at_low[left] * (high[left] - low[left]) / (at_high[left] - at_low[left])
        part[left] = (low[left] + high[left]) / 2 if count % 3 == 2 else falsely  # which may stall
        after[left] = look(share[left] + part[left, None] * step[left], left)
        now = np.einsum("kc,kc->k", _over(after[left], share[left]), step[left])
        below, above = left[now < 0], left[now >= 0]
        low[below], at_low[below] = part[below], now[now < 0]
        high[above], at_high[above] = part[above], now[now >= 0]
        left = left[(abs(now) > -ENOUGH * falls[left]) & (high[left] - low[left] > STILL)]
    return part, after


def _height(placed: PosedShape, x: Values, share: Values, soften: float) -> Values:
    """(k,) D(y) + mu/2 |l - 1/c|^2."""
    away = share - 1 / x.shape[1]
    return placed.distance(np.einsum("kc,kcd->kd", share, x)) + soften / 2 * np.einsum("kc,kc->k", away, away)


def _slope(x: Values, normal: Values, share: Values, soften: float) -> Values:
    """(k, c) its derivative by the shares, but for what is the same of all."""
    return np.asarray(np.einsum("kcd,kd->kc", x - x[:, :1], normal) + soften * (share - 1 / x.shape[1]))


@dataclass(frozen=True, eq=False)
class SoftMinGap:
    """Of facets whose corners have `gaps` (k, c), m; `soften`: mu, m."""

    gaps: Values
    smoothing: float

    @cached_property
    def barycentric(self) -> Values:
        """(k, c) l."""
        k, c = self.gaps.shape
        return minimise_on_simplex(np.tile(self.smoothing * np.eye(c), (k, 1, 1)), self.gaps, np.full((k, c), 1 / c))

    @property
    def gap(self) -> Values:
        """(k,) G' less the most that it can be above the least, m."""
        c = self.gaps.shape[1]
        off = self.barycentric - 1 / c
        above = self.smoothing / 2 * np.einsum("kc,kc->k", off, off) - smoothing_error(c, self.smoothing)
        return np.asarray(np.einsum("kc,kc->k", self.barycentric, self.gaps) + above)

    def curvature(self) -> Values:
        """(k, c, c) d2G'/dg2, 1/m."""
        free = self.barycentric > 0
        both = free[:, :, None] & free[:, None, :]
        count = free.sum(axis=1)[:, None, None]
        return np.asarray(np.where(both, 1 / count - np.eye(self.gaps.shape[1]), 0.0) / self.smoothing)
