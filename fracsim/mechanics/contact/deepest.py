"""The place on a facet that is nearest to a convex obstacle, or deepest in it.

    G(x) = min over shares l of   D(y) + mu/2 |l - 1/c|^2,      y = sum_c l_c x_c,   l_c >= 0,  sum l_c = 1

D the signed distance, x (c, d) the corners of a triangle (c = 3) or a segment (c = 2). Without the last term the place
would jump from one end of a flat obstacle to the other as the facet tilts; with it the shares are unique and change
steadily, and G, the least of a convex function, has the derivatives

    dG/dx_c = l_c n(y),      d2G/dx2 = L_xx - L_xl S L_lx

n the normal of the distance, L the function above, S the inverse of L_ll over shares that may change. It is never more
than mu/2 (1 - 1/c) above the least distance of the facet.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from .placed import Placed

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

ITERATIONS, HALVINGS = 60, 30
STARTS = 0.0, 0.9, 0.5  # from the middle; from near the best of the sides, where that does not lead anywhere
OUTSIDE = 0.2  # how far below 0 shares may fall on the way
FOUND = 1e-11  # of the size of a facet: what is left of a derivative by shares


@dataclass(frozen=True, eq=False)
class Deepest:
    """The places on facets with corners x (k, c, d).

    Attributes:
        placed: the obstacle.    soften: mu, m.    share: (k, c) l.
    """

    placed: Placed
    x: Values
    soften: float
    share: Values

    @cached_property
    def place(self) -> Values:
        """(k, d) y, m."""
        return np.asarray(np.einsum("kc,kcd->kd", self.share, self.x))

    @cached_property
    def gap(self) -> Values:
        """(k,) G less the most that it can be above the least distance, m."""
        return _height(self.placed, self.x, self.share, self.soften) - most_above(self.x.shape[1], self.soften)

    @cached_property
    def normal(self) -> Values:
        """(k, d) n."""
        return self.placed.normal(self.place)

    @property
    def by_corner(self) -> Values:
        """(k, c, d) dG/dx."""
        return np.asarray(self.share[:, :, None] * self.normal[:, None, :])

    @cached_property
    def slack(self) -> Values:
        """(k, c) by how much the tangent of L rises from the place to each corner, m: where a place is found roughly it
        may fall."""
        slope = _slope(self.x, self.normal, self.share, self.soften)
        return np.asarray(slope - np.einsum("kc,kc->k", self.share, slope)[:, None])

    def curvature(self) -> Values:
        """(k, c d, c d) d2G/dx2, 1/m."""
        k, c, d = self.x.shape
        H, free = self.placed.curvature(self.place), self.share > 0
        out = np.einsum("kij,kcj->kci", H, self.x - self.place[:, None])
        Q = np.einsum("kci,kei->kce", self.x - self.place[:, None], out) + self.soften * np.eye(c)
        both = free[:, :, None] & free[:, None, :]
        bordered = np.zeros((k, c + 1, c + 1))
        bordered[:, :c, :c] = np.where(both, Q, np.eye(c) * ~free[:, :, None])
        bordered[:, :c, c] = bordered[:, c, :c] = free
        S = np.where(both, np.linalg.inv(bordered)[:, :c, :c], 0.0)
        mixed = np.einsum("kc,kei->kcie", self.share, out) + np.einsum("ce,ki->kcie", np.eye(c), self.normal)
        mixed = mixed.reshape(k, c * d, c)
        direct = np.einsum("kc,ke,kij->kciej", self.share, self.share, H).reshape(k, c * d, c * d)
        return np.asarray(direct - mixed @ S @ mixed.transpose(0, 2, 1))


def most_above(corners: int, soften: float) -> float:
    """m, the most that G can be above the least distance."""
    return soften / 2 * (1 - 1 / corners)


def deepest(placed: Placed, x: Values, soften: float, found: float = FOUND) -> Deepest:
    """Of facets with corners x (k, c, d): along their sides, and inside where that is deeper; `found`: what is left of
    derivatives by shares, of the size of a facet."""
    k, c, _ = x.shape
    share, least = np.zeros((k, c)), np.full(k, np.inf)
    sides = [[first, (first + 1) % c] for first in range(c if c == 3 else 1)]
    parts = _along(placed, np.concatenate([x[:, ends] for ends in sides]), soften, found)
    for ends, along in zip(sides, parts.reshape(len(sides), k), strict=True):
        trial = np.zeros((k, c))
        trial[:, ends] = np.column_stack([1 - along, along])
        height = _height(placed, x, trial, soften)
        better = height < least
        share[better], least[better] = trial[better], height[better]
    if c == 3:
        for start in STARTS if k else ():
            inner = _lower_inside(placed, x, soften, share, 100 * found)
            if not len(inner):
                break
            begin = start * share[inner] + (1 - start) / 3
            share[inner] = _inside(placed, x[inner], soften, begin, share[inner], found)
    return Deepest(placed, x, soften, share)


def _lower_inside(placed: Placed, x: Values, soften: float, share: Values, by: float) -> Ints:
    """Facets that have a place nearer to the obstacle on the way from this one to a corner."""
    slope = _slope(x, placed.normal(np.einsum("kc,kcd->kd", share, x)), share, soften)
    below = slope.min(axis=1) - np.einsum("kc,kc->k", share, slope)
    return np.flatnonzero(below < -by * np.linalg.norm(x[:, 1] - x[:, 0], axis=1))


def _height(placed: Placed, x: Values, share: Values, soften: float) -> Values:
    """(k,) D(y) + mu/2 |l - 1/c|^2."""
    away = share - 1 / x.shape[1]
    return placed.distance(np.einsum("kc,kcd->kd", share, x)) + soften / 2 * np.einsum("kc,kc->k", away, away)


def _slope(x: Values, normal: Values, share: Values, soften: float) -> Values:
    """(k, c) its derivative by the shares, but for what is the same of all."""
    return np.asarray(np.einsum("kcd,kd->kc", x - x[:, :1], normal) + soften * (share - 1 / x.shape[1]))


def _along(placed: Placed, ends: Values, soften: float, found: float) -> Values:
    """(k,) share of the second end (k, 2, d) of a side: the zero of a derivative that never falls, between brackets."""
    side = ends[:, 1] - ends[:, 0]
    small = found * np.linalg.norm(side, axis=1)

    def slope(of: Ints, t: Values) -> Values:
        n = placed.normal(ends[of, 0] + t[:, None] * side[of])
        return np.asarray(np.einsum("kd,kd->k", n, side[of]) + soften * (2 * t - 1))

    low, high, every = np.zeros(len(ends)), np.ones(len(ends)), np.arange(len(ends))
    at_first, at_last = slope(every, low) >= 0, slope(every, high) <= 0
    t, left = np.where(at_first, 0.0, np.where(at_last, 1.0, 0.5)), every[~at_first & ~at_last]
    last = np.full(len(ends), np.inf)
    for _ in range(ITERATIONS):
        now = slope(left, t[left])
        left, now = left[abs(now) > small[left]], now[abs(now) > small[left]]
        if not len(left):
            break
        at = t[left]
        low[left[now < 0]], high[left[now > 0]] = at[now < 0], at[now > 0]
        H = placed.curvature(ends[left, 0] + at[:, None] * side[left])
        ahead = at - now / (np.einsum("kd,kde,ke->k", side[left], H, side[left]) + 2 * soften)
        # where the curvature jumps Newton's method may go to and fro: the bracket is halved where it gains too little
        inside = (ahead > low[left]) & (ahead < high[left]) & (abs(now) <= 0.5 * last[left])
        last[left] = abs(now)
        t[left] = np.where(inside, ahead, (low[left] + high[left]) / 2)
    return t


def _inside(placed: Placed, x: Values, soften: float, begin: Values, otherwise: Values, found: float) -> Values:
    """(k, 3) shares inside triangles by Newton's method, with steps that are halved; `otherwise` where they leave or
    are no better."""
    sides, share, left = x[:, 1:] - x[:, :1], begin, np.arange(len(x))
    for _ in range(ITERATIONS):
        now, E = share[left], sides[left]
        place = np.einsum("kc,kcd->kd", now, x[left])
        slope = np.einsum("kad,kd->ka", E, placed.normal(place)) + soften * (now[:, 1:] - now[:, :1])
        H = np.einsum("kai,kij,kbj->kab", E, placed.curvature(place), E) + soften * (np.eye(2) + 1)
        step = -np.linalg.solve(H, slope[:, :, None])[:, :, 0]
        share[left] = _lower(placed, x[left], soften, now, np.column_stack([-step.sum(axis=1), step]), slope, step)
        left = left[abs(slope).max(axis=1) > found * np.linalg.norm(E[:, 0], axis=1)]
        if not len(left):
            break
    better = _height(placed, x, share, soften) < _height(placed, x, otherwise, soften)
    return np.where((better & (share.min(axis=1) > 0))[:, None], share, otherwise)


def _lower(
    placed: Placed, x: Values, soften: float, share: Values, step: Values, slope: Values, inner: Values
) -> Values:
    """Shares after a step, or as much of it as goes down and not far out of the triangle."""
    height, falls = _height(placed, x, share, soften), np.einsum("ka,ka->k", slope, inner)
    room = np.divide(share + OUTSIDE, -step, out=np.full_like(step, np.inf), where=step < 0).min(axis=1)
    part, up = np.minimum(room, 1.0), np.arange(len(x))
    slack = 1e-15 * np.linalg.norm(x[:, 0] - placed.pose.centre, axis=1)  # round-off goes the whole way
    for _ in range(HALVINGS):
        trial = share[up] + part[up, None] * step[up]
        above = _height(placed, x[up], trial, soften) - height[up] - slack[up]
        up = up[above > 1e-4 * part[up] * falls[up]]
        if not len(up):
            break
        part[up] /= 2
    return np.asarray(share + part[:, None] * step)
