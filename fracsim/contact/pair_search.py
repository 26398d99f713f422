"""Search for points, edges and triangles of a surface that may come near one another in a motion, in C (pair_search.c).

A grid of cubes gives pairs whose bounding boxes meet. Of these the pairs remain that can come within a distance r: with
the distances d_0 and d_1 at both ends of a straight motion, and the largest relative motion s of their vertices, they
stay at least (d_0 + d_1 - s) / 2 apart.

Source: C. Ericson (2005), Real-time collision detection, chapters 5 and 7.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ..mesh.c_library import load_library

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
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
    def none(cls, count: int) -> PairFilter:
        """Pairs of all vertices."""
        return cls(np.full(count, -1, np.int32), np.ones(count, bool))


def near_pairs(pairs: SimplexPairs, where: PairFilter, start: Values, end: Values, reach: float) -> Ints:
    """(k, 2) numbers of simplices that may come within `reach`, m, as vertices move from `start` to `end` (n, d), m."""
    x, y = (_in_space(positions) for positions in (start, end))
    sets = [number for simplices in (pairs.first, pairs.second) for number in (*simplices.shape, simplices)]
    options = int(pairs.centroids), int(pairs.is_one_set), where.patches, where.is_owned
    search, capacity = load_library(SOURCE).find_near_pairs, 4 * len(pairs.first) + 1000
    while True:
        result = np.empty((capacity, 2), np.int32)
        count = search(x, y, *sets, *options, reach, capacity, result)
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


class PairSearch:
    """Pairs within a distance of each other; x (n, d) of the vertices, m.

    Pairs are searched along a whole step of Newton's method, within the distance and twice a margin. They serve all
    positions within the margin of it: the trials of the line search, the steps after it, and mostly the next one.

    Attributes:
        filter: vertices of which pairs are searched.
    """

    def __init__(self, count: int, sets: Sequence[SimplexPairs], margin: float) -> None:
        """`count`: n; `sets`: pairs that are searched; `margin`: motion, m, after which they are searched again."""
        self.filter, self._sets, self._margin = PairFilter.none(count), sets, margin
        self.clear_caches()

    def clear_caches(self) -> None:
        """Discard all pairs."""
        self._pairs: list[Ints] | None = None

    def pairs(self, x: Values) -> list[Ints]:
        """(k, 2) pairs of each set; the same list while it is valid."""
        if self._pairs is None or not self._is_valid(x):
            self._pairs = self._search(x, x)
        return self._pairs

    def pairs_along(self, x: Values, end: Values) -> list[Ints]:
        """(k, 2) pairs of each set for the whole motion from x to `end`; the same list while it is valid."""
        if self._pairs is None or not (self._is_valid(x) and self._is_valid(end)):
            self._pairs = self._search(x, end)
        return self._pairs

    def _search(self, x: Values, end: Values) -> list[Ints]:
        """Search along a motion; the mean motion brings nothing together."""
        start, centred_end = centred(x), centred(end)
        self._start, self._motion, margin = start, centred_end - start, 2 * self._margin
        return [near_pairs(pairs, self.filter, start, centred_end, pairs.distance + margin) for pairs in self._sets]

    def _is_valid(self, x: Values) -> bool:
        """Whether no pair can be missing: all points are near one point of time of the motion in the last search."""
        offset, square = centred(x) - self._start, float(np.vdot(self._motion, self._motion))
        along = min(max(float(np.vdot(offset, self._motion)) / square, 0.0), 1.0) if square else 0.0
        return max_length(offset - along * self._motion) <= self._margin


def centred(x: Values) -> Values:
    """(n, d) positions relative to their mean, m."""
    result: Values = x - x.mean(axis=0) if len(x) else x
    return result


def max_length(vectors: Values) -> float:
    """Largest length of the rows of an array (n, d)."""
    return float(np.sqrt(np.max(np.einsum("nd,nd->n", vectors, vectors), initial=0.0)))
