"""Penalty between edges of surfaces in 3D, which cross between their points.

Edges a and b with the closest points a_0 + s a and b_0 + t b of their lines have the gap g = n . o, o the vector
between these points and n = +-(a x b) / |a x b|. The sign is such that g > 0 as edges come near, and stays while they
cross in projection: edges that have passed through each other are pushed back. Their energy is

    E = k h (D - g)^2 / 2,    h = S(s / e) S((1 - s) / e) S(t / e) S((1 - t) / e) S(sin^2(a, b) / c)

with S(z) = z^2 (3 - 2 z), 1 for z > 1. Near their ends edges are left to points before facets, and so are edges that
are nearly parallel. Only sharp edges act: where both facets of an edge are nearly in one plane, points keep surfaces
apart to within the sagitta, and edges would add a pressure that depends on how the meshes cross.

Equations: docs/theory.md#explicit-contact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .pair_search import PairFilter, PairSearch, SimplexPairs, near_pairs
from .penalty_contacts import ContactHistory, ElementRanks, PenaltyContacts
from .retractable_surface import unit_normals

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class EdgePolicy:
    """Tuned numbers of edges against edges.

    Attributes:
        min_angle, full_angle: angle between the facets of an edge, rad, from which on it acts, and acts fully. The
            sagitta of facets at an angle q over an edge h is q h / 8: below D for smaller angles.
        end_share: e, part of an edge at each end over which it is left to points.
        parallel: c, squared sine of the angle between edges below which they are left to points.
        min_sine: squared sine below which closest points are not defined.
        max_gap: largest gap, or depth, in D; deeper edges have passed through.
        search_margin: motion, in D, after which candidates are searched again.
    """

    min_angle: float = 0.1
    full_angle: float = 0.3
    end_share: float = 0.2
    parallel: float = 0.04
    min_sine: float = 1e-6
    max_gap: float = 3.0
    search_margin: float = 1.0


EDGES = EdgePolicy()


@dataclass(frozen=True)
class SharpEdges:
    """Convex edges of a surface of triangles.

    Attributes:
        ends: (e, 2) points, the lower number first; ascending.
        corners: (e, 2, 3) corners of both facets.
        triangles: (e, 2) numbers of both.
        weight: (e,) in (0, 1], by the angle between the facets at rest.
    """

    ends: Ints
    corners: Ints
    triangles: Ints
    weight: Values

    def outward(self, x: Values, edges: Ints) -> Values:
        """(k, 3) sums of the unit normals of both facets of edges (k,) at x (n, 3)."""
        return np.asarray(unit_normals(x[self.corners[edges].reshape(-1, 3)]).reshape(-1, 2, 3).sum(axis=1))


def find_sharp_edges(x: Values, elements: Ints) -> SharpEdges:
    """Convex edges of two triangles of `elements` (k, 3) with points at x (n, 3), m; not of one alone."""
    sides = np.sort(np.stack([elements, np.roll(elements, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    ends, first, inverse, count = np.unique(sides, axis=0, return_index=True, return_inverse=True, return_counts=True)
    last = np.empty(len(ends), np.int64)
    last[inverse.reshape(-1)] = np.arange(len(sides))
    normals, centroids = unit_normals(x[elements]), x[elements].mean(axis=1)
    triangles = np.stack([first, last], axis=1) // 3
    cosine = np.einsum("ed,ed->e", normals[triangles[:, 0]], normals[triangles[:, 1]])
    rise = np.einsum("ed,ed->e", normals[triangles[:, 0]], centroids[triangles[:, 1]] - x[ends[:, 0]])
    angle: Values = np.where((count == 2) & (rise < 0), np.arccos(np.clip(cosine, -1.0, 1.0)), 0.0)
    excess: Values = np.asarray((angle - EDGES.min_angle) / (EDGES.full_angle - EDGES.min_angle))
    weight, _ = _smooth_step(excess)
    sharp = np.flatnonzero(weight > 0)
    return SharpEdges(ends[sharp], elements[triangles[sharp]], triangles[sharp], weight[sharp])


class EdgeContacts:
    """Pairs of sharp edges of a surface, and their history.

    Attributes:
        history: pairs near each other at the end of the last step.
    """

    def __init__(
        self,
        rest_positions: Values,
        elements: Ints,
        limit: Values,
        *,
        distance: float,
        patch: npt.NDArray[np.int32] | None = None,
        ranks: ElementRanks | None = None,
    ) -> None:
        """Edges of a surface.

        Args:
            rest_positions: (n, 3) m.
            elements: (k, 3) triangles.
            limit: (n,) stiffness that each point may have, N/m.
            distance: D, m.
            patch: (n,) numbers of parts of the surface that touch others alone; None: all touch.
            ranks: of the elements; a pair belongs to the lowest rank at its lower edge. None: all are of this rank.
        """
        self._sharp, self._width = find_sharp_edges(rest_positions, elements), distance
        self._count = len(rest_positions)
        self._key = self._sharp.ends @ np.array([self._count, 1])  # ascending
        ends = self._sharp.ends
        self._stiffness = limit[ends].min(axis=1, initial=np.inf)
        self._used, local = np.unique(ends, return_inverse=True)
        edges = local.reshape(-1, 2)
        self._sets = SimplexPairs.of(edges, edges, EDGES.max_gap * distance)
        self._is_owned = None if ranks is None else ranks.own(self._sharp.triangles)
        is_searched = None
        if self._is_owned is not None:
            is_searched = np.zeros(len(self._used), bool)
            is_searched[edges[self._is_owned]] = True
        where = PairFilter.of(len(self._used), None if patch is None else patch[self._used], is_searched)
        self._search = PairSearch(where, [self._sets], EDGES.search_margin * distance)
        self.set_history(ContactHistory.none(4, 3))

    def set_history(self, history: ContactHistory) -> None:
        """Set the pairs near each other; those of edges that are not sharp are left out."""
        history = _ordered_ends(history)
        edges = [self._edge_numbers(history.points[:, columns]) for columns in (slice(0, 2), slice(2, 4))]
        is_stored = self._belong(*edges)
        if not is_stored.all():
            history, edges = history.select(is_stored), [numbers[is_stored] for numbers in edges]
        self.history = _swapped(history, edges[0] > edges[1])
        key = np.minimum(*edges) * len(self._key) + np.maximum(*edges)
        self._history_order = np.argsort(key)
        self._history_key = key[self._history_order]

    def store(self, ends: Ints) -> Flags:
        """(k,) whether pairs of edges with ends (k, 4) can be of this rank."""
        pairs = np.sort(ends.reshape(-1, 2, 2), axis=2)
        return self._belong(self._edge_numbers(pairs[:, 0]), self._edge_numbers(pairs[:, 1]))

    def _belong(self, first: Ints, second: Ints) -> Flags:
        """(k,) whether pairs of edges (k,), -1: not sharp, are of this rank."""
        are_sharp = (first >= 0) & (second >= 0)
        if self._is_owned is None or not are_sharp.any():
            return np.asarray(are_sharp)
        return np.asarray(are_sharp & self._is_owned[np.minimum(first, second)])

    def _edge_numbers(self, ends: Ints) -> Ints:
        """(k,) numbers of sharp edges with ends (k, 2); -1: not sharp."""
        key = ends @ np.array([self._count, 1])
        rows = np.minimum(np.searchsorted(self._key, key), max(len(self._key) - 1, 0))
        return np.where(self._key[rows] == key, rows, -1) if len(self._key) else np.full(len(key), -1)

    def _history_rows(self, pairs: Ints) -> Ints:
        """(k,) rows of the history of pairs of edges (k, 2); -1: none."""
        if not len(self._history_key):
            return np.full(len(pairs), -1)
        key = pairs @ np.array([len(self._key), 1])
        position = np.minimum(np.searchsorted(self._history_key, key), len(self._history_key) - 1)
        return np.where(self._history_key[position] == key, self._history_order[position], -1)

    def contacts_within(self, x: Values, reach: float) -> PenaltyContacts:
        """Pairs with gaps below `reach`, m, that cross in projection, with points at x (n, 3), m."""
        pairs = self._near_pairs(x)
        ends = np.concatenate([self._sharp.ends[pairs[:, 0]], self._sharp.ends[pairs[:, 1]]], axis=1)
        crossing = _CrossingEdges.of(x[ends])
        near = crossing.cross_in_projection() & (crossing.distance < EDGES.max_gap * self._width)
        pairs, ends, crossing = pairs[near], ends[near], crossing.select(near)
        rows = self._history_rows(pairs)
        is_stored, history = rows >= 0, self.history
        side = np.where(crossing.height < 0, -1.0, 1.0)
        if is_stored.any():
            side[is_stored] = history.side[rows[is_stored]]
        gap, normal = side * crossing.height, side[:, None] * crossing.normal
        first, second = (self._sharp.outward(x, pairs[:, column]) for column in range(2))
        # the edge a lies in front of b, and b in front of a
        in_front = (np.einsum("kd,kd->k", second, normal) > 0) & (np.einsum("kd,kd->k", first, normal) < 0)
        counts = (is_stored | in_front) & (gap < reach)
        pairs, ends, rows, is_stored, crossing = (
            pairs[counts],
            ends[counts],
            rows[counts],
            is_stored[counts],
            crossing.select(counts),
        )
        share, share_gradient = crossing.shares()
        stiffness = self._stiffness[pairs].min(axis=1) * self._sharp.weight[pairs].prod(axis=1)
        start, slip = np.zeros(len(pairs)), np.zeros((len(pairs), 3))
        if is_stored.any():
            rows = rows[is_stored]
            previous = history.stiffness[rows]
            stiffness[is_stored] = np.where(previous > 0, previous, stiffness[is_stored])
            start[is_stored], slip[is_stored] = previous * history.share[rows], history.slip[rows]
        return PenaltyContacts(
            ends, crossing.weights, gap[counts], normal[counts], stiffness, share, share_gradient, slip, start
        )

    def end_step(self, x: Values, near: PenaltyContacts, slip: Values | None) -> None:
        """Store contacts `near` at the end of a step, and slips (k, 3) of their springs, m; x: (n, 3), m."""
        if not len(near.gap) and not len(self.history.points):
            return
        crossing = _CrossingEdges.of(x[near.points])
        side = np.where(np.einsum("kd,kd->k", crossing.normal, near.normal) < 0, -1.0, 1.0)
        self.set_history(ContactHistory.of(near, self._width, slip, side))

    def clear_caches(self) -> None:
        """Discard the candidates."""
        self._search.clear_caches()

    def _near_pairs(self, x: Values) -> Ints:
        """(k, 2) sharp edges that may be near each other with points at x (n, 3), m, the lower number first."""
        (pairs,) = self._search.pairs(x[self._used])
        return self._owned(pairs)

    def _owned(self, pairs: Ints) -> Ints:
        """(k, 2) pairs of this rank among pairs of sharp edges."""
        return pairs if self._is_owned is None else pairs[self._is_owned[pairs[:, 0]]]

    def clearance(self, x: Values, reach: float) -> float:
        """Least distance between sharp edges, m, at most `reach`; that of their lines, or 0 where they are parallel."""
        vertices = x[self._used]
        pairs = self._owned(near_pairs(self._sets, self._search.filter, vertices, vertices, reach))
        ends = np.concatenate([self._sharp.ends[pairs[:, 0]], self._sharp.ends[pairs[:, 1]]], axis=1)
        return min(reach, float(_segment_distances(x[ends]).min(initial=reach)))


def _ordered_ends(history: ContactHistory) -> ContactHistory:
    """The same pairs with the lower end of each edge first; n stays."""
    points, values = history.points.copy(), history.values.copy()
    for first in (0, 2):
        reverse = points[:, first] > points[:, first + 1]
        points[reverse, first : first + 2] = points[reverse, first : first + 2][:, ::-1]
        values[reverse, 0] *= -1
    return ContactHistory(points, values)


def _swapped(history: ContactHistory, rows: Flags) -> ContactHistory:
    """The same pairs with a and b exchanged in some rows: a x b and the slip change their signs, as o does."""
    if not rows.any():
        return history
    points, values = np.where(rows[:, None], history.points[:, [2, 3, 0, 1]], history.points), history.values.copy()
    values[rows, 3:] *= -1
    return ContactHistory(points, values)


@dataclass(frozen=True)
class _CrossingEdges:
    """Pairs of edges, and the closest points of their lines.

    Attributes:
        a, b: (k, 3) vectors along the edges, m.
        offset: (k, 3) o, from the point on b to that on a, m.
        position: (k, 2) s and t.
        normal: (k, 3) a x b / |a x b|.
        squares: (k, 3) a . a, b . b and a . b, m^2.
    """

    a: Values
    b: Values
    offset: Values
    position: Values
    normal: Values
    squares: Values

    @classmethod
    def of(cls, ends: Values) -> _CrossingEdges:
        """Pairs of edges with ends (k, 4, 3), m."""
        a, b, r = ends[:, 1] - ends[:, 0], ends[:, 3] - ends[:, 2], ends[:, 0] - ends[:, 2]
        A, B, C = (np.einsum("kd,kd->k", *pair) for pair in ((a, a), (b, b), (a, b)))
        along_a, along_b = np.einsum("kd,kd->k", a, r), np.einsum("kd,kd->k", b, r)
        determinant = A * B - C * C
        determinant = np.where(determinant > EDGES.min_sine * A * B, determinant, np.inf)
        s, t = (C * along_b - B * along_a) / determinant, (A * along_b - C * along_a) / determinant
        normal = np.cross(a, b) / np.sqrt(determinant)[:, None]
        offset = r + s[:, None] * a - t[:, None] * b
        return cls(a, b, offset, np.stack([s, t], axis=1), normal, np.stack([A, B, C], axis=1))

    def select(self, rows: Flags) -> _CrossingEdges:
        """Some of the pairs."""
        arrays = (self.a, self.b, self.offset, self.position, self.normal, self.squares)
        return _CrossingEdges(*(array[rows] for array in arrays))

    def cross_in_projection(self) -> Flags:
        """(k,) whether the closest points lie between the ends of both; never of parallel edges."""
        return np.asarray(((self.position > 0) & (self.position < 1)).all(axis=1))

    @property
    def distance(self) -> Values:
        """(k,) distance of the lines, m."""
        return np.linalg.norm(self.offset, axis=1)

    @property
    def height(self) -> Values:
        """(k,) distance of the lines along `normal`, with its sign, m."""
        return np.asarray(np.einsum("kd,kd->k", self.offset, self.normal))

    @property
    def weights(self) -> Values:
        """(k, 4) weights of the ends in `offset`."""
        s, t = self.position.T
        return np.stack([1 - s, s, t - 1, -t], axis=1)

    def shares(self) -> tuple[Values, Values]:
        """(k,) h, and its derivatives (k, 4, 3) by the ends, 1/m."""
        A, B, C = self.squares.T
        determinant = A * B - C * C
        of_a, of_b = np.array([-1.0, 1.0, 0.0, 0.0]), np.array([0.0, 0.0, -1.0, 1.0])
        # derivatives of a . o and b . o where s and t are held
        w, a, b, o = self.weights[:, :, None], self.a[:, None], self.b[:, None], self.offset[:, None]
        d_a, d_b = of_a[:, None] * o + w * a, of_b[:, None] * o + w * b
        A, B, C, determinant = (value[:, None, None] for value in (A, B, C, determinant))
        d_s, d_t = (C * d_b - B * d_a) / determinant, (A * d_b - C * d_a) / determinant
        d_C = of_a[:, None] * b + of_b[:, None] * a
        d_sine = -2 * C * d_C / (A * B) + 2 * C**2 * (of_a[:, None] * a / A + of_b[:, None] * b / B) / (A * B)
        s, t, e = *self.position.T, EDGES.end_share
        factors = [_smooth_step(s / e), _smooth_step((1 - s) / e), _smooth_step(t / e), _smooth_step((1 - t) / e)]
        factors += [_smooth_step((determinant / (A * B))[:, 0, 0] / EDGES.parallel)]
        slopes = [d_s / e, -d_s / e, d_t / e, -d_t / e, d_sine / EDGES.parallel]
        values = np.array([value for value, _ in factors])
        gradient = np.zeros(d_s.shape)
        for row, ((_, derivative), slope) in enumerate(zip(factors, slopes, strict=True)):
            remaining = np.delete(values, row, axis=0).prod(axis=0)
            gradient += (remaining * derivative)[:, None, None] * slope
        return values.prod(axis=0), gradient


def _smooth_step(z: Values) -> tuple[Values, Values]:
    """S(z) = z^2 (3 - 2 z) between 0 and 1, and its derivative."""
    z = np.clip(z, 0.0, 1.0)
    return np.asarray(z**2 * (3 - 2 * z)), np.asarray(6 * z * (1 - z))


def _segment_distances(ends: Values) -> Values:
    """(k,) distances of segments with ends (k, 4, 3), m."""
    crossing = _CrossingEdges.of(ends)
    distance = np.where(crossing.cross_in_projection(), crossing.distance, np.inf)
    for point, first in ((0, 2), (1, 2), (2, 0), (3, 0)):
        start, side = ends[:, first], ends[:, first + 1] - ends[:, first]
        arm = ends[:, point] - start
        along = np.einsum("kd,kd->k", arm, side) / np.einsum("kd,kd->k", side, side)
        distance = np.minimum(distance, np.linalg.norm(arm - np.clip(along, 0.0, 1.0)[:, None] * side, axis=1))
    return distance
