"""A ball that flies at a thin plate over an anvil, both within a step: it breaks the plate, and the anvil is struck."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import trimesh

pytest.importorskip("mujoco", reason="an environment made without a network")

from fracsim.mesh.split_surface.closed_surface import build_split_surface
from fracsim.rigid.bodies import Bodies
from fracsim.rigid.contact_points import ContactImpulses
from fracsim.rigid.contact_solver import SETTINGS as SOLVER_SETTINGS
from fracsim.rigid.engine import Engine
from fracsim.rigid.mujoco_model import SETTINGS as MODEL_SETTINGS
from fracsim.rigid.rigid_stepper import RigidState, RigidStepper
from fracsim.scene.rigid_scene import RigidScene, build_rigid_scene
from test_rigid_study import study

Values = npt.NDArray[np.float64]
RADIUS, SIDE, BELOW, OVER = 0.02, 0.2, 0.005, 0.013
SCENES = [(thick, speed) for thick in (0.002, 0.004, 0.008) for speed in (5.0, 20.0, 50.0)]
SPEEDS = {5.0: 2e-3, 20.0: 1e-3, 50.0: 5e-4}  # m/s, and a step in which it comes by 10, 20 and 25 mm


def scene_of(thick: float, speed: float, step: float) -> RigidScene:
    """A plate in the air, 5 mm over the anvil; nothing weighs, and nothing rebounds."""
    ball = {"name": "ball", "shape": "sphere", "radius": RADIUS, "at": [0.11, 0.095, BELOW + thick + OVER + RADIUS],
            "density": 7800.0, "velocity": [0.0, 0.0, -speed], "friction": 0.3}  # fmt: skip
    anvil = {"name": "anvil", "shape": "plane", "at": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0], "friction": 0.4}
    changed: dict[str, Any] = {
        "mesh": {"builder": "box", "size": [SIDE, SIDE, thick], "h": 0.025},
        "material": {"energy": "linear", "young": 7e10, "poisson": 0.22, "density": 2500.0},
        "fracture": {"strength": 1e6, "kernel": "neighbours"},
        "brittle": {"surfaces": 6, "spacing": 0.02},
        "body": [{"position": [0.0, 0.0, BELOW]}],
        "obstacle": [anvil, ball],
        "load": None,
        "time": {"scheme": "rigid", "step": step, "end": 1.0},
    }
    return build_rigid_scene(study(**changed))


def surfaces(stepper: RigidStepper, bodies: Bodies) -> Values:
    """(m, 3, 3) triangles of the split surface of the pieces, where they are."""
    copy, skeleton = stepper.instances.get(0), stepper._geometry.numbering
    made = build_split_surface(skeleton, *copy.input_damage())
    at_rest = made.points + stepper._geometry.poses.position[0]
    return bodies.to_current(at_rest, made.point_fragment)[made.elements]


class Watch:
    """What touched in a step, as it was taken in the end."""

    def __init__(self) -> None:
        self.touches = ContactImpulses.empty()


@pytest.fixture
def watch(monkeypatch: pytest.MonkeyPatch) -> Watch:
    """Of the steps of an engine."""
    found, advance = Watch(), Engine.advance

    def watched(self: Engine, *how: Any) -> tuple[Bodies, ContactImpulses]:
        moved, found.touches = advance(self, *how)
        return moved, found.touches

    monkeypatch.setattr(Engine, "advance", watched)
    return found


def depths(stepper: RigidStepper, bodies: Bodies) -> Values:
    """m that anything is in the anvil by, and a piece in the ball."""
    triangles = surfaces(stepper, bodies)
    centre = np.tile(bodies.position[-1], (len(triangles), 1))
    nearest = np.linalg.norm(trimesh.triangles.closest_point(triangles, centre) - centre, axis=1).min()
    low = min(triangles[:, :, 2].min(), bodies.position[-1, 2] - RADIUS)
    return np.maximum([-low, RADIUS - nearest], 0.0)


def assert_step(before: RigidState, after: RigidState, touches: ContactImpulses, speed: float) -> None:
    """No energy is gained; both momenta change by what the anvil gave. Momentum is a sum of some thousand products,
    round-off 1e-16 each; of the angular momentum that is lost which is set back by c_0 dt with what rests
    (rigid.engine); contacts give way by a share 1 - impedance of what they take."""
    one, two, anvil = before.bodies, after.bodies, len(after.bodies)
    points, given = touches.received_by(anvil)
    size = float(one.mass[-1]) * speed
    assert two.kinetic_energy < one.kinetic_energy + (1 - SOLVER_SETTINGS.impedance) * size * speed
    assert two.momentum - one.momentum == pytest.approx(-given.sum(axis=0), abs=1e-12 * size)
    turned, lifted = np.cross(points, -given).sum(axis=0), MODEL_SETTINGS.min_impact_speed * (after.t - before.t) * size
    assert two.angular_momentum - one.angular_momentum == pytest.approx(turned, abs=lifted)


@pytest.mark.parametrize("finer", [1, 2, 4])
@pytest.mark.parametrize(("thick", "speed"), SCENES)
def test_what_is_behind_a_plate_does_not_stop_what_flies_at_it(
    thick: float, speed: float, finer: int, watch: Watch
) -> None:
    """The plate breaks, whatever the step, and takes along what it has of the ball's momentum: the anvil is struck by
    its pieces, not by the ball through them.

    Nothing is ever in the anvil, nor the ball in a piece, by half as much as the plate is thick: beyond that it would
    come out on the other side."""
    step = SPEEDS[speed] / finer
    scene = scene_of(thick, speed, step)
    stepper, state, given = scene.stepper, scene.initial_state, 0.0
    while state.t < 1.5 * (OVER + BELOW) / speed + 2 * SPEEDS[speed]:
        before = state
        state, report = stepper.advance(state)
        assert_step(before, state, watch.touches, speed)
        assert np.all(depths(stepper, state.bodies) < thick / 2)
        given -= float(report.obstacle_forces[0, 2]) * step
    mass = float(state.bodies.mass[-1])
    assert stepper.fragment_count > 2 and given > 0.3 * mass * speed


@pytest.mark.parametrize("at", [1, 2])
def test_it_goes_on_from_a_checkpoint_to_the_last_digit(at: int) -> None:
    """Before the step that is taken apart, and after it."""
    ends = []
    for stops in (False, True):
        scene = scene_of(0.002, 50.0, SPEEDS[50.0] / 2)
        stepper, state = scene.stepper, scene.initial_state
        for step in range(4):
            if stops and step == at:
                saved, stepper = stepper.to_checkpoint(state), scene_of(0.002, 50.0, SPEEDS[50.0] / 2).stepper
                state = stepper.from_checkpoint(saved, state.t, state.step, state.work)
            state, _ = stepper.advance(state)
        ends.append(state.bodies)
    assert len(ends[0]) > 3
    for one, other in zip(*(vars(each).values() for each in ends), strict=True):
        assert np.array_equal(one, other)
