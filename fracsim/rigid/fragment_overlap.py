"""Overlaps of convex parts of fragments, which exist from the moment of fracture.

Convex hulls of neighbours overlap along rough and curved cracks. Two parts that overlap by d when their body breaks may
keep that overlap: the gap is measured from -d, and d decreases monotonically as the parts separate. So fragments stay
where they broke, do not push each other apart, and support one another.

Equations: docs/theory.md#motion-and-contact-of-rigid-bodies.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

# Number of a part in pairs of fragments whose overlap has not been measured yet.
UNMEASURED = -1


@dataclass(frozen=True)
class InitialOverlaps:
    """Overlaps of k pairs of parts of fragments. Checkpoints store the arrays by the names of the attributes.

    Attributes:
        names: (k, 2) names of the two fragments, ascending.
        parts: (k, 2) numbers of their parts; UNMEASURED: the next overlap of the fragments is admitted as it is.
        depth: (k,) admitted overlap, m.
    """

    names: Ints
    parts: Ints
    depth: Values

    @classmethod
    def empty(cls) -> InitialOverlaps:
        """Return no overlaps."""
        return cls(np.empty((0, 2), np.int64), np.empty((0, 2), np.int64), np.empty(0))

    @classmethod
    def between_new_fragments(cls, names: Ints) -> InitialOverlaps:
        """Return unmeasured overlaps of pairs of fragments, names (k, 2), that have just separated."""
        return cls(names, np.full_like(names, UNMEASURED), np.full(len(names), np.inf))

    def after_fracture(self, names: Ints, parent: Ints) -> InitialOverlaps:
        """Return the overlaps after bodies broke.

        Pairs of bodies that did not break stay. Pairs of fragments of one body, or of a pair that overlapped, are new.

        Args:
            names: (n,) of the present bodies, ascending.
            parent: (n,) names of the bodies that they were part of.
        """
        order = np.argsort(parent, kind="stable")
        old, start, count = np.unique(parent[order], return_index=True, return_counts=True)
        broken = count > 1
        pairs = np.searchsorted(old, self.names)
        replaced: Flags = np.asarray(broken[pairs].any(axis=1))
        within = np.tile(np.flatnonzero(broken)[:, None], 2)
        across = np.unique(pairs[replaced], axis=0)
        candidates = _all_pairs(np.concatenate([within, across]), start, count)
        first, second = (names[order[members]] for members in candidates)
        new = np.stack([first, second], axis=1)
        # of one body every pair is listed twice: keep it once
        first_parent, second_parent = (parent[np.searchsorted(names, name)] for name in (first, second))
        new = new[(first < second) | (first_parent != second_parent)]
        return self._select(~replaced)._concatenate(InitialOverlaps.between_new_fragments(np.sort(new, axis=1)))

    def _select(self, rows: Flags) -> InitialOverlaps:
        return InitialOverlaps(self.names[rows], self.parts[rows], self.depth[rows])

    def _concatenate(self, following: InitialOverlaps) -> InitialOverlaps:
        pairs = zip(vars(self).values(), vars(following).values(), strict=True)
        return InitialOverlaps(*(np.concatenate(pair) for pair in pairs))


def _all_pairs(pairs: Ints, start: Ints, count: Ints) -> tuple[Ints, Ints]:
    """Return every member of the first group with every member of the second, of pairs of groups (k, 2).

    Members of a group are consecutive numbers: `count` of them from `start` on.
    """
    a, b = pairs.T
    sizes = count[a] * count[b]
    row = np.repeat(np.arange(len(pairs)), sizes)
    number = np.arange(sizes.sum()) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    return start[a[row]] + number // count[b[row]], start[b[row]] + number % count[b[row]]


@dataclass(frozen=True)
class AdmittedOverlaps:
    """Overlaps that are admitted between the geoms (convex parts) of an engine.

    A pair (i, j) of numbers below `geom_count` is stored as the code min(i, j) geom_count + max(i, j).

    Attributes:
        names: (n,) of the bodies, ascending.
        first_geom: (n,) first geom of every body.
        geom_count: number of geoms.
        new_pairs: codes of pairs of bodies whose overlap has not been measured.
        geom_pairs: (k,) codes of pairs of geoms, ascending.
        depth: (k,) admitted overlap, m.
    """

    names: Ints
    first_geom: Ints
    geom_count: int
    new_pairs: Ints
    geom_pairs: Ints
    depth: Values

    @classmethod
    def from_overlaps(
        cls, overlaps: InitialOverlaps, names: Ints, first_geom: Ints, geom_count: int
    ) -> AdmittedOverlaps:
        """Return the overlaps of fragments that are bodies of the names (n,)."""
        pairs, new = np.searchsorted(names, overlaps.names), overlaps.parts[:, 0] == UNMEASURED
        code = _pair_codes(first_geom[pairs[~new]] + overlaps.parts[~new], geom_count)
        order = np.argsort(code)
        depth = overlaps.depth[~new][order]
        return cls(names, first_geom, geom_count, _pair_codes(pairs[new], geom_count), code[order], depth)

    def __call__(self, geoms: Ints, pairs: Ints, gap: Values) -> tuple[Values, AdmittedOverlaps]:
        """Return gaps measured from the admitted overlaps, and the overlaps that are admitted from now on.

        Args:
            geoms: (k, 2) of the contacts; -1 for none.
            pairs: (k, 2) bodies of the contacts.
            gap: (k,) m.
        """
        if not len(self.geom_pairs) and not len(self.new_pairs):
            return gap, self
        codes, overlapping = _pair_codes(geoms, self.geom_count), np.flatnonzero((gap < 0) & (geoms[:, 0] >= 0))
        # the deepest contact of every pair of geoms
        code, row = np.unique(codes[overlapping], return_inverse=True)
        depth: Values = np.zeros(len(code))
        np.maximum.at(depth, row, -gap[overlapping])
        admitted: Values = np.zeros(len(code))
        overlapping_pairs = pairs[overlapping]
        between_bodies = np.maximum(*overlapping_pairs.T) < len(self.names)
        is_new = np.isin(_pair_codes(overlapping_pairs, self.geom_count), self.new_pairs)
        admitted[row[between_bodies & is_new]] = np.inf
        _, present, stored = np.intersect1d(code, self.geom_pairs, assume_unique=True, return_indices=True)
        admitted[present] = self.depth[stored]
        remain = admitted > 0
        code, admitted = code[remain], np.minimum(admitted, depth)[remain]
        after = replace(self.without_contact, geom_pairs=code, depth=admitted)
        return gap + _look_up(codes, code, admitted), after

    @cached_property
    def body_pairs(self) -> Ints:
        """Pairs (k, 2) of bodies that overlap or may do so."""
        measured = np.searchsorted(self.first_geom, _decode(self.geom_pairs, self.geom_count), side="right") - 1
        return np.unique(np.concatenate([measured, _decode(self.new_pairs, self.geom_count)]), axis=0)

    @property
    def without_contact(self) -> AdmittedOverlaps:
        """These bodies without admitted overlaps."""
        return replace(self, new_pairs=self.new_pairs[:0], geom_pairs=self.geom_pairs[:0], depth=self.depth[:0])

    def to_initial_overlaps(self) -> InitialOverlaps:
        """Return the overlaps by names of fragments."""
        geoms = _decode(self.geom_pairs, self.geom_count)
        body = np.searchsorted(self.first_geom, geoms, side="right") - 1
        measured = InitialOverlaps(self.names[body], geoms - self.first_geom[body], self.depth)
        new = InitialOverlaps.between_new_fragments(self.names[_decode(self.new_pairs, self.geom_count)])
        return measured._concatenate(new)


def _pair_codes(pairs: Ints, count: int) -> Ints:
    """Return the codes (k,) of pairs (k, 2) of numbers below `count`."""
    return np.asarray(np.minimum(*pairs.T) * count + np.maximum(*pairs.T), np.int64)


def _decode(codes: Ints, count: int) -> Ints:
    """Return the pairs (k, 2) that codes (k,) stand for."""
    return np.stack([codes // count, codes % count], axis=1)


def _look_up(codes: Ints, keys: Ints, values: Values) -> Values:
    """Return for codes (k,) the values (m,) of the ascending keys (m,); 0 for codes that are no key."""
    row = np.searchsorted(keys, codes)
    is_key = np.append(keys, -1)[row] == codes
    return np.asarray(np.where(is_key, np.append(values, 0.0)[row], 0.0))
