"""Obstacles from files in explicit steps: against closed forms, conservation laws, Coulomb's law and intersections."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import meshio
import numpy as np
import numpy.typing as npt
import pytest

from fracsim.contact.penalty_contact import PenaltyMeshContact
from fracsim.contact.pose import Pose
from fracsim.contact.triangle_mesh_shape import is_inside
from fracsim.scene import Scene
from support.resumed import assert_alike, going_stopped_resumed
from support.scenes import Walk, each_step, make_scene, positions
from support.torn import RUNS
from test_mesh_obstacles import CUBE, SOFT, block, last, mean_velocity
from test_penalty_edges import ROOF, ROOF_SIDES, tilted_bar

trimesh = pytest.importorskip("trimesh", reason="an environment made without a network")

Values = npt.NDArray[np.float64]
EXPLICIT = {"scheme": "explicit", "step": 5e-3}


def term_of(scene: Scene) -> PenaltyMeshContact:
    (found,) = [term for term in scene.balance.terms if isinstance(term, PenaltyMeshContact)]
    return found


def falling(obstacle: dict[str, Any], velocity: list[float], end: float, **tables: Any) -> tuple[Scene, Walk]:
    """A soft cube of 1 m that moves at `velocity` towards an obstacle."""
    return make_scene(**{
        "mesh": CUBE, "material": SOFT, "obstacle": [obstacle], "initial": {"velocity": velocity},
        "contact": {"itself": False, "distance": 0.02}, "time": EXPLICIT | {"end": end},
    } | tables)  # fmt: skip


def deepest(term: PenaltyMeshContact) -> float:
    """How deep points of the body lie in the obstacle, or its points in the body: by trimesh, m."""
    x, surface = term._end_positions(), term.surface.current
    assert x is not None
    mesh = surface.parts[0].mesh
    body = trimesh.Trimesh(x, surface.elements, process=False)
    obstacle = trimesh.Trimesh(mesh.positions, mesh.triangles, process=False)
    depths = [0.0]
    for points, within in ((x, obstacle), (mesh.positions, body)):
        inside = is_inside(points, np.asarray(within.triangles))
        if inside.any():
            depths += list(trimesh.proximity.closest_point_naive(within, points[inside])[1])
    return float(max(depths))


def test_a_point_over_a_facet_and_a_facet_over_a_point(tmp_path: Path) -> None:
    """k (D - g) along the normal, on the nodes by the barycentric coordinates: of a node of the body over the middle of
    a large triangle, and of the tip of a pyramid under a face of the body."""
    scene, _ = falling(
        block(tmp_path, (9.0, 9.0, 1.0)) | {"at": [0.9, 0.7, -0.51]},
        [0.0] * 3,
        0.1,
        contact={"itself": False, "distance": 0.005},
    )
    term = term_of(scene)
    surface = term.surface.current
    x, part = surface.rest_positions.copy(), surface.parts[0]
    lowest = np.flatnonzero(x[:, 2] == x[:, 2].min())
    x[lowest, 2] -= 0.007  # 0.003 apart, of 0.005
    contacts = part.pairs.contacts(part.points(x))
    own = (contacts.points[:, 0] < len(x)) & (contacts.gap < 0.004)
    np.testing.assert_array_equal(np.sort(contacts.points[own, 0]), lowest)
    np.testing.assert_allclose(contacts.gap[own], 0.003)
    only = contacts.select(own).gradient(term.law.distance, len(x) + len(part.mesh.points))
    np.testing.assert_allclose(-only[contacts.points[own, 0], 2], contacts.stiffness[own] * 0.002)
    np.testing.assert_allclose(only.sum(axis=0), 0.0, atol=1e-12)


@pytest.mark.parametrize("speed", (pytest.param(0.5, marks=pytest.mark.slow), 1.0, 2.0))
def test_a_body_bounces_off_a_held_block(speed: float, tmp_path: Path) -> None:
    """Energy to 2 %; the impulse is what changes the momentum; depths by trimesh below half an edge times v / c."""
    scene, state = falling(block(tmp_path) | {"at": [0.45, 0.55, -0.55]}, [0.0, 0.0, -speed], 0.27 + 0.03 / speed)
    term, m = term_of(scene), scene.balance.mass.lumped.sum() / 3
    impulse, force, began, depth = 0.0, 0.0, 0.5 * m * speed**2, 0.0
    for report in each_step(scene, state):
        new = last(scene)["contact_block_z"]
        impulse, force = impulse - report.dt * (force + new) / 2, new
        assert report.kinetic + report.elastic == pytest.approx(began, rel=0.02)
        assert m * (mean_velocity(scene, state)[2] + speed) == pytest.approx(impulse, abs=1e-9 * m)
        depth = max(depth, deepest(term))
    assert mean_velocity(scene, state)[2] > 0.6 * speed
    assert depth < 0.25 * speed / 10.0


def test_a_ridge_from_a_file_does_not_cut_an_edge(tmp_path: Path) -> None:
    """A body on edge falls across the ridge of a roof, with no point of either near the other: it comes off again."""
    meshio.Mesh(ROOF, [("triangle", ROOF_SIDES.astype(np.int32))]).write(tmp_path / "roof.stl")
    X, cells = tilted_bar()
    X = X + np.array([0.03, 0.07, 0.25 * np.sqrt(0.5) + 0.05])
    meshio.Mesh(X, [("tetra", cells)]).write(tmp_path / "body.vtu")
    roof = {"name": "roof", "shape": "mesh", "file": str(tmp_path / "roof.stl"), "at": [0.0, 0.0, 0.0], "friction": 0.0}
    scene, state = falling(roof, [0.0, 0.0, -0.5], 0.4, mesh={"file": str(tmp_path / "body.vtu")})
    began = 0.125 * scene.balance.mass.lumped.sum() / 3
    for report in each_step(scene, state):
        assert report.kinetic + report.elastic == pytest.approx(began, rel=0.02)
    assert mean_velocity(scene, state)[2] > 0.05


@pytest.mark.parametrize(("mass", "friction"), [(0.3, 0.0), (0.3, 0.4), (200.0, 0.0), (200.0, 0.4)])
def test_an_isolated_pair_keeps_its_momenta_and_energy(mass: float, friction: float, tmp_path: Path) -> None:
    """A spinning block from a file hits a body: linear and angular momentum, and with what friction takes the energy.
    Friction acts across the gap, which turns the pair a little."""
    striker = block(tmp_path, (0.5, 0.4, 0.3)) | {
        "at": [0.6, 0.45, -0.3], "mass": mass, "velocity": [0.3, 0.0, 1.0], "spin": [0.4, 0.5, 0.2],
        "friction": friction,
    }  # fmt: skip
    scene, state = falling(striker, [0.0] * 3, 0.4)
    (bodies,) = [term for term in scene.balance.terms if term.name == "rigid"]
    m = scene.balance.mass.lumped.reshape(-1, 3)

    def momenta() -> tuple[Values, Values]:
        v, motion = state.v.reshape(-1, 3), bodies.free[0].motion
        x, p = positions(scene) + state.u.reshape(-1, 3), motion.momentum
        angular = np.cross(x, m * v).sum(axis=0) + np.cross(motion.pose.centre, p[:3]) + p[3:]
        return (m * v).sum(axis=0) + p[:3], angular

    (linear, angular), began = momenta(), None
    for report in each_step(scene, state):
        total = report.kinetic + report.elastic + state.dissipated
        began = began or total
        assert total == pytest.approx(began, rel=0.02 if mass > 1 else 0.06)
        now = momenta()
        np.testing.assert_allclose(now[0], linear, atol=1e-11 * abs(linear).max())
        np.testing.assert_allclose(now[1], angular, atol=(0.01 if friction else 1e-11) * np.linalg.norm(angular))
    assert abs(mean_velocity(scene, state)[2]) > 1e-3 and (state.dissipated > 0) == (friction > 0)


@pytest.mark.parametrize(("share", "sticks"), [pytest.param(1.2, True, marks=pytest.mark.slow), (0.8, False)])
def test_on_a_slope_it_sticks_or_slides(share: float, sticks: bool, tmp_path: Path) -> None:
    """tan(theta) = 0.5 and mu = `share` of it, on a plate from a file: it stays, or slides with g (sin - mu cos)."""
    slope = 0.5
    along, down = np.array([slope, -1.0]) / np.hypot(1, slope) * 9.81
    plate = block(tmp_path, (4.0, 2.0, 0.4)) | {"at": [1.45, 0.55, -0.22], "friction": share * slope}
    scene, state = falling(
        plate, [0.0] * 3, 1.0 if sticks else 0.5, material=SOFT | {"young": 1e6, "density": 1000.0},
        load={"gravity": [along, 0.0, down]}, damping={"mass": 20.0 * sticks, "stiffness": 1e-3},
        contact={"itself": False, "distance": 0.02},
    )  # fmt: skip
    m, path = scene.balance.mass.lumped[::3], []
    for _ in each_step(scene, state):
        path.append((state.t, float(m @ state.u[::3]) / m.sum()))
    t, way = np.array(path).T
    if sticks:
        assert np.ptp(way[t > 0.8]) < 1e-4 and way[-1] < 0.015
    else:
        late = t > 0.2
        assert 2 * np.polyfit(t[late], way[late], 2)[0] == pytest.approx(along + share * slope * down, rel=0.05)


def test_the_work_of_a_turning_driven_obstacle_is_in_the_books(tmp_path: Path) -> None:
    """A block that rises, turns and rubs: what it does is stored, moves, or is lost to friction."""
    turning = block(tmp_path, (1.5, 1.5, 0.5)) | {
        "at": [0.5, 0.5, -0.28], "velocity": [0.0, 0.0, 0.5], "spin": [0.0, 0.0, 3.0], "friction": 0.3,
    }  # fmt: skip
    scene, state = falling(turning, [0.0] * 3, 0.3)
    work = 0.0
    for report in each_step(scene, state):
        work += last(scene)["work_block"]
        missing = work - report.kinetic - report.elastic - state.dissipated
        assert abs(missing) < 0.02 * max(work, 1.0)
    assert work > 10.0 and state.dissipated > 0.05 * work
    assert state.work == pytest.approx(work)


@pytest.mark.slow
def test_a_small_ball_from_a_file_does_not_pass_between_points(tmp_path: Path) -> None:
    """A ball is thrown at the middle of a facet: its own points press the facet, so that it comes off again."""
    trimesh.creation.icosphere(subdivisions=3, radius=0.2).export(tmp_path / "ball.stl")
    thrown = {"name": "ball", "shape": "mesh", "file": str(tmp_path / "ball.stl"), "at": [0.3, 0.2, -0.23],
              "velocity": [0.0, 0.0, 0.5], "mass": 20.0}  # fmt: skip
    scene, state = falling(thrown, [0.0] * 3, 0.6)
    depth = 0.0
    for report in each_step(scene, state):
        depth = max(depth, deepest(term_of(scene)))
        assert report.kinetic + report.elastic == pytest.approx(2.5, rel=0.02)
    assert last(scene)["velocity_ball_z"] < 0 and depth < 0.05


def test_the_step_is_that_of_the_bound(tmp_path: Path) -> None:
    """The default leaves at least 0.8 of the stable step; a light free obstacle, or a given stiffness, takes more."""
    steps = []
    for more, contact in (({"at": [5.0, 5.0, 5.0]}, {}), ({}, {}), ({}, {"stiffness": 1e6}), ({"mass": 0.5}, {})):
        obstacle = block(tmp_path) | {"at": [0.5, 0.5, -0.53]} | more
        time = EXPLICIT | {"step": 1.0, "end": 10.0}
        _, state = falling(
            obstacle, [0.0, 0.0, -1.0], 0.0, time=time, contact={"itself": False, "distance": 0.02} | contact
        )
        steps.append(min(state.advance().dt for _ in range(4)))
    assert 0.75 * steps[0] < steps[1] < 0.95 * steps[0]
    assert steps[2] < 0.5 * steps[0] and steps[3] < 0.6 * steps[0]


@pytest.mark.slow
def test_a_restart_goes_on_as_the_run_would_have(tmp_path: Path) -> None:
    """An axe that breaks a body, and rubs: stopped in touch and resumed, the same but for round-off."""
    hewn = RUNS["hewn"]
    obstacle = [entry | {"velocity": [0.0, 0.05, -0.1]} for entry in hewn["obstacle"]]
    tables: dict[str, Any] = hewn | {
        "time": {"scheme": "explicit", "step": 0.05, "end": 9.0}, "output": {"picture": False, "interval": 1.0},
        "obstacle": obstacle, "fracture": {"strength": 0.01, "radius": 0.2},
    }  # fmt: skip
    going, broken, again = going_stopped_resumed(tables, tmp_path, 32, 8)
    assert broken > 5 and going.scene.probes().any()
    assert_alike(again, going, 1e-9)


def test_poses_are_those_of_the_path(tmp_path: Path) -> None:
    """A step of a body far from a driven obstacle asks for no positions, and does no work."""
    scene, state = falling(block(tmp_path) | {"at": [9.0, 9.0, 9.0], "velocity": [1.0, 0.0, 0.0]}, [0.0] * 3, 0.02)
    for _ in each_step(scene, state):
        pass
    term = term_of(scene)
    assert term.state.is_idle() and last(scene)["work_block"] == 0
    np.testing.assert_allclose(term._all_meshes[0].pose.centre, Pose.at_point(np.array([9.02, 9.0, 9.0])).centre)
