"""What pushes a surface apart from itself in explicit steps: a penalty on points before facets, on one rank.

    E(x) = sum over points p of  k_p (D - g_p)^2 / 2    where g_p < D

g_p the distance, m, to that facet of the surface which is nearest among those that p is before, outwards; D the gap
from which on it acts. A point that was pushed as the last step ended may lie behind the facet that pushed it, or one
beside that: g_p < 0. All others behind a facet are on the far side of what they belong to. Facets that a point is a
corner of do not push it, nor do edges push one another.

k_p is what the point takes as it comes to be pushed, or a corner of the facet before it if that takes less, and stays
so while it is pushed. With l the shares of the place on the facet and n its direction, dE/dx_p = -k (D - g) n and
dE/dx_c = k l_c (D - g) n: forces sum to nothing, and their moments.

Points before facets: the nearest place on each, and the distance to it, signed by the side that a point is on.
"""

from __future__ import annotations

from dataclasses import dataclass

import ipctk
import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix

from .closest_point import minimise_on_simplex
from .crack_wall_offset import unit_normals
from .ipc_pairs import IpcPairs, PairKind, PairSearch, centred
from .penalty_law import SOME
from .sample_points import Vertices

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
FARTHEST = 3.0  # distances D: gaps that are looked at; what is deeper has gone through
MARGIN = 1.0  # distances D: how far points may go before candidates are looked for again
ALIKE = 1e-9  # of the mean edge: distances to the same place, by several facets
LITTLE = 1e-3  # share of a corner that takes nothing worth speaking of
SEEN = 10.0  # distances D: gaps that are looked for where nothing is within reach
AHEAD = 2.0  # distances D: gaps of points that may be pushed a step later
NONE = -1  # corners of facets that push nothing


@dataclass(frozen=True)
class PointFacetPairs:
    """Points (k,) before facets with corners (k, d).

    Attributes:
        share: (k, d) of the nearest places.    gap: (k,) m, negative behind a facet.
        normal: (k, d) unit vectors from the places, outwards.
    """

    points: Ints
    corners: Ints
    barycentric: Values
    gap: Values
    normal: Values

    def select(self, which: Flags | Ints) -> PointFacetPairs:
        """Some of them."""
        return PointFacetPairs(
            self.points[which], self.corners[which], self.barycentric[which], self.gap[which], self.normal[which]
        )  # fmt: skip


class ClosestPointCache:
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
            self._known &= ~self.involves((x != self._x).any(axis=1))
        self._x = x
        if len(new := rows[~self._known[rows]]):
            self._share[new], self._way[new] = _nearest(x, self.points[new], self.corners[new])
            self._known[new] = True
        return self._share[rows], self._way[rows]

    def involves(self, moved: Flags) -> Flags:
        """(k,) those of which the point or a corner is among (n,)."""
        return np.asarray(moved[self.points] | moved[self.corners].any(axis=1))

    def are_within(self, x: Values, rows: Ints, reach: float) -> Flags:
        """(r,) whether some of them are nearer than `reach` m."""
        _, way = self(x, rows)
        return np.asarray(np.einsum("kd,kd->k", way, way) < reach**2)


def closest_distance(x: Values, points: Ints, corners: Ints, most: float) -> float:
    """The least of points to facets (k, d), `most` at most, m, with points at x (n, d)."""
    _, way = _nearest(x, points, corners)
    return min(most, float(np.linalg.norm(way, axis=1).min(initial=most)))


def point_facet_pairs(x: Values, watched: ClosestPointCache, rows: Ints, reach: float, alike: float) -> PointFacetPairs:
    """Of some pairs those nearer than `reach`, m, one facet for each place: of facets that share it, at distances
    `alike` but for so many m, the one that looks most towards the point or away from it, which tells the side."""
    share, way = watched(x, rows)
    distance = np.linalg.norm(way, axis=1)
    close = np.flatnonzero(distance < reach)
    points, corners = watched.points[rows[close]], watched.corners[rows[close]]
    share, way, distance = share[close], way[close], distance[close]
    normal = unit_normals(x[corners])
    along = np.einsum("kd,kd->k", way, normal)
    order = np.lexsort((distance, points))
    new = (np.diff(points[order]) > 0) | (np.diff(distance[order]) > alike)
    place = np.cumsum(np.r_[False, new][: len(order)])
    best = order[np.lexsort((-abs(along[order]), place))]
    which = best[np.unique(place, return_index=True)[1]]
    gap = np.where(along < 0, -1.0, 1.0) * distance
    clear = distance > alike
    normal = np.where(clear[:, None], way / np.where(clear, gap, 1.0)[:, None], normal)
    return PointFacetPairs(points, corners, share, gap, normal).select(which)


def _nearest(x: Values, points: Ints, corners: Ints) -> tuple[Values, Values]:
    """(k, d) shares of the nearest places, and ways (k, d) from there to the points, m."""
    k, d = corners.shape
    arms = x[corners] - x[points][:, None]
    middle = np.full((k, d), 1 / d)
    slope = np.einsum("kcd,kd->kc", arms, arms.mean(axis=1))
    share = minimise_on_simplex(arms @ arms.transpose(0, 2, 1), slope, middle)
    return share, -np.einsum("kcd,kc->kd", arms, share)


@dataclass(frozen=True)
class PenaltyContacts:
    """What is pushed.

    Attributes:
        at: points (k,) before facets.    rate: (k,) k_p, N/m.
    """

    pairs: PointFacetPairs
    stiffness: Values


class PointFacetPenalty(IpcPairs):
    """A penalty between the points and facets of a surface.

    Attributes:
        by: (n, d) corners of the facets that pushed points as the last step ended, or NONE.
        held: (n,) k_p of these, N/m; 0 of others.    width: D, m.
        slip: (n, d) m, of their springs, where there is friction (penalty_self_contact).
    """

    def __init__(self, rest: Values, elements: Ints, rate: Values, *, distance: float) -> None:
        """`rate`: (n,) k_p, N/m; the others as for Pairs."""
        super().__init__(rest, elements, distance=distance, stiffness=1.0)
        self.contact_facets: Ints = np.full((len(rest), rest.shape[1]), NONE, np.int64)
        self.contact_stiffness: Values = np.zeros(len(rest))
        self.slip: Values = np.zeros_like(rest)
        self._rate, self.width, self._elements = rate, distance, elements
        self._used = np.unique(elements)  # ipctk's points
        kind = PairKind(distance, 1.0, "ee_candidates", Vertices(self._mesh))
        self._near = PairSearch(self._mesh, [kind], FARTHEST * distance, MARGIN * distance)
        self._found: ipctk.Candidates | None = None  # all of which are watched, and some close where points were then
        self._watched: ClosestPointCache
        self._close: Flags
        self._from: Values
        self._last: tuple[Values, PointFacetPairs] | None = None
        self._met_at: tuple[PointFacetPairs, PenaltyContacts] | None = None

    def energy(self, x: Values) -> float:
        """E(x), J."""
        met = self.contacts(x)
        return 0.5 * float(met.stiffness @ (self.width - met.pairs.gap) ** 2)

    def gradient(self, x: Values) -> Values:
        """(n, d) dE/dx, N: the force on the points is its negative."""
        met, found = self.contacts(x), np.zeros_like(x)
        force = (met.stiffness * (self.width - met.pairs.gap))[:, None] * met.pairs.normal
        np.add.at(found, met.pairs.points, -force)
        np.add.at(found, met.pairs.corners, met.pairs.barycentric[:, :, None] * force[:, None])
        return found

    def min_gap(self, x: Values) -> float:
        """The least gap that is below D, m; infinite where there is none."""
        return float(self.contacts(x).pairs.gap.min(initial=np.inf))

    def end_step(self, x: Values, slips: Values | None = None) -> None:
        """A step is over with points at x (n, d), and `slips` (k, d) of what is pushed, m."""
        met = self.contacts(x)
        if not len(met.stiffness) and not self.contact_stiffness.any():
            return
        by, held, slip = np.full_like(self.contact_facets, NONE), np.zeros(len(x)), np.zeros_like(x)
        by[met.pairs.points], held[met.pairs.points] = met.pairs.corners, met.stiffness
        if slips is not None:
            slip[met.pairs.points] = slips
        self.set_contacts(by, held, slip)

    def set_contacts(self, by: Ints, held: Values, slip: Values) -> None:
        """What is pushed from here on."""
        self.contact_facets, self.contact_stiffness, self.slip, self._met_at = by, held, slip, None

    def max_added_frequency(self, x: Values, weights: csr_matrix, mass: Values) -> float:
        """What it adds at most to the square of a frequency (penalty_law), 1/s^2, with points near x (n, d) that follow
        nodes of `mass` (nodes,), kg, by `weights` (n, nodes)."""
        near = self._before(x, AHEAD * self.width)
        k, d = near.pairs.corners.shape
        if not k:
            return 0.0
        rows = np.repeat(np.arange(k), d)
        of_facets = csr_matrix(
            (near.pairs.barycentric.reshape(-1), (rows, near.pairs.corners.reshape(-1))), shape=(k, len(x))
        )
        size = abs(weights[near.pairs.points] - of_facets @ weights)
        load = size.T @ (near.stiffness * np.asarray(size.sum(axis=1)).ravel())
        return float((load / mass).max(initial=0.0))

    def clearance(self, x: Values) -> float:
        """By how much any two points at x (n, d) may come closer before a look is due, m: 0 unless none are near."""
        if self.contact_stiffness.any() or len(self._may_meet(x)):
            return 0.0
        on, found, reach = centred(self._mesh.vertices(x)), ipctk.Candidates(), SEEN * self.width
        found.build(self._mesh, on, on, reach / 2, ipctk.LBVH())
        points, facets = self._numbers(found).T
        return max(0.0, closest_distance(x, points, self._elements[facets], reach) - AHEAD * self.width)

    def contacts(self, x: Values) -> PenaltyContacts:
        """What is pushed."""
        if self._met_at is None or self._met_at[0] is not self._facing(x):
            self._met_at = self._facing(x), self._before(x, self.width)
        return self._met_at[1]

    def _before(self, x: Values, reach: float) -> PenaltyContacts:
        """The nearest facet of each point that has one within `reach`, m."""
        every = self._facing(x)
        known = self.contact_facets[every.points]
        again = (known[:, :, None] == every.corners[:, None]).any(axis=(1, 2))
        some = every.select((every.gap > 0) | again)
        order = np.lexsort((abs(some.gap), some.points))
        which = np.zeros(len(order), bool)
        which[order[np.unique(some.points[order], return_index=True)[1]]] = True
        some = some.select(which & (some.gap < reach))
        return PenaltyContacts(some, self._rates_of(some))

    def _facing(self, x: Values) -> PointFacetPairs:
        """What points are before, or behind; that of the last x is kept."""
        if self._last is None or not np.array_equal(x, self._last[0]):
            here, rows = x.copy(), self._may_meet(x)
            self._last = here, point_facet_pairs(here, self._watched, rows, FARTHEST * self.width, ALIKE * self._edge)
        return self._last[1]

    def _rates_of(self, at: PointFacetPairs) -> Values:
        """(k,) k_p: no more than a corner of the facet takes; while a point is pushed it stays as it was."""
        takes = (self._rate[at.corners] / np.maximum(at.barycentric, LITTLE)).min(axis=1, initial=np.inf)
        held = self.contact_stiffness[at.points]
        return np.where(held > 0, held, np.minimum(self._rate[at.points], takes))

    def _may_meet(self, x: Values) -> Ints:
        """(k,) which of the pairs that are watched may be as near, or as deep, as counts: those that were when their
        points were last near here."""
        on = self._mesh.vertices(x)
        (found,) = self._near.candidates(on)
        here, reach = centred(on), (FARTHEST + 3 * MARGIN) * self.width
        if found is not self._found:
            points, facets = self._numbers(found).T
            self._found, self._watched, self._from = found, ClosestPointCache(points, self._elements[facets]), here
            self._close = self._watched.are_within(x.copy(), np.arange(len(points)), reach)
        elif (gone := np.sum((here - self._from) ** 2, axis=1) > (MARGIN * self.width) ** 2).any():
            moved = np.zeros(len(x), bool)
            moved[self._used[gone]] = True
            rows = np.flatnonzero(self._watched.involves(moved))
            self._close[rows] = self._watched.are_within(x.copy(), rows, reach)
            self._from = np.where(gone[:, None], here, self._from)
        return np.flatnonzero(self._close)

    def _numbers(self, found: ipctk.Candidates) -> Ints:
        """(k, 2) points and facets of ipctk's candidates."""
        solid = self.contact_facets.shape[1] == 3
        ids = [(each.vertex_id, each.face_id) for each in found.fv_candidates] if solid else \
              [(each.vertex_id, each.edge_id) for each in found.ev_candidates]  # fmt: skip
        pairs = np.array(ids, np.int64).reshape(-1, 2)
        return np.column_stack([self._used[pairs[:, 0]], pairs[:, 1]])


def penalty_stiffness(weights: csr_matrix, area: Values, mass: Values, pressure: float, most: float) -> Values:
    """(n,) k_p, N/m: `pressure` (Pa/m) on half the area of each point, as the other side pushes too, but no more than
    what adds `most` (1/s^2) to the square of a frequency where each node is met by as many points as it carries."""
    size = abs(weights)
    spread = np.asarray(size.sum(axis=1)).ravel()
    rate = (size.T @ (area * spread)) / mass
    held = size.tocoo()
    fastest = np.zeros(len(area))
    np.maximum.at(fastest, held.row, np.where(held.data > SOME * spread[held.row], rate[held.col], 0.0))
    own = np.where(fastest > 0, area / np.where(fastest > 0, fastest, 1.0), 0.0)
    return np.minimum(0.5 * pressure * area, 0.25 * most * own)
