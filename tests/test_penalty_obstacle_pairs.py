"""Obstacles that touch one another in explicit steps: momentum, energy, what carries, and the books."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from fracsim.contact.penalty_obstacle_pairs import VerletRigidObstacles
from fracsim.contact.pose import Pose, PosedShape
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


KINDS = ("analytic", "file on analytic", "analytic on file", "files")


def slab_and_tile(kind: str, path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """A held slab with its top at 0.05, and a free tile of 0.3 x 0.3 x 0.04 m; analytic, or read from files."""
    slab: dict[str, Any] = {"shape": "box", "size": [2.0, 1.0, 0.1]}
    tile: dict[str, Any] = {"shape": "box", "size": [0.3, 0.3, 0.04]}
    if kind in ("analytic on file", "files"):
        (path / "slab").mkdir()
        slab = block(path / "slab", (2.0, 1.0, 0.1))
    if kind in ("file on analytic", "files"):
        tile = block(path, (0.3, 0.3, 0.04))
    return slab | {"name": "slab", "at": [0.0, 0.0, 0.0]}, tile | {"name": "tile", "mass": 0.5}


@pytest.mark.parametrize(("share", "sticks"), [(1.3, True), (0.7, False)])
@pytest.mark.parametrize("kind", KINDS)
def test_a_tile_on_a_slope_sticks_or_slides(kind: str, share: float, sticks: bool, tmp_path: Path) -> None:
    """tan(theta) = 0.4, mu = `share` of it: it slides with g (sin - mu cos), or creeps at most, as it bounces without
    any damping (and friction of new points begins without a stretch). Nothing is lost but by friction."""
    slab, tile = slab_and_tile(kind, tmp_path)
    g, slope, h = 10.0, 0.4, 0.1 if kind == "analytic on file" else 0.5
    along, down = np.array([slope, -1.0]) / np.hypot(1, slope) * g
    scene, state = beside(
        3, slab | {"friction": share * slope}, tile | {"at": [0.0, 0.0, 0.07 + 0.0205]}, end=0.4,
        load={"gravity": [along, 0.0, down]},
        mesh={"builder": "box", "size": [0.5] * 3, "h": h, "origin": [-20.0] * 3},
    )  # fmt: skip
    bodies, moved = bodies_of(scene), []
    for report in each_step(scene, state):
        assert report.kinetic + report.elastic + state.dissipated == pytest.approx(state.work, abs=0.02)
        moved.append((state.t, bodies.free[1].motion.pose.centre[0]))
    t, way = np.array(moved).T
    if sticks:
        assert way[-1] < 0.07 * 0.5 * along * 0.4**2
    else:
        late = t > 0.1
        held = along - 2 * np.polyfit(t[late], way[late], 2)[0]
        assert held == pytest.approx(-share * slope * down, rel=0.06)
        assert state.dissipated > 0.02


@pytest.mark.parametrize("kind", ("analytic", "files"))
def test_friction_of_a_pair_is_a_spring_that_slips(kind: str, tmp_path: Path) -> None:
    """A tile that is pressed in by hand and drawn aside: as stiff along the slab as across it, up to mu N. Both
    have opposite forces, and what is dissipated is the work that is not stored."""
    slab, tile = slab_and_tile(kind, tmp_path)
    scene, _ = beside(3, slab | {"friction": 0.5}, tile | {"at": [0.0, 0.0, 0.092]}, end=1.0)
    bodies = bodies_of(scene)
    (pair,), index = bodies._pairs, [number for number in bodies._pairs[0].numbers].index(1)

    def moved(x: float, z: float) -> Values:
        start = list(bodies.posed)
        pose = start[1].pose
        end = PosedShape(start[1].shape, Pose(np.array([x, 0.0, 0.092 - z]), pose.rotation))
        bodies.posed[1] = end
        increments = [np.zeros(6), np.r_[end.pose.centre - pose.centre, np.zeros(3)]]
        pair.end_step(start, bodies.posed, increments)
        np.testing.assert_allclose(pair.forces.wrenches[:, :3].sum(axis=0), 0.0, atol=1e-12)
        return np.asarray(pair.forces.wrenches[index, :3])

    moved(0.0, 0.010)
    press = moved(0.0, 0.010 + 1e-6)[2]
    k = (press - moved(0.0, 0.010)[2]) / 1e-6
    assert k > 0 and pair.forces.energies[1] < 1e-9 * pair.forces.energies[0]
    force = moved(0.001, 0.010)
    # a few points at the rim have other normals
    assert force[0] == pytest.approx(-k * 0.001, rel=0.03)
    assert pair.forces.energies[1] == pytest.approx(0.5 * k * 0.001**2, rel=0.03)
    assert pair.dissipated == pytest.approx(0.0, abs=1e-3 * pair.forces.energies[1])
    stored, first = pair.forces.energies[1], -force[0]
    force = moved(0.011, 0.010)
    assert -force[0] == pytest.approx(0.5 * force[2], rel=0.03)
    # by the trapezoidal rule, as a step has it
    work = 0.5 * (first - force[0]) * 0.01
    assert pair.dissipated == pytest.approx(work - (pair.forces.energies[1] - stored), rel=1e-6)
    assert pair.dissipated > 0.6 * work


def test_a_ball_rolls_down_a_slope() -> None:
    """With friction to spare: 5/7 g sin(theta), spin v / r within the gap, and nothing is lost."""
    g, slope, r = 10.0, 0.3, 0.2
    along, down = np.array([slope, -1.0]) / np.hypot(1, slope) * g
    scene, state = beside(
        3, {"name": "floor", "shape": "plane", "at": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0], "friction": 0.6},
        {"name": "ball", "shape": "sphere", "radius": r, "at": [0.0, 0.0, r + 0.0195], "mass": 5.0}, end=0.5,
        load={"gravity": [along, 0.0, down]},
        mesh={"builder": "box", "size": [1.0] * 3, "h": 0.5, "origin": [0.0, 9.0, 5.0]},
    )  # fmt: skip
    rows = []
    for report in each_step(scene, state):
        row = last(scene)
        rows.append((state.t, row["velocity_ball_x"], r * row["spin_ball_y"]))
        assert report.kinetic + report.elastic + state.dissipated == pytest.approx(state.work, abs=0.02)
    t, velocity, spin = np.array(rows).T
    # it swings on the spring of friction, about what follows
    assert np.polyfit(t, velocity, 1)[0] == pytest.approx(5 / 7 * along, rel=0.02)
    assert np.polyfit(t, spin, 1)[0] == pytest.approx(5 / 7 * along, rel=0.02)
    assert state.dissipated < 0.02 * state.work


def test_a_cylinder_spins_on_without_friction() -> None:
    """On a plane the normal meets its axis: no moment about it, at whatever angle the cylinder is."""
    plane = {"name": "floor", "shape": "plane", "at": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}
    log = {"name": "it", "shape": "cylinder", "radius": 0.1, "length": 0.4, "axis": [1.0, 0.0, 0.0], "mass": 5.0,
           "at": [0.0, 0.0, 0.125], "spin": [5.0, 0.0, 0.0], "velocity": [0.0, 0.2, 0.0]}  # fmt: skip
    scene, state = beside(
        3, plane, log, end=0.3, load={"gravity": [0.0, 0.0, -10.0]},
        mesh={"builder": "box", "size": [1.0] * 3, "h": 0.5, "origin": [0.0, 9.0, 5.0]},
    )  # fmt: skip
    for _ in each_step(scene, state):
        assert last(scene)["spin_it_x"] == pytest.approx(5.0, rel=1e-9)


@pytest.mark.parametrize("kind", ("balls", "files"))
def test_two_that_rub_keep_momentum(kind: str, tmp_path: Path) -> None:
    """They meet askew and spin: linear and angular momentum to round-off; what friction takes is in the books, and
    friction is never more than mu N."""
    one: dict[str, Any] = {"shape": "sphere", "radius": 0.2}
    if kind == "files":
        one = block(tmp_path, (0.3, 0.3, 0.3))
    scene, state = beside(
        3, one | {"name": "a", "at": [-0.22, 0.0, 0.0], "mass": 3.0, "velocity": [1.0, 0.5, 0.0], "friction": 0.3,
                  "spin": [0.0, 3.0, 0.0]},
        one | {"name": "b", "at": [0.22, 0.03, 0.05], "mass": 5.0, "velocity": [-0.5, 0.0, 0.0]}, end=0.3,
    )  # fmt: skip
    bodies = bodies_of(scene)

    def momenta() -> Values:
        motions = [free.motion for free in bodies.free.values()]
        angular = [np.cross(motion.pose.centre, motion.momentum[:3]) + motion.momentum[3:] for motion in motions]
        return np.concatenate([np.sum([motion.momentum[:3] for motion in motions], axis=0), np.sum(angular, axis=0)])

    before, began = momenta(), sum(free.body.history_values(free.motion)[-1] for free in bodies.free.values())
    (pair,) = bodies._pairs
    for report in each_step(scene, state):
        np.testing.assert_allclose(momenta(), before, atol=1e-12)
        assert report.kinetic + report.elastic + state.dissipated == pytest.approx(began, rel=0.02)
        rub, press = pair.forces.friction[0, :3], (pair.forces.wrenches - pair.forces.friction)[0, :3]
        if kind == "balls":
            assert np.linalg.norm(rub) <= 0.3 * np.linalg.norm(press) * (1 + 1e-9)
    assert state.dissipated > 0.005 * began


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


@pytest.mark.parametrize("kind", ("files", "box and file"))
def test_a_restart_goes_on_as_the_run_would_have(kind: str, tmp_path: Path) -> None:
    """Two free blocks that rub, stopped in contact and resumed: the same but for round-off."""
    cube = block(tmp_path, (0.3, 0.3, 0.3))
    first: dict[str, Any] = cube if kind == "files" else {"shape": "box", "size": [0.3, 0.3, 0.3]}
    tables = {
        "mesh": {"builder": "box", "size": [1.0] * 3, "h": 0.5, "origin": [-20.0] * 3}, "material": SOFT,
        "contact": {"itself": False, "distance": 0.02}, "output": {"picture": False, "interval": 9.0},
        "obstacle": [first | {"name": "a", "at": [-0.16, 0.0, 0.0], "mass": 3.0, "velocity": [1.0, 0.3, 0.0]},
                     cube | {"name": "b", "at": [0.16, 0.05, 0.08], "mass": 5.0, "friction": 0.3}],
        "time": {"scheme": "explicit", "step": 5e-3, "end": 9.0},
    }  # fmt: skip
    going, _, again = going_stopped_resumed(tables, tmp_path, 5, 20)
    assert_alike(again, going, 1e-12)
    assert last(going.scene)["velocity_b_x"] > 0.3
