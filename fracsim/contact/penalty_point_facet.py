"""Points before facets of a surface, for a penalty in explicit steps.

g_p is the distance, m, of a point p to the nearest facet of those that p is in front of. A point that was near a facet
at the end of the last step may lie behind it, or one beside it, within 60 degrees of its normal: g_p < 0. All other
points behind a facet are on the far side of its body. Facets of which a point is a corner do not act on it.

k_p is the stiffness that the point, or a corner of its facet, may have as contact begins, and is constant during
contact. The weights of a contact are 1 of the point and minus the barycentric coordinates on the facet.

Equations: docs/theory.md#explicit-contact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .closest_point import minimise_on_simplex
from .pair_search import PairFilter, PairSearch, SimplexPairs, near_pairs
from .penalty_contacts import NO_POINT, ContactHistory, ContactStiffness, NodalMassShare, PenaltyContacts
from .retractable_surface import unit_normals

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class PointFacetPolicy:
    """Tuned numbers of point-facet pairs; lengths in D.

    Attributes:
        max_gap: largest gap, or depth, of a pair; a deeper point has passed through.
        search_margin: motion of points after which pairs are searched again.
        same_distance: difference of distances, in mean edges, of facets that share a closest point.
        min_slope: cosine between the normal of a facet and the direction to a point behind it. A facet that is seen
            from its side tells nothing: its plane has points of the same body in it.
        min_barycentric: coordinate of a corner below which the corner does not carry a point.
        clearance_gap: gaps that are searched where nothing is within reach.
        ahead_gap: gap of points that may be in contact a step later; below that of the faces of a new crack
            (SURFACE.face_gap), which round-off would decide about.
        max_added: part of the allowed increase of the square of a frequency that the points at a node may cause.
    """

    max_gap: float = 3.0
    search_margin: float = 1.0
    same_distance: float = 1e-9
    min_slope: float = 0.5
    min_barycentric: float = 1e-3
    clearance_gap: float = 10.0
    ahead_gap: float = 1.99
    max_added: float = 0.25


POINT_FACET = PointFacetPolicy()


@dataclass(frozen=True)
class PointFacetPairs:
    """Points in front of facets.

    Attributes:
        points: (k,).
        corners: (k, d) of the facets.
        barycentric: (k, d) of the closest points.
        gap: (k,) m, negative behind a facet.
        normal: (k, d) unit vectors from the closest points, outwards.
    """

    points: Ints
    corners: Ints
    barycentric: Values
    gap: Values
    normal: Values

    def select(self, rows: Flags | Ints) -> PointFacetPairs:
        """Some of the pairs."""
        return PointFacetPairs(
            self.points[rows], self.corners[rows], self.barycentric[rows], self.gap[rows], self.normal[rows]
        )


def closest_distance(x: Values, points: Ints, corners: Ints, limit: float) -> float:
    """Least distance of points to facets (k, d), at most `limit`, m, with points at x (n, d)."""
    _, offset = _closest_points(x, points, corners)
    return min(limit, float(np.linalg.norm(offset, axis=1).min(initial=limit)))


def point_facet_pairs(x: Values, points: Ints, corners: Ints, reach: float, tolerance: float) -> PointFacetPairs:
    """Pairs of points and facets (k, d) nearer than `reach`, m, one facet for each closest point.

    Of facets that share a closest point, at equal distances within `tolerance`, m, the one is taken whose normal is
    most parallel to the offset: it tells the side of the point.
    """
    barycentric, offset = _closest_points(x, points, corners)
    distance = np.linalg.norm(offset, axis=1)
    near = np.flatnonzero(distance < reach)
    points, corners = points[near], corners[near]
    barycentric, offset, distance = barycentric[near], offset[near], distance[near]
    normal = unit_normals(x[corners])
    height = np.einsum("kd,kd->k", offset, normal)
    order = np.lexsort((distance, points))
    is_new = (np.diff(points[order]) > 0) | (np.diff(distance[order]) > tolerance)
    group = np.cumsum(np.r_[False, is_new][: len(order)])
    steepest = np.zeros(len(order))
    np.maximum.at(steepest, group, abs(height[order]))
    # round-off decides nothing: of several facets the first one
    level = abs(height[order]) >= steepest[group] - tolerance
    selected = np.sort(_first_rows(group[level], order[level]))
    gap = np.where(height < 0, -1.0, 1.0) * distance
    is_clear = distance > tolerance
    normal = np.where(is_clear[:, None], offset / np.where(is_clear, gap, 1.0)[:, None], normal)
    return PointFacetPairs(points, corners, barycentric, gap, normal).select(selected)


def _first_rows(groups: Ints, rows: Ints) -> Ints:
    """(g,) lowest of the rows (k,) of each group (k,), in the order of the groups."""
    order = np.lexsort((rows, groups))
    return rows[order[np.unique(groups[order], return_index=True)[1]]]


def _closest_points(x: Values, points: Ints, corners: Ints) -> tuple[Values, Values]:
    """(k, d) barycentric coordinates of closest points, and vectors (k, d) from there to the points, m."""
    k, d = corners.shape
    arms = x[corners] - x[points][:, None]
    centroid = np.full((k, d), 1 / d)
    slope = np.einsum("kcd,kd->kc", arms, arms.mean(axis=1))
    barycentric = minimise_on_simplex(arms @ arms.transpose(0, 2, 1), slope, centroid)
    return barycentric, -np.einsum("kcd,kc->kd", arms, barycentric)


class PointFacetContacts:
    """Points of a surface before its facets, and their history.

    Attributes:
        history: contacts at the end of the last step.
    """

    def __init__(
        self,
        elements: Ints,
        stiffness: ContactStiffness,
        *,
        distance: float,
        edge: float,
        patch: npt.NDArray[np.int32] | None = None,
        is_owned: Flags | None = None,
    ) -> None:
        """Points and facets of a surface.

        Args:
            elements: (k, d) facets.
            stiffness: of points.
            distance: D, m.
            edge: mean length of edges, m.
            patch: (n,) numbers of parts of the surface that touch others alone; None: all touch.
            is_owned: (n,) points whose contacts belong to this rank; None: all.
        """
        count, dim = len(stiffness.point), elements.shape[1]
        self.is_owned = np.ones(count, bool) if is_owned is None else is_owned
        self._stiffness, self._width, self._elements, self._edge = stiffness, distance, elements, edge
        self._used, local = np.unique(elements, return_inverse=True)
        facets, reach = local.reshape(elements.shape), POINT_FACET.max_gap * distance
        owned = np.flatnonzero(self.is_owned[self._used])
        self._owned_points = self._used[owned]
        self._sets = SimplexPairs.of(owned[:, None], facets, reach)
        where = PairFilter.of(len(self._used), None if patch is None else patch[self._used])
        self._search = PairSearch(where, [self._sets], POINT_FACET.search_margin * distance)
        self._last: tuple[Values, PointFacetPairs] | None = None
        self.set_history(ContactHistory.none(1 + dim, dim))

    def set_history(self, history: ContactHistory) -> None:
        """Set the contacts at the end of the last step; those of points of other ranks are left out."""
        self.history = history = history.select(self.is_owned[history.points[:, 0]])
        points, (count, dim) = history.points[:, 0], (len(self.is_owned), self._elements.shape[1])
        # of all points: corners of the facets that they were before, k_p of those in contact, and slip
        self._facets = np.full((count, dim), NO_POINT)
        self._start_stiffness, self._slip = np.zeros(count), np.zeros((count, dim))
        self._facets[points] = history.points[:, 1:]
        self._start_stiffness[points], self._slip[points] = history.stiffness, history.slip

    def contacts_within(self, x: Values, reach: float) -> PenaltyContacts:
        """Nearest facet of each point that has one within `reach`, m, with points at x (n, d), m."""
        pairs = self._all_pairs(x)
        previous = self._facets[pairs.points]
        # a point may be behind facets of the last step, or those beside them
        stays = (previous[:, :, None] == pairs.corners[:, None]).any(axis=(1, 2))
        behind = np.flatnonzero((pairs.gap <= 0) & stays)
        slope = np.einsum("kd,kd->k", pairs.normal[behind], unit_normals(x[pairs.corners[behind]]))
        stays[behind] = abs(slope) >= POINT_FACET.min_slope
        pairs = pairs.select((pairs.gap > 0) | stays)
        depth = np.full(len(x), np.inf)
        np.minimum.at(depth, pairs.points, abs(pairs.gap))
        # of equally near facets the first one, whatever round-off
        near = np.flatnonzero(abs(pairs.gap) <= depth[pairs.points] + POINT_FACET.same_distance * self._edge)
        pairs = pairs.select(_first_rows(pairs.points[near], near))
        pairs = pairs.select(pairs.gap < reach)
        return PenaltyContacts(
            points=np.column_stack([pairs.points, pairs.corners]),
            weights=np.column_stack([np.ones(len(pairs.points)), -pairs.barycentric]),
            gap=pairs.gap,
            normal=pairs.normal,
            stiffness=self._stiffness_of(pairs),
            share=np.ones(len(pairs.points)),
            share_gradient=None,
            slip=self._slip[pairs.points],
            start_stiffness=self._start_stiffness[pairs.points],
        )

    def end_step(self, near: PenaltyContacts, slip: Values | None) -> None:
        """Store contacts `near` at the end of a step, and slips (k, d) of their springs, m."""
        if len(near.gap) or len(self.history.points):
            self.set_history(ContactHistory.of(near, self._width, slip))

    def anything_is_near(self, x: Values) -> bool:
        """Whether any point has contact, or may be near a facet, at x (n, d), m."""
        return bool(self.history.stiffness.any()) or len(self._candidates(x)[0]) > 0

    def clearance(self, x: Values, reach: float) -> float:
        """Least distance between points and facets at x (n, d), m, at most `reach`."""
        vertices = x[self._used]
        points, facets = near_pairs(self._sets, self._search.filter, vertices, vertices, reach).T
        return closest_distance(x, self._owned_points[points], self._elements[facets], reach)

    def clear_caches(self) -> None:
        """Discard the candidates."""
        self._search.clear_caches()

    def _all_pairs(self, x: Values) -> PointFacetPairs:
        """Pairs of points in front of facets or behind; those of the last x are kept."""
        if self._last is None or not np.array_equal(x, self._last[0]):
            positions, candidates = x.copy(), self._candidates(x)
            reach, tolerance = POINT_FACET.max_gap * self._width, POINT_FACET.same_distance * self._edge
            self._last = positions, point_facet_pairs(positions, *candidates, reach, tolerance)
        return self._last[1]

    def _stiffness_of(self, pairs: PointFacetPairs) -> Values:
        """(k,) k_p, N/m: at most what a corner that carries the point may have; constant during contact.

        So all facets that share a closest point give the same stiffness.
        """
        allowed, carries = self._stiffness, pairs.barycentric > POINT_FACET.min_barycentric
        weight = np.where(carries, pairs.barycentric, 1.0)
        limit = np.where(carries, allowed.limit[pairs.corners] / weight, np.inf).min(axis=1, initial=np.inf)
        reduction = np.where(carries, allowed.reduction[pairs.corners], 1.0).min(axis=1, initial=1.0)
        largest = allowed.point[pairs.points] * reduction
        previous = self._start_stiffness[pairs.points]
        return np.where(previous > 0, previous, np.minimum(largest, limit))

    def _candidates(self, x: Values) -> tuple[Ints, Ints]:
        """(k,) points and (k, d) facets that may be as near, or as deep, as counts, with points at x (n, d), m."""
        (pairs,) = self._search.pairs(x[self._used])
        points, facets = pairs.T
        return self._owned_points[points], self._elements[facets]


def penalty_stiffness(
    share: NodalMassShare, area: Values, pressure: float, max_added: float, local_area: Values | None = None
) -> Values:
    """(n,) stiffness k_p of points, N/m (collective).

    `pressure` on half the area of each point, as the other side acts too. At most what adds `max_added` to the square
    of a frequency where each node is in contact with as many points as it carries.

    Args:
        share: of the points in the mass of their nodes.
        area: (n,) m^2.
        pressure: penalty's stiffness, Pa/m.
        max_added: 1/s^2; infinite: no limit.
        local_area: (n,) share of this rank in `area`, m^2; None: all of it.
    """
    stiffness = 0.5 * pressure * area
    if np.isinf(max_added):
        return stiffness
    return np.minimum(stiffness, POINT_FACET.max_added * max_added * share.point_masses(area, local_area))
