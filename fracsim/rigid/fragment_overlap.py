"""Pieces that lie in one another from birth: hulls of neighbours overlap along rough and curved cracks.

Two parts that overlap by d when their body breaks may go on doing so, and come no deeper: their distance counts from d,
which shrinks with what they part by. So pieces stay where they broke, push nothing apart, and carry one another.

Equations: docs/theory.md#motion-and-contact-of-rigid-bodies.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]

NEW = -1  # of parts: of two pieces none has been looked at


@dataclass(frozen=True)
class Overlaps:
    """k pairs of parts of pieces.

    Attributes:
        names: (k, 2) of the pieces, the lower first.    parts: (k, 2) of each; NEW: whatever overlaps next is allowed.
        depth: (k,) that is allowed, m.
    """

    names: Ints
    parts: Ints
    depth: Values

    @classmethod
    def none(cls) -> Overlaps:
        """No pair at all."""
        return cls(np.empty((0, 2), np.int64), np.empty((0, 2), np.int64), np.empty(0))

    @classmethod
    def new(cls, names: Ints) -> Overlaps:
        """Pairs of pieces (k, 2) that have just come of one body."""
        return cls(names, np.full_like(names, NEW), np.full(len(names), np.inf))

    def divided(self, names: Ints, parent: Ints) -> Overlaps:
        """After pieces broke, `names` (n,) of what there is now and of what each was a part of, `parent` (n,): what did
        not break keeps its pairs, what comes of one piece or of an overlapping pair is new."""
        order = np.argsort(parent, kind="stable")
        old, start, count = np.unique(parent[order], return_index=True, return_counts=True)
        torn = count > 1
        pairs = np.searchsorted(old, self.names)
        lost = torn[pairs].any(axis=1)
        families = np.tile(np.flatnonzero(torn)[:, None], 2)
        across = np.unique(pairs[lost], axis=0)
        first, second = (names[order[each]] for each in _crossed(np.concatenate([families, across]), start, count))
        both = np.stack([first, second], axis=1)
        both = both[
            (first < second) | (parent[np.searchsorted(names, first)] != parent[np.searchsorted(names, second)])
        ]
        new = Overlaps.new(np.sort(both, axis=1))
        return Overlaps(*(np.concatenate([mine[~lost], more]) for mine, more in zip(
            (self.names, self.parts, self.depth), (new.names, new.parts, new.depth), strict=True)))  # fmt: skip


def _crossed(pairs: Ints, start: Ints, count: Ints) -> tuple[Ints, Ints]:
    """Every member of the first group of pairs (k, 2) with every one of the second; members follow `start`."""
    a, b = pairs.T
    many = count[a] * count[b]
    of = np.repeat(np.arange(len(pairs)), many)
    place = np.arange(many.sum()) - np.repeat(np.cumsum(many) - many, many)
    return start[a[of]] + place // count[b[of]], start[b[of]] + place % count[b[of]]


@dataclass(frozen=True)
class Parting:
    """Overlaps between the geoms of an engine.

    Attributes:
        names: (n,) of the bodies, ascending.    first: (n,) geom of each, of so many `geoms`.
        new: codes of pairs of bodies.    known, depth: (k,) codes of pairs of geoms, ascending, and what is allowed, m.
    """

    names: Ints
    first: Ints
    geoms: int
    new: Ints
    known: Ints
    depth: Values

    @classmethod
    def of(cls, overlaps: Overlaps, names: Ints, first: Ints, geoms: int) -> Parting:
        """Overlaps of pieces that are bodies of these names (n,)."""
        pairs, new = np.searchsorted(names, overlaps.names), overlaps.parts[:, 0] == NEW
        code = _code(first[pairs[~new]] + overlaps.parts[~new], geoms)
        order = np.argsort(code)
        return cls(names, first, geoms, _code(pairs[new], geoms), code[order], overlaps.depth[~new][order])

    def __call__(self, geoms: Ints, things: Ints, gap: Values) -> tuple[Values, Parting]:
        """(k,) distances of contacts of geoms (k, 2), -1 of none, of things (k, 2) beyond those allowed, from distances
        (k,), m; and what is allowed from then on."""
        if not len(self.known) and not len(self.new):
            return gap, self
        every, deep = _code(geoms, self.geoms), np.flatnonzero((gap < 0) & (geoms[:, 0] >= 0))
        code, place = np.unique(every[deep], return_inverse=True)
        depth: Values = np.zeros(len(code))
        np.maximum.at(depth, place, -gap[deep])
        allowed: Values = np.zeros(len(code))
        pairs = things[deep]
        bodies = np.maximum(*pairs.T) < len(self.names)
        allowed[place[bodies & np.isin(_code(pairs, self.geoms), self.new)]] = np.inf
        _, at, known = np.intersect1d(code, self.known, assume_unique=True, return_indices=True)
        allowed[at] = self.depth[known]
        some = allowed > 0
        code, allowed = code[some], np.minimum(allowed, depth)[some]
        return gap + _looked_up(every, code, allowed), replace(self.gone, known=code, depth=allowed)

    @cached_property
    def pairs(self) -> Ints:
        """(k, 2) bodies that lie in one another, or may."""
        geoms = np.stack([self.known // self.geoms, self.known % self.geoms], axis=1)
        known = np.searchsorted(self.first, geoms, side="right") - 1
        new = np.stack([self.new // self.geoms, self.new % self.geoms], axis=1)
        return np.unique(np.concatenate([known, new]), axis=0)

    @property
    def gone(self) -> Parting:
        """Where nothing touches."""
        return replace(self, new=self.new[:0], known=self.known[:0], depth=self.depth[:0])

    @property
    def overlaps(self) -> Overlaps:
        """As they are now."""
        geoms = np.stack([self.known // self.geoms, self.known % self.geoms], axis=1)
        body = np.searchsorted(self.first, geoms, side="right") - 1
        known = Overlaps(self.names[body], geoms - self.first[body], self.depth)
        new = Overlaps.new(self.names[np.stack([self.new // self.geoms, self.new % self.geoms], axis=1)])
        return Overlaps(*(np.concatenate(each) for each in zip(vars(known).values(), vars(new).values(), strict=True)))


def _code(pairs: Ints, geoms: int) -> Ints:
    """(k,) of pairs (k, 2) below a number."""
    return np.asarray(np.minimum(*pairs.T) * geoms + np.maximum(*pairs.T), np.int64)


def _looked_up(codes: Ints, known: Ints, values: Values) -> Values:
    """(k,) the values (m,) of codes (k,) among those known (m,), ascending; 0 of all others."""
    place = np.searchsorted(known, codes)
    there = np.append(known, -1)[place] == codes
    return np.asarray(np.where(there, np.append(values, 0.0)[place], 0.0))
