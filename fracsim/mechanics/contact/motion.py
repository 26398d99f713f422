"""Points and an obstacle in motion: the gaps on the way, and bounds of how fast they close."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from .deepest import Deepest, deepest
from .placed import Placed
from .pose import Values, turned

Ints = npt.NDArray[np.int64]

ROUGH = 1e-6  # of the size of a facet: what is left of derivatives where its deepest place is found roughly


@dataclass(frozen=True, eq=False)
class Motion:
    """Points x (n, d) go straight by `moved` (n, d), m, and the pose of an obstacle by q: at share s by s q."""

    obstacle: Placed
    x: Values
    moved: Values
    q: Values

    def gap(self, share: Values) -> Values:
        """(n,) distances after shares (n,) of the motion, m."""
        return self.obstacle.shape.distance(self._place(share))

    def speed(self, share: Values) -> Values:
        """(n,) no gap closes faster than this from `share` to the end, m per whole motion.

        Seen from the centre a point goes straight, by v. The distance to a convex body is a convex function, which lies
        above its tangent: a gap loses no more than -n . v, n its normal at `share`. So what slides along a floor may go
        on. To a hollow body the distance is 1-Lipschitz only: |v|. A turn by w adds |w| times the reach.
        """
        v = self._relative
        if self.obstacle.shape.convex:
            n = self.obstacle.shape.normal(self._place(share))
            closing = np.maximum(-np.einsum("ni,ni->n", n, self._seen(v, share)), 0)
        else:
            closing = np.linalg.norm(v, axis=1)
        return closing + self._turning

    @cached_property
    def _relative(self) -> Values:
        return self.moved - self.q[: self.obstacle.pose.dim]

    @cached_property
    def _turn(self) -> Values:
        return self.q[self.obstacle.pose.dim :]

    @cached_property
    def _turning(self) -> Values:
        """(n,) |w| times the largest distance from the centre on the way, which is at one of its ends."""
        ends = [np.linalg.norm(self._from_centre(np.full(len(self.x), share)), axis=1) for share in (0.0, 1.0)]
        return np.asarray(np.linalg.norm(self._turn) * np.maximum(*ends))

    def _place(self, share: Values) -> Values:
        """(n, d) the points in the frame of the body. Kept: gaps and speeds are asked for at the same shares."""
        kept = vars(self).get("kept")
        if kept is None or kept[0] is not share:
            kept = vars(self)["kept"] = share, self._seen(self._from_centre(share), share)
        return kept[1]

    def _from_centre(self, share: Values) -> Values:
        return np.asarray(self.x - self.obstacle.pose.centre + share[:, None] * self._relative)

    def _seen(self, vectors: Values, share: Values) -> Values:
        """(n, d) vectors in the frame that the body has at each share."""
        return np.asarray(turned(vectors, -share[:, None] * self._turn) @ self.obstacle.pose.rotation)


class Passing:
    """Facets whose deepest places are `at`, and whose corners go straight by `relative` (k, c, d), m, past a convex
    obstacle that turns by `turn` (r,), rad, meanwhile.

    On the way these are found roughly: L (deepest) lies above its tangent at any place, which is what counts. The
    obstacle stays where it was, and corners go as they are seen from it.
    """

    def __init__(self, at: Deepest, relative: Values, turn: Values) -> None:
        self._start, self._relative, self._turn = at.x, relative, turn
        self._share: Values = np.zeros(len(at.x))
        self._at = at
        self._centre, self._turns = at.placed.pose.centre, float(np.linalg.norm(turn))

    @property
    def count(self) -> int:
        """k."""
        return len(self._start)

    def of(self, which: Ints) -> Passing:
        """Some of them, at the start."""
        at = self._at
        some = Deepest(at.placed, at.x[which], at.soften, at.share[which])
        return Passing(some, self._relative[which], self._turn)

    def _there(self, share: Values) -> Deepest:
        if not np.array_equal(share, self._share):
            x, at = self._start + share[:, None, None] * self._relative, self._at
            if self._turns:
                x = self._centre + self._seen(x - self._centre, share)
            self._share, self._at = share.copy(), deepest(at.placed, x, at.soften, at.share, ROUGH)
        return self._at

    def _seen(self, vectors: Values, share: Values) -> Values:
        """(k, c, d) vectors in the axes of the obstacle at each share, turned back to those that it had."""
        (k, c, d), w = vectors.shape, -share[:, None] * self._turn
        return turned(vectors.reshape(-1, d), np.repeat(w, c, axis=0)).reshape(k, c, d)

    def gap(self, share: Values) -> Values:
        """(k,) no less is left after shares (k,) of the motion, m."""
        at = self._there(share)
        return at.gap + np.minimum(at.slack.min(axis=1), 0.0)

    def speed(self, share: Values) -> Values:
        """(k,) no gap closes faster than this from `share` to the end, m per whole motion.

        Each corner is over the tangent by its slack, or more: one that comes closer by v may go on by the share
        (gap + slack) / v. A turn by w adds |w| times the reach.
        """
        at, gap = self._there(share), np.maximum(self.gap(share), np.finfo(float).tiny)[:, None]
        v = self._seen(self._relative, share) if self._turns else self._relative
        closing = np.maximum(-np.einsum("kcd,kd->kc", v, at.normal), 0.0)
        if self._turns:
            closing += self._turns * self._reach()
        over = np.maximum(at.gap[:, None] + at.slack, gap)
        return np.asarray((closing * gap / over).max(axis=1))

    def _reach(self) -> Values:
        """(k, c) the largest distance of corners from the centre on the way, which is at one of its ends."""
        ends = self._start - self._centre, self._start - self._centre + self._relative
        return np.maximum(*(np.linalg.norm(each, axis=2) for each in ends))
