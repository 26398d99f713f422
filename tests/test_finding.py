"""What some bodies meet is found as among all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("mujoco", reason="an environment made without a network")

from fracsim.contact.shapes import Sphere
from fracsim.rigid.collision_detection import CollisionDetector, MotionBounds
from fracsim.rigid.contact_points import Contacts
from fracsim.rigid.mujoco_model import ContactParameters, PrescribedObstacle, build_model
from fracsim.rigid.obstacles import obstacle_primitive
from support.falling import CUBE, DOWN, cubes, floor

Values = npt.NDArray[np.float64]


def told(contacts: Contacts) -> Values:
    """(k, 12) things, places, normals, gaps and friction, in an order of their own."""
    rows = np.column_stack([contacts.pairs, contacts.geoms, contacts.point, contacts.axes[:, 0], contacts.gap,
                            contacts.friction])  # fmt: skip
    return np.asarray(rows[np.lexsort(rows.T[::-1])])


def test_some_bodies_meet_what_they_meet_among_all() -> None:
    """Sixty-four blocks askew over a floor and a driven ball: contacts of a third of them, and none of the others."""
    rng = np.random.default_rng(5)
    bodies = cubes((1.1 * np.indices((4, 4, 4)).reshape(3, -1).T + 0.6).tolist())
    bodies = replace(bodies, rotation=Rotation.random(64, rng=rng).as_matrix(), velocity=rng.normal(size=(64, 3)))
    ball = PrescribedObstacle(obstacle_primitive(Sphere(1.0, 3), "ball"), np.array([1.0, 1.0, -0.2]), 0.3, driven=True)
    model = build_model(bodies, [[CUBE]] * 64, [floor(0.5), ball], ContactParameters(5e-3, DOWN, 0.4))
    find, looked = CollisionDetector(model), model.planes.begin_step()
    rates: Values = np.tile([200.0, 0.0, 0.0], (2, 1))  # 1 m a step
    course = MotionBounds(rates, np.zeros(3), [*rng.uniform(0.01, 0.3, (2, 64))])
    ways: Values = np.array([[0.0, 0, 0], [1.0, 1.0, -0.2]])
    some = np.append([True], rng.uniform(size=63) < 0.3)
    every, chosen = (find(bodies, ways, course, 5e-3, looked, only) for only in (None, some))
    met = np.append(some, [False, False])[every.pairs].any(axis=1)
    assert {64, 65} <= set(every.pairs[met].ravel()) and 50 < np.count_nonzero(met) < len(every) - 50
    assert np.array_equal(told(chosen), told(every.select(np.flatnonzero(met))))
    again = find(bodies, ways, course, 5e-3, looked)
    assert np.array_equal(told(again), told(every)), "and all are looked for afterwards"


def test_things_come_together_as_fast_as_their_points_do() -> None:
    """Speeds along the axes of random contacts: points of turning bodies a moment before and after, by rotations."""
    rng = np.random.default_rng(2)
    places, velocity, spin = rng.normal(size=(3, 7, 3))
    things = np.array([[a, b] for a in range(7) for b in range(7) if a != b])
    point, k = rng.normal(size=(len(things), 3)), len(things)
    axes = Rotation.random(k, rng=rng).as_matrix()
    contacts = Contacts.with_arms(things, things, point, axes, np.zeros(k), np.zeros(k), places)
    gone: Values = np.zeros((2, k, 3))  # where the point is, of the first and of the second thing
    for dt in (-1e-5, 1e-5):
        turn = Rotation.from_rotvec(dt * spin).as_matrix()
        at = [
            (turn[of] @ (point - places[of])[:, :, None])[:, :, 0] + places[of] + dt * velocity[of] for of in things.T
        ]
        gone += np.array(at) / (2 * dt)
    apart = np.einsum("kij,kj->ki", axes, gone[1] - gone[0])
    assert np.allclose(contacts.relative_velocities(velocity, spin), apart, atol=1e-8)
    assert np.allclose(contacts.approach_speeds(velocity, spin), -apart[:, 0], atol=1e-8)
    assert np.array_equal(contacts.both_flagged(np.arange(7) < 4), (things < 4).all(axis=1))
