"""The rigid-body engine against mechanics: weight, friction, bounces, tumbling, what stands and what is driven."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("mujoco", reason="an environment made without a network")

from fracsim.contact.shapes import Capsule, HalfSpace, RoundedBox, RoundedCylinder, Sphere
from fracsim.rigid import contact_solver
from fracsim.rigid.bodies import Bodies
from fracsim.rigid.collision_detection import CollisionDetector, MotionBounds
from fracsim.rigid.contact_points import ContactImpulses
from fracsim.rigid.contact_solver import SETTINGS
from fracsim.rigid.engine import Engine
from fracsim.rigid.fragment_overlap import InitialOverlaps
from fracsim.rigid.mujoco_model import ContactParameters, Part, PrescribedObstacle, build_model
from fracsim.rigid.obstacles import obstacle_primitive
from support.falling import CUBE, DOWN, MASS, G, cubes, floor

Values = npt.NDArray[np.float64]
FREE = 0 * DOWN


def run(engine: Engine, bodies: Bodies, steps: int) -> tuple[Bodies, list[ContactImpulses]]:
    """Some steps on, and what touched in each."""
    touches = []
    for _ in range(steps):
        bodies, found = engine.advance(bodies)
        touches.append(found)
    return bodies, touches


def received(touches: list[ContactImpulses], thing: int) -> Values:
    """(3,) N s that a thing has received."""
    return np.asarray(sum(each.received_by(thing)[1].sum(axis=0) for each in touches))


@pytest.mark.parametrize(("step", "friction"), [(2e-3, 0.5), (5e-4, 0.5), (2e-3, 0.0)])
def test_a_stone_at_rest_receives_its_weight(step: float, friction: float) -> None:
    """m g t of the floor, to the tolerance of the solver, at any step, of one without friction, too; and it does not go
    anywhere."""
    bodies = cubes([[0.0, 0.0, 0.5]])
    bodies, touches = run(Engine(bodies, [[CUBE]], [floor(friction)], ContactParameters(step, DOWN)), bodies, 350)
    settled = received(touches[250:], 0)
    assert np.allclose(settled, [0.0, 0.0, MASS * G * 100 * step], rtol=1e-6, atol=1e-6)
    assert np.allclose(bodies.position, [[0.0, 0.0, 0.5]], atol=1e-3)


def test_blocks_stand_on_one_another(solver: None) -> None:
    """Three, for a second."""
    bodies = cubes([[0.0, 0.0, 0.5 + k] for k in range(3)])
    after, touches = run(Engine(bodies, [[CUBE]] * 3, [floor()], ContactParameters(5e-3, DOWN, 0.5)), bodies, 200)
    assert np.allclose(after.position, bodies.position, atol=2e-3)
    assert -received(touches, 3)[2] == pytest.approx(3 * MASS * G * 1.0, rel=1e-3)


@pytest.mark.slow
def test_ten_blocks_stand_for_ten_seconds(solver: None) -> None:
    """Issue 13."""
    bodies = cubes([[0.0, 0.0, 0.5 + k] for k in range(10)])
    after, _ = run(Engine(bodies, [[CUBE]] * 10, [floor()], ContactParameters(5e-3, DOWN, 0.5)), bodies, 2000)
    assert np.allclose(after.position, bodies.position, atol=5e-3)


@pytest.mark.parametrize("friction", [0.2, 0.5])
def test_a_block_slides_as_coulomb_says(friction: float, solver: None) -> None:
    """From v to rest in v^2 / (2 mu g), and there it stays."""
    bodies = cubes([[0.0, 0.0, 0.5]], [1.0, 0.0, 0.0])
    after, _ = run(Engine(bodies, [[CUBE]], [floor(friction)], ContactParameters(2e-3, DOWN)), bodies, 300)
    assert after.position[0, 0] == pytest.approx(1.0 / (2 * friction * G), rel=0.01)
    assert np.abs(after.velocity).max() < 1e-3


def test_what_slides_stays_on_its_floor(solver: None) -> None:
    """At 20 m/s, in steps of 10 ms and with mu = 0.5: a convex problem of friction alone has it hover mu v dt = 0.1 m
    over its floor, and throws it up there at mu v = 10 m/s."""
    bodies = replace(cubes([[0.0, 0.0, 0.51]]), velocity=np.array([[20.0, 0.0, -1.0]]))
    engine = Engine(bodies, [[CUBE]], [floor()], ContactParameters(1e-2, DOWN, 0.5))
    for _ in range(50):
        bodies, _ = engine.advance(bodies)
        assert -2e-3 < (CUBE @ bodies.rotation[0].T + bodies.position[0])[:, 2].min() < 0.015, (
            "c_0 dt below it, at most"
        )
    landed = np.sqrt(1.0 + 2 * G * 0.01)  # the blow rubs, too
    assert bodies.velocity[0, 0] == pytest.approx(20.0 - 0.5 * (landed + G * 0.49), abs=0.05)


def test_what_slides_does_not_sink_in(solver: None) -> None:
    """It slips the slower, by mu g dt a step; with room for the slip that it had, it goes down by mu^2 g dt^2 a step,
    and comes up by a fifth of what it is in: five times as deep in the end, 0.28 mm here. A fifth of that is allowed
    while it slides, and hardly any once it is at rest."""
    step, friction = 4e-3, 0.6
    bodies, allowed = cubes([[0.0, 0.0, 0.5]], [2.0, 0.0, 0.0]), friction**2 * G * step**2
    engine, low = Engine(bodies, [[CUBE]], [floor(friction)], ContactParameters(step, DOWN)), []
    for _ in range(150):
        bodies, _ = engine.advance(bodies)
        low.append(float((CUBE @ bodies.rotation[0].T + bodies.position[0])[:, 2].min()))
    assert np.abs(bodies.velocity).max() < 1e-6
    assert -1.1 * allowed < min(low[:80]) and -allowed / 5 < low[-1] < 1e-5


@pytest.mark.parametrize("restitution", [0.0, 0.5, 0.8])
def test_a_ball_bounces_with_its_restitution(restitution: float) -> None:
    """Without gravity; at two steps, wherever in a step it meets the floor; its lowest place is the floor."""
    for step, above in ((2e-3, 0.01), (5e-4, 0.01), (1e-3, 0.0104), (1e-3, 0.0108)):
        bodies = cubes([[0.0, 0.0, 0.5 + above]], [0.0, 0.0, -2.0])
        ball = obstacle_primitive(Sphere(0.5, 3), "ball")
        after, _ = run(
            Engine(bodies, [[ball]], [floor()], ContactParameters(step, FREE, 0.0, restitution)), bodies, 100
        )
        assert after.velocity[0, 2] / 2.0 == pytest.approx(restitution, abs=2e-4)
        assert after.position[0, 2] >= 0.5 - 1e-9


def test_soft_contacts_first_lead_to_the_same_hard_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sixty-four blocks that spin and fall in a heap: solved at once, and from softer contacts on, which is for crowds
    that Newton's method alone gets lost in; in one event. Slip is looked at until it changes by less than
    slip_tolerance c_0, which mu times is the most that the two may be apart by."""
    monkeypatch.setattr("fracsim.rigid.engine.would_hit_next", lambda *_: False)
    grid = 1.02 * np.indices((4, 4, 4)).reshape(3, -1).T + 0.53
    spin = 5.0 * np.random.default_rng(1).normal(size=(64, 3))
    falling = replace(cubes(grid.tolist()), velocity=np.tile(6.0 * DOWN / G, (64, 1)), spin=spin)
    found = []
    for at_once in (SETTINGS.direct_iterations, 1):
        monkeypatch.setattr(contact_solver, "SETTINGS", replace(SETTINGS, direct_iterations=at_once))
        engine = Engine(falling, [[CUBE]] * 64, [floor()], ContactParameters(5e-3, DOWN, 0.4))
        found.append(run(engine, falling, 1))
    (one, touches), (other, others) = found
    assert len(touches[0]) > 100 and not np.array_equal(one.velocity, other.velocity)
    apart = 0.4 * SETTINGS.slip_tolerance * ContactParameters(5e-3, DOWN).impact_threshold
    assert np.allclose(one.velocity, other.velocity, atol=apart) and np.allclose(one.spin, other.spin, atol=apart)
    assert np.allclose(received(touches, 64), received(others, 64), rtol=0, atol=apart * 64 * 1000)


def test_what_spins_onto_a_floor_does_not_sink_into_it() -> None:
    """A cube with eight corners cut off, 24 of them, that turns by 0.07 rad a step: none is ever in the floor
    by more than a fifth of what the turn is not straight for, (w dt)^2 r / 2 of its 0.8 m, 2 mm."""
    hull = np.concatenate([CUBE * cut for cut in ([0.7, 1, 1], [1, 0.7, 1], [1, 1, 0.7])])
    bodies = replace(cubes([[0.0, 0.0, 1.2]], [2.0, 0.0, -8.0]), spin=np.array([[30.0, 20.0, 10.0]]))
    engine, low = Engine(bodies, [[hull]], [floor()], ContactParameters(2e-3, DOWN, 0.5)), []
    for _ in range(300):
        bodies, _ = engine.advance(bodies)
        low.append(float((hull @ bodies.rotation[0].T)[:, 2].min() + bodies.position[0, 2]))
    assert -4e-4 < min(low) < 1e-3


def struck_at_its_edge(tilt: float, out: float, speed: float, mass: float) -> tuple[Bodies, list[list[Part]], Values]:
    """A disc, 1 m across and 1 kg, that stands on the floor aslant at rest, and a ball that comes down on it, `out` of
    its middle, where it is higher; its corners."""
    around = 2 * np.pi * np.arange(24) / 24
    rim = 0.5 * np.stack([np.cos(around), np.sin(around), 0 * around], axis=1)
    disc = np.concatenate([rim + np.array([0.0, 0.0, side]) for side in (-0.01, 0.01)])
    turn = np.stack([Rotation.from_rotvec([0.0, tilt, 0.0]).as_matrix(), np.eye(3)])
    high = float(-(disc @ turn[0].T)[:, 2].min())
    over = high + out * np.sin(tilt) + 0.111 / np.cos(tilt)
    bodies = replace(
        cubes([[0.0, 0.0, high], [-out * np.cos(tilt), 0.0, over]]), mass=np.array([1.0, mass]), rotation=turn,
        inertia=np.stack([np.diag([1 / 16, 1 / 16, 1 / 8]), 4e-3 * mass * np.eye(3)]),
        velocity=np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -speed]]),
    )  # fmt: skip
    return bodies, [[disc], [obstacle_primitive(Sphere(0.1, 3), "ball")]], disc


@pytest.mark.parametrize(("tilt", "out", "speed", "mass"), [(0.1, 0.3, 5, 50), (0.2, 0.4, 10, 50), (0.1, 0.4, 5, 50)])
def test_what_is_struck_comes_down_on_corners_that_nobody_thought_of(
    tilt: float, out: float, speed: float, mass: float, solver: None
) -> None:
    """It rests on a few corners, and turns onto others, a tenth of a metre over the floor, within the step: it was 19
    to 37 mm in the floor after it. Now by no more than c_0 dt."""
    rules = ContactParameters(0.02, DOWN, 0.4)
    bodies, parts, disc = struck_at_its_edge(tilt, out, speed, mass)
    engine = Engine(bodies, parts, [floor(0.4)], rules)
    for _ in range(3):
        bodies, _ = engine.advance(bodies)
        assert (disc @ bodies.rotation[0].T)[:, 2].min() + bodies.position[
            0, 2
        ] > -rules.impact_threshold * rules.time_step


@pytest.mark.parametrize("shape", [HalfSpace((0.0, 0.0, 1.0)), RoundedBox((4.0, 4.0, 2.0))])
@pytest.mark.parametrize("share", [0.3, 0.95])
def test_what_rests_does_not_sink_in_before_it_is_struck(
    shape: HalfSpace | RoundedBox, share: float, solver: None
) -> None:
    """A block on a floor without friction, met from the side by another as heavy after a share s of the step: it fell
    g (s dt)^2 / 2 = 0.11 mm until then. It goes on with half the speed, on the floor."""
    step, down = 5e-3, 1.0 if isinstance(shape, RoundedBox) else 0.0
    stand = PrescribedObstacle(obstacle_primitive(shape, "floor"), np.array([0.0, 0.0, -down]), 0.0)
    bodies = cubes([[0.0, 0.0, 0.5], [-1.0 - 10.0 * step * share, 0.0, 0.5]])
    bodies = replace(bodies, velocity=np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]]))
    after, _ = Engine(bodies, [[CUBE]] * 2, [stand], ContactParameters(step, DOWN)).advance(bodies)
    assert after.position[:, 2] == pytest.approx([0.5, 0.5], abs=1e-6)
    assert after.velocity[:, 0] == pytest.approx([5.0, 5.0], abs=1e-3)
    assert after.position[0, 0] == pytest.approx(5.0 * step * (1 - share), abs=1e-5)


def test_bodies_that_collide_keep_their_momentum(solver: None) -> None:
    """Two cubes askew, with friction and no gravity: m v and m x x v + I w to round-off of the solver."""
    bodies = cubes([[0.0, 0.0, 0.0], [1.2, 0.3, 0.2]])
    bodies = replace(bodies, velocity=np.array([[4.0, 0, 0], [0, 0, 0]]), spin=np.array([[0.0, 1, 2], [0, 0, -3]]))
    after, touches = run(Engine(bodies, [[CUBE]] * 2, [], ContactParameters(1e-3, FREE, 0.5)), bodies, 200)
    assert sum(len(each) for each in touches) > 0 and np.abs(after.spin - bodies.spin).max() > 0.1
    assert np.allclose(after.momentum, bodies.momentum, atol=1e-9 * 4 * MASS)
    assert np.allclose(after.angular_momentum, bodies.angular_momentum, atol=1e-9 * 4 * MASS)
    assert after.kinetic_energy < bodies.kinetic_energy


def test_siblings_stay_in_one_another_until_they_have_been_apart() -> None:
    """Two cubes that overlap stay where they are, and are driven apart by nothing; once apart, they collide."""
    bodies, family = (
        cubes([[0.0, 0.0, 0.0], [0.9, 0.0, 0.0]]),
        InitialOverlaps.between_new_fragments(np.array([[0, 1]])),
    )
    engine = Engine(bodies, [[CUBE]] * 2, [], ContactParameters(1e-3, FREE), family)
    after, _ = run(engine, bodies, 20)
    assert np.array_equal(after.position, bodies.position) and engine.initial_overlaps.depth == pytest.approx(0.1)
    apart = replace(
        after, position=np.array([[0.0, 0, 0], [1.1, 0, 0]]), velocity=np.array([[0.0, 0, 0], [-5.0, 0, 0]])
    )
    after, _ = run(engine, apart, 100)
    assert not len(engine.initial_overlaps.depth)
    assert after.velocity[0, 0] < -1.0 and after.position[1, 0] - after.position[0, 0] > 0.98
    known, _ = run(Engine(bodies, [[CUBE]] * 2, [], ContactParameters(1e-3, FREE)), bodies, 20)
    assert known.position[1, 0] - known.position[0, 0] > 0.9 + 1e-6, "others push each other apart"


def test_siblings_carry_one_another_as_deep_as_they_were() -> None:
    """A cube that lies a tenth in another one from birth rests on it, and is not pushed out; two of them that fly
    towards each other stop."""
    bodies = cubes([[0.0, 0.0, 0.5], [0.1, 0.0, 1.4]])
    family = InitialOverlaps.between_new_fragments(np.array([[0, 1]]))
    after, touches = run(
        Engine(bodies, [[CUBE]] * 2, [floor()], ContactParameters(2e-3, DOWN, 0.5), family), bodies, 300
    )
    assert np.allclose(after.position, bodies.position, atol=1e-4)
    assert received(touches[-100:], 1)[2] == pytest.approx(MASS * G * 0.2, rel=1e-3)
    bodies = cubes([[0.0, 0.0, 0.5], [0.0, 0.0, 1.4]])
    moving = replace(bodies, velocity=np.array([[0.0, 0, 0], [0.0, 0, -3.0]]))
    after, _ = run(Engine(bodies, [[CUBE]] * 2, [], ContactParameters(2e-3, FREE), family), moving, 50)
    assert after.position[1, 2] - after.position[0, 2] == pytest.approx(0.9, abs=1e-4)
    assert np.allclose(after.velocity[:, 2], -1.5, atol=1e-3)


def test_pieces_of_pieces_overlap_as_their_parents_did() -> None:
    """Of 1, 4 and 7, that overlapped two and two, 4 breaks into 4, 5 and 6: 1 and 7 keep theirs, all others are new."""
    before = InitialOverlaps(np.array([[1, 4], [1, 7], [4, 7]]), np.zeros((3, 2), np.int64), np.array([0.1, 0.2, 0.3]))
    after = before.after_fracture(np.array([1, 4, 5, 6, 7]), np.array([1, 4, 4, 4, 7]))
    kept = after.parts[:, 0] == 0
    assert after.names[kept].tolist() == [[1, 7]] and after.depth[kept].tolist() == [0.2]
    new = [[1, 4], [1, 5], [1, 6], [4, 5], [4, 6], [4, 7], [5, 6], [5, 7], [6, 7]]
    assert sorted(after.names[~kept].tolist()) == new and np.all(np.isinf(after.depth[~kept]))


def test_what_is_driven_carries_what_lies_on_it() -> None:
    """A floor that goes sideways at 1 m/s drags a block along by friction, and does the work that it takes."""
    bodies = cubes([[0.0, 0.0, 0.5]])
    stand = replace(floor(0.5), driven=True)
    engine = Engine(bodies, [[CUBE]], [stand], ContactParameters(2e-3, DOWN))
    for step in range(400):
        bodies, touches = engine.advance(bodies, np.array([[2e-3 * (step + 1), 0.0, 0.0]]))
    assert np.allclose(bodies.velocity, [[1.0, 0.0, 0.0]], atol=1e-3)
    assert np.allclose(-touches.received_by(1)[1].sum(axis=0), touches.received_by(0)[1].sum(axis=0))


def test_overlap_is_told_with_its_depth() -> None:
    """A cube 0.1 m in the floor and 0.2 m in another."""
    bodies = cubes([[0.0, 0.0, 0.4], [0.8, 0.0, 0.4]])
    engine = Engine(bodies, [[CUBE]] * 2, [floor()], ContactParameters(1e-3, DOWN))
    found = {(a, b): depth for a, b, depth in engine.find_penetrations(bodies)}
    assert found == {(0, 1): pytest.approx(0.2, abs=1e-6), (0, 2): pytest.approx(0.1), (1, 2): pytest.approx(0.1)}
    assert not engine.find_penetrations(cubes([[0.0, 0.0, 1.0], [3.0, 0.0, 1.0]]))


def test_a_ball_lands_on_every_shape_that_stands() -> None:
    """Held at its top: sphere, capsule, cylinder, box and plane, each where its outline says."""
    ball = obstacle_primitive(Sphere(0.5, 3), "ball")
    slanted = (1.0, 2.0, 2.0)
    for shape in (HalfSpace((0.0, 0.0, 1.0)), Sphere(0.7, 3), Capsule(0.3, 1.0, slanted),
                  RoundedCylinder(0.4, 1.2, axis=slanted),
                  RoundedBox((1.0, 2.0, 0.6))):  # fmt: skip
        top = 0.0 if isinstance(shape, HalfSpace) else float(shape.tessellate()[0][:, 2].max())
        at = np.array([0.0, 0.0, -top])
        over = (
            np.zeros(3) if isinstance(shape, HalfSpace) else shape.tessellate()[0][shape.tessellate()[0][:, 2].argmax()]
        )
        near, far = (cubes([[over[0], over[1], 0.5 + gap]]) for gap in (-0.01, 0.05))
        engine = Engine(
            near, [[ball]], [PrescribedObstacle(obstacle_primitive(shape, "it"), at)], ContactParameters(1e-3, DOWN)
        )
        assert engine.find_penetrations(near) and not engine.find_penetrations(far), shape


def test_a_round_body_meets_a_floor_with_few_of_its_corners() -> None:
    """Of 2,000 near the floor two dozen, and it comes to rest on them, lying neither in it nor above it."""
    number = np.arange(2000)
    z = 1 - (2 * number + 1) / 2000
    angle = np.pi * (3 - np.sqrt(5)) * number
    ball = 0.5 * np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], axis=1)
    bodies = replace(cubes([[0.0, 0.0, 0.6]]), velocity=np.array([[0.0, 0.0, -20.0]]))
    rules, reach, still = ContactParameters(2e-2, DOWN), np.array([2e-2 * 20.0]), np.zeros((1, 3))
    model = build_model(bodies, [[ball]], [floor()], rules)
    course, looked = MotionBounds(still, np.zeros(3), [reach, reach]), model.planes.begin_step()
    assert 6 <= len(CollisionDetector(model)(bodies, still, course, rules.time_step, looked)) <= 24
    after, _ = Engine(bodies, [[ball]], [floor()], rules).advance(bodies)
    low = (ball @ after.rotation[0].T + after.position[0])[:, 2].min()
    assert -5e-4 < low < 5e-3


def test_what_spins_fast_and_touches_keeps_the_spin_that_friction_leaves_it(solver: None) -> None:
    """A ball that turns by two radians a step slides: dv/dt = mu g, and I dw/dt = -mu m g r with I = m / 6."""
    step, steps, friction, radius = 4e-3, 50, 0.3, 0.5
    ball, bodies = obstacle_primitive(Sphere(radius, 3), "ball"), cubes([[0.0, 0.0, radius]])
    bodies = replace(bodies, spin=np.array([[0.0, 500.0, 0.0]]))
    after, _ = run(Engine(bodies, [[ball]], [floor(friction)], ContactParameters(step, DOWN, friction)), bodies, steps)
    gained = friction * G * step * steps
    assert after.velocity[0] == pytest.approx([gained, 0.0, 0.0], rel=1e-4, abs=1e-4)
    assert after.spin[0] == pytest.approx([0.0, 500.0 - 6 * radius * gained, 0.0], rel=1e-6, abs=1e-4)


def test_what_spins_fast_keeps_angular_momentum_where_it_strikes() -> None:
    """A block that turns by two radians a step meets another in the air, which rubs along: both momenta stay."""
    bodies = cubes([[0.0, 0.0, 0.0], [0.2, 0.1, 1.01]])
    bodies = replace(
        bodies, velocity=np.array([[0.0, 0.0, 3.0], [0.0, 0.0, -3.0]]), spin=np.array([[0, 0, 500.0], 3 * [0]])
    )
    engine = Engine(bodies, [[CUBE]] * 2, [], ContactParameters(4e-3, FREE, 0.4))
    after, touches = run(engine, bodies, 2)
    assert any(len(each) for each in touches) and after.kinetic_energy < bodies.kinetic_energy
    assert np.abs(after.spin[1]).max() > 1.0, "it is taken along"
    assert after.momentum == pytest.approx(bodies.momentum, abs=1e-6 * MASS)
    assert after.angular_momentum == pytest.approx(bodies.angular_momentum, abs=1e-6 * MASS * 500)


def test_a_crumb_does_not_whirl() -> None:
    """A needle that lands on its end at 20 m/s would turn by 12 rad in the step; it stays on the floor, and gains no
    energy. What nothing touches turns as it will."""
    needle = np.array([[0.0, 0, -0.05], [0.002, 0, 0.05], [-0.001, 0.002, 0.05], [-0.001, -0.002, 0.05]])
    needle = needle @ np.array([[0.9, 0, 0.436], [0, 1, 0], [-0.436, 0, 0.9]])
    light = replace(
        cubes([[0.0, 0.0, 0.3], [9.0, 0.0, 9.0]]), mass=np.full(2, 1e-6), inertia=np.tile(5e-10 * np.eye(3), (2, 1, 1))
    )
    falling = replace(
        light, velocity=np.array([[0.0, 0, -20.0], [0.0, 0.0, 0.0]]), spin=np.array([[0.0, 0, 0], [0, 0, 300.0]])
    )
    engine, bodies = Engine(falling, [[needle]] * 2, [floor()], ContactParameters(2e-2, DOWN)), falling
    for _ in range(5):
        bodies, _ = engine.advance(bodies)
        low = (needle @ bodies.rotation[0].T + bodies.position[0])[:, 2].min()
        assert np.linalg.norm(bodies.spin[0]) <= 1.0 / 2e-2 * (1 + 1e-9) and low > -2e-3
    assert bodies.kinetic_energy < falling.kinetic_energy
    assert bodies.spin[1] == pytest.approx([0.0, 0.0, 300.0])


def test_without_active_contacts_there_are_no_forces() -> None:
    """All impacts of an event may be left to later ones."""
    bodies, rules = cubes([[0.0, 0.0, 0.5]]), ContactParameters(1e-3, DOWN)
    model = build_model(bodies, [[CUBE]], [floor()], rules)
    place = np.zeros((1, 3))
    bounds = MotionBounds(place, np.zeros(3), 2 * [np.full(1, 0.1)])
    contacts = CollisionDetector(model)(bodies, place, bounds, 1e-3, model.planes.begin_step())
    newton, none = contact_solver.MujocoNewtonSolver(model, rules), np.empty((0, 3))
    newton.set_up(bodies, none, none, contacts, DOWN)
    force, contact_force, closed = newton.solve(contacts.gap, np.zeros(len(contacts), bool))
    assert len(contacts) >= 4 and not force.any() and not contact_force.any() and not closed.any()
