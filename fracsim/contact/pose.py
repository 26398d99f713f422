"""Rigid poses, and distances to a shape at a pose with their derivatives.

For a fixed point x, y = x - c, n and H the normal and curvature of the distance there, and an increment q = (t, w) of
the pose, the gap is phi(x, q) = D(exp(-w) (y - t)), D the distance in the axes of space. Its derivatives at q = 0, with
G(y) w = -w x y (in 2D -w J y, J the rotation by 90 degrees):

    d/dt = -n         d/dw = G(y)^T n = -(y x n)
    d2/dx2 = H        d2/dx dt = -H        d2/dx dw = H G(y) - G(n)
    d2/dt2 = H        d2/dt dw = -(H G(y) - G(n))
    d2/dw2 = G^T H G + (n y^T + y n^T) / 2 - (n . y) I; in 2D G^T H G - n . y

Every step of Newton's method starts from q = 0. Without the last terms it would not be quadratic for a body that rolls.

Equations: docs/theory.md#rigid-obstacles.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import factorial

import numpy as np
from scipy.spatial.transform import Rotation

from ..array_types import Values
from .shape_base import Shape

_IDENTITY = np.eye(3)


@dataclass(frozen=True, eq=False)
class Pose:
    """Rigid pose x = c + R X, X in the frame of the body.

    An increment is q = (t, w), (p,) = (3,) in 2D and (6,) in 3D: c moves by t (m), and the body rotates about c by the
    angle or rotation vector w (rad, axes of space), x = c + t + exp(w) R X.

    Attributes:
        centre: (d,) c, m.
        rotation: (d, d) R.
    """

    centre: Values
    rotation: Values

    @classmethod
    def at_point(cls, centre: Values) -> Pose:
        """Pose at a point (d,), m, without rotation."""
        return cls(np.asarray(centre, float), np.eye(len(centre)))

    @property
    def dim(self) -> int:
        """Dimension d, 2 or 3."""
        return len(self.centre)

    def equals(self, other: Pose) -> bool:
        """Whether both are the same."""
        return bool(np.array_equal(self.centre, other.centre) and np.array_equal(self.rotation, other.rotation))

    def to_body(self, x: Values) -> Values:
        """(n, d) X = R^T (x - c) of points x (n, d), m."""
        return np.asarray((x - self.centre) @ self.rotation)

    def points_to_space(self, X: Values) -> Values:
        """(n, d) x = c + R X, m."""
        return np.asarray(self.centre + X @ self.rotation.T)

    def vectors_to_space(self, v: Values) -> Values:
        """(n, d) R v."""
        return np.asarray(v @ self.rotation.T)

    def tensors_to_space(self, A: Values) -> Values:
        """(n, d, d) R A R^T."""
        return np.asarray(self.rotation @ A @ self.rotation.T)

    def rotation_vector(self) -> Values:
        """(1,) angle or (3,) rotation vector of R, rad, of at most half a turn."""
        if self.dim == 3:
            return np.asarray(Rotation.from_matrix(self.rotation).as_rotvec())
        return np.arctan2(self.rotation[1:, 0], self.rotation[:1, 0])

    def incremented(self, q: Values) -> Pose:
        """Pose after an increment q = (t, w); R stays a rotation to round-off however often this is done."""
        t, w = q[: self.dim], q[self.dim :]
        if self.dim == 3:
            product = _rotation_matrix(w) @ self.rotation
            # R (3 - R^T R) / 2: deviations from a rotation are squared
            return Pose(self.centre + t, product @ (1.5 * _IDENTITY - 0.5 * product.T @ product))
        angle = np.arctan2(self.rotation[1, 0], self.rotation[0, 0]) + w[0]
        cos, sin = np.cos(angle), np.sin(angle)
        return Pose(self.centre + t, np.array([[cos, -sin], [sin, cos]]))

    def increment_to(self, target: Pose) -> Values:
        """(p,) increment from this pose to another one, with a rotation of at most half a turn."""
        w = Pose(target.centre, target.rotation @ self.rotation.T).rotation_vector()
        return np.concatenate([target.centre - self.centre, w])


def rotate_vectors(y: Values, w: Values) -> Values:
    """(n, d) exp(w) y of vectors y (n, d), each with its own angle w (n, 1) or rotation vector w (n, 3), rad."""
    if y.shape[1] == 3:
        return np.asarray(Rotation.from_rotvec(w).apply(y)) if len(y) else y
    cos, sin = np.cos(w[:, 0]), np.sin(w[:, 0])
    return np.stack([cos * y[:, 0] - sin * y[:, 1], sin * y[:, 0] + cos * y[:, 1]], axis=1)


def rotation_derivative(y: Values) -> Values:
    """(n, d, r) G(y) of fixed points y (n, d); r = 1 or 3.

    Seen from a body that rotates by w they move by G(y) w = -w x y.
    """
    if y.shape[1] == 2:
        return np.stack([y[:, 1], -y[:, 0]], axis=1)[:, :, None]
    G = np.zeros((len(y), 3, 3))
    G[:, 2, 1], G[:, 0, 2], G[:, 1, 0] = y.T
    return G - G.transpose(0, 2, 1)


@dataclass(frozen=True, eq=False)
class PosedShape:
    """Shape at a pose; points (n, d), m, are points of space, and p = 3 in 2D, 6 in 3D."""

    shape: Shape
    pose: Pose

    @cached_property
    def packed(self) -> Values:
        """Numbers of the shape and its pose for the shape's compiled functions, if it has some."""
        assert self.shape.kernels is not None
        return self.shape.kernels.pack(self.shape, self.pose.centre, self.pose.rotation)

    def effective_increment(self, q: Values) -> Values:
        """(p,) part of an increment of the pose that changes gaps: no rotation of a sphere."""
        if not self.shape.rotation_invariant:
            return q
        return np.concatenate([q[: self.pose.dim], 0 * q[self.pose.dim :]])

    def distance(self, x: Values) -> Values:
        """(n,) signed distances, m; positive outside."""
        if (kernels := self.shape.kernels) is not None:
            return kernels.distance(self.packed, x)
        return self.shape.distance(self.pose.to_body(x))

    def normal(self, x: Values) -> Values:
        """(n, d) gradients of the distance."""
        if (kernels := self.shape.kernels) is not None:
            return kernels.normal(self.packed, x)
        return self.pose.vectors_to_space(self.shape.normal(self.pose.to_body(x)))

    def curvature(self, x: Values) -> Values:
        """(n, d, d) Hessians of the distance, 1/m."""
        if (kernels := self.shape.kernels) is not None:
            return kernels.curvature(self.packed, x)
        return self.pose.tensors_to_space(self.shape.curvature(self.pose.to_body(x)))

    def distance_bound(self, x: Values) -> float:
        """Lower bound, m, of the distance of all points x (n, d) and of points between them.

        A convex distance lies above its tangent plane, also over the bounding box of the points.
        """
        if not len(x):
            return np.inf
        if not self.shape.convex:
            return -np.inf
        # column by column: ten times as fast as a reduction over rows
        lower, upper = (np.array([reduce(column) for column in x.T]) for reduce in (np.min, np.max))
        nearest = np.clip(self.pose.centre, lower, upper)[None]
        n = self.normal(nearest)
        decrease = np.minimum(n * (lower - nearest), n * (upper - nearest)).sum()
        return float((self.distance(nearest) + decrease).item())


def rotation_second_derivative(n: Values, y: Values) -> Values:
    """(n, r, r) second derivatives of n . exp(-w) y by w at w = 0, of vectors n and y (n, d)."""
    scalar = np.einsum("ni,ni->n", n, y)[:, None, None]
    if n.shape[1] == 2:
        return -scalar
    ny = n[:, :, None] * y[:, None, :]
    return (ny + ny.transpose(0, 2, 1)) / 2 - scalar * _IDENTITY


def min_distance(obstacles: Sequence[PosedShape], x: Values) -> Values:
    """(n,) distances of points x (n, d) to the nearest of several shapes, m."""
    return np.asarray(np.min([posed.distance(x) for posed in obstacles], axis=0))


def _rotation_matrix(w: Values) -> Values:
    """(3, 3) exp(w) of a rotation vector w (3,), rad (Rodrigues)."""
    W, angle = _cross(w), math.sqrt(float(w @ w))
    first, second = (math.sin(angle) / angle, 2 * (math.sin(angle / 2) / angle) ** 2) if angle else (1.0, 0.5)
    result: Values = _IDENTITY + first * W + second * (W @ W)
    return result


# Left Jacobian of SO(3): exp(w + dw) = exp(J(w) dw) exp(w) to first order,
#     J = 1 + a W + b W^2,  W y = w x y,  a = (1 - cos s) / s^2,  b = (s - sin s) / s^3,  s = |w|;  in 2D J = 1
# (Sola, Deray, Atchuthan 2018, A micro Lie theory for state estimation in robotics, arXiv:1812.01537, eq. 145).
# a, b, a'/s, b'/s as power series in s^2: exact to round-off up to a full turn, and at s = 0 as well
_POWERS = range(24)
_A, _B = ([(-1.0) ** k / factorial(2 * k + extra) for k in _POWERS] for extra in (2, 3))
_A_SLOPE, _B_SLOPE = ([2 * (k + 1) * series[k + 1] for k in _POWERS[:-1]] for series in (_A, _B))


def left_jacobian(w: Values) -> Values:
    """(r, r) left Jacobian J(w) of a rotation vector or angle w (r,), rad."""
    if len(w) == 1:
        return np.ones((1, 1))
    W = _cross(w)
    result: Values = _IDENTITY + _series(_A, w) * W + _series(_B, w) * W @ W
    return result


def left_jacobian_derivative(w: Values, moment: Values) -> Values:
    """(r, r) symmetric part of the derivative of J(w)^T m by w, for a constant moment m (r,)."""
    if len(w) == 1:
        return np.zeros((1, 1))
    across, along = np.cross(w, moment), float(w @ moment)
    slope = -_series(_A_SLOPE, w) * across + _series(_B_SLOPE, w) * np.cross(w, across)
    derivative = _series(_B, w) * (along * _IDENTITY - np.outer(w, moment)) + np.outer(slope, w)
    return np.asarray(derivative + derivative.T) / 2


def _series(coefficients: list[float], w: Values) -> float:
    square, result = float(w @ w), 0.0
    for coefficient in reversed(coefficients):
        result = result * square + coefficient
    return result


def _cross(w: Values) -> Values:
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def solve_matrix(matrix: Values, values: Values) -> Values:
    """A^-1 b of a matrix (k, k) and values (k,) or (k, m)."""
    return np.asarray(np.linalg.solve(matrix, values), np.float64)


# --- points that a pose carries, and forces on them ---


def point_jacobian(arm: Values) -> Values:
    """(m, d, p) derivatives of points with arms (m, d), m, by an increment of the pose."""
    return -arm_jacobian(arm)


def resultant(force: Values, arm: Values) -> Values:
    """(p,) sums of forces (n, d) and of their moments arm x force."""
    moment = -np.einsum("ndr,nd->r", rotation_derivative(arm), force)
    return np.concatenate([force.sum(axis=0), moment])


def closing_distance(start: Pose, end: Pose, x: Values, force: Values, motion: Values) -> float:
    """Largest approach in a step of an obstacle and the points that it pushes, m.

    Args:
        start: pose of the obstacle.
        end: its pose at the end of the step.
        x: (n, d) points of the body then, m.
        force: (n, d) normal forces on these, N.
        motion: (n, d) of these without contact, m.
    """
    size = np.linalg.norm(force, axis=1)
    pushed = size > 0
    obstacle_motion = x[pushed] - start.points_to_space(end.to_body(x[pushed]))
    normal = force[pushed] / size[pushed, None]
    distance = np.einsum("ni,ni->n", obstacle_motion - motion[pushed], normal)
    return float(distance.max(initial=0.0))


def arm_jacobian(arm: Values) -> Values:
    """(n, d, p) J of arms (n, d), m."""
    d, by_rotation = arm.shape[1], rotation_derivative(arm)
    J = np.empty((len(arm), d, d + by_rotation.shape[2]))
    J[:, :, :d], J[:, :, d:] = -np.eye(d), by_rotation
    return J
