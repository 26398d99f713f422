"""The rigid-body engine against mechanics: weight, friction, bounces, tumbling, what stands and what is driven."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.integrate import solve_ivp

pytest.importorskip("mujoco", reason="an environment made without a network")

from fracsim.mechanics.contact.shapes import Box, Capsule, Cylinder, Plane, Sphere
from fracsim.rigid.bodies import Bodies
from fracsim.rigid.engine import Engine, Rules, Stand
from fracsim.rigid.primitives import primitive
from fracsim.rigid.touches import Touches
from fracsim.rigid.tumbling import tumbled
from support.falling import CUBE, DOWN, MASS, G, cubes, floor

Values = npt.NDArray[np.float64]
FREE = 0 * DOWN


def run(engine: Engine, bodies: Bodies, steps: int) -> tuple[Bodies, list[Touches]]:
    """Some steps on, and what touched in each."""
    touches = []
    for _ in range(steps):
        bodies, found = engine.advance(bodies)
        touches.append(found)
    return bodies, touches


def received(touches: list[Touches], thing: int) -> Values:
    """(3,) N s that a thing has received."""
    return np.asarray(sum(each.on(thing)[1].sum(axis=0) for each in touches))


@pytest.mark.parametrize("step", [2e-3, 5e-4])
def test_a_stone_at_rest_receives_its_weight(step: float) -> None:
    """m g t of the floor, to the tolerance of the solver, at any step; and it does not go anywhere."""
    bodies = cubes([[0.0, 0.0, 0.5]])
    bodies, touches = run(Engine(bodies, [[CUBE]], [floor()], Rules(step, DOWN)), bodies, 350)
    settled = received(touches[250:], 0)
    assert np.allclose(settled, [0.0, 0.0, MASS * G * 100 * step], rtol=1e-6, atol=1e-6)
    assert np.allclose(bodies.place, [[0.0, 0.0, 0.5]], atol=1e-3)


def test_blocks_stand_on_one_another() -> None:
    """Three, for a second."""
    bodies = cubes([[0.0, 0.0, 0.5 + k] for k in range(3)])
    after, touches = run(Engine(bodies, [[CUBE]] * 3, [floor()], Rules(5e-3, DOWN, 0.5)), bodies, 200)
    assert np.allclose(after.place, bodies.place, atol=2e-3)
    assert -received(touches, 3)[2] == pytest.approx(3 * MASS * G * 1.0, rel=1e-3)


@pytest.mark.slow
def test_ten_blocks_stand_for_ten_seconds() -> None:
    """Issue 13."""
    bodies = cubes([[0.0, 0.0, 0.5 + k] for k in range(10)])
    after, _ = run(Engine(bodies, [[CUBE]] * 10, [floor()], Rules(5e-3, DOWN, 0.5)), bodies, 2000)
    assert np.allclose(after.place, bodies.place, atol=5e-3)


@pytest.mark.parametrize("friction", [0.2, 0.5])
def test_a_block_slides_as_coulomb_says(friction: float) -> None:
    """From v to rest in v^2 / (2 mu g), and there it stays."""
    bodies = cubes([[0.0, 0.0, 0.5]], [1.0, 0.0, 0.0])
    after, _ = run(Engine(bodies, [[CUBE]], [floor(friction)], Rules(2e-3, DOWN)), bodies, 300)
    assert after.place[0, 0] == pytest.approx(1.0 / (2 * friction * G), rel=0.01)
    assert np.abs(after.velocity).max() < 1e-3


@pytest.mark.parametrize("restitution", [0.0, 0.5, 0.8])
def test_a_ball_bounces_with_its_restitution(restitution: float) -> None:
    """Without gravity; at two steps, wherever in a step it meets the floor."""
    for step, above in ((2e-3, 0.01), (5e-4, 0.01), (1e-3, 0.0104), (1e-3, 0.0108)):
        bodies = cubes([[0.0, 0.0, 0.5 + above]], [0.0, 0.0, -2.0])
        ball = primitive(Sphere(0.5, 3), "ball")
        after, _ = run(Engine(bodies, [[ball]], [floor()], Rules(step, FREE, 0.0, restitution)), bodies, 100)
        assert after.velocity[0, 2] / 2.0 == pytest.approx(restitution, abs=0.065 if restitution else 0.055)


def test_bodies_that_collide_keep_their_momentum() -> None:
    """Two cubes askew, with friction and no gravity: m v and m x x v + I w to round-off of the solver."""
    bodies = cubes([[0.0, 0.0, 0.0], [1.2, 0.3, 0.2]])
    bodies = replace(bodies, velocity=np.array([[4.0, 0, 0], [0, 0, 0]]), spin=np.array([[0.0, 1, 2], [0, 0, -3]]))
    after, touches = run(Engine(bodies, [[CUBE]] * 2, [], Rules(1e-3, FREE, 0.5)), bodies, 200)
    assert sum(len(each) for each in touches) > 0 and np.abs(after.spin - bodies.spin).max() > 0.1
    assert np.allclose(after.momentum, bodies.momentum, atol=1e-9 * 4 * MASS)
    assert np.allclose(after.angular_momentum, bodies.angular_momentum, atol=1e-9 * 4 * MASS)
    assert after.kinetic < bodies.kinetic


TOP = np.diag([1.0, 2.0, 3.0])[None]  # kg m^2
NEARLY = np.array([[0.1, 2 * np.pi, 0.2]])  # rad/s: about the axis that it does not stay on


def tops(steps: int, turns: float) -> tuple[Values, Values, Values]:
    """Rotations (1, 3, 3), spins (1, 3) and energies (steps,) of an asymmetric top that nothing acts on."""
    turn, spin, energy = np.eye(3)[None], NEARLY, []
    for _ in range(steps):
        turn, spin = tumbled(turn, TOP, spin, np.zeros((1, 3)), turns / steps)
        energy.append(float(np.einsum("ni,nij,nj->", spin, turn @ TOP @ np.swapaxes(turn, 1, 2), spin)) / 2)
    return turn, spin, np.array(energy)


def kept(turns: int, a_turn: int) -> float:
    """Largest relative error of energy and angular momentum of the top."""
    turn, spin, energy = tops(turns * a_turn, turns)
    start = TOP[0] @ NEARLY[0]
    momentum = (turn @ TOP @ np.swapaxes(turn, 1, 2))[0] @ spin[0]
    assert np.allclose(momentum, start, atol=1e-12 * np.linalg.norm(start))
    return float(np.abs(energy / (NEARLY[0] @ start / 2) - 1).max())


def test_a_top_keeps_its_angular_momentum_to_round_off_and_its_energy() -> None:
    """Four turns with sixty steps each, through its tumbles."""
    assert kept(4, 60) < 1e-3


@pytest.mark.slow
def test_a_top_keeps_its_energy_over_a_hundred_turns() -> None:
    """Issue 13: 1e-3."""
    assert kept(100, 100) < 1e-3


def test_a_top_turns_as_euler_says() -> None:
    """I dw/dt = (I w) x w in the axes of the body, by an adaptive Runge-Kutta method: of second order in the step."""
    main = np.diag(TOP[0])
    exact = solve_ivp(lambda _, w: np.cross(main * w, w) / main, (0, 1.5), NEARLY[0], rtol=1e-11, atol=1e-12).y[:, -1]
    errors = []
    for steps in (75, 150):
        turn, spin, _ = tops(steps, 1.5)
        errors.append(float(np.abs(turn[0].T @ spin[0] - exact).max()))
    assert errors[1] < 0.05 and errors[0] / errors[1] == pytest.approx(4.0, rel=0.2)


def test_siblings_pass_until_they_have_been_apart() -> None:
    """Two cubes that overlap stay where they are, and are driven apart by nothing; once apart, they collide."""
    bodies = cubes([[0.0, 0.0, 0.0], [0.9, 0.0, 0.0]])
    engine = Engine(bodies, [[CUBE]] * 2, [], Rules(1e-3, FREE), {(0, 1)})
    after, _ = run(engine, bodies, 20)
    assert np.array_equal(after.place, bodies.place) and engine.siblings == {(0, 1)}
    apart = replace(after, place=np.array([[0.0, 0, 0], [1.1, 0, 0]]), velocity=np.array([[0.0, 0, 0], [-5.0, 0, 0]]))
    after, _ = run(engine, apart, 100)
    assert not engine.siblings
    assert after.velocity[0, 0] < -1.0 and after.place[1, 0] - after.place[0, 0] > 0.98
    known, _ = run(Engine(bodies, [[CUBE]] * 2, [], Rules(1e-3, FREE)), bodies, 20)
    assert np.abs(known.place - bodies.place).max() > 0.01, "others push each other apart"


def test_what_is_driven_carries_what_lies_on_it() -> None:
    """A floor that goes sideways at 1 m/s drags a block along by friction, and does the work that it takes."""
    bodies = cubes([[0.0, 0.0, 0.5]])
    stand = replace(floor(0.5), driven=True)
    engine = Engine(bodies, [[CUBE]], [stand], Rules(2e-3, DOWN))
    for step in range(400):
        bodies, touches = engine.advance(bodies, np.array([[2e-3 * (step + 1), 0.0, 0.0]]))
    assert np.allclose(bodies.velocity, [[1.0, 0.0, 0.0]], atol=1e-3)
    assert np.allclose(-touches.on(1)[1].sum(axis=0), touches.on(0)[1].sum(axis=0))


def test_overlap_is_told_with_its_depth() -> None:
    """A cube 0.1 m in the floor and 0.2 m in another."""
    bodies = cubes([[0.0, 0.0, 0.4], [0.8, 0.0, 0.4]])
    engine = Engine(bodies, [[CUBE]] * 2, [floor()], Rules(1e-3, DOWN))
    found = {(a, b): depth for a, b, depth in engine.depth(bodies)}
    assert found == {(0, 1): pytest.approx(0.2, abs=1e-6), (0, 2): pytest.approx(0.1), (1, 2): pytest.approx(0.1)}
    assert not engine.depth(cubes([[0.0, 0.0, 1.0], [3.0, 0.0, 1.0]]))


def test_a_ball_lands_on_every_shape_that_stands() -> None:
    """Held at its top: sphere, capsule, cylinder, box and plane, each where its outline says."""
    ball = primitive(Sphere(0.5, 3), "ball")
    slanted = (1.0, 2.0, 2.0)
    for shape in (Plane((0.0, 0.0, 1.0)), Sphere(0.7, 3), Capsule(0.3, 1.0, slanted), Cylinder(0.4, 1.2, axis=slanted),
                  Box((1.0, 2.0, 0.6))):  # fmt: skip
        top = 0.0 if isinstance(shape, Plane) else float(shape.outline()[0][:, 2].max())
        at = np.array([0.0, 0.0, -top])
        over = np.zeros(3) if isinstance(shape, Plane) else shape.outline()[0][shape.outline()[0][:, 2].argmax()]
        near, far = (cubes([[over[0], over[1], 0.5 + gap]]) for gap in (-0.01, 0.05))
        engine = Engine(near, [[ball]], [Stand(primitive(shape, "it"), at)], Rules(1e-3, DOWN))
        assert engine.depth(near) and not engine.depth(far), shape
