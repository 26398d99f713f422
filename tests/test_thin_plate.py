"""A ball that flies at a thin plate over an anvil, both within a step."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

pytest.importorskip("mujoco", reason="an environment made without a network")

from fracsim.rigid.bodies import Bodies
from fracsim.rigid.engine import Engine
from fracsim.rigid.touches import Touches
from fracsim.scene.rigid import RigidScene, build_rigid_scene
from test_rigid_study import study

Values = npt.NDArray[np.float64]
RADIUS, SIDE, BELOW, OVER = 0.02, 0.2, 0.005, 0.013
FRICTION = 0.4  # of the anvil and of pieces
SPEEDS = {5.0: 2e-3, 20.0: 1e-3, 50.0: 5e-4}  # m/s, and a step in which it comes by 10, 20 and 25 mm


def scene_of(thick: float, speed: float, step: float) -> RigidScene:
    """A plate in the air, 5 mm over the anvil; nothing weighs, and nothing rebounds."""
    ball = {"name": "ball", "shape": "sphere", "radius": RADIUS, "at": [0.11, 0.095, BELOW + thick + OVER + RADIUS],
            "density": 7800.0, "velocity": [0.0, 0.0, -speed], "friction": 0.3}  # fmt: skip
    anvil = {"name": "anvil", "shape": "plane", "at": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0], "friction": FRICTION}
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


@pytest.mark.parametrize(
    ("thick", "speed", "finer"), [(0.004, 5.0, 4), (0.004, 20.0, 4), (0.004, 50.0, 4), (0.008, 20.0, 1)]
)
def test_what_touched_is_what_pushed(thick: float, speed: float, finer: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """All that there is changes its momentum by what the anvil is told to have given, to round-off of a sum of some
    thousand products."""
    found, advance = [], Engine.advance

    def watched(self: Engine, *how: Any) -> tuple[Bodies, Touches]:
        found.append(advance(self, *how))
        return found[-1]

    monkeypatch.setattr(Engine, "advance", watched)
    scene = scene_of(thick, speed, SPEEDS[speed] / finer)
    stepper, state = scene.stepper, scene.first
    while state.t < 1.5 * (OVER + BELOW) / speed + 2 * SPEEDS[speed]:
        before = state.bodies
        state, _ = stepper.advance(state)
        _, given = found[-1][1].on(len(state.bodies))
        size = float(before.mass[-1]) * speed
        assert state.bodies.momentum - before.momentum == pytest.approx(-given.sum(axis=0), abs=1e-12 * size)
