"""Contacts of hulls with planes: every corner that may come as far.

MuJoCo finds three places of a hull at most. A shard that turns fast falls through a floor with a fourth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .bodies import Bodies

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

SURELY, SLACK = 1.5, 0.25  # times what a corner comes in a step, and of what its body may: it is looked at
NEAREST = 6  # corners of a body that are looked at in any case


def _nearest(of: Ints, gap: Values) -> Flags:
    """(k,) whether corners of bodies (k,) are among the nearest of theirs, by distances (k,)."""
    order = np.lexsort((gap, of))
    _, start, count = np.unique(of[order], return_index=True, return_counts=True)
    rank = np.empty(len(of), np.int64)
    rank[order] = np.arange(len(of)) - np.repeat(start, count)
    return np.asarray(rank < NEAREST)


@dataclass(frozen=True)
class Planes:
    """p planes, and N corners of hulls.

    Attributes:
        stand, geom: (p,) their numbers among what stands and of the engine.    normal: (p, 3) outwards.
        friction: (p,)    corners: (N, 3) about the centres of the bodies at rest, m.    of, part: (N,) body and geom.
    """

    stand: Ints
    geom: Ints
    normal: Values
    friction: Values
    corners: Values
    of: Ints
    part: Ints

    def near(
        self, bodies: Bodies, ways: Values, reach: Values, speeds: Values, step: float
    ) -> list[tuple[int, Ints, Values, Values]]:
        """Of each plane that anything is near to: its number here, the parts (k,) that are, the distances (k,) of
        corners and the points (k, 3), m. `ways`, `speeds`: (stands, 3) and (stands,) where planes are and what they
        come in a step, m; `reach`: (n,) what bodies do; `step`: s."""
        if not len(self.stand) or not len(self.corners):
            return []
        x = np.einsum("kij,kj->ki", bodies.turn[self.of], self.corners) + bodies.place[self.of]
        found = []
        for number, (stand, normal) in enumerate(zip(self.stand, self.normal, strict=True)):
            gap = (x - ways[stand]) @ normal
            rows = np.flatnonzero(gap < reach[self.of] + speeds[stand])
            if len(rows):
                of = self.of[rows]
                coming = -np.einsum("ki,i->k", bodies.velocity_at(x[rows], of), normal)
                soon = SURELY * step * coming + SLACK * reach[of] + speeds[stand]
                rows = rows[_nearest(of, gap[rows]) | (gap[rows] < soon)]
                points = x[rows] - gap[rows, None] / 2 * normal
                found.append((number, self.part[rows], gap[rows], points))
        return found
