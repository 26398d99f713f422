"""The gap to a round obstacle over a step in which a point slides around it.

With the normal n at the end of a way d from gap g_n to g the force of a barrier does p n . d, and not p (g - g_n): more
by p e~, e~ = n . d - (g - g_n) about d . H d / 2 of the curvature H, which a point that slides around a ball gains in
every step. With the normal n_n of the start it loses as much. The barrier acts on

    f = g - e / 2,    e = g - g_n - n_n . d,    so that its force has the direction (n + n_n) / 2

and is right to second order. Where e is no longer small beside g, f = g (g + e / 2) / (g + e): open wherever g is.
The start is seen from the obstacle, and goes with it.

Equations: docs/theory.md#contact-in-a-time-step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .pose import Pose

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Start:
    """Points as a step began.

    Attributes:
        gap: (n,) of all, m.    known: (k,) those that the barrier acted on.    normal, place: (k, d) of these, m.
    """

    gap: Values
    known: Ints
    normal: Values
    place: Values

    @classmethod
    def straight(cls, gap: Values, dim: int) -> Start:
        """Of points of which nothing but gaps (n,), m, is known: f = g."""
        return cls(gap, np.empty(0, np.int64), np.empty((0, dim)), np.empty((0, dim)))

    def seen(self, then: Pose, now: Pose) -> Start:
        """As it is where the obstacle has gone from one pose to another."""
        normal = now.vectors_to_space(self.normal @ then.rotation)
        return Start(self.gap, self.known, normal, now.points_to_space(then.to_body(self.place)))

    def bent(self, points: Ints, gap: Values, normal: Values, x: Values) -> Bent:
        """f of some points (m,), those that are known among them, with gaps (m,) and normals (m, d) at places x."""
        e, turned, has = np.zeros(len(points)), np.zeros_like(x), np.zeros(len(points), bool)
        at = np.searchsorted(points, self.known)
        e[at] = gap[at] - self.gap[self.known] - np.einsum("ni,ni->n", self.normal, x[at] - self.place)
        turned[at], has[at] = normal[at] - self.normal, True
        return Bent.of(gap, e, normal, turned, has)


@dataclass(frozen=True, eq=False)
class Bent:
    """f of points before an obstacle.

    Attributes:
        value: (m,) m.    gradient: (m, d).    of_curvature: (m,) its second derivative is that share of the gap's, and
            rest: (m, d, d), 1/m.
    """

    value: Values
    gradient: Values
    of_curvature: Values
    rest: Values

    @classmethod
    def of(cls, g: Values, e: Values, n: Values, m: Values, has: npt.NDArray[np.bool_]) -> Bent:
        """Of gaps g and excesses e (k,) with gradients n and m (k, d); f = g but where it `has` an excess.

        Before hollow obstacles e is negative, and f = g - e / 2.
        """
        over = np.where((e > 0) & (g > 0), e, 0.0)
        whole = np.where(over > 0, g + over, 1.0)
        s, t = np.where(over > 0, g / whole, 1.0), over / whole  # s + t = 1
        value = np.where(over > 0, g * (s + t / 2), g - np.where(has & (g > 0), np.minimum(e, 0.0), 0.0) / 2)
        by_g, by_e = 1 - t**2 / 2, np.where(has, -(s**2) / 2, 0.0)
        gg, ge, ee = (np.where(over > 0, each / whole, 0.0)[:, None, None] for each in (t**2, -s * t, s**2))
        nn, nm, mm = (a[:, :, None] * b[:, None, :] for a, b in ((n, n), (n, m), (m, m)))
        rest = gg * nn + ge * (nm + nm.transpose(0, 2, 1)) + ee * mm
        return cls(value, by_g[:, None] * n + by_e[:, None] * m, by_g + by_e, rest)
