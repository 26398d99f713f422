"""The step of a free obstacle: potential, gradient and Hessian against differences, and turns against matrices."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.linalg import expm

from fracsim.contact.laws import Barrier, CoulombFriction
from fracsim.contact.node_contact import PoseCoupling, PoseDerivatives, evaluate_points, lag_contact
from fracsim.contact.obstacle import FreeObstacle
from fracsim.contact.pose import PosedShape, left_jacobian, left_jacobian_derivative
from fracsim.contact.rigid_body import RigidStep, RigidSystem, SystemDerivatives
from fracsim.contact.shapes import Sphere, TranslatedShape
from fracsim.forms.schemes import BackwardEuler, GeneralizedAlpha, Newmark, Scheme
from fracsim.mechanics.contact_time_weights import ContactTimeWeights

Values = npt.NDArray[np.float64]
SCHEMES: list[Scheme] = [BackwardEuler(), Newmark(), GeneralizedAlpha()]
both = pytest.mark.parametrize("dim", (2, 3))


def generator(w: Values) -> Values:
    """W with W y = w x y."""
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


@pytest.mark.parametrize("size", (0.0, 1e-6, 0.3, 3.0))
def test_turns_and_what_changes_them(size: float) -> None:
    """exp(w + dw) = exp(J dw) exp(w) by central differences of SciPy's exponential; J^T m by those of J."""
    w, m, h = size * np.array([0.48, -0.6, 0.64]), np.array([2.0, -1.0, 3.0]), 1e-6
    slopes = []
    for e in np.eye(3):
        rate = (expm(generator(w + h * e)) - expm(generator(w - h * e))) / (2 * h) @ expm(generator(w)).T
        np.testing.assert_allclose(rate, generator(left_jacobian(w) @ e), atol=1e-9)
        slopes.append((left_jacobian(w + h * e) - left_jacobian(w - h * e)).T @ m / (2 * h))
    slope = np.column_stack(slopes)
    np.testing.assert_allclose(left_jacobian_derivative(w, m), (slope + slope.T) / 2, atol=1e-9)


def thing(dim: int, *, hinged: bool) -> FreeObstacle:
    """A disk or sphere, on a hinge beside it or not."""
    ball, turns = Sphere(0.3, dim=dim), 1 if dim == 2 else 3
    arm = np.array([0.5, -0.2, 0.1])[:dim] if hinged else np.zeros(dim)
    shape = TranslatedShape(ball, arm)
    axis = np.concatenate([np.zeros(dim), [1.0] if dim == 2 else [0.6, 0.0, 0.8]])[:, None]
    ways = axis if hinged else np.eye(dim + turns)
    return FreeObstacle(
        "it", shape, np.zeros(dim), friction=0.4, mass=2.0, inertia=shape.inertia(2.0 / shape.volume),
        motion_basis=ways,
        mass_centre=arm, gravity=np.array([1.0, -9.0, 2.0])[:dim], start_rate=np.linspace(0.5, 1.5, ways.shape[1]),
    )  # fmt: skip


@both
@pytest.mark.parametrize("hinged", (False, True))
@pytest.mark.parametrize("scheme", SCHEMES, ids=lambda each: type(each).__name__)
def test_gradient_and_hessian_of_the_incremental_potential(scheme: Scheme, hinged: bool, dim: int) -> None:
    """Points around the obstacle, pressed and rubbed, and a turn of half a radian: Phi by differences, then its
    gradient."""
    body, barrier, dt, rng = thing(dim, hinged=hinged), Barrier(50.0, 0.1), 0.1, np.random.default_rng(1)
    way = rng.normal(size=(40, dim))
    radius = 0.3 + rng.uniform(0.03, 0.2, 40)
    x = body.mass_centre + way / np.linalg.norm(way, axis=1)[:, None] * radius[:, None]
    area, start = np.full(40, 0.02), body.start_motion()
    at_start = PosedShape(body.shape, start.pose)
    held = lag_contact(x, at_start.distance(x), area, at_start, barrier)
    assert len(held.points) > 5
    c_a, _ = scheme.rate_coefficients(dt)
    step = RigidStep(body, start, scheme, dt, c_a, 1 - scheme.alpha_f, ContactTimeWeights.for_scheme(scheme).factor)

    z = np.array([0.02]) if hinged else np.array([0.02, -0.01, 0.015, 0.3, -0.25, 0.3])[: len(body.motion_basis)]
    fixed = x if hinged else step.pose(0.8 * z).points_to_space(x)  # they have moved along: gaps are open

    def contact(z: Values, *, exact: bool = True) -> PoseDerivatives:
        placed = PosedShape(body.shape, step.pose(z))
        under = placed.pose.points_to_space(start.pose.to_body(held.position)) - held.position
        point = evaluate_points(fixed, area, placed, barrier, held, CoulombFriction(0.4, 0.02), under)
        return PoseCoupling(point, fixed, placed.pose, held, start.pose, exact=exact).derivatives()

    def phi(z: Values) -> float:
        return step.free_potential(z) + step.factor * step.share**2 * contact(z).energy

    assert np.isfinite(phi(z)) and contact(z).energy > 1e-3
    gradient, hessian = step.system(z, contact(z), exact=True)
    _, stiffness = step.system(z, contact(z, exact=False), exact=False)
    h, steps = 1e-6, np.eye(len(z))
    slope = np.array([(phi(z + h * e) - phi(z - h * e)) / (2 * h) for e in steps])
    np.testing.assert_allclose(step.share * gradient, slope, rtol=1e-6, atol=1e-6 * np.abs(slope).max())
    bent = [
        step.system(z + h * e, contact(z + h * e), exact=True)[0]
        - step.system(z - h * e, contact(z - h * e), exact=True)[0]
        for e in steps
    ]
    bent = np.column_stack(bent) / (2 * h * step.share)
    np.testing.assert_allclose(hessian, bent, atol=1e-6 * np.abs(bent).max())
    assert np.linalg.eigvalsh(stiffness).min() > 0


@pytest.mark.parametrize("scheme", SCHEMES, ids=lambda each: type(each).__name__)
def test_a_body_that_tumbles_keeps_its_angular_momentum(scheme: Scheme) -> None:
    """Three unlike moments of inertia, no moment from outside: L stays to round-off through 200 steps of 0.2 rad, and
    the energy, which is that of L and the pose alone, within 2 % of itself."""
    body = thing(3, hinged=False)
    body = replace(
        body, inertia=np.diag([1.0, 2.0, 2.8]), gravity=np.zeros(3), start_rate=np.array([0, 0, 0, 0.5, 9.0, 2.0])
    )
    flight, dt = body.start_motion(), 0.02
    first, energies = flight, []
    for _ in range(200):
        step = RigidStep(body, flight, scheme, dt, scheme.rate_coefficients(dt)[0], 1 - scheme.alpha_f, 1.0)
        none = PoseDerivatives(0.0, np.zeros(6), np.zeros((6, 6)))
        contact = SystemDerivatives([none])
        (z,) = RigidSystem([step]).minimise([np.zeros(6)], lambda *_, contact=contact: contact, lambda *_: 1.0)
        flight = step.end_motion(z, np.zeros(6))
        energies.append(body.history_values(flight)[-1])
    np.testing.assert_allclose(flight.momentum, first.momentum, atol=1e-10)
    assert np.ptp(energies) < 0.02 * energies[0]
    assert np.abs(flight.pose.rotation - np.eye(3)).max() > 0.5
