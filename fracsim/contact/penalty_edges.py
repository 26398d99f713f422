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

from ..array_types import Flags, Ints, Values
from ..mesh.ghost_exchange import KeyLookup
from .pair_search import SimplexPairs
from .penalty_law import ElementRanks, PenaltyContacts
from .retractable_surface import unit_normals


@dataclass(frozen=True)
class EdgePolicy:
    """Tuned numbers of edges against edges.

    Attributes:
        min_angle, full_angle: angle between the facets of an edge, rad, from which on it acts, and acts fully. The
            sagitta of facets at an angle q over an edge h is q h / 8: below D for smaller angles.
        end_share: e, part of an edge at each end over which it is left to points.
        parallel: c, squared sine of the angle between edges below which they are left to points.
        min_sine: squared sine below which closest points are not defined.
    """

    min_angle: float = 0.1
    full_angle: float = 0.3
    end_share: float = 0.2
    parallel: float = 0.04
    min_sine: float = 1e-6


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
    """Sharp edges of a surface before one another.

    Attributes:
        candidates: pairs of sharp edges that are searched.
    """

    def __init__(
        self, rest_positions: Values, elements: Ints, limit: Values, *, max_gap: float, ranks: ElementRanks | None
    ) -> None:
        """Edges of a surface.

        Args:
            rest_positions: (n, 3) m.
            elements: (k, 3) triangles.
            limit: (n,) stiffness that each point may have, N/m.
            max_gap: largest gap, or depth, of a pair, m; deeper edges have passed through.
            ranks: of the elements; a pair belongs to the lowest rank at its lower edge. None: all are of this rank.
        """
        self._sharp, self._max_gap = find_sharp_edges(rest_positions, elements), max_gap
        ends, count = self._sharp.ends, len(rest_positions)
        self._stiffness, self._key = limit[ends].min(axis=1, initial=np.inf), np.array([count, 1])
        self._number = KeyLookup(ends @ self._key)
        edges = np.searchsorted(np.unique(elements), ends)
        self.candidates = SimplexPairs.of(edges, edges, max_gap)
        self._is_owned: Flags = np.ones(len(ends), bool) if ranks is None else ranks.own(self._sharp.triangles)

    def set_history(self, points: Ints, history: PenaltyContacts) -> Flags:
        """Set the pairs near each other at the end of the last step; returns (k,) flags of those of this rank.

        The lower edge of a pair comes first, and the lower end of an edge, whatever numbers points have: their order
        is that of the input mesh.

        `points`: (k, 4) their numbers; -1: a point that is no more.
        """
        edges = self._number(np.maximum(points, 0).reshape(-1, 2, 2) @ self._key)
        is_own: Flags = np.asarray((points >= 0).all(axis=1) & (edges >= 0).all(axis=1))
        is_own[is_own] = self._is_owned[edges[is_own, 0]]
        self._history, self._row = history.select(is_own), KeyLookup(self._pair_key(edges[is_own]))
        return is_own

    def _pair_key(self, pairs: Ints) -> Ints:
        return np.asarray(pairs @ np.array([len(self._sharp.ends), 1]))

    def contacts_within(self, x: Values, pairs: Ints, reach: float) -> PenaltyContacts:
        """Candidates (k, 2) with gaps below `reach`, m, that cross in projection, with points at x (n, 3), m."""
        pairs = pairs[self._is_owned[pairs[:, 0]]]
        crossing = _CrossingEdges.of(x[self._sharp.ends[pairs].reshape(-1, 4)])
        # the closest points lie between the ends of both; never those of parallel edges
        crosses = ((crossing.position > 0) & (crossing.position < 1)).all(axis=1)
        pairs = pairs[crosses & (abs(crossing.height) < self._max_gap)]
        ends: Ints = self._sharp.ends[pairs].reshape(-1, 4)
        crossing = _CrossingEdges.of(x[ends])
        stored = self._row(self._pair_key(pairs))
        is_stored, history = np.flatnonzero(stored >= 0), self._history.select(stored[stored >= 0])
        side = np.where(crossing.height < 0, -1.0, 1.0)
        side[is_stored] = history.side
        gap, normal = side * crossing.height, side[:, None] * crossing.normal
        first, second = (self._sharp.outward(x, column) for column in pairs.T)
        # the edge a lies in front of b, and b in front of a
        counts = (np.einsum("kd,kd->k", second, normal) > 0) & (np.einsum("kd,kd->k", first, normal) < 0)
        counts[is_stored] = True
        stiffness = self._stiffness[pairs].min(axis=1) * self._sharp.weight[pairs].prod(axis=1)
        touched = history.start_stiffness > 0
        stiffness[is_stored[touched]] = history.stiffness[touched]
        start: Values = np.zeros(len(pairs))
        slip: Values = np.zeros((len(pairs), 3))
        start[is_stored], slip[is_stored] = history.start_stiffness, history.slip
        arrays = ends, crossing.weights, gap, normal, stiffness, *crossing.shares(), side, slip, start
        return PenaltyContacts(*arrays).select(counts & (gap < reach))


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
        # near one end at most: e < 1/2
        (s, t), e = self.position.T, EDGES.end_share
        factors = [_smooth_step(np.minimum(z, 1 - z) / e) for z in (s, t)]
        factors += [_smooth_step((determinant / (A * B))[:, 0, 0] / EDGES.parallel)]
        signs = (np.where(z < 0.5, 1 / e, -1 / e)[:, None, None] for z in (s, t))
        slopes = [*(sign * slope for sign, slope in zip(signs, (d_s, d_t), strict=True)), d_sine / EDGES.parallel]
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
