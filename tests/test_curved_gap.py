"""The gap over a step in which points slide around an obstacle: by hand, by differences, in the books of a press."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from fracsim.contact.laws import Barrier
from fracsim.contact.node_contact import ContactForces, LaggedContact, StepStart, evaluate_points
from fracsim.contact.pose import Pose, PosedShape
from fracsim.contact.shapes import RoundedBox, Shape, Sphere
from support.scenes import each_step, make_scene

Values = npt.NDArray[np.float64]


def test_around_a_ball_by_hand() -> None:
    """A point that goes from angle 0 to a at the same gap g around a ball, R from its centre: e = R (1 - cos a); the
    force is p along the mean of both normals while e is small, which does nothing along the chord."""
    R, a, g = 0.4, 1e-3, 0.1
    x0, x1 = R * np.array([[1.0, 0.0]]), R * np.array([[np.cos(a), np.sin(a)]])
    start = StepStart(np.array([g]), LaggedContact(np.array([0]), np.ones(1), x0 / R, x0, x0))
    bent = start.curved_gap(np.array([0]), np.array([g]), x1 / R, x1)
    e = R * (1 - np.cos(a))
    assert bent.value == pytest.approx(g * (g + e / 2) / (g + e))
    assert bent.value == pytest.approx(g - e / 2, rel=1e-9)
    assert abs(bent.gradient[0] @ (x1 - x0)[0]) < 1e-4 * abs((x1 / R)[0] @ (x1 - x0)[0])


@pytest.mark.parametrize("shape", [Sphere(0.3), Sphere(0.5, hollow=True), RoundedBox((0.5, 0.5, 0.5), rounding=0.1)])
def test_forces_and_stiffness_are_derivatives(shape: Shape) -> None:
    """Of the potential, by differences, for points that have gone some way, a few from beyond the barrier."""
    barrier, placed, rng = Barrier(50.0, 0.2), PosedShape(shape, Pose.at_point(np.zeros(3))), np.random.default_rng(0)
    x0, x = (rng.uniform(-0.45, 0.45, (400, 3)) for _ in range(2))
    x = x0 + 0.1 * x
    apart = (placed.distance(x0) > 0.03) & (placed.distance(x) > 0.02)
    x0, x, gap = x0[apart], x[apart], placed.distance(x0[apart])
    known = np.flatnonzero(gap < 0.2)
    acting = LaggedContact(known, np.ones(len(known)), placed.normal(x0[known]), x0[known], x0[known])
    start, area = StepStart(gap, acting), np.full(len(x), 0.02)
    assert len(known) > 5

    def felt(x: Values) -> ContactForces:
        return evaluate_points(x, area, placed, barrier, None, None, np.zeros(3), start)

    found, h = felt(x), 1e-6
    slopes, bends = [], []
    for step in h * np.eye(3):
        up, down = felt(x + step), felt(x - step)
        assert len(up.points) == len(down.points) == len(found.points)
        slopes.append((up.potential - down.potential) / (2 * h))
        bends.append(-(up.normal - down.normal) / (2 * h))
    np.testing.assert_allclose(-found.normal.sum(axis=0), slopes, atol=1e-6 * np.abs(found.normal).sum())
    np.testing.assert_allclose(
        found.normal_hessian, np.stack(bends, axis=2), atol=1e-5 * np.abs(found.normal_hessian).max()
    )


@pytest.mark.parametrize("scheme", ("newmark", "generalized-alpha"))
def test_a_round_press_gains_nothing(scheme: str) -> None:
    """A ball as wide as two edges is driven into a block whose points slide around it: what the block has is the work
    of the ball, and no more."""
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 1.0], "h": 0.25}, boundary=[{"on": "bottom", "fix": "xy"}],
        material={"energy": "linear", "young": 1e5, "poisson": 0.3, "density": 100.0},
        obstacle=[{"name": "it", "shape": "sphere", "radius": 0.25, "at": [0.5, 1.27], "velocity": [0.0, -0.5]}],
        time={"scheme": scheme, "step": 0.01, "end": 0.18},
    )  # fmt: skip
    for report in each_step(scene, state):
        assert report.kinetic + report.elastic + state.dissipated < state.work + 2e-3 * 200
    assert state.work > 40
