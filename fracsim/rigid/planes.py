"""Contacts of hulls with planes: every corner that may come as far.

MuJoCo finds three places of a hull at most. A shard that turns fast falls through a floor with a fourth. Which corners
may come as far is told by how bodies move as a step begins: what something strikes comes down with others, and is
looked at once more with these.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from ..mechanics.contact.axes import frame
from .bodies import Bodies

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

SURELY, SLACK = 1.5, 0.25  # times what a corner comes in a step, and of what its body may: it is looked at
NEAREST = 6  # corners of a body that are looked at in any case
SECTORS, LOWEST, WIDEST = 8, 2, 1  # of a body around its centre: corners that may touch in each, lowest and outermost


def _first(of: Ints, value: Values, many: int) -> Flags:
    """(k,) whether corners of groups (k,) are among the `many` with the least value (k,) of theirs."""
    order = np.lexsort((value, of))
    _, start, count = np.unique(of[order], return_index=True, return_counts=True)
    rank = np.empty(len(of), np.int64)
    rank[order] = np.arange(len(of)) - np.repeat(start, count)
    return np.asarray(rank < many)


def _bearing(of: Ints, arm: Values, across: Values, later: Values) -> Flags:
    """(k,) which corners of bodies (k,) at `arm` (k, 3) from their centres bear: those `later` (k,) lowest and those
    farthest out in every direction along the plane with axes (3, 3), the last one its normal; all of a body that has
    few."""
    along = arm @ across[:, 0], arm @ across[:, 1]
    sector = np.floor((np.arctan2(*along) / (2 * np.pi) + 0.5) * SECTORS).astype(np.int64)
    group = SECTORS * of + np.minimum(sector, SECTORS - 1)
    few = np.bincount(of) <= SECTORS * (LOWEST + WIDEST)
    return np.asarray(_first(group, later, LOWEST) | _first(group, -np.hypot(*along), WIDEST) | few[of])


@dataclass
class Looked:
    """(p, N) corners that were looked at in a step when it was last asked for what is near, and those that are in any
    case."""

    at: Flags
    always: Flags


@dataclass(frozen=True)
class Planes:
    """p planes, and N corners of hulls.

    Attributes:
        stand, geom: (p,) their numbers among what stands and of the engine.    normal: (p, 3) outwards.
        friction: (p,)    corners: (N, 3) about the centres of the bodies at rest, m.    of, part: (N,) body and geom.
        extent: (n,) how far each body reaches from its centre, m.
    """

    stand: Ints
    geom: Ints
    normal: Values
    friction: Values
    corners: Values
    of: Ints
    part: Ints
    extent: Values

    @cached_property
    def across(self) -> list[Values]:
        """(3, 3) axes of each, the last one its normal."""
        return [frame(normal) for normal in self.normal]

    def looked(self) -> Looked:
        """As a step begins: nothing has been missed in it."""
        none = np.zeros((len(self.stand), len(self.corners)), bool)
        return Looked(none, none.copy())

    def missed(self, bodies: Bodies, ways: Values, deep: float, looked: Looked) -> Flags:
        """(n,) bodies with corners that are in a plane by more than `deep`, m, and were not looked at: now they are, in
        this step, as far as they bear. `bodies`, `ways`: (stands, 3) where things are after it."""
        found = np.zeros(len(bodies), bool)
        for number, (stand, normal) in enumerate(zip(self.stand, [*self.normal], strict=True)):
            near, gap = self._around(bodies, ways[stand], normal, np.zeros(len(bodies)))
            rows = np.flatnonzero((gap < -deep) & ~looked.at[number, near])
            if len(rows):
                of = self.of[near[rows]]
                bears = _bearing(of, self._arms(bodies, near[rows]), self.across[number], gap[rows])
                looked.always[number, near[rows[bears]]] = found[of] = True
        return found

    def _around(
        self, bodies: Bodies, way: Values, normal: Values, reach: Values, only: Flags | None = None
    ) -> tuple[Ints, Values]:
        """Corners (k,) of bodies that come near a plane with a normal (3,) through a point (3,), and how far from it
        they are (k,), m; `reach`: (n,) how far each and the plane come, m; `only`: (n,) of these bodies."""
        height, across = (bodies.place - way) @ normal, np.einsum("nij,i->nj", bodies.turn, normal)
        low = height < self.extent + reach
        near = np.flatnonzero((low if only is None else low & only)[self.of])
        of = self.of[near]
        return near, np.einsum("kj,kj->k", across[of], self.corners[near]) + height[of]

    def _arms(self, bodies: Bodies, corners: Ints) -> Values:
        """(k, 3) corners (k,) beside the centres of their bodies, m."""
        return np.asarray(np.einsum("kij,kj->ki", bodies.turn[self.of[corners]], self.corners[corners]))

    def near(
        self, bodies: Bodies, ways: Values, reach: Values, speeds: Values, step: float, looked: Looked,
        only: Flags | None = None,
    ) -> list[tuple[int, Ints, Values, Values]]:  # fmt: skip
        """Of each plane that anything is near to: its number here, the parts (k,) that are, the distances (k,) of
        corners and the points (k, 3), m. `ways`, `speeds`: (stands, 3) and (stands,) where planes are and what they
        come in a step, m; `reach`: (n,) what bodies do; `step`: s; `only`: (n,) of these bodies."""
        if not len(self.stand) or not len(self.corners):
            return []
        found = []
        for number, (stand, normal) in enumerate(zip(self.stand, [*self.normal], strict=True)):
            near, gap = self._around(bodies, ways[stand], normal, reach + speeds[stand], only)
            seen, always = looked.at[number], looked.always[number]
            seen[slice(None) if only is None else only[self.of]] = False
            rows = np.flatnonzero((gap < reach[self.of[near]] + speeds[stand]) | always[near])
            if len(rows):
                near, of, gap = near[rows], self.of[near[rows]], gap[rows]
                arms = self._arms(bodies, near)
                x = arms + bodies.place[of]
                way = -step * np.einsum("ki,i->k", bodies.velocity_at(x, of), normal)
                soon = np.flatnonzero(gap < SURELY * way + SLACK * reach[of] + speeds[stand])
                kept = _first(of, gap, NEAREST) | always[near]
                kept[soon] |= _bearing(of[soon], arms[soon], self.across[number], (gap - way)[soon])
                seen[near[kept]] = True
                points = x[kept] - gap[kept, None] / 2 * normal
                found.append((number, self.part[near[kept]], gap[kept], points))
        return found
