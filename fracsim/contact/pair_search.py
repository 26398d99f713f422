"""Search for points, edges and triangles of a surface that may come near one another in a motion, in C (pair_search.c).

A grid of cubes gives pairs whose bounding boxes meet. Of these the pairs remain that can come within a distance r: with
the distances d_0 and d_1 at both ends of a straight motion, and the largest relative motion s of their vertices, they
stay at least (d_0 + d_1 - s) / 2 apart. Pairs that intersect are found in the same grid.

Source: C. Ericson (2005), Real-time collision detection, chapters 5 and 7.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ..array_types import Flags, Ints, Values
from ..mesh.c_library import load_library

Numbers = npt.NDArray[np.signedinteger]
SOURCE = Path(__file__).with_suffix(".c")


@dataclass(frozen=True)
class SimplexPairs:
    """Pairs of two sets of simplices of a surface without common vertices.

    Attributes:
        first: (m, a) vertices of points (a = 1), edges (2), or elements of which the centroids count.
        second: (n, b) vertices of edges (2) or triangles (3). If it is `first`, each pair of edges counts once.
        distance: within which pairs are wanted, m.
        centroids: whether the centroids of `first` count.
    """

    first: npt.NDArray[np.int32]
    second: npt.NDArray[np.int32]
    distance: float
    centroids: bool = False

    @property
    def is_one_set(self) -> bool:
        """Whether the order of a pair has no meaning."""
        return self.first is self.second and not self.centroids

    @classmethod
    def of(cls, first: Numbers, second: Numbers, distance: float, *, centroids: bool = False) -> SimplexPairs:
        """Pairs of sets of simplices that are given as arrays of any type."""
        vertices = np.ascontiguousarray(first, np.int32)
        return cls(
            vertices, vertices if second is first else np.ascontiguousarray(second, np.int32), distance, centroids
        )


@dataclass(frozen=True)
class PairFilter:
    """Vertices of which pairs are searched.

    Attributes:
        patches: (n,) simplices of different patches may be a pair, negative: of all.
        is_owned: (n,) flags: one vertex of a pair at least is marked.
    """

    patches: npt.NDArray[np.int32]
    is_owned: Flags

    @classmethod
    def of(cls, count: int, patches: npt.NDArray[np.int32] | None = None, is_owned: Flags | None = None) -> PairFilter:
        """Pairs of `count` vertices; without patches or marks (None) all of them count."""
        return cls(
            np.full(count, -1, np.int32) if patches is None else np.ascontiguousarray(patches),
            np.ones(count, bool) if is_owned is None else is_owned,
        )


def near_pairs(
    pairs: SimplexPairs, where: PairFilter, start: Values, end: Values, reach: float, moved: Flags | None = None
) -> Ints:
    """(k, 2) numbers of simplices that may come within `reach`, m, as vertices move from `start` to `end` (n, d), m.

    `moved`: (n,) flags, of which one vertex of a pair at least has one; None: all pairs count.
    """
    return _find_pairs(pairs, where, start, end, reach, moved, crossing=False)


def intersecting_pairs(elements: Numbers, where: PairFilter, x: Values) -> Ints:
    """(k, 2) elements (m, d) that intersect elsewhere than at common vertices, with vertices at x (n, d), m.

    Elements that touch intersect, unless they lie in one plane (2D: on one line).
    """
    pairs = SimplexPairs.of(elements, elements, 0.0)
    return _find_pairs(pairs, where, x, x, 0.0, None, crossing=True)


def _find_pairs(
    pairs: SimplexPairs, where: PairFilter, start: Values, end: Values, reach: float, moved: Flags | None, *,
    crossing: bool,
) -> Ints:  # fmt: skip
    x, y = (_in_space(positions) for positions in (start, end))
    sets = [number for simplices in (pairs.first, pairs.second) for number in (*simplices.shape, simplices)]
    options = int(pairs.centroids), int(pairs.is_one_set), int(crossing)
    flags = where.patches, where.is_owned, np.ones(len(x), bool) if moved is None else moved
    search, capacity = load_library(SOURCE).find_pairs, 4 * len(pairs.first) + 1000
    while True:
        result = np.empty((capacity, 2), np.int32)
        count = search(x, y, *sets, *options, *flags, reach, capacity, result)
        if count < 0:
            raise MemoryError(f"no memory for the search among {len(pairs.second)} elements in contact")
        if count <= capacity:
            return result[:count].astype(np.int64)
        capacity = count


def pair_distances(pairs: SimplexPairs, numbers: Ints, x: Values) -> Values:
    """(k,) distances of pairs (k, 2) of simplices, m, with vertices at x (n, d), m."""
    result = np.empty(len(numbers))
    sets = [item for simplices in (pairs.first, pairs.second) for item in (simplices.shape[1], simplices)]
    arguments = int(pairs.centroids), len(numbers), np.ascontiguousarray(numbers), result
    load_library(SOURCE).pair_distances(_in_space(x), *sets, *arguments)
    return result


def free_fractions(
    pairs: SimplexPairs, numbers: Ints, start: Values, end: Values, min_gap_ratio: float, rounds: int
) -> Values:
    """(k,) fractions in [0, 1] of the motion in which each of the pairs (k, 2) has no collision.

    A pair that would collide keeps the part `min_gap_ratio` of its distance, and more where `rounds` evaluations of its
    distance are not enough. Vertices move straight from `start` to `end`, (n, d), m.

    Source: B. Mirtich (1996), Impulse-based dynamic simulation of rigid body systems, section 2.3.
    """
    result = np.empty(len(numbers))
    sets = [item for simplices in (pairs.first, pairs.second) for item in (simplices.shape[1], simplices)]
    arguments = len(numbers), np.ascontiguousarray(numbers), min_gap_ratio, rounds, result
    load_library(SOURCE).free_fractions(_in_space(start), _in_space(end), *sets, *arguments)
    return result


def _in_space(x: Values) -> Values:
    """(n, 3) contiguous positions of (n, d), with zeros in the plane."""
    result = np.zeros((len(x), 3))
    result[:, : x.shape[1]] = x
    return result


@dataclass(frozen=True)
class PairSearchPolicy:
    """Tuned numbers of searches.

    Attributes:
        max_moved: share of the vertices up to which pairs of those that have moved are searched again alone. With a
            fifth of the vertices that takes 0.8 of the time of a search among all.
        fits: fits of a motion to the vertices that are near it.
        fitted: share of the vertices, those nearest to the motion, to which it is fitted.
    """

    max_moved: float = 0.3
    fits: int = 3
    fitted: float = 0.7


SEARCH = PairSearchPolicy()


@dataclass(frozen=True)
class SearchedMotion:
    """Straight motion of vertices along which pairs have been searched.

    Attributes:
        start: (n, d) m.
        change: (n, d) m.
        margin: m.
    """

    start: Values
    change: Values
    margin: float

    def far_vertices(self, x: Values) -> Flags:
        """(n,) flags of vertices at x (n, d), m, that are farther than the margin from one time of the motion.

        All may have moved alike besides. The time and the common motion are fitted to most vertices, unless the middle
        of all displacements from the start serves.
        """
        offset, weight = x - self.start, np.ones(len(x))
        far = weight > 0
        if len(x) and max_length(offset - [0.5 * (u.max() + u.min()) for u in offset.T]) <= self.margin:
            return ~far
        for _ in range(SEARCH.fits if len(x) else 0):
            away, change = (vectors - weight @ vectors / weight.sum() for vectors in (offset, self.change))
            weighted = weight[:, None] * change
            square, along = float(np.vdot(weighted, change)), 0.0
            if square:
                along = min(max(float(np.vdot(weighted, away)) / square, 0.0), 1.0)
            away -= along * change
            distance = np.einsum("nd,nd->n", away, away)
            # positions that are no numbers are far
            far = ~(distance <= self.margin**2)
            if not far.any() or np.isnan(distance).any():
                break
            fitted = int(SEARCH.fitted * (len(x) - 1))
            weight = 1.0 * (distance <= np.partition(distance, fitted)[fitted])
        return np.asarray(far)


class PairSearch:
    """Pairs within a distance of each other; x (n, d) of the vertices, m.

    Pairs are searched along a whole step of Newton's method, within the distance and twice a margin. They serve all
    positions within the margin of it: the trials of the line search, the steps after it, and mostly the next one. Where
    few vertices have left it, the pairs of these alone are searched again. Pairs are in the order of their numbers,
    whatever has been searched: sums over them do not depend on it.

    Attributes:
        filter: vertices of which pairs are searched.
    """

    def __init__(
        self, where: PairFilter, sets: Sequence[SimplexPairs], margin: float, max_moved: float = SEARCH.max_moved
    ) -> None:
        """Begin without pairs.

        Args:
            where: the filter.
            sets: searched pairs.
            margin: motion, m, after which they are searched again.
            max_moved: share of the vertices up to which pairs of those that have moved are searched again alone.
        """
        self.filter, self._sets, self._margin, self._max_moved = where, sets, margin, max_moved
        self.clear_caches()

    def clear_caches(self) -> None:
        """Discard all pairs."""
        # the search among all vertices, and the later one of pairs with a moved vertex
        self._all: tuple[SearchedMotion, list[Ints]] | None = None
        self._later: tuple[SearchedMotion, Flags] | None = None
        self._pairs: list[Ints] = []  # of both

    def pairs(self, x: Values) -> list[Ints]:
        """(k, 2) pairs of each set; the same list while it is valid."""
        return self.pairs_along(x, x)

    def pairs_along(self, x: Values, end: Values) -> list[Ints]:
        """(k, 2) pairs of each set for the whole motion from x to `end`; the same list while it is valid."""
        if self._all is None:
            self._search(x, end)
            return self._pairs
        ends = (x,) if end is x else (x, end)
        moved = np.any([self._all[0].far_vertices(positions) for positions in ends], axis=0)
        if not moved.any():
            self._pairs, self._later = self._all[1], None
        elif np.count_nonzero(moved) > self._max_moved * len(x):
            self._search(x, end)
        elif not self._is_later_valid(moved, ends):
            self._search_moved(x, end, moved)
        return self._pairs

    def _is_later_valid(self, moved: Flags, ends: Sequence[Values]) -> bool:
        """Whether the later search has all pairs of moved vertices at positions (n, d)."""
        if self._later is None:
            return False
        motion, searched = self._later
        return not (moved & ~searched).any() and not any(motion.far_vertices(x).any() for x in ends)

    def _search(self, x: Values, end: Values) -> None:
        """Search all pairs along a motion."""
        motion = self._motion(x, end)
        self._pairs = [sort_pairs(pairs, self._along(motion, pairs)) for pairs in self._sets]
        self._all, self._later = (motion, self._pairs), None

    def _search_moved(self, x: Values, end: Values, moved: Flags) -> None:
        """Search the pairs of moved vertices along a motion; other pairs are those of the last search among all."""
        assert self._all is not None
        motion, result = self._motion(x, end), []
        for pairs, numbers in zip(self._sets, self._all[1], strict=True):
            is_moved = moved[pairs.first[numbers[:, 0]]].any(axis=1) | moved[pairs.second[numbers[:, 1]]].any(axis=1)
            result.append(sort_pairs(pairs, np.concatenate([numbers[~is_moved], self._along(motion, pairs, moved)])))
        self._pairs, self._later = result, (motion, moved)

    def _motion(self, x: Values, end: Values) -> SearchedMotion:
        """Motion without that of most vertices, which brings nothing together."""
        change = end - x
        return SearchedMotion(x, change - np.median(change, axis=0) if len(x) else change, self._margin)

    def _along(self, motion: SearchedMotion, pairs: SimplexPairs, moved: Flags | None = None) -> Ints:
        reach = pairs.distance + 2 * self._margin
        return near_pairs(pairs, self.filter, motion.start, motion.start + motion.change, reach, moved)


def sort_pairs(pairs: SimplexPairs, numbers: Ints) -> Ints:
    """Pairs (k, 2) in the order of their numbers."""
    return numbers[np.argsort(numbers[:, 0] * len(pairs.second) + numbers[:, 1])]


def max_length(vectors: Values) -> float:
    """Largest length of the rows of an array (n, d)."""
    return float(np.sqrt(np.max(np.einsum("nd,nd->n", vectors, vectors), initial=0.0)))
