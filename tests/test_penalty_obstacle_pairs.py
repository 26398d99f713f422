"""Obstacles that touch one another in explicit steps: momentum, energy, what carries, and the books."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from fracsim.contact.rigid_obstacles import VerletRigidObstacles
from fracsim.scene import Scene
from support.resumed import assert_alike, going_stopped_resumed
from support.scenes import Walk, each_step, make_scene
from test_mesh_obstacles import SOFT, block, last

Values = npt.NDArray[np.float64]


def beside(dim: int, *obstacles: dict[str, Any], end: float, **tables: Any) -> tuple[Scene, Walk]:
    """A soft body at rest, far from obstacles that meet one another."""
    return make_scene(**{
        "mesh": {"builder": "box", "size": [1.0] * dim, "h": 0.5, "origin": [-20.0] * dim}, "material": SOFT,
        "contact": {"itself": False, "distance": 0.02}, "obstacle": list(obstacles),
        "time": {"scheme": "explicit", "step": 5e-3, "end": end},
    } | tables)  # fmt: skip


def bodies_of(scene: Scene) -> VerletRigidObstacles:
    (found,) = [term for term in scene.balance.terms if isinstance(term, VerletRigidObstacles)]
    return found


@pytest.mark.parametrize("kind", ("balls", "boxes", "ball and file", "file and box", "files"))
def test_two_free_ones_collide(kind: str, tmp_path: Path) -> None:
    """Off their centres: linear and angular momentum to round-off, energy to 2 %, and depths of a few of their steps'
    motion; they part at the speed at which they met."""
    ball, box = {"shape": "sphere", "radius": 0.2}, {"shape": "box", "size": [0.3, 0.3, 0.3]}
    cube = block(tmp_path, (0.3, 0.3, 0.3)) if "file" in kind else {}
    first, second = {"balls": (ball, ball), "boxes": (box, box), "ball and file": (ball, cube),
                     "file and box": (cube, box), "files": (cube, cube)}[kind]  # fmt: skip
    off = [0.05, 0.08] if "box" in kind or kind == "files" else [0.03, 0.05]
    scene, state = beside(
        3, first | {"name": "a", "at": [-0.25, 0.0, 0.0], "mass": 3.0, "velocity": [1.0, 0.0, 0.0]},
        second | {"name": "b", "at": [0.25, *off], "mass": 5.0, "velocity": [-0.5, 0.0, 0.0]}, end=0.4,
    )  # fmt: skip
    bodies = bodies_of(scene)

    def momenta() -> tuple[Values, Values]:
        motions = [free.motion for free in bodies.free.values()]
        angular = [np.cross(motion.pose.centre, motion.momentum[:3]) + motion.momentum[3:] for motion in motions]
        return np.sum([motion.momentum[:3] for motion in motions], axis=0), np.sum(angular, axis=0)

    (linear, angular), began, stored = momenta(), 0.5 * 3.0 + 0.5 * 5.0 * 0.25, 0.0
    for report in each_step(scene, state):
        np.testing.assert_allclose(momenta()[0], linear, atol=1e-12)
        np.testing.assert_allclose(momenta()[1], angular, atol=1e-12)
        assert report.kinetic + report.elastic == pytest.approx(began, rel=0.02)
        stored = max(stored, report.elastic)
    row = last(scene)
    assert stored > 0.1 and row["velocity_b_x"] - row["velocity_a_x"] > 0.3
    np.testing.assert_allclose([row["work_a"], row["work_b"]], 0.0, atol=1e-12)  # neither has met the body


@pytest.mark.parametrize("dim", (2, 3))
def test_a_box_lies_on_a_floor_that_rises(dim: int) -> None:
    """Set down on a held box, then lifted: the floor carries m g; its work is what the box has in the end."""
    up, g = [0.0] * (dim - 1), 10.0
    size = [2.0, 2.0, 0.4][-dim:]
    floor = {"name": "floor", "shape": "box", "size": size, "at": [*up, -0.2],
             "displacement": {"time": [0.0, 1.0], "value": [[*up, 0.0], [*up, 0.3]]}}  # fmt: skip
    box = {"name": "it", "shape": "box", "size": [0.5] * dim, "at": [*up, 0.28], "mass": 20.0}
    scene, state = beside(dim, floor, box, end=1.0, load={"gravity": [*up, -g]})
    bodies, began = bodies_of(scene), None
    for report in each_step(scene, state):
        total = report.kinetic + report.elastic - state.work
        began = total if began is None else began
        assert total == pytest.approx(began, abs=0.02 * 20.0 * g * 0.3)
    assert state.work > 0.0
    posed = bodies.posed_at(state.t)
    gap = posed[1].pose.centre[-1] - posed[0].pose.centre[-1] - 0.2 - 0.25
    assert -0.02 < gap < 0.03 and abs(posed[1].pose.centre[0]) < 1e-3


def test_a_light_one_takes_shorter_steps() -> None:
    """Near one another obstacles limit the step: with a given stiffness by the mass of the lighter one."""
    steps = []
    for x, mass in ((3.0, 0.1), (0.45, 0.1), (0.45, 10.0)):
        _, state = beside(
            2, {"name": "a", "shape": "sphere", "radius": 0.2, "at": [0.0, 0.0], "mass": mass},
            {"name": "b", "shape": "sphere", "radius": 0.2, "at": [x, 0.0]}, end=10.0,
            contact={"itself": False, "distance": 0.02, "stiffness": 1e4},
            time={"scheme": "explicit", "step": 1.0, "end": 10.0},
        )  # fmt: skip
        steps.append(state.advance().dt)
    assert steps[1] < 0.2 * steps[0] and steps[1] < 0.5 * steps[2] <= 0.5 * steps[0]


def test_a_restart_goes_on_as_the_run_would_have(tmp_path: Path) -> None:
    """Two free blocks from files, stopped in contact and resumed: the same but for round-off."""
    cube = block(tmp_path, (0.3, 0.3, 0.3))
    tables = {
        "mesh": {"builder": "box", "size": [1.0] * 3, "h": 0.5, "origin": [-20.0] * 3}, "material": SOFT,
        "contact": {"itself": False, "distance": 0.02}, "output": {"picture": False, "interval": 9.0},
        "obstacle": [cube | {"name": "a", "at": [-0.16, 0.0, 0.0], "mass": 3.0, "velocity": [1.0, 0.0, 0.0]},
                     cube | {"name": "b", "at": [0.16, 0.05, 0.08], "mass": 5.0}],
        "time": {"scheme": "explicit", "step": 5e-3, "end": 9.0},
    }  # fmt: skip
    going, _, again = going_stopped_resumed(tables, tmp_path, 5, 20)
    assert_alike(again, going, 1e-12)
    assert last(going.scene)["velocity_b_x"] > 0.3
