"""Things that are struck more than once in a step, and those that touch what is struck: against closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

pytest.importorskip("mujoco", reason="an environment made without a network")

from fracsim.contact.shapes import Sphere
from fracsim.rigid.bodies import Bodies
from fracsim.rigid.contact_solver import SETTINGS
from fracsim.rigid.engine import Engine
from fracsim.rigid.impact_sequence import FamilyFunction
from fracsim.rigid.mujoco_model import ContactParameters
from fracsim.rigid.obstacles import obstacle_primitive
from support.falling import CUBE, DOWN, MASS, cubes, floor

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
FREE = 0 * DOWN
BALL = obstacle_primitive(Sphere(0.5, 3), "ball")


def breaks(each: Ints) -> Ints:
    """All may break, and are of bodies of their own."""
    return each


KINS: list[FamilyFunction] = [lambda each: 0 * each, lambda each: 0 * each - 1, lambda each: -2 - each]


def one_step(
    bodies: Bodies, parts: list[list[object]], rules: ContactParameters, *, kin: FamilyFunction | None = breaks
) -> Bodies:
    """Over the floor."""
    return Engine(bodies, parts, [floor()], rules).advance(bodies, None, kin)[0]  # type: ignore[arg-type]


@pytest.mark.parametrize("step", [0.4, 0.3, 0.22])
def test_a_row_of_balls_hands_on_what_the_first_one_has(step: float) -> None:
    """Equal balls with gaps of 1 m, e = 1, all within a step: at 10 m/s the first stops after 1 m, the second too, and
    the last goes on from 0.2 s; contacts give way by a share 1 - impedance of what they take."""
    gives = 2 * (1 - SETTINGS.impedance) * 10.0
    bodies = cubes([[0.0, 0, 9.0], [2.0, 0, 9.0], [4.0, 0, 9.0]])
    velocity: Values = np.array([[10.0, 0, 0], [0, 0, 0], [0, 0, 0]])
    after = one_step(replace(bodies, velocity=velocity), [[BALL]] * 3, ContactParameters(step, FREE, 0.0, 1.0))
    assert after.velocity[:, 0] == pytest.approx([0.0, 0.0, 10.0], abs=gives)
    assert after.position[:, 0] == pytest.approx([1.0, 3.0, 4.0 + 10 * (step - 0.2)], abs=step * gives)


def assert_taken_along(thick: float, below: float, kin: FamilyFunction | None) -> None:
    """A ball that flies at a plate in the air over a floor, both nearer than it comes in the step, takes the plate
    along, and what ends on the floor is the plate, with the ball on it. Contacts give way by a share 1 - impedance of
    what they take, in the speed of the lighter one."""
    step, over = 0.1, 0.3
    gives = 2 * (1 - SETTINGS.impedance) * 20.0 * (1 + 10)
    bodies = cubes([[0.0, 0, below + thick / 2], [0.0, 0, below + thick + over + 0.5]])
    bodies = replace(bodies, velocity=np.array([[0.0, 0, 0], [0, 0, -20.0]]), mass=np.array([MASS / 10, MASS]))
    plate = CUBE * np.array([1.0, 1.0, thick])
    after = one_step(bodies, [[plate], [BALL]], ContactParameters(step, FREE, 0.0), kin=kin)
    assert after.position[:, 2] == pytest.approx([thick / 2, thick + 0.5], abs=step * gives)
    assert np.abs(after.velocity).max() < gives


@pytest.mark.parametrize("thick", [0.01, 0.1])
@pytest.mark.parametrize("below", [0.02, 0.5])
def test_a_ball_does_not_stop_over_a_plate_that_gives_way(thick: float, below: float, solver: None) -> None:
    """Where it may break."""
    assert_taken_along(thick, below, breaks)


@pytest.mark.parametrize("kin", [None, *KINS])
@pytest.mark.parametrize("below", [0.02, 0.5])
def test_nor_over_one_that_does_not_where_contacts_are_few(below: float, kin: FamilyFunction | None) -> None:
    """What does not break, pieces of one body, and what breaks no more."""
    assert_taken_along(0.1, below, kin)


def test_events_of_a_step_keep_momentum_and_gain_no_energy(solver: None) -> None:
    """Blocks, turned and spinning, that fly into a heap within a few steps of which each is many of their sizes."""
    rng = np.random.default_rng(1)
    bodies = cubes([[1.4 * x, 1.4 * y, 1.4 * z] for x in range(3) for y in range(3) for z in range(3)])
    turn = np.linalg.qr(rng.normal(size=(27, 3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))[:, None, None]
    velocity = -10 * (bodies.position - bodies.position.mean(axis=0)) + rng.normal(size=(27, 3))
    bodies = replace(bodies, rotation=turn, velocity=velocity, spin=rng.normal(size=(27, 3)))
    engine, first, before = (
        Engine(bodies, [[CUBE]] * 27, [], ContactParameters(0.02, FREE, 0.4)),
        bodies,
        bodies.kinetic_energy,
    )
    size = MASS * float(np.linalg.norm(velocity, axis=1).sum())
    for _ in range(15):
        bodies, _ = engine.advance(bodies, None, lambda each: each)
        assert bodies.kinetic_energy < before * (1 + 1e-9)
        before = bodies.kinetic_energy
        assert np.allclose(bodies.momentum, first.momentum, atol=1e-9 * size)
        assert np.allclose(bodies.angular_momentum, first.angular_momentum, atol=1e-9 * size)
    assert before < 0.5 * first.kinetic_energy


@pytest.mark.parametrize("kin", KINS)
def test_other_steps_of_a_crowd_are_not_taken_apart(kin: FamilyFunction, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two blocks, one of which flies into the other over a floor behind, as if they were many: these come to the
    digits that they come to where nothing is known of what breaks."""
    monkeypatch.setattr("fracsim.rigid.contact_solver.SETTINGS", replace(SETTINGS, max_newton_contacts=0))
    bodies = cubes([[0.0, 0, 0.6], [0.3, 0, 1.8]])
    bodies = replace(bodies, velocity=np.array([[0.0, 0, 0], [0, 0, -20.0]]))
    rules = ContactParameters(0.1, FREE)
    ends = [one_step(bodies, [[CUBE]] * 2, rules, kin=of) for of in (None, kin)]
    apart = one_step(bodies, [[CUBE]] * 2, rules)
    for one, other in zip(*(vars(each).values() for each in ends), strict=True):
        assert np.array_equal(one, other)
    assert not np.array_equal(apart.velocity, ends[0].velocity)
