"""Many contacts at once: Coulomb's law in each, whatever the bodies weigh, and momentum."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

pytest.importorskip("mujoco", reason="an environment made without a network")

from fracsim.rigid.bodies import Bodies
from fracsim.rigid.contact_points import Contacts
from fracsim.rigid.engine import Engine
from fracsim.rigid.mujoco_model import ContactParameters
from fracsim.rigid.projected_gradient import ProjectedGradientSolver, project_on_cones
from support.falling import CUBE, DOWN, MASS, cubes

Values = npt.NDArray[np.float64]


def test_the_nearest_of_a_cone_is_where_what_is_left_is_at_right_angles() -> None:
    """Moreau: p = a + b with a in the cone |a_t| <= mu a_n, b in its polar cone, mu |b_t| <= -b_n, and a . b = 0."""
    p, mu = np.random.default_rng(0).normal(size=(3, 500)), np.linspace(0.0, 2.0, 500)
    near = project_on_cones(p.T, mu).T
    left = p - near
    assert np.all(np.hypot(near[1], near[2]) <= mu * near[0] + 1e-12)
    assert np.all(mu * np.hypot(left[1], left[2]) <= -left[0] + 1e-12)
    assert np.allclose((near * left).sum(axis=0), 0.0, atol=1e-12)
    assert np.count_nonzero(near[0] == 0) > 50 and np.count_nonzero((left == 0).all(axis=0)) > 50


def pile(friction: float) -> tuple[Contacts, Bodies]:
    """Blocks of 30 and 1000 kg in turn, three on three in four layers, that spin and slide, each on four corners of the
    one below or on what stands."""
    at = np.indices((3, 3, 4)).reshape(3, -1).T
    rng, mass = np.random.default_rng(3), np.where(at.sum(axis=1) % 2, 0.03, 1.0) * MASS
    bodies = cubes((at + np.array([0, 0, 0.5])).tolist())
    inertia = mass[:, None, None] * np.eye(3) / 6
    velocity, spin = rng.normal(size=(2, 36, 3))
    bodies = replace(bodies, mass=mass, inertia=inertia, velocity=velocity, spin=spin)
    second = np.repeat(np.arange(36), 4)
    first = np.where(at[second, 2] > 0, second - 1, 36)
    corners = np.array([[x, y, -0.5] for x in (-0.5, 0.5) for y in (-0.5, 0.5)])
    point = bodies.position[second] + np.tile(corners, (36, 1))
    axes = np.tile(np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), (len(point), 1, 1))
    things = np.stack([first, second], axis=1)
    places = np.concatenate([bodies.position, np.zeros((1, 3))])
    mu = np.full(len(point), friction)
    return Contacts.with_arms(things, things, point, axes, np.zeros(len(point)), mu, places), bodies


@pytest.mark.parametrize("friction", [0.0, 0.3, 0.8])
def test_every_contact_of_a_crowd_keeps_coulombs_law(friction: float) -> None:
    """Nothing comes nearer than it may, what parts gives nothing, what sticks stays within the cone and what slips
    gives mu times its pressure against the slip; bodies get what contacts give, by sums that share no code with it."""
    contacts, bodies = pile(friction)
    aim = np.random.default_rng(4).uniform(0.0, 0.3, len(contacts))
    still = np.zeros((1, 3))
    free = contacts.relative_velocities(np.concatenate([bodies.velocity, still]), np.concatenate([bodies.spin, still]))
    crowd = ProjectedGradientSolver.assemble(contacts, free, aim, bodies.mass, np.linalg.inv(bodies.inertia))
    p, error = crowd.solve(1e-7, 5000, np.zeros_like(free))
    assert error == 0.0
    velocity, spin = np.concatenate([bodies.velocity, still]), np.concatenate([bodies.spin, still])
    for (first, second), at, axes, each in zip(contacts.pairs, contacts.point, contacts.axes, p, strict=True):
        for body, sign in ((first, -1.0), (second, 1.0)):
            if body < 36:
                velocity[body] += sign * each @ axes / bodies.mass[body]
                arm = np.cross(at - bodies.position[body], sign * each @ axes)
                spin[body] += np.linalg.solve(bodies.inertia[body], arm)
    after = np.concatenate([bodies.velocity, bodies.spin], axis=1) + crowd.velocity_changes(p)
    assert np.allclose(after, np.concatenate([velocity, spin], axis=1)[:36], atol=1e-10)
    u = contacts.relative_velocities(velocity, spin)
    spare, slip, along = u[:, 0] + aim, np.linalg.norm(u[:, 1:], axis=1), np.linalg.norm(p[:, 1:], axis=1)
    pressed, sliding = p[:, 0] > 1e-3, slip > 1e-3
    assert spare.min() > -1e-5 and np.all(along <= friction * p[:, 0] * (1 + 1e-9))
    assert np.allclose(spare[pressed], 0.0, atol=1e-5) and 40 < np.count_nonzero(pressed) < len(contacts)
    both = pressed & sliding
    assert np.allclose(p[both, 1:], -friction * p[both, :1] * u[both, 1:] / slip[both, None], rtol=0.01, atol=1e-3)
    if friction == 0.3:
        assert np.count_nonzero(both) > 10 and np.count_nonzero(pressed & ~sliding) > 10


def test_a_heap_keeps_its_momentum_and_loses_energy() -> None:
    """A thousand contacts of blocks that fly together, without weight or a floor: as a crowd, m v and m x x v + I w."""
    grid = 1.01 * np.indices((7, 7, 7)).reshape(3, -1).T
    bodies = cubes(grid.tolist())
    inwards = -2.0 * (grid - grid.mean(axis=0))
    bodies = replace(bodies, velocity=inwards, spin=np.random.default_rng(1).normal(size=(343, 3)))
    engine = Engine(bodies, [[CUBE]] * 343, [], ContactParameters(5e-3, 0 * DOWN, 0.4))
    after, touches = engine.advance(bodies)
    size = MASS * np.abs(bodies.velocity).sum()
    assert len(touches) > 1000 and after.kinetic_energy < 0.9 * bodies.kinetic_energy
    assert np.allclose(after.momentum, bodies.momentum, atol=1e-9 * size)
    assert np.allclose(after.angular_momentum, bodies.angular_momentum, atol=1e-8 * size)


def test_no_step_of_a_crowd_is_too_long() -> None:
    """J M^-1 J^T <= D: by the eigenvalues of the dense matrix, its rows from moments of single forces; and D is not as
    many times too large as bodies have contacts."""
    contacts, bodies = pile(0.3)
    k = len(contacts)
    crowd = ProjectedGradientSolver.assemble(
        contacts, np.zeros((k, 3)), np.zeros(k), bodies.mass, np.linalg.inv(bodies.inertia)
    )
    across = np.zeros((3, k, 36, 6))
    for number, (things, at, axes) in enumerate(zip(contacts.pairs, contacts.point, contacts.axes, strict=True)):
        for body, sign in zip(things, (-1.0, 1.0), strict=True):
            if body < 36:
                turning = np.cross(at - bodies.position[body], axes)
                across[:, number, body] = sign * np.concatenate([axes, turning], axis=1)
    weight = np.concatenate([np.tile(1 / bodies.mass, (3, 1)), np.tile(1 / bodies.inertia[:, 0, 0], (3, 1))]).T
    scaled = (across * np.sqrt(weight)).reshape(3, k, -1) / np.sqrt(crowd.diagonal_bounds())[:, None]
    most = np.linalg.svd(scaled.reshape(3 * k, -1), compute_uv=False)[0] ** 2
    assert 0.4 < most <= 1 + 1e-12
    assert np.bincount(contacts.pairs.ravel())[:36].max() == 8
