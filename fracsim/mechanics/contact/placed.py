"""A shape somewhere in space: the gap to it, and derivatives of the gap with respect to point and pose.

For a fixed point x, y = x - c, n and H the normal and curvature of the distance there, and an increment q = (t, w) of
the pose (exponential map, see Pose), the gap is phi(x, q) = D(exp(-w) (y - t)), D the distance seen in the axes of
space. Its derivatives at q = 0, with G(y) w = -w x y (in 2D -w J y, J the quarter turn):

    d/dt = -n         d/dw = G(y)^T n = -(y x n)
    d2/dx2 = H        d2/dx dt = -H        d2/dx dw = H G(y) - G(n)
    d2/dt2 = H        d2/dt dw = -(H G(y) - G(n))
    d2/dw2 = G^T H G + (n y^T + y n^T) / 2 - (n . y) I; in 2D G^T H G - n . y

They hold where a Newton step starts from the pose as it is, so that every increment starts from q = 0. Without the
last terms, those of the second-order turn, Newton would not be quadratic for a body that rolls.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .pose import Pose, Values, turning
from .shape import Shape


@dataclass(frozen=True, eq=False)
class Placed:
    """A shape at a pose; all points are points of space, (n, d) in m, p = 3 in 2D and 6 in 3D."""

    shape: Shape
    pose: Pose

    def felt(self, q: Values) -> Values:
        """(p,) what gaps feel of an increment of the pose: no turn of what is round."""
        if not self.shape.round:
            return q
        return np.concatenate([q[: self.pose.dim], 0 * q[self.pose.dim :]])

    def distance(self, x: Values) -> Values:
        """(n,) signed distance, m."""
        return self.shape.distance(self.pose.to_body(x))

    def normal(self, x: Values) -> Values:
        """(n, d) gradient of the distance."""
        return self.pose.vectors_to_space(self.shape.normal(self.pose.to_body(x)))

    def curvature(self, x: Values) -> Values:
        """(n, d, d) Hessian of the distance, 1/m."""
        return self.pose.tensors_to_space(self.shape.curvature(self.pose.to_body(x)))

    def beyond(self, x: Values) -> float:
        """m, no point of x (n, d), nor any place between them, is nearer than this: a convex distance lies above its
        tangent, over the box around the points too."""
        if not len(x):
            return np.inf
        if not self.shape.convex:
            return -np.inf
        # by columns, of which a reduction is ten times as fast
        lower, upper = (np.array([each(column) for column in x.T]) for each in (np.min, np.max))
        nearest = np.clip(self.pose.centre, lower, upper)[None]
        n = self.normal(nearest)
        return float((self.distance(nearest) + np.minimum(n * (lower - nearest), n * (upper - nearest)).sum()).item())

    def by_pose(self, x: Values) -> Values:
        """(n, p) derivative of the distance of fixed points with respect to q = (t, w)."""
        n = self.normal(x)
        by_turn = np.einsum("nip,ni->np", turning(x - self.pose.centre), n)
        return np.concatenate([-n, by_turn], axis=1)

    def by_point_and_pose(self, x: Values) -> Values:
        """(n, d, p) second derivative with respect to the point and q."""
        H, G = self.curvature(x), turning(x - self.pose.centre)
        return np.concatenate([-H, H @ G - turning(self.normal(x))], axis=2)


def second_order_turn(n: Values, y: Values) -> Values:
    """(n, p, p) second derivative of n . exp(-w) y at w = 0."""
    along = np.einsum("ni,ni->n", n, y)[:, None, None]
    if n.shape[1] == 2:
        return -along
    ny = n[:, :, None] * y[:, None, :]
    return (ny + ny.transpose(0, 2, 1)) / 2 - along * np.eye(3)


def least_distance(obstacles: Sequence[Placed], x: Values) -> Values:
    """(n,) of points x (n, d) to the nearest of several shapes, m."""
    return np.asarray(np.min([placed.distance(x) for placed in obstacles], axis=0))
