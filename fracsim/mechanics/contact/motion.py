"""Points and an obstacle in motion: the gaps on the way, and bounds of how fast they close."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .placed import Placed
from .pose import Values, turned


@dataclass(frozen=True, eq=False)
class Motion:
    """Points x (n, d) go straight by `moved` (n, d), m, and the pose of an obstacle by q: at share s by s q."""

    obstacle: Placed
    x: Values
    moved: Values
    q: Values

    def gap(self, share: Values) -> Values:
        """(n,) distances after shares (n,) of the motion, m."""
        return self.obstacle.shape.distance(self._seen(self._from_centre(share), share))

    def speed(self, share: Values) -> Values:
        """(n,) no gap closes faster than this from `share` to the end, m per whole motion.

        Seen from the centre a point goes straight, by v. The distance to a convex body is a convex function, which lies
        above its tangent: a gap loses no more than -n . v, n its normal at `share`. So what slides along a floor may go
        on. To a hollow body the distance is 1-Lipschitz only: |v|. A turn by w adds |w| times the reach.
        """
        v = self._relative()
        if self.obstacle.shape.convex:
            n = self.obstacle.shape.normal(self._seen(self._from_centre(share), share))
            closing = np.maximum(-np.einsum("ni,ni->n", n, self._seen(v, share)), 0)
        else:
            closing = np.linalg.norm(v, axis=1)
        return closing + np.linalg.norm(self._turn()) * self._reach()

    def _relative(self) -> Values:
        return self.moved - self.q[: self.obstacle.pose.dim]

    def _turn(self) -> Values:
        return self.q[self.obstacle.pose.dim :]

    def _from_centre(self, share: Values) -> Values:
        return np.asarray(self.x - self.obstacle.pose.centre + share[:, None] * self._relative())

    def _seen(self, vectors: Values, share: Values) -> Values:
        """(n, d) vectors in the frame that the body has at each share."""
        return np.asarray(turned(vectors, -share[:, None] * self._turn()) @ self.obstacle.pose.rotation)

    def _reach(self) -> Values:
        """(n,) the largest distance from the centre on the way, which is at one of its ends."""
        ends = [np.linalg.norm(self._from_centre(np.full(len(self.x), share)), axis=1) for share in (0.0, 1.0)]
        return np.maximum(*ends)
