"""Rigid poses, and the distance to a shape at a pose with its derivatives."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from fracsim.contact.pose import Pose, PosedShape, point_jacobian, rotation_derivative, rotation_second_derivative
from fracsim.contact.shapes import Shape
from support.laws import rotation
from support.shapes import ALL, Values, differences, points

EPS = np.finfo(float).eps
all_shapes = pytest.mark.parametrize("shape", ALL.values(), ids=ALL.keys())
both = pytest.mark.parametrize("dim", (2, 3))


def somewhere(dim: int, seed: int = 0) -> Pose:
    """A random pose."""
    return Pose(np.random.default_rng(seed).uniform(-1, 1, dim), rotation(dim, seed))


def generator(w: Values) -> Values:
    """The skew matrix W with W y = w x y, in 2D the angle times a quarter turn."""
    if len(w) == 1:
        return np.array([[0, -w[0]], [w[0], 0]])
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


@both
@given(seed=st.integers(0, 10**6))
def test_increments_are_exponentials(dim: int, seed: int) -> None:
    """c + t and exp(W) R against SciPy's matrix exponential; the rotation stays one."""
    pose = somewhere(dim, seed)
    q = np.random.default_rng(seed).uniform(-2, 2, 3 if dim == 2 else 6)
    moved = pose.incremented(q)
    np.testing.assert_allclose(moved.centre, pose.centre + q[:dim], atol=10 * EPS)
    np.testing.assert_allclose(moved.rotation, expm(generator(q[dim:])) @ pose.rotation, atol=200 * EPS)


@both
def test_many_turns_leave_a_rotation(dim: int) -> None:
    """A thousand increments: R^T R = I to round-off of one, and in 2D (or about one axis) angles add up."""
    pose, q = Pose.at_point(np.zeros(dim)), np.zeros(3 if dim == 2 else 6)
    q[-1] = 0.01
    for _ in range(1000):
        pose = pose.incremented(q)
    np.testing.assert_allclose(pose.rotation.T @ pose.rotation, np.eye(dim), atol=10 * EPS)
    np.testing.assert_allclose(pose.rotation[:2, :2], expm(generator(np.array([10.0]))), atol=1e-11)


@both
def test_to_the_body_and_back(dim: int) -> None:
    """Points, vectors and tensors: x = c + R X, v = R V, A = R B R^T."""
    pose, rng = somewhere(dim), np.random.default_rng(1)
    x, B = rng.normal(size=(20, dim)), rng.normal(size=(20, dim, dim))
    np.testing.assert_allclose(pose.points_to_space(pose.to_body(x)), x, atol=20 * EPS)
    np.testing.assert_allclose(pose.vectors_to_space(pose.to_body(x)), x - pose.centre, atol=20 * EPS)
    A = pose.tensors_to_space(B)
    np.testing.assert_allclose(A[3], pose.rotation @ B[3] @ pose.rotation.T, atol=20 * EPS)


@both
def test_fixed_points_turn_the_other_way(dim: int) -> None:
    """G(y) w = -w x y."""
    y, w = np.random.default_rng(2).normal(size=(5, dim)), np.array([0.3, -0.5, 0.7][: 1 if dim == 2 else 3])
    np.testing.assert_allclose(rotation_derivative(y) @ w, -y @ generator(w).T, atol=10 * EPS)


def gradient_by_pose(placed: PosedShape, x: Values) -> Values:
    """(n, p) derivatives of the distances of fixed points: minus the motion of the obstacle's points along n."""
    return -np.einsum("nd,ndp->np", placed.normal(x), point_jacobian(x - placed.pose.centre))


def smooth(shape: Shape, x: Values) -> Values:
    """Points without a kink of the distance, or a jump of its Hessian, within 1e-3 of them."""
    bent = differences(shape.normal, x, 1e-3)
    return np.asarray(x[np.abs(bent - shape.curvature(x)).max(axis=(1, 2)) < 1e-2])


@all_shapes
def test_derivatives_by_the_pose(shape: Shape) -> None:
    """First and second derivatives of D(exp(-w) (x - c - t)) by central differences of increments of the pose."""
    pose = somewhere(shape.dim, 5)
    x = pose.points_to_space(smooth(shape, points(shape, 60, seed=4)))
    placed, p = PosedShape(shape, pose), 3 if shape.dim == 2 else 6
    assert len(x) > 20

    def after(q: Values) -> PosedShape:
        return PosedShape(shape, pose.incremented(q))

    h, steps = 1e-6, np.eye(p)
    by_pose = np.stack([(after(h * e).distance(x) - after(-h * e).distance(x)) / (2 * h) for e in steps], axis=-1)
    np.testing.assert_allclose(gradient_by_pose(placed, x), by_pose, atol=1e-8)
    np.testing.assert_allclose(placed.normal(x), differences(placed.distance, x), atol=1e-8)
    np.testing.assert_allclose(placed.curvature(x), differences(placed.normal, x), atol=1e-6)


@both
def test_the_second_derivative_of_a_turn(dim: int) -> None:
    """Of n . exp(-w) y by w, by central differences: round-off 1e-16 / h^2, truncation h^2."""
    n, y = np.random.default_rng(6).normal(size=(2, 20, dim))
    H, h, p = rotation_second_derivative(n, y), 1e-4, 1 if dim == 2 else 3
    np.testing.assert_allclose(H, H.transpose(0, 2, 1), atol=1e-13)

    def turned(w: Values) -> Values:
        return np.asarray(np.einsum("ni,ij,nj->n", n, expm(-generator(w)), y))

    for i, j in np.ndindex(p, p):
        a, b = h * np.eye(p)[[i, j]]
        second = (turned(a + b) - turned(a - b) - turned(b - a) + turned(-a - b)) / (4 * h**2)
        np.testing.assert_allclose(H[:, i, j], second, atol=1e-6 * np.abs(H).max())


def test_the_sign_of_the_moment() -> None:
    """By hand: a box turned by dw about z under a point beside its middle: the side at x > 0 rises, gaps shrink.

    dd/dw = -((x - c) x n)_z = -(0.3 * 1) with x - c = (0.3, 1) and n = (0, 1).
    """
    placed = PosedShape(ALL["rectangle"], Pose.at_point(np.array([5.0, 2.0])))
    np.testing.assert_allclose(gradient_by_pose(placed, np.array([[5.3, 3.0]])), [[0, -1, -0.3]], atol=10 * EPS)
