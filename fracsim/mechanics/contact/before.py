"""Points before facets: the nearest place on each, and the distance to it, signed by the side that a point is on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .recede import normals
from .shares import least_over_shares

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Before:
    """Points (k,) before facets with corners (k, d).

    Attributes:
        share: (k, d) of the nearest places.    gap: (k,) m, negative behind a facet.
        normal: (k, d) unit vectors from the places, outwards.
    """

    points: Ints
    corners: Ints
    share: Values
    gap: Values
    normal: Values

    def some(self, which: Flags | Ints) -> Before:
        """Some of them."""
        return Before(
            self.points[which], self.corners[which], self.share[which], self.gap[which], self.normal[which]
        )  # fmt: skip


class Watched:
    """Nearest places of points (k,) on facets with corners (k, d), found anew where either has moved."""

    def __init__(self, points: Ints, corners: Ints) -> None:
        self.points, self.corners = points, corners
        self._share, self._way = np.zeros(corners.shape), np.zeros(corners.shape)
        self._known = np.zeros(len(points), bool)
        self._x: Values | None = None

    def __call__(self, x: Values, rows: Ints) -> tuple[Values, Values]:
        """(r, d) shares of the nearest places of some of them, and ways (r, d) from there to the points at x (n, d),
        m."""
        if self._x is None or x.shape != self._x.shape:
            self._known[:] = False
        elif x is not self._x:
            self._known &= ~self.of((x != self._x).any(axis=1))
        self._x = x
        if len(new := rows[~self._known[rows]]):
            self._share[new], self._way[new] = _nearest(x, self.points[new], self.corners[new])
            self._known[new] = True
        return self._share[rows], self._way[rows]

    def of(self, moved: Flags) -> Flags:
        """(k,) those of which the point or a corner is among (n,)."""
        return np.asarray(moved[self.points] | moved[self.corners].any(axis=1))

    def nearer(self, x: Values, rows: Ints, reach: float) -> Flags:
        """(r,) whether some of them are nearer than `reach` m."""
        _, way = self(x, rows)
        return np.asarray(np.einsum("kd,kd->k", way, way) < reach**2)


def nearest(x: Values, points: Ints, corners: Ints, most: float) -> float:
    """The least of points to facets (k, d), `most` at most, m, with points at x (n, d)."""
    _, way = _nearest(x, points, corners)
    return min(most, float(np.linalg.norm(way, axis=1).min(initial=most)))


def before(x: Values, watched: Watched, rows: Ints, reach: float, alike: float) -> Before:
    """Of some pairs those nearer than `reach`, m, one facet for each place: of facets that share it, at distances
    `alike` but for so many m, the one that looks most towards the point or away from it, which tells the side."""
    share, way = watched(x, rows)
    distance = np.linalg.norm(way, axis=1)
    close = np.flatnonzero(distance < reach)
    points, corners = watched.points[rows[close]], watched.corners[rows[close]]
    share, way, distance = share[close], way[close], distance[close]
    normal = normals(x[corners])
    along = np.einsum("kd,kd->k", way, normal)
    order = np.lexsort((distance, points))
    new = (np.diff(points[order]) > 0) | (np.diff(distance[order]) > alike)
    place = np.cumsum(np.r_[False, new][: len(order)])
    best = order[np.lexsort((-abs(along[order]), place))]
    which = best[np.unique(place, return_index=True)[1]]
    gap = np.where(along < 0, -1.0, 1.0) * distance
    clear = distance > alike
    normal = np.where(clear[:, None], way / np.where(clear, gap, 1.0)[:, None], normal)
    return Before(points, corners, share, gap, normal).some(which)


def _nearest(x: Values, points: Ints, corners: Ints) -> tuple[Values, Values]:
    """(k, d) shares of the nearest places, and ways (k, d) from there to the points, m."""
    k, d = corners.shape
    arms = x[corners] - x[points][:, None]
    middle = np.full((k, d), 1 / d)
    slope = np.einsum("kcd,kd->kc", arms, arms.mean(axis=1))
    share = least_over_shares(arms @ arms.transpose(0, 2, 1), slope, middle)
    return share, -np.einsum("kcd,kc->kd", arms, share)
