"""Rigid poses: where a body is and how it is turned.

A shape somewhere in space: the gap to it, and derivatives of the gap with respect to point and pose.

For a fixed point x, y = x - c, n and H the normal and curvature of the distance there, and an increment q = (t, w) of
the pose (exponential map, see Pose), the gap is phi(x, q) = D(exp(-w) (y - t)), D the distance seen in the axes of
space. Its derivatives at q = 0, with G(y) w = -w x y (in 2D -w J y, J the quarter turn):

    d/dt = -n         d/dw = G(y)^T n = -(y x n)
    d2/dx2 = H        d2/dx dt = -H        d2/dx dw = H G(y) - G(n)
    d2/dt2 = H        d2/dt dw = -(H G(y) - G(n))
    d2/dw2 = G^T H G + (n y^T + y n^T) / 2 - (n . y) I; in 2D G^T H G - n . y

They hold where a Newton step starts from the pose as it is, so that every increment starts from q = 0. Without the
last terms, those of the second-order turn, Newton would not be quadratic for a body that rolls.

Rotation vectors that are not small: how a turn by w (rad, axes of space) answers to a change of w.

    exp(w + dw) = exp(J(w) dw) exp(w) to first order,   J = 1 + a W + b W^2,  W y = w x y,
    a = (1 - cos s) / s^2,  b = (s - sin s) / s^3,  s = |w|

(the left Jacobian of SO(3); J. Sola et al., A micro Lie theory for state estimation in robotics, arXiv:1812.01537, eq.
145). In 2D J = 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import factorial

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from .shape_base import Shape

Values = npt.NDArray[np.float64]
# a, b, a'/s, b'/s as power series in s^2: exact to round-off up to a whole turn, and at s = 0 as well
_POWERS = range(24)


@dataclass(frozen=True, eq=False)
class Pose:
    """x = c + R X: `centre` c (d,) in m, `rotation` R (d, d), X in the frame of the body.

    An increment is q = (t, w), (3,) in 2D and (6,) in 3D: c moves by t (m) and the body turns about c by the angle or
    rotation vector w (rad, axes of space): x = c + t + exp(w) R X.
    """

    centre: Values
    rotation: Values

    @classmethod
    def at_point(cls, centre: Values) -> Pose:
        """Not turned."""
        return cls(np.asarray(centre, float), np.eye(len(centre)))

    @property
    def dim(self) -> int:
        """2 or 3."""
        return len(self.centre)

    def to_body(self, x: Values) -> Values:
        """(n, d) X = R^T (x - c) of points x (n, d)."""
        return np.asarray((x - self.centre) @ self.rotation)

    def points_to_space(self, X: Values) -> Values:
        """(n, d) x = c + R X."""
        return np.asarray(self.centre + X @ self.rotation.T)

    def vectors_to_space(self, v: Values) -> Values:
        """(n, d) R v."""
        return np.asarray(v @ self.rotation.T)

    def tensors_to_space(self, A: Values) -> Values:
        """(n, d, d) R A R^T."""
        return np.asarray(self.rotation @ A @ self.rotation.T)

    def rotation_vector(self) -> Values:
        """(1,) or (3,) angle or rotation vector of R, rad, at most half a turn."""
        if self.dim == 3:
            return np.asarray(Rotation.from_matrix(self.rotation).as_rotvec())
        return np.arctan2(self.rotation[1:, 0], self.rotation[:1, 0])

    def incremented(self, q: Values) -> Pose:
        """The pose after an increment q = (t, w); the rotation stays one to round-off however often this is done."""
        t, w = q[: self.dim], q[self.dim :]
        if self.dim == 3:
            turned = Rotation.from_rotvec(w) * Rotation.from_matrix(self.rotation)
            return Pose(self.centre + t, turned.as_matrix())
        angle = np.arctan2(self.rotation[1, 0], self.rotation[0, 0]) + w[0]
        cos, sin = np.cos(angle), np.sin(angle)
        return Pose(self.centre + t, np.array([[cos, -sin], [sin, cos]]))

    def increment_to(self, other: Pose) -> Values:
        """(p,) the increment that leads from here to another pose, with a turn of half a turn at most."""
        w = Pose(other.centre, other.rotation @ self.rotation.T).rotation_vector()
        return np.concatenate([other.centre - self.centre, w])


def rotate_vectors(y: Values, w: Values) -> Values:
    """(n, d) exp(w) y of vectors y (n, d), each turned by its own angle w (n, 1) or rotation vector w (n, 3), rad."""
    if y.shape[1] == 3:
        return np.asarray(Rotation.from_rotvec(w).apply(y)) if len(y) else y
    cos, sin = np.cos(w[:, 0]), np.sin(w[:, 0])
    return np.stack([cos * y[:, 0] - sin * y[:, 1], sin * y[:, 0] + cos * y[:, 1]], axis=1)


def rotation_derivative(y: Values) -> Values:
    """(n, d, p) G(y): a body that turns by w sees the fixed points y (n, d) move by G(y) w = -w x y; p = 1 or 3."""
    if y.shape[1] == 2:
        return np.stack([y[:, 1], -y[:, 0]], axis=1)[:, :, None]
    zero = np.zeros(len(y))
    a, b, c = y.T
    rows = [[zero, -c, b], [c, zero, -a], [-b, a, zero]]
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)


@dataclass(frozen=True, eq=False)
class PosedShape:
    """A shape at a pose; all points are points of space, (n, d) in m, p = 3 in 2D and 6 in 3D."""

    shape: Shape
    pose: Pose

    def effective_increment(self, q: Values) -> Values:
        """(p,) what gaps feel of an increment of the pose: no turn of what is round."""
        if not self.shape.rotation_invariant:
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

    def distance_bound(self, x: Values) -> float:
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

    def pose_gradient(self, x: Values) -> Values:
        """(n, p) derivative of the distance of fixed points with respect to q = (t, w)."""
        n = self.normal(x)
        by_turn = np.einsum("nip,ni->np", rotation_derivative(x - self.pose.centre), n)
        return np.concatenate([-n, by_turn], axis=1)

    def mixed_hessian(self, x: Values) -> Values:
        """(n, d, p) second derivative with respect to the point and q."""
        H, G = self.curvature(x), rotation_derivative(x - self.pose.centre)
        return np.concatenate([-H, H @ G - rotation_derivative(self.normal(x))], axis=2)


def rotation_second_derivative(n: Values, y: Values) -> Values:
    """(n, p, p) second derivative of n . exp(-w) y at w = 0."""
    along = np.einsum("ni,ni->n", n, y)[:, None, None]
    if n.shape[1] == 2:
        return -along
    ny = n[:, :, None] * y[:, None, :]
    return (ny + ny.transpose(0, 2, 1)) / 2 - along * np.eye(3)


def min_distance(obstacles: Sequence[PosedShape], x: Values) -> Values:
    """(n,) of points x (n, d) to the nearest of several shapes, m."""
    return np.asarray(np.min([placed.distance(x) for placed in obstacles], axis=0))


_A, _B = ([(-1.0) ** k / factorial(2 * k + extra) for k in _POWERS] for extra in (2, 3))


_A_SLOPE, _B_SLOPE = ([2 * (k + 1) * series[k + 1] for k in _POWERS[:-1]] for series in (_A, _B))


def left_jacobian(w: Values) -> Values:
    """(r, r) J(w), r = 1 or 3 numbers of a turn."""
    if len(w) == 1:
        return np.ones((1, 1))
    W = _cross(w)
    result: Values = np.eye(3) + _sum(_A, w) * W + _sum(_B, w) * W @ W
    return result


def left_jacobian_derivative(w: Values, moment: Values) -> Values:
    """(r, r) symmetric part of the derivative of J(w)^T m by w, the moment m (r,) held."""
    if len(w) == 1:
        return np.zeros((1, 1))
    across, along = np.cross(w, moment), float(w @ moment)
    steep = -_sum(_A_SLOPE, w) * across + _sum(_B_SLOPE, w) * np.cross(w, across)
    found = _sum(_B, w) * (along * np.eye(3) - np.outer(w, moment)) + np.outer(steep, w)
    return np.asarray(found + found.T) / 2


def _sum(series: list[float], w: Values) -> float:
    return float(np.polynomial.polynomial.polyval(float(w @ w), series))


def _cross(w: Values) -> Values:
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
