"""Room for walls that come to light where there is none: their points are drawn in towards their nodes.

Gaps inside a body are closed before anything is there that could touch: it bends around an obstacle, is squeezed, or a
crumb whose cells are all split loses its deformation gradient. A new point takes the largest share of its arm that
brings no barrier to act, one that was there before the largest at which it is no nearer than it was: no energy comes
from nothing. Where there is no room even at the node, the point is left out. With every step points go out again as
far as the barrier lets them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...mesh.split.identity import found_again
from ...mesh.split.places import Places

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

SHARES = np.linspace(1.0, 0.0, 11)  # of the share that a point had
NEARER = (0.8,) * 12 + (0.0,)  # what an element that is cut leaves of its points' shares, each time
OUT = 0.2  # of the arm, that a step gives back


@dataclass(frozen=True)
class Known:
    """Copies that are worth knowing again: rows of `identity`, their shares (k,), and gaps (k,) in m; nan: left out."""

    rows: Values
    share: Values
    gap: Values

    @classmethod
    def of(cls, rows: Values, share: Values, gap: Values, width: float) -> Known:
        """Of all copies those that are within `width` m, or drawn in."""
        which = np.flatnonzero(~(gap >= width) | (share < 1))
        return cls(rows[which], share[which], gap[which])

    def again(self, rows: Values, width: float) -> tuple[Values, Values]:
        """(n,) shares that the copies `rows` begin with, and gaps that they must keep: all of `width`, if new."""
        share, gap = np.ones(len(rows)), np.full(len(rows), width)
        at = found_again(self.rows, rows)
        share[at[at >= 0]], gap[at[at >= 0]] = self.share[at >= 0], self.gap[at >= 0]
        return share, np.where(np.isnan(gap), width, np.minimum(gap, width))


def drawn_in(
    at: Places, u: Values, which: Ints, share: Values, wanted: Values, gaps: Callable[[Values], Values]
) -> tuple[Places, Ints]:
    """Points `which` (k,) drawn in from `share` (k,) until gaps(x) reach `wanted` (k,), m; and those that have no room,
    whose shares stay. `u`: (nodes, d) displacements, m."""
    found, left = at.share.copy(), np.arange(len(which))
    found[which] = share
    for part in SHARES:
        trial = part * share[left]
        # of what does not move: round-off
        fits = gaps(at.some(u, which[left], trial)) >= wanted[left] - 1e-9 * abs(wanted[left])
        found[which[left[fits]]] = trial[fits]
        left = left[~fits]
        if not len(left):
            break
    return at if np.array_equal(found, at.share) else at.drawn_in(found), which[left]


def uncut(at: Places, u: Values, elements: Ints, cut: Callable[[Values], Flags]) -> Places:
    """Copies of elements (m, d) that are `cut` drawn in until none is, or they are at their nodes. `cut`: of points at
    x (n, d), m, (m,) flags. `u`: (nodes, d) displacements, m."""
    for part in NEARER:
        tight = np.intersect1d(elements[cut(at(u))], at.copies)
        tight = tight[at.share[tight] > 0]
        if not len(tight):
            break
        share = at.share.copy()
        share[tight] *= part
        at = at.drawn_in(share)
    return at


def let_out(at: Places, u: Values, wanted: float, gaps: Callable[[Values], Values]) -> Places:
    """Points that were drawn in go out by OUT where gaps stay `wanted`, m."""
    inside = np.flatnonzero(at.share < 1)
    if not len(inside):
        return at
    trial, share = np.minimum(at.share[inside] + OUT, 1.0), at.share.copy()
    fits = gaps(at.some(u, inside, trial)) >= wanted
    share[inside[fits]] = trial[fits]
    return at.drawn_in(share)
