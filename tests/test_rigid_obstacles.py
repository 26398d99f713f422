"""Obstacles among rigid bodies: free ones exchange momentum as bodies do, and files are unions of convex parts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from mpi4py import MPI

pytest.importorskip("mujoco", reason="an environment made without a network")

from fracsim.deformable_run import run_study
from fracsim.scene.rigid_scene import RigidScene, build_rigid_scene
from test_rigid_study import FLOOR, assert_same, rows, study, tables

Values = npt.NDArray[np.float64]
BLOCK = {"builder": "box", "size": [0.2, 0.2, 0.2], "h": 0.1}  # 16 kg
BALL: dict[str, Any] = {"name": "ball", "shape": "sphere", "radius": 0.05, "at": [0.1, 0.1, 0.26]}
NOTHING = dict.fromkeys(("fracture", "brittle", "obstacle", "load", "body", "contact"))


def scene_of(*obstacles: dict[str, Any], step: float = 1e-3, end: float = 0.02, **changed: Any) -> RigidScene:
    """A block of 0.2 m and obstacles."""
    time = {"scheme": "rigid", "step": step, "end": end}
    return build_rigid_scene(study(**NOTHING | {"mesh": BLOCK, "obstacle": [*obstacles], "time": time} | changed))


def ended(scene: RigidScene) -> Any:
    """The state at the end."""
    state = scene.initial_state
    while not scene.ended(state):
        state, _ = scene.stepper.advance(state)
    return state


@pytest.mark.parametrize("restitution", [0.0, 0.6])
def test_a_free_ball_meets_a_block_as_two_bodies_do(restitution: float) -> None:
    """Along the line of their centres: v = (m u +- e M u) / (m + M), of the ball and of the block."""
    ball = BALL | {"mass": 4.0, "velocity": [0.0, 0.0, -3.0]}
    state = ended(scene_of(ball, contact={"restitution": restitution}))
    m, M, u = 4.0, 16.0, -3.0
    assert state.bodies.mass == pytest.approx([M, m])
    common = m * u / (m + M)
    block, found = common * (1 + restitution), common - restitution * M * u / (m + M)
    assert state.bodies.velocity[:, 2] == pytest.approx([block, found], abs=2e-3)
    assert np.abs(state.bodies.velocity[:, :2]).max() < 1e-9


def test_momentum_is_kept_by_what_is_struck_beside_its_centre_and_breaks() -> None:
    """A ball against the end of a weak bar, rubbing: m v and m x x v + I w of the pieces and the ball, to round-off."""
    ball = BALL | {"at": [0.55, 0.12, 0.26], "velocity": [1.0, 0.5, -9.0], "density": 7800.0, "friction": 0.5,
                   "spin": [20.0, -30.0, 10.0]}  # fmt: skip
    bar = {"builder": "box", "size": [0.6, 0.2, 0.2], "h": 0.1}
    breaks = {"fracture": tables()["fracture"] | {"strength": 1e5}, "brittle": {"surfaces": 4}}
    scene = scene_of(ball, mesh=bar, **breaks)
    first, last = scene.initial_state.bodies, ended(scene).bodies
    assert first.mass[1] == pytest.approx(7800 * 4 / 3 * np.pi * 0.05**3, rel=1e-12)
    assert len(last) > 2 and last.mass.sum() == pytest.approx(first.mass.sum(), rel=1e-12)
    assert np.allclose(last.momentum, first.momentum, atol=1e-9 * np.linalg.norm(first.momentum))
    assert np.allclose(last.angular_momentum, first.angular_momentum, atol=1e-9 * np.linalg.norm(first.momentum))
    assert np.linalg.norm(last.spin[-1] - first.spin[-1]) > 1.0, "it rubbed"
    assert last.kinetic_energy < first.kinetic_energy


def test_a_free_box_slides_on_the_floor_after_coulomb() -> None:
    """Obstacles meet each other: v - mu g t, and it stays on the floor; the block of the study is far away."""
    box = {"name": "box", "shape": "box", "size": [0.2, 0.2, 0.1], "at": [3.0, 0.0, 0.05], "mass": 2.0,
           "velocity": [2.0, 0.0, 0.0], "friction": 0.3}  # fmt: skip
    floor = FLOOR | {"friction": 0.3}
    fall = {"gravity": [0.0, 0.0, -9.81]}
    state = ended(scene_of(floor, box, end=0.3, step=2e-3, load=fall))
    assert state.bodies.velocity[-1, 0] == pytest.approx(2.0 - 0.3 * 9.81 * 0.3, rel=0.01)
    assert state.bodies.position[-1, 2] == pytest.approx(0.05, abs=2e-4)


def test_a_run_tells_how_a_free_obstacle_flies_and_goes_on_after_a_stop(tmp_path: Path) -> None:
    """Columns as of other studies: in the end the ball has what it lost, work_ball, less, and what it gave the block is
    what contact_ball says; drawn where it is; after a restart the same."""
    ball = BALL | {"mass": 4.0, "velocity": [0.0, 0.0, -3.0], "at": [0.15, 0.1, 0.3]}
    whole = NOTHING | {"mesh": BLOCK, "obstacle": [ball], "output": {"every": 5, "picture": False, "checkpoint": 1e-9}}
    times = [{"scheme": "rigid", "step": 2e-3, "end": end} for end in (0.02, 0.06)]
    for time, again in zip(times, (False, True), strict=True):
        run_study(MPI.COMM_SELF, study(**whole, time=time), tmp_path / "out", restart=again)
    run_study(MPI.COMM_SELF, study(**whole, time=times[1]), tmp_path / "whole")
    found, expected = (rows(tmp_path / name / "history.csv") for name in ("out", "whole"))
    assert_same(found, expected)
    start = 0.5 * 4.0 * 3.0**2
    assert found["kinetic_ball"][-1] == pytest.approx(start - found["work_ball"][-1], rel=1e-9) and found["kinetic"][0]
    assert found["pieces"][-1] == 1 and found["velocity_ball_z"][0] == -3.0
    given = 2e-3 * found["contact_ball_z"].sum()
    assert 4.0 * (found["velocity_ball_z"][-1] + 3.0) == pytest.approx(given, rel=1e-9) and given > 1.0
    way = 0.3 + 2e-3 * found["velocity_ball_z"].sum()
    assert found["position_ball_z"][-1] == pytest.approx(way, abs=2e-3)
    assert abs(found["spin_ball_y"][-1]) < 0.01, "nothing rubs"
    names = [path.name for path in (tmp_path / "out" / "surface").iterdir()]
    assert any("ball" in name for name in names)


def obj_of(path: Path, boxes: list[tuple[list[float], list[float]]]) -> str:
    """A file of boxes with these lower and upper corners, each closed."""
    lines, faces = list[str](), list[str]()
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    for number, (low, high) in enumerate(boxes):
        for k in range(8):
            corner = [(low, high)[k >> axis & 1][axis] for axis in (2, 1, 0)][::-1]
            lines.append("v " + " ".join(map(str, corner)))
        for a, b, c, d in quads:
            faces += [f"f {8 * number + 1 + i} {8 * number + 1 + j} {8 * number + 1 + k}" for i, j, k in
                      ((a, c, b), (a, d, c))]  # fmt: skip
    path.write_text("\n".join(lines + faces) + "\n")
    return str(path)


@pytest.mark.parametrize("how", [{}, {"velocity": [0.0, 0.0, 0.5]}, {"mass": 30.0, "spin": [1.0, 4.0, 2.0]}])
def test_a_box_from_a_file_does_what_a_box_does(how: dict[str, Any], tmp_path: Path) -> None:
    """Held, driven upwards, and free and tumbling, under a block that falls on it askew: bodies end in the same place,
    as near as the engine's points of touch are (a box has rounded edges where it is weighed)."""
    file = obj_of(tmp_path / "box.obj", [([-0.3, -0.2, -0.1], [0.3, 0.2, 0.1])])
    plain = {"name": "box", "at": [0.0, 0.0, -0.2], "friction": 0.4} | how
    falls = {"body": [{"position": [-0.1, -0.05, -0.06], "rotation": [0.1, 0.2, 0.0], "velocity": [0.0, 0.0, -2.0]}],
             "load": {"gravity": [0.0, 0.0, -9.81]}, "end": 0.03}  # fmt: skip
    boxes = {"shape": "box", "size": [0.6, 0.4, 0.2]}, {"shape": "mesh", "file": file}
    found, expected = (ended(scene_of(plain | shape, **falls)).bodies for shape in boxes)
    assert np.allclose(found.mass, expected.mass, rtol=1e-9) and np.allclose(found.inertia, expected.inertia, rtol=2e-3)
    assert np.allclose(found.position, expected.position, atol=1e-3)
    assert np.allclose(found.rotation, expected.rotation, atol=1e-2)
    assert expected.velocity[0, 2] > -1.0, "it was met"


def test_a_hollow_in_a_file_is_one(tmp_path: Path) -> None:
    """A trough of a slab and two walls: the block falls between these, on the slab, and not on their hull. A slab that
    is free falls on the floor and stays there, its centre half its height above it."""
    walls = [([x, -0.3, 0.01], [x + 0.2, 0.3, 0.3]) for x in (-0.5, 0.3)]
    closed = [([-0.5, -0.3, -0.1], [0.5, 0.3, 0.0]), *walls]
    file = obj_of(tmp_path / "trough.obj", closed)
    trough = {"name": "trough", "shape": "mesh", "file": file, "at": [0.1, 0.1, -0.3]}
    falls = {"load": {"gravity": [0.0, 0.0, -9.81]}, "end": 0.4, "step": 2e-3}
    lies = ended(scene_of(trough, **falls)).bodies
    assert lies.position[0, 2] == pytest.approx(-0.3 + 0.1, abs=1e-3) and np.abs(lies.velocity).max() < 0.02
    slab = {"name": "slab", "shape": "mesh", "file": obj_of(tmp_path / "slab.obj", closed[:1]), "at": [5.0, 0.0, 0.3]}
    fallen = ended(scene_of(slab | {"density": 1000.0}, FLOOR, **falls)).bodies
    assert fallen.mass[1] == pytest.approx(1000 * 0.06, rel=1e-9)
    assert fallen.position[1, 2] == pytest.approx(0.05, abs=5e-4)
