"""Pairs of a penalty between the elements of a surface in explicit steps: points before facets, and edges.

Of a body with itself, of bodies and triangle meshes, and of triangle meshes with one another; edges against edges in 3D
alone (penalty_edges). Energy, forces and friction are those of penalty_law.

g_p is the distance, m, of a point p to the nearest facet of those that p is in front of. A point that was near a facet
at the end of the last step may lie behind it, or one beside it, within 60 degrees of its normal: g_p < 0. All other
points behind a facet are on the far side of its body. Facets of which a point is a corner do not act on it.

k_p is the stiffness that the point, or a corner of its facet, may have as contact begins, and is constant during
contact. The weights of a contact are 1 of the point and minus the barycentric coordinates on the facet.

Equations: docs/theory.md#explicit-contact.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from ..array_types import Flags, Ints, Values
from ..mesh.ghost_exchange import KeyLookup
from .closest_point import closest_points_of_facets
from .pair_search import (
    PairFilter,
    PairSearch,
    SimplexPairs,
    intersecting_pairs,
    near_pairs,
    pair_distances,
)
from .penalty_edges import EdgeContacts
from .penalty_law import ContactStiffness, ElementRanks, PenaltyContacts, PenaltyForces
from .retractable_surface import unit_normals


@dataclass(frozen=True)
class PenaltyPairPolicy:
    """Tuned numbers of pairs; lengths in D.

    Attributes:
        max_gap: largest gap, or depth, of a pair; what is deeper has passed through.
        search_margin: motion of points after which pairs are searched again. With 0.5 a body on a plate takes 1.1 times
            as long, with 2 a broken one 1.3 times.
        same_distance: difference of distances, in mean edges, of facets that share a closest point.
        min_slope: cosine between the normal of a facet and the direction to a point behind it. A facet that is seen
            from its side tells nothing: its plane has points of the same body in it.
        min_barycentric: coordinate of a corner below which the corner does not carry a point.
        clearance_gap: gaps that are searched where nothing is within reach.
        ahead_gap: gap of contacts that may be closed a step later; below that of the faces of a new crack
            (SURFACE.face_gap), which round-off would decide about.
    """

    max_gap: float = 3.0
    search_margin: float = 1.0
    same_distance: float = 1e-9
    min_slope: float = 0.5
    min_barycentric: float = 1e-3
    clearance_gap: float = 10.0
    ahead_gap: float = 1.99


PAIRS = PenaltyPairPolicy()


class PointFacetContacts:
    """Points of a surface before its facets.

    Attributes:
        candidates: pairs of points of this rank and facets that are searched.
    """

    def __init__(
        self, elements: Ints, stiffness: ContactStiffness, distance: float, edge: float, is_owned: Flags
    ) -> None:
        """Points and facets of a surface.

        Args:
            elements: (k, d) facets.
            stiffness: of points.
            distance: D, m.
            edge: mean length of edges, m.
            is_owned: (n,) points whose contacts belong to this rank.
        """
        self._elements, self._stiffness, self._is_owned = elements, stiffness, is_owned
        self._max_gap, self._tolerance = PAIRS.max_gap * distance, PAIRS.same_distance * edge
        used, facets = np.unique(elements, return_inverse=True)
        owned = np.flatnonzero(is_owned[used])
        self._points = used[owned]
        self.candidates = SimplexPairs.of(owned[:, None], facets.reshape(elements.shape), self._max_gap)

    def set_history(self, points: Ints, history: PenaltyContacts) -> Flags:
        """Set the contacts at the end of the last step; returns (k,) flags of those of points of this rank.

        `points`: (k, 1 + d) their numbers; -1: a point that is no more.
        """
        is_own = points[:, 0] >= 0
        is_own[is_own] = self._is_owned[points[is_own, 0]]
        (point, *facet), count, stored = points[is_own].T, len(self._is_owned), history.select(is_own)
        # of all points: corners of the facets that they were before, k_p of those in contact, and slip
        self._facets, self._slip = np.full((count, len(facet)), -1), np.zeros((count, len(facet)))
        self._facets[point], self._slip[point] = np.column_stack(facet), stored.slip
        self._start_stiffness: Values = np.zeros(count)
        # edges that broke may have left less of a point
        self._start_stiffness[point] = np.minimum(stored.start_stiffness, self._stiffness.limit[point])
        return is_own

    def contacts_within(self, x: Values, pairs: Ints, reach: float) -> PenaltyContacts:
        """Nearest facet of each point that has one within `reach`, m, among candidates (k, 2); points at x (n, d), m.

        Of facets that share a closest point the one is taken whose normal is most parallel to the offset: it tells the
        side of the point. Of equally near facets the first one counts, whatever round-off.
        """
        points, corners = self._points[pairs[:, 0]], self._elements[pairs[:, 1]]
        barycentric, offset = closest_points_of_facets(x[points], x[corners])
        distance = np.linalg.norm(offset, axis=1)
        near = np.flatnonzero(distance < self._max_gap)
        near_normal = unit_normals(x[corners[near]])
        near_height = np.einsum("kd,kd->k", offset[near], near_normal)
        steepest = self._steepest_facets(points[near], distance[near], abs(near_height))
        rows, height = near[steepest], near_height[steepest]
        points, corners, distance = points[rows], corners[rows], distance[rows]
        # a point may be behind facets of the last step, or those beside them
        may_be_behind = (self._facets[points][:, :, None] == corners[:, None]).any(axis=(1, 2))
        may_be_behind &= abs(height) + self._tolerance >= PAIRS.min_slope * distance
        counts = np.flatnonzero(((height >= 0) & (distance > 0)) | may_be_behind)
        nearest = np.full(len(x), np.inf)
        np.minimum.at(nearest, points[counts], distance[counts])
        counts = counts[distance[counts] <= nearest[points[counts]] + self._tolerance]
        counts = _first_rows(points[counts], counts)
        gap = np.where(height[counts] < 0, -1.0, 1.0) * distance[counts]
        within = gap < reach
        gap, counts = gap[within], counts[within]
        rows, points, corners, is_clear = rows[counts], points[counts], corners[counts], abs(gap) > self._tolerance
        normal = offset[rows] / np.where(is_clear, gap, 1.0)[:, None]
        normal = np.where(is_clear[:, None], normal, near_normal[steepest[counts]])
        weights = np.column_stack([np.ones(len(rows)), -barycentric[rows]])
        stiffness, start = self._stiffness_of(points, corners, barycentric[rows]), self._start_stiffness[points]
        members = np.column_stack([points, corners])
        return PenaltyContacts.of_points(members, weights, gap, normal, stiffness, self._slip[points], start)

    def _steepest_facets(self, points: Ints, distance: Values, height: Values) -> Ints:
        """(j,) one row (k,) for each closest point of a point: the highest, ascending."""
        order = np.lexsort((distance, points))
        is_new = (np.diff(points[order]) > 0) | (np.diff(distance[order]) > self._tolerance)
        group = np.cumsum(np.r_[False, is_new][: len(order)])
        highest = np.zeros(len(order))
        np.maximum.at(highest, group, height[order])
        level = height[order] >= highest[group] - self._tolerance
        return np.sort(_first_rows(group[level], order[level]))

    def _stiffness_of(self, points: Ints, corners: Ints, barycentric: Values) -> Values:
        """(k,) k_p, N/m: at most what a corner that carries the point may have; constant during contact.

        So all facets that share a closest point give the same stiffness.
        """
        allowed, carries = self._stiffness, barycentric > PAIRS.min_barycentric
        weight = np.where(carries, barycentric, 1.0)
        limit = np.where(carries, allowed.limit[corners] / weight, np.inf).min(axis=1, initial=np.inf)
        reduction = np.where(carries, allowed.reduction[corners], 1.0).min(axis=1, initial=1.0)
        previous = self._start_stiffness[points]
        return np.where(previous > 0, previous, np.minimum(allowed.point[points] * reduction, limit))


def _first_rows(groups: Ints, rows: Ints) -> Ints:
    """(g,) lowest of the rows (k,) of each group (k,), in the order of the groups."""
    order = np.lexsort((rows, groups))
    return rows[order[np.unique(groups[order], return_index=True)[1]]]


class PenaltyPairs:
    """Penalty between the elements of a surface; x is always (n, d), m.

    Attributes:
        width: D, m.
        keys: (n,) of the points.
        history: contacts of this rank near each other at the end of the last step.
    """

    history: PenaltyContacts

    def __init__(
        self,
        rest_positions: Values,
        elements: Ints,
        stiffness: ContactStiffness,
        *,
        distance: float,
        patch: npt.NDArray[np.int32] | None = None,
        ranks: ElementRanks | None = None,
        edge: float | None = None,
        keys: Ints | None = None,
    ) -> None:
        """Pairs of a surface.

        Args:
            rest_positions: (n, d) reference positions, m.
            elements: (m, d) points of segments or triangles.
            stiffness: of points.
            distance: D, m.
            patch: (n,) numbers of parts of the surface that touch others alone; None: all touch.
            ranks: of the elements; None: all are of this rank.
            edge: mean length of edges, m; None: of these elements.
            keys: (n,) of the points, which do not depend on the ranks; None: their numbers.
        """
        self.width, (count, dim) = distance, rest_positions.shape
        if edge is None:
            sides = rest_positions[elements] - rest_positions[np.roll(elements, 1, axis=1)]
            edge = float(np.linalg.norm(sides, axis=2).mean()) if len(elements) else distance
        self._elements, self._patch, self._used = elements, patch, np.unique(elements)
        self.keys: Ints = np.arange(count) if keys is None else keys
        self._number = KeyLookup(self.keys)
        is_owned: Flags = np.ones(count, bool) if ranks is None else ranks.own_points
        points = PointFacetContacts(elements, stiffness, distance, edge, is_owned)
        self._kinds: list[PointFacetContacts | EdgeContacts] = [points]
        if dim == 3:
            max_gap = PAIRS.max_gap * distance
            self._kinds.append(EdgeContacts(rest_positions, elements, stiffness.limit, max_gap=max_gap, ranks=ranks))
        where = PairFilter.of(len(self._used), None if patch is None else patch[self._used])
        self._sets = [kind.candidates for kind in self._kinds]
        # steps are short: once a vertex has moved by more than the margin, others will have soon, and all are searched
        self._search = PairSearch(where, self._sets, PAIRS.search_margin * distance, max_moved=0.0)
        self._near: tuple[Values, PenaltyContacts] | None = None  # of the last x
        self.set_history(PenaltyContacts.none(dim))

    def set_history(self, history: PenaltyContacts) -> None:
        """Set the contacts at the end of the last step, by keys of points; those of other ranks are left out."""
        self._near = None
        self._set_history(history)

    def _set_history(self, history: PenaltyContacts) -> None:
        numbers, of_edges = self._number(history.points), history.side != 0
        is_own = np.zeros(len(of_edges), bool)
        for kind, rows in zip(self._kinds, (~of_edges, of_edges), strict=False):
            is_own[rows] = kind.set_history(numbers[rows], history.select(rows))
        self.history = history.select(is_own)

    def energy(self, x: Values) -> float:
        """Energy E(x), J."""
        return self.contacts(x).energy(self.width)

    def gradient(self, x: Values) -> Values:
        """(n, d) dE/dx, N: minus the forces on the points."""
        return self.contacts(x).gradient(self.width, len(x))

    def min_gap(self, x: Values) -> float:
        """Least gap below D, m; infinite where there is none."""
        return float(self.contacts(x).gap.min(initial=np.inf))

    def contacts(self, x: Values) -> PenaltyContacts:
        """Contacts with points at x."""
        near = self.near_contacts(x)
        return near.select(near.gap < self.width)

    def near_contacts(self, x: Values) -> PenaltyContacts:
        """Contacts that may be closed a step later, with points at x; those of the last x are kept."""
        if self._near is None or not np.array_equal(x, self._near[0]):
            pairs_of_kinds, reach = self._search.pairs(x[self._used]), PAIRS.ahead_gap * self.width
            kinds = zip(self._kinds, pairs_of_kinds, strict=True)
            near = PenaltyContacts.join([kind.contacts_within(x, pairs, reach) for kind, pairs in kinds])
            self._near = x.copy(), near
        return self._near[1]

    def forces(self, x: Values, start: Values | None = None, friction: float = 0.0) -> PenaltyForces:
        """Forces with points at x, and at `start` (n, d) at the start of the step, m; None: at x."""
        contacts = self.contacts(x)
        motion = contacts.relative(x - start) if friction and start is not None else np.zeros_like(contacts.normal)
        return PenaltyForces(contacts, motion, friction, self.width, len(x))

    def end_step(self, x: Values, slips: Values | None = None) -> None:
        """Store contacts at the end of a step, and slips (k, d) of the springs of `contacts`, m."""
        near = self.near_contacts(x)
        touches, all_slips = near.gap < self.width, np.zeros_like(near.normal)
        if slips is not None:
            all_slips[touches] = slips
        near = replace(near, slip=all_slips, start_stiffness=np.where(touches, near.spring_stiffness, 0.0))
        self._near = x.copy(), near
        self._set_history(replace(near, points=self.keys[near.points]))

    def intersections(self, x: Values) -> Ints:
        """(k, 2) elements that intersect with points at x."""
        return intersecting_pairs(self._elements, PairFilter.of(len(x), self._patch), x)

    def anything_is_near(self, x: Values) -> bool:
        """Whether any point has contact, or may be near a facet, at x."""
        return bool(self.history.start_stiffness.any()) or len(self._search.pairs(x[self._used])[0]) > 0

    def clearance(self, x: Values) -> float:
        """Distance by which any two points at x may approach before anything is near, m; nothing is near at x."""
        vertices, distance = x[self._used], PAIRS.clearance_gap * self.width
        for pairs in self._sets:
            near = near_pairs(pairs, self._search.filter, vertices, vertices, distance)
            distance = float(pair_distances(pairs, near, vertices).min(initial=distance))
        return max(0.0, distance - PAIRS.ahead_gap * self.width)
