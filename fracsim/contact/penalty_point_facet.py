"""Penalty between points and facets of one surface, for contact of a body with itself in explicit steps; on one rank.

    E(x) = sum over points p of  k_p (D - g_p)^2 / 2    where g_p < D

g_p is the distance, m, to the nearest facet of those that p is in front of, D the gap below which the penalty acts. A
point that was in contact at the end of the last step may lie behind its facet, or one beside it: g_p < 0. All other
points behind a facet are on the far side of its body. Facets of which a point is a corner do not act on it, nor do
edges act on one another.

k_p is the stiffness that the point, or a corner of its facet, may have as contact begins, and is constant during
contact. With l the barycentric coordinates on the facet and n its normal, dE/dx_p = -k (D - g) n and
dE/dx_c = k l_c (D - g) n: forces and their moments sum to zero.

Equations: docs/theory.md#explicit-contact.
"""

from __future__ import annotations

from dataclasses import dataclass

import ipctk
import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix

from .closest_point import minimise_on_simplex
from .ipc_pairs import IpcPairs, PairKind, PairSearch, centred
from .ipc_surface import unit_normals
from .sample_points import Vertices

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

# corners of the facet of a point without contact
NO_FACET = -1


@dataclass(frozen=True)
class PointFacetPolicy:
    """Tuned numbers of point-facet pairs; lengths in D.

    Attributes:
        max_gap: largest gap, or depth, of a pair; a deeper point has passed through.
        search_margin: motion of points after which candidates are searched again.
        same_distance: difference of distances, in mean edges, of facets that share a closest point.
        min_barycentric: coordinate of a corner below which the corner does not limit the stiffness.
        clearance_gap: gaps that are searched where nothing is within reach.
        ahead_gap: gap of points that may be in contact a step later.
        max_added: part of the allowed increase of the square of a frequency that the points at a node may cause.
        min_weight: weight of a node, in the sum of all of a point, below which it is round-off of arms that cancel.
    """

    max_gap: float = 3.0
    search_margin: float = 1.0
    same_distance: float = 1e-9
    min_barycentric: float = 1e-3
    clearance_gap: float = 10.0
    ahead_gap: float = 2.0
    max_added: float = 0.25
    min_weight: float = 1e-6


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


class ClosestPointCache:
    """Closest points of pairs of a point and a facet, computed again where either has moved.

    Attributes:
        points: (k,).
        corners: (k, d) of the facets.
    """

    def __init__(self, points: Ints, corners: Ints) -> None:
        self.points, self.corners = points, corners
        self._barycentric, self._offset = np.zeros(corners.shape), np.zeros(corners.shape)
        self._is_known = np.zeros(len(points), bool)
        self._x: Values | None = None

    def __call__(self, x: Values, rows: Ints) -> tuple[Values, Values]:
        """(r, d) barycentric coordinates, and vectors (r, d), m, from closest points to the points at x (n, d)."""
        if self._x is None or x.shape != self._x.shape:
            self._is_known[:] = False
        elif x is not self._x:
            self._is_known &= ~self.involves((x != self._x).any(axis=1))
        self._x = x
        if len(new := rows[~self._is_known[rows]]):
            self._barycentric[new], self._offset[new] = _closest_points(x, self.points[new], self.corners[new])
            self._is_known[new] = True
        return self._barycentric[rows], self._offset[rows]

    def involves(self, moved: Flags) -> Flags:
        """(k,) pairs of which the point or a corner is among `moved` (n,)."""
        return np.asarray(moved[self.points] | moved[self.corners].any(axis=1))

    def are_within(self, x: Values, rows: Ints, reach: float) -> Flags:
        """(r,) whether pairs are nearer than `reach`, m."""
        _, offset = self(x, rows)
        return np.asarray(np.einsum("kd,kd->k", offset, offset) < reach**2)


def closest_distance(x: Values, points: Ints, corners: Ints, limit: float) -> float:
    """Least distance of points to facets (k, d), at most `limit`, m, with points at x (n, d)."""
    _, offset = _closest_points(x, points, corners)
    return min(limit, float(np.linalg.norm(offset, axis=1).min(initial=limit)))


def point_facet_pairs(
    x: Values, cache: ClosestPointCache, rows: Ints, reach: float, tolerance: float
) -> PointFacetPairs:
    """Pairs nearer than `reach`, m, one facet for each closest point.

    Of facets that share a closest point, at equal distances within `tolerance`, m, the one is taken whose normal is
    most parallel to the offset: it tells the side of the point.
    """
    barycentric, offset = cache(x, rows)
    distance = np.linalg.norm(offset, axis=1)
    near = np.flatnonzero(distance < reach)
    points, corners = cache.points[rows[near]], cache.corners[rows[near]]
    barycentric, offset, distance = barycentric[near], offset[near], distance[near]
    normal = unit_normals(x[corners])
    height = np.einsum("kd,kd->k", offset, normal)
    order = np.lexsort((distance, points))
    is_new = (np.diff(points[order]) > 0) | (np.diff(distance[order]) > tolerance)
    group = np.cumsum(np.r_[False, is_new][: len(order)])
    best = order[np.lexsort((-abs(height[order]), group))]
    selected = best[np.unique(group, return_index=True)[1]]
    gap = np.where(height < 0, -1.0, 1.0) * distance
    is_clear = distance > tolerance
    normal = np.where(is_clear[:, None], offset / np.where(is_clear, gap, 1.0)[:, None], normal)
    return PointFacetPairs(points, corners, barycentric, gap, normal).select(selected)


def _closest_points(x: Values, points: Ints, corners: Ints) -> tuple[Values, Values]:
    """(k, d) barycentric coordinates of closest points, and vectors (k, d) from there to the points, m."""
    k, d = corners.shape
    arms = x[corners] - x[points][:, None]
    centroid = np.full((k, d), 1 / d)
    slope = np.einsum("kcd,kd->kc", arms, arms.mean(axis=1))
    barycentric = minimise_on_simplex(arms @ arms.transpose(0, 2, 1), slope, centroid)
    return barycentric, -np.einsum("kcd,kc->kd", arms, barycentric)


@dataclass(frozen=True)
class PenaltyContacts:
    """Pairs in contact.

    Attributes:
        pairs: points before facets.
        stiffness: (k,) k_p, N/m.
    """

    pairs: PointFacetPairs
    stiffness: Values


class PointFacetPenalty(IpcPairs):
    """Penalty between the points and facets of a surface.

    Attributes:
        contact_facets: (n, d) corners of the facets in contact with points at the end of the last step, or NO_FACET.
        contact_stiffness: (n,) k_p of these, N/m; 0 of points without contact.
        slip: (n, d) stretch of their springs of friction, m.
        width: D, m.
    """

    def __init__(self, rest_positions: Values, elements: Ints, stiffness: Values, *, distance: float) -> None:
        """`stiffness`: (n,) k_p, N/m; the others as for IpcPairs."""
        super().__init__(rest_positions, elements, distance=distance, stiffness=1.0)
        self.contact_facets: Ints = np.full((len(rest_positions), rest_positions.shape[1]), NO_FACET, np.int64)
        self.contact_stiffness: Values = np.zeros(len(rest_positions))
        self.slip: Values = np.zeros_like(rest_positions)
        self._point_stiffness, self.width, self._elements = stiffness, distance, elements
        self._used = np.unique(elements)  # the points of ipctk's mesh
        kind = PairKind(distance, 1.0, "ee_candidates", Vertices(self._mesh))
        reach, margin = POINT_FACET.max_gap * distance, POINT_FACET.search_margin * distance
        self._search = PairSearch(self._mesh, [kind], reach, margin)
        self._candidates: ipctk.Candidates | None = None  # those of which closest points are cached
        self._cache: ClosestPointCache
        self._is_close: Flags  # (k,) cached pairs that were close at the positions of their last check
        self._check_positions: Values
        self._last: tuple[Values, PointFacetPairs] | None = None
        self._last_contacts: tuple[PointFacetPairs, PenaltyContacts] | None = None

    def energy(self, x: Values) -> float:
        """Energy E(x), J."""
        contacts = self.contacts(x)
        return 0.5 * float(contacts.stiffness @ (self.width - contacts.pairs.gap) ** 2)

    def gradient(self, x: Values) -> Values:
        """(n, d) dE/dx, N: minus the forces on the points."""
        contacts, gradient = self.contacts(x), np.zeros_like(x)
        pairs = contacts.pairs
        force = (contacts.stiffness * (self.width - pairs.gap))[:, None] * pairs.normal
        np.add.at(gradient, pairs.points, -force)
        np.add.at(gradient, pairs.corners, pairs.barycentric[:, :, None] * force[:, None])
        return gradient

    def min_gap(self, x: Values) -> float:
        """Least gap below D, m; infinite where there is none."""
        return float(self.contacts(x).pairs.gap.min(initial=np.inf))

    def end_step(self, x: Values, slips: Values | None = None) -> None:
        """Store contacts at the end of a step, with points at x (n, d), and slips (k, d) of their springs, m."""
        contacts = self.contacts(x)
        if not len(contacts.stiffness) and not self.contact_stiffness.any():
            return
        facets, stiffness, slip = np.full_like(self.contact_facets, NO_FACET), np.zeros(len(x)), np.zeros_like(x)
        points = contacts.pairs.points
        facets[points], stiffness[points] = contacts.pairs.corners, contacts.stiffness
        if slips is not None:
            slip[points] = slips
        self.set_contacts(facets, stiffness, slip)

    def set_contacts(self, facets: Ints, stiffness: Values, slip: Values) -> None:
        """Set facets (n, d), stiffness (n,) and slip (n, d) of the points in contact."""
        self.contact_facets, self.contact_stiffness, self.slip = facets, stiffness, slip
        self._last_contacts = None

    def max_added_frequency(self, x: Values, weights: csr_matrix, mass: Values) -> float:
        """Bound of the increase of the square of a frequency (penalty_obstacles.NodalMassShare), 1/s^2.

        Args:
            x: (n, d) points, m.
            weights: (n, nodes) with which points follow nodes.
            mass: (nodes,) kg.
        """
        near = self._contacts_within(x, POINT_FACET.ahead_gap * self.width)
        k, d = near.pairs.corners.shape
        if not k:
            return 0.0
        rows = np.repeat(np.arange(k), d)
        entries = near.pairs.barycentric.reshape(-1), (rows, near.pairs.corners.reshape(-1))
        facet_map = csr_matrix(entries, shape=(k, len(x)))
        size = abs(weights[near.pairs.points] - facet_map @ weights)
        load = size.T @ (near.stiffness * np.asarray(size.sum(axis=1)).ravel())
        return float((load / mass).max(initial=0.0))

    def clearance(self, x: Values) -> float:
        """Distance by which any two points at x (n, d) may approach before anything is near, m; 0 if anything is."""
        if self.contact_stiffness.any() or len(self._close_rows(x)):
            return 0.0
        vertices, candidates = centred(self._mesh.vertices(x)), ipctk.Candidates()
        reach = POINT_FACET.clearance_gap * self.width
        candidates.build(self._mesh, vertices, vertices, reach / 2, ipctk.LBVH())
        points, facets = self._points_and_facets(candidates).T
        distance = closest_distance(x, points, self._elements[facets], reach)
        return max(0.0, distance - POINT_FACET.ahead_gap * self.width)

    def contacts(self, x: Values) -> PenaltyContacts:
        """Pairs in contact with points at x (n, d), m; those of the last x are kept."""
        pairs = self._all_pairs(x)
        if self._last_contacts is None or self._last_contacts[0] is not pairs:
            self._last_contacts = pairs, self._contacts_within(x, self.width)
        return self._last_contacts[1]

    def _contacts_within(self, x: Values, reach: float) -> PenaltyContacts:
        """Nearest facet of each point that has one within `reach`, m."""
        pairs = self._all_pairs(x)
        previous = self.contact_facets[pairs.points]
        # facets of the last step, or beside them, may be in front of a point that lies behind
        stays = (previous[:, :, None] == pairs.corners[:, None]).any(axis=(1, 2))
        pairs = pairs.select((pairs.gap > 0) | stays)
        order = np.lexsort((abs(pairs.gap), pairs.points))
        is_nearest = np.zeros(len(order), bool)
        is_nearest[order[np.unique(pairs.points[order], return_index=True)[1]]] = True
        pairs = pairs.select(is_nearest & (pairs.gap < reach))
        return PenaltyContacts(pairs, self._stiffness_of(pairs))

    def _all_pairs(self, x: Values) -> PointFacetPairs:
        """Pairs of points in front of facets or behind; those of the last x are kept."""
        if self._last is None or not np.array_equal(x, self._last[0]):
            positions, rows = x.copy(), self._close_rows(x)
            reach, tolerance = POINT_FACET.max_gap * self.width, POINT_FACET.same_distance * self._edge
            self._last = positions, point_facet_pairs(positions, self._cache, rows, reach, tolerance)
        return self._last[1]

    def _stiffness_of(self, pairs: PointFacetPairs) -> Values:
        """(k,) k_p, N/m: at most what a corner of the facet may have; constant during contact."""
        weight = np.maximum(pairs.barycentric, POINT_FACET.min_barycentric)
        limit = (self._point_stiffness[pairs.corners] / weight).min(axis=1, initial=np.inf)
        previous = self.contact_stiffness[pairs.points]
        return np.where(previous > 0, previous, np.minimum(self._point_stiffness[pairs.points], limit))

    def _close_rows(self, x: Values) -> Ints:
        """(k,) cached pairs that may be as near, or as deep, as counts, with points at x (n, d), m.

        A pair is checked again when one of its points has moved by the margin since its last check.
        """
        vertices = self._mesh.vertices(x)
        (candidates,) = self._search.candidates(vertices)
        margin = POINT_FACET.search_margin
        positions, reach = centred(vertices), (POINT_FACET.max_gap + 3 * margin) * self.width
        if candidates is not self._candidates:
            points, facets = self._points_and_facets(candidates).T
            self._candidates, self._cache = candidates, ClosestPointCache(points, self._elements[facets])
            self._check_positions = positions
            self._is_close = self._cache.are_within(x.copy(), np.arange(len(points)), reach)
        elif (far := np.sum((positions - self._check_positions) ** 2, axis=1) > (margin * self.width) ** 2).any():
            moved = np.zeros(len(x), bool)
            moved[self._used[far]] = True
            rows = np.flatnonzero(self._cache.involves(moved))
            self._is_close[rows] = self._cache.are_within(x.copy(), rows, reach)
            self._check_positions = np.where(far[:, None], positions, self._check_positions)
        return np.flatnonzero(self._is_close)

    def _points_and_facets(self, candidates: ipctk.Candidates) -> Ints:
        """(k, 2) points and facets of ipctk's candidates."""
        if self.contact_facets.shape[1] == 3:
            numbers = [(pair.vertex_id, pair.face_id) for pair in candidates.fv_candidates]
        else:
            numbers = [(pair.vertex_id, pair.edge_id) for pair in candidates.ev_candidates]
        pairs = np.array(numbers, np.int64).reshape(-1, 2)
        return np.column_stack([self._used[pairs[:, 0]], pairs[:, 1]])


def penalty_stiffness(weights: csr_matrix, area: Values, mass: Values, pressure: float, max_added: float) -> Values:
    """(n,) stiffness k_p of points, N/m.

    `pressure` on half the area of each point, as the other side acts too. At most what adds `max_added` to the square
    of a frequency where each node is in contact with as many points as it carries.

    Args:
        weights: (n, nodes) with which points follow nodes.
        area: (n,) m^2.
        mass: (nodes,) kg.
        pressure: penalty's stiffness, Pa/m.
        most: 1/s^2.
    """
    size = abs(weights)
    row_sum = np.asarray(size.sum(axis=1)).ravel()
    rate = (size.T @ (area * row_sum)) / mass
    entries = size.tocoo()
    counts = entries.data > POINT_FACET.min_weight * row_sum[entries.row]
    max_rate = np.zeros(len(area))
    np.maximum.at(max_rate, entries.row, np.where(counts, rate[entries.col], 0.0))
    point_mass = np.where(max_rate > 0, area / np.where(max_rate > 0, max_rate, 1.0), 0.0)
    return np.minimum(0.5 * pressure * area, POINT_FACET.max_added * max_added * point_mass)
