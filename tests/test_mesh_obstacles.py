"""Obstacles whose surface is read from a file, against closed forms, conservation laws and the analytic shapes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import meshio
import numpy as np
import numpy.typing as npt
import pytest
from mpi4py import MPI

from fracsim.contact.mesh_obstacle_term import MeshObstacleTerm
from fracsim.contact.mesh_obstacles import BarrierPart, MeshObstacle
from fracsim.contact.pose import Pose, PosedShape
from fracsim.contact.retractable_surface import RetractableSurface
from fracsim.contact.rigid_pose import FreePose
from fracsim.contact.self_contact import BarrierBodySurface
from fracsim.contact.shapes import RoundedBox
from fracsim.contact.triangle_mesh_shape import (
    TriangleMeshShape,
    is_inside,
    penetration_depth,
    refine_triangles,
    surface_distances,
)
from fracsim.deformable_run import Run
from fracsim.errors import InputError
from fracsim.scene import Scene, build_scene
from fracsim.study.check import check_study
from support.resumed import assert_alike, going_stopped_resumed
from support.scenes import Walk, each_step, make_scene, make_study, march, positions
from support.torn import RUNS
from support.vtu import points_of

Values = npt.NDArray[np.float64]

FINE = {"snes_rtol": 1e-9, "ksp_rtol": 1e-9}
SOFT = {"energy": "neo-hookean", "young": 1e4, "poisson": 0.3, "density": 100.0}
CUBE = {"builder": "box", "size": [1.0, 1.0, 1.0], "h": 0.5}
G = 10.0
CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
SIDES = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6],
                  [0, 6, 4], [1, 5, 7], [1, 7, 3]])  # fmt: skip


def block(folder: Path, size: tuple[float, float, float] = (2.0, 2.0, 1.0), kind: str = "stl") -> dict[str, Any]:
    """An obstacle read from a file of twelve triangles."""
    meshio.Mesh(CORNERS * size, [("triangle", SIDES.astype(np.int32))]).write(folder / f"block.{kind}")
    return {"name": "block", "shape": "mesh", "file": str(folder / f"block.{kind}")}


def last(scene: Scene) -> dict[str, float]:
    """The columns of the obstacle after a step."""
    return dict(zip(scene.probes.columns, scene.probes().tolist(), strict=True))


def mean_velocity(scene: Scene, state: Walk) -> Values:
    m = scene.balance.mass.lumped.reshape(-1, 3)
    return np.asarray((m * state.v.reshape(-1, 3)).sum(axis=0) / m[:, 0].sum())


# --- triangles ------------------------------------------------------------------------------------------------------


def test_refined_triangles_are_small_and_enclose_the_same() -> None:
    """No side is longer than asked for; the surface is closed, of the same area and volume, and holds its corners."""
    X = CORNERS * [3.0, 2.0, 0.1]
    points, triangles = refine_triangles(X, SIDES, 0.23)
    sides = points[triangles] - points[np.roll(triangles, 1, axis=1)]
    assert np.linalg.norm(sides, axis=2).max() <= 0.23
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).sum() / 2
    assert area == pytest.approx(2 * (3 * 2 + 3 * 0.1 + 2 * 0.1))
    assert TriangleMeshShape(points, triangles).volume == pytest.approx(3 * 2 * 0.1)
    edges = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    assert np.all(np.unique(edges, axis=0, return_counts=True)[1] == 2)
    assert np.array_equal(points[:8], X)


def test_distance_and_depth_are_those_of_a_box() -> None:
    """To a box of triangles, against the signed distance of the box (all but sharp); by how far two boxes overlap."""
    x = np.random.default_rng(1).uniform(-1.0, 1.0, (400, 3))
    box = RoundedBox((1.0, 0.6, 0.8), rounding=1e-9)
    corners = (CORNERS * [1.0, 0.6, 0.8])[SIDES]
    signed = np.where(is_inside(x, corners), -1.0, 1.0) * surface_distances(x, corners)
    np.testing.assert_allclose(signed, box.distance(x), atol=1e-8)
    fine = refine_triangles(CORNERS, SIDES, 0.3)
    for way, cut, deep in (([0.0, 0.3, 0.93], True, 0.07), ([0.0, 0.0, 1.01], False, None)):
        found = penetration_depth((fine[0] + way, fine[1]), (CORNERS, SIDES), cut=cut)
        assert found == (None if deep is None else pytest.approx(deep))
    assert penetration_depth((0.2 * CORNERS, SIDES), (CORNERS, SIDES), cut=False) == pytest.approx(0.4)


@pytest.mark.parametrize("scale", [1.0, 1e-3, 1e-30])
def test_a_coarse_solid_that_turns_is_not_stopped_by_a_small_body(scale: float) -> None:
    """The solid turns beside a body whose edges are as long as its own, or shorter by `scale`, and touches nothing."""
    points, triangles = refine_triangles(CORNERS, SIDES, 0.4)
    x = scale * points + [2.0, 0.0, 0.0]
    solid = MeshObstacle("block", *refine_triangles(CORNERS, SIDES, 0.3), 0.0)
    part = BarrierPart.build(x, triangles, solid, distance=0.1 * scale, stiffness=50.0, edge=0.4 * scale)
    start = solid.pose
    solid.move_to(start.incremented(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.2])))
    assert part.free_fraction(x, x, start) == 1.0


def test_what_acts_on_a_solid_is_the_derivative_by_its_place() -> None:
    """Minus the sum of the forces on the body, against differences of the energy as the solid is moved; and the Hessian
    against those of the gradient."""
    points, triangles = refine_triangles(CORNERS, SIDES, 0.4)
    solid = MeshObstacle("block", *refine_triangles(CORNERS * [0.5, 0.4, 0.3] + [0.1, 0.05, 0.68], SIDES, 0.3), 0.0)
    part = BarrierPart.build(points, triangles, solid, distance=0.1, stiffness=50.0, edge=0.4)
    x, step = points + 0.01 * np.sin(30 * points), 1e-6
    moved = []
    for axis in range(3):
        ends = []
        for sign in (-1.0, 1.0):
            solid.move_to(Pose.at_point(sign * step * np.eye(3)[axis]))
            ends.append(part.energy(x))
        moved.append((ends[1] - ends[0]) / (2 * step))
    solid.move_to(Pose.at_point(np.zeros(3)))
    push = -part.gradient(x).sum(axis=0)
    assert abs(push[2]) > 1.0
    np.testing.assert_allclose(moved, push, atol=1e-6 * np.abs(push).max())
    way = np.cos(50 * x)
    ends = [part.gradient(x + sign * step * way) for sign in (-1.0, 1.0)]
    bent = (part.full_hessian(x, exact=True)[: x.size, : x.size] @ way.reshape(-1)).reshape(-1, 3)
    np.testing.assert_allclose((ends[1] - ends[0]) / (2 * step), bent, atol=1e-5 * np.abs(bent).max())


# --- impulse, rest, force -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", (pytest.param("backward-euler", marks=pytest.mark.slow), "generalized-alpha"))
def test_the_impulse_is_what_balances_momentum(scheme: str, tmp_path: Path) -> None:
    """A cube of jelly falls on a block: m v = sum of dt f - m g t, nothing below the block's face, no energy gained."""
    scene, state = make_scene(
        mesh=CUBE, material=SOFT, load={"gravity": [0.0, 0.0, -G]}, solver=FINE,
        obstacle=[block(tmp_path) | {"at": [0.5, 0.5, -0.55], "friction": 0.3}],
        time={"scheme": scheme, "step": 0.03, "end": 0.24},
    )  # fmt: skip
    impulse, touched = np.zeros(3), 0
    for report in each_step(scene, state):
        found = last(scene)
        force = -np.array([found[f"contact_block_{axis}"] for axis in "xyz"])
        impulse, touched = impulse + report.dt * force, touched + (force[2] > 0)
        assert (positions(scene) + state.u.reshape(-1, 3))[:, 2].min() > -0.05
        assert report.kinetic + report.elastic + state.dissipated < state.work + 1e-4
    np.testing.assert_allclose(100 * mean_velocity(scene, state), impulse - [0, 0, 100 * G * state.t], atol=1e-4)
    assert touched > 3 and impulse[2] > 200


def test_a_body_at_rest_is_carried(tmp_path: Path) -> None:
    """Laid on a block of a file in centimetres, damped to rest: the load cell reads m g to 1e-6."""
    scene, state = make_scene(
        mesh=CUBE, material=SOFT, load={"gravity": [0.0, 0.0, -G]}, damping={"mass": 10.0}, solver=FINE,
        obstacle=[block(tmp_path, (200.0, 200.0, 100.0), "obj") | {"at": [0.5, 0.5, -0.52], "scale": 0.01}],
        time={"scheme": "backward-euler", "step": 0.5, "end": 5.0},
    )  # fmt: skip
    march(scene, state)
    found = last(scene)
    assert found["contact_block_z"] == pytest.approx(-100 * G, rel=1e-6)
    assert abs(found["contact_block_x"]) < 1e-4 * 100 * G and 0 < found["gap_block"] < 0.03


@pytest.mark.parametrize("order", [1, 2])
def test_it_presses_as_the_analytic_shape_does(tmp_path: Path, order: int) -> None:
    """A block driven down on a body, and a plane: forces by both sorts of barrier within 1 %, gaps within their
    distance; the work of the block is what the body takes up."""
    forces, way = [], {"time": [0.0, 1.0], "value": [[0.0, 0.0, 0.0], [0.0, 0.0, -0.2]]}
    plane = {"name": "block", "shape": "plane", "normal": [0.0, 0.0, -1.0]}
    mesh = CUBE | {"order": order, "h": 0.5 * order}  # as many nodes
    for shape, high in ((plane, 0.0), (block(tmp_path), 0.5)):
        scene, state = make_scene(
            mesh=mesh, material=SOFT, boundary=[{"on": "bottom", "fix": "xyz"}], solver=FINE,
            obstacle=[shape | {"at": [0.5, 0.5, 1.002 + high], "displacement": way}],
            contact={"itself": False, "distance": 2e-3}, time={"scheme": "quasi-static", "step": 0.25, "end": 1.0},
        )  # fmt: skip
        done = 0.0
        stored = [report.elastic for report in each_step(scene, state) if (done := done + last(scene)["work_block"])]
        forces.append(last(scene)["contact_block_z"])
        assert 0 < last(scene)["gap_block"] < 2e-3
    assert forces[0] > 500 and forces[0] == pytest.approx(forces[1], rel=0.01)
    assert state.work == pytest.approx(done) and done == pytest.approx(stored[-1], rel=0.1)


@pytest.mark.slow
def test_a_striker_far_faster_than_its_steps_does_not_tunnel(tmp_path: Path) -> None:
    """A block of 0.3 m at 100 m/s, steps of 10 ms: it would cross the cube in one, cuts nothing, and takes it along
    (by 1.0 m in these steps, by 1.5 in twenty times as many)."""
    scene, state = make_scene(
        mesh=CUBE, material=SOFT | {"young": 1e6},
        obstacle=[block(tmp_path, (0.3, 0.3, 0.3)) | {"at": [0.5, 0.5, 1.3], "velocity": [0.0, 0.0, -100.0]}],
        time={"scheme": "backward-euler", "step": 0.01, "end": 0.02},
    )  # fmt: skip
    (term,) = [each for each in scene.balance.terms if each.name == "solids"]
    for _ in each_step(scene, state):
        assert len(term.surface.current.parts[0].cut_elements(term.end_positions())) == 0
    x = positions(scene) + state.u.reshape(-1, 3)
    assert x[:, 2].mean() < 0.5 - 0.9 and mean_velocity(scene, state)[2] < -50


@pytest.mark.slow
@pytest.mark.parametrize("mu", (0.25, 0.35))
def test_on_a_slope_it_sticks_or_slides_as_coulomb_says(mu: float, tmp_path: Path) -> None:
    """tan = 0.3: beyond it the block stays, below it slides by g (sin - mu cos), and mu N times its way is lost."""
    slope = np.arctan(0.3)
    scene, state = make_scene(
        mesh=CUBE, material=SOFT | {"young": 1e6}, load={"gravity": [G * np.sin(slope), 0.0, -G * np.cos(slope)]},
        obstacle=[block(tmp_path, (4.0, 2.0, 1.0)) | {"at": [1.0, 0.5, -0.525], "friction": mu}], solver=FINE,
        time={"scheme": "backward-euler", "step": 0.025, "end": 0.5}, contact={"itself": False, "creep": 1e-3},
    )  # fmt: skip
    ends = []
    for _ in each_step(scene, state):
        ends.append((state.t, mean_velocity(scene, state)[0], state.dissipated))
    (t0, v0, lost0), (t1, v1, lost1) = ends[-5], ends[-1]
    if mu > 0.3:
        assert abs(v1) < 2e-3
    else:
        assert (v1 - v0) / (t1 - t0) == pytest.approx(G * (np.sin(slope) - mu * np.cos(slope)), rel=0.01)
        way = 0.5 * (v0 + v1) * (t1 - t0)
        assert lost1 - lost0 == pytest.approx(mu * 100 * G * np.cos(slope) * way, rel=0.05)


@pytest.mark.parametrize("order", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_walls_that_come_to_light_are_outside(order: int) -> None:
    """A body broken by an axe: no corner of its walls is in the axe, and none of its elements is cut, in any step."""
    scene, state = make_scene(**RUNS["hewn"] | {"mesh": RUNS["hewn"]["mesh"] | {"order": order}})
    (term,) = [each for each in scene.balance.terms if each.name == "solids"]
    broken, drawn_in = 0, 0
    for report in each_step(scene, state):
        broken += report.broken
        x, facing = term.end_positions(), term.surface.current.parts[0]
        assert len(facing.cut_elements(x)) == 0
        used = np.unique(term.surface.current.elements[term.surface.current.remaining()])
        assert not is_inside(x[used], facing.mesh.positions[facing.mesh.triangles]).any()
        drawn_in += int((term.surface.current.point_map.share < 1).sum())
    assert broken > 5 and drawn_in > 0


def test_walls_are_extended_at_the_start_of_a_step_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Passes after edges broke begin at the same displacement with another surface, which stays as it is."""
    scene, state = make_scene(**RUNS["hewn"] | {"fracture": RUNS["hewn"]["fracture"] | {"passes": 4}})
    surfaces: dict[bytes, set[RetractableSurface[BarrierPart]]] = {}

    def extend_faces(surface: BarrierBodySurface, u: Values) -> None:
        surfaces.setdefault(u.tobytes(), set()).add(surface.current)

    (term,) = [term for term in scene.balance.terms if isinstance(term, MeshObstacleTerm)]
    first = term.surface.current
    monkeypatch.setattr(BarrierBodySurface, "extend_faces", extend_faces)
    march(scene, state)
    assert term.surface.current is not first and len(surfaces) == 4
    assert all(len(extended) == 1 for extended in surfaces.values())


@pytest.mark.slow
def test_a_restart_goes_on_as_the_run_would_have(tmp_path: Path) -> None:
    """Stopped after edges broke, and resumed: the same cracks, energies and forces, walls drawn in as they were."""
    time = {"scheme": "backward-euler", "step": 0.05, "end": 1.0}
    tables = RUNS["hewn"] | {"time": time, "solver": FINE, "output": {"picture": False, "interval": 9.0}}
    going, broken, again = going_stopped_resumed(tables, tmp_path, 6, 2)
    assert broken > 5
    assert_alike(again, going, 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("itself", (True, "pieces"))
def test_beside_contact_of_the_body_with_itself(itself: bool | str) -> None:
    """Both hold in the same steps: nothing of the body cuts the axe, nor, where it feels itself, itself."""
    scene, state = make_scene(**RUNS["hewn"] | {"contact": {"itself": itself}})
    terms = {each.name: each for each in scene.balance.terms}
    for _ in each_step(scene, state):
        for name in ("solids", "contact"):
            x = terms[name].end_positions()
            assert not any(len(cut) for cut in terms[name].surface.current.cut_elements(x))


# --- free, and turning ----------------------------------------------------------------------------------------------


def test_moments_are_those_of_a_box() -> None:
    """Centre and inertia of twelve triangles about a point elsewhere: m (b^2 + c^2) / 12, and Steiner's share."""
    size, off = np.array([0.5, 0.4, 0.3]), np.array([0.7, -0.2, 0.1])
    solid = TriangleMeshShape(CORNERS * size + off, SIDES)
    mass = 7.0 * size.prod()
    own = np.diag(mass / 12 * (size @ size - size**2))
    np.testing.assert_allclose(solid.centre, off, atol=1e-14)
    away = mass * ((off @ off) * np.eye(3) - np.outer(off, off))
    np.testing.assert_allclose(solid.inertia(7.0), own + away, atol=1e-13)


def free_solid(scene: Scene) -> tuple[MeshObstacleTerm, FreePose]:
    (term,) = [each for each in scene.balance.terms if isinstance(each, MeshObstacleTerm)]
    return term, term.group.bodies.free[0]


def momenta(scene: Scene, state: Walk) -> tuple[Values, Values]:
    """(3,) linear and angular momentum about the origin of body and obstacle."""
    flight, m = free_solid(scene)[1].motion, scene.balance.mass.lumped.reshape(-1, 3)
    x, v, p = positions(scene) + state.u.reshape(-1, 3), state.v.reshape(-1, 3), flight.momentum
    return (m * v).sum(axis=0) + p[:3], np.cross(x, m * v).sum(axis=0) + np.cross(flight.pose.centre, p[:3]) + p[3:]


def thrown(folder: Path, **more: Any) -> dict[str, Any]:
    """A block of 20 kg on its way to a cube of jelly of 100 kg that nothing holds."""
    block_ = block(folder, (0.5, 0.4, 0.3)) | {"at": [0.55, 0.5, 1.2], "mass": 20.0} | more
    return {"mesh": CUBE, "material": SOFT, "solver": FINE, "obstacle": [block_]}


def test_what_is_pushed_by_a_body_is_the_derivative_by_its_pose(tmp_path: Path) -> None:
    """Gradient and Hessian of what a free solid feels, with friction and turned already, against differences."""
    tables = thrown(tmp_path, at=[0.55, 0.5, 1.155], velocity=[0.3, 0.0, -0.2], spin=[0.5, 1.0, 2.0], friction=0.4)
    scene, state = make_scene(**tables, time={"scheme": "backward-euler", "step": 0.01, "end": 0.01})
    march(scene, state)
    scene.balance.begin_step(state.t + 0.01, 0.01, state.u, state.v, state.a)
    scene.balance.set_displacement(state.u)
    term, solid = free_solid(scene)
    z, h = 1e-3 * np.array([1.0, -2.0, 1.0, 3.0, 1.0, -2.0]), 1e-6
    term.group.bodies._unknowns.move_to([z])
    here, pose, ends = term.pose_contact.pose_derivatives(exact=True)[0], solid.posed.pose, []
    assert here.energy > 0 and term.friction is not None and np.abs(here.gradient).min() > 0
    for q in np.concatenate([h * np.eye(6), -h * np.eye(6)]):
        term.group.bodies.posed[0] = PosedShape(solid.posed.shape, pose.incremented(q))
        term.poses_moved()
        ends.append(((found := term.pose_contact.pose_derivatives(exact=True)[0]).energy, found.gradient))
    slope = np.array([(ends[k][0] - ends[k + 6][0]) / (2 * h) for k in range(6)])
    np.testing.assert_allclose(here.gradient, slope, atol=1e-5 * np.abs(slope).max())
    bent = np.array([(ends[k][1] - ends[k + 6][1]) / (2 * h) for k in range(6)])
    np.testing.assert_allclose(here.hessian, (bent + bent.T) / 2, atol=1e-4 * np.abs(bent).max())


def test_an_isolated_pair_keeps_its_momenta(tmp_path: Path) -> None:
    """A spinning block thrown on the cube: m v of both to the solver's tolerance, angular momentum but for what
    backward Euler loses in turning (of first order in the step); no energy from nothing, nothing cut in any step."""
    tables = thrown(tmp_path, velocity=[0.2, 0.0, -2.0], spin=[1.0, 0.5, 0.2])
    scene, state = make_scene(**tables, time={"scheme": "backward-euler", "step": 0.01, "end": 0.08})
    (linear, angular), (term, _) = momenta(scene, state), free_solid(scene)
    held = term.group.bodies.motions.kinetic_energy()
    for report in each_step(scene, state):
        now = momenta(scene, state)
        np.testing.assert_allclose(now[0], linear, atol=1e-9 * 40)
        np.testing.assert_allclose(now[1], angular, atol=4e-3 * np.linalg.norm(angular))
        assert report.kinetic + report.elastic < held * (1 + 1e-9)
        held = report.kinetic + report.elastic
        assert len(term.surface.current.parts[0].cut_elements(term.end_positions())) == 0
    found = last(scene)
    assert found["velocity_block_z"] > -0.5 and abs(found["spin_block_y"] - 0.5) > 0.3
    assert found["position_block_x"] == pytest.approx(0.55 + 0.08 * 0.2, rel=0.05)


def test_a_weight_dropped_on_a_body_comes_to_rest(tmp_path: Path) -> None:
    """Guided, on a damped cube that is held: contact has given it m v + m g t in all, and carries m g in the end."""
    tables = thrown(tmp_path, guide="z", velocity=[0.0, 0.0, -1.0], mass=None, density=20.0 / 0.06)
    scene, state = make_scene(
        **tables | {"material": SOFT | {"young": 1e5}}, boundary=[{"on": "bottom", "fix": "xyz"}],
        load={"gravity": [0.0, 0.0, -G]}, damping={"stiffness": 0.02},
        time={"scheme": "backward-euler", "step": 0.04, "end": 1.2},
    )  # fmt: skip
    impulse = sum(last(scene)["contact_block_z"] * report.dt for report in each_step(scene, state))
    found = last(scene)
    assert impulse == pytest.approx(20.0 * 1.0 + 20.0 * G * state.t, rel=1e-3)
    assert abs(found["velocity_block_z"]) < 1e-3 and found["position_block_x"] == 0.55
    assert found["contact_block_z"] == pytest.approx(20.0 * G, rel=1e-3)


def test_a_free_solid_beside_a_plane_that_is_held(tmp_path: Path) -> None:
    """Falls freely, away from both: the plane is held, though something is free."""
    tables = thrown(tmp_path, at=[3.0, 0.5, 1.0])
    tables["obstacle"].append({"name": "floor", "shape": "plane", "at": [0.0, 0.0, -0.6], "normal": [0.0, 0.0, 1.0]})
    scene, state = make_scene(
        **tables, load={"gravity": [0.0, 0.0, -G]}, boundary=[{"on": "bottom", "fix": "xyz"}],
        time={"scheme": "backward-euler", "step": 0.02, "end": 0.8},
    )  # fmt: skip
    before = last(scene)["velocity_block_z"]
    march(scene, state, 2)
    assert last(scene)["velocity_block_z"] - before == pytest.approx(-G * 0.04)


@pytest.mark.slow
def test_a_free_solid_rests_on_a_floor_and_hangs_on_a_hinge(tmp_path: Path) -> None:
    """Away from the body: dropped on a plane, turned, it comes to lie flat on it; a quarter of a swing on a hinge takes
    the energy that it falls by, m g l, into its spin: I w^2 / 2 (Newmark's, 1 %)."""
    floor = {"name": "floor", "shape": "plane", "at": [0.0, 0.0, -0.6], "normal": [0.0, 0.0, 1.0]}
    common = {"load": {"gravity": [0.0, 0.0, -G]}, "boundary": [{"on": "bottom", "fix": "xyz"}]}
    tables = thrown(tmp_path, at=[3.0, 0.5, -0.3], spin=[0.0, 2.0, 0.0])
    tables["obstacle"].append(floor)
    scene, state = make_scene(**tables | common, time={"scheme": "backward-euler", "step": 0.02, "end": 0.8})
    lowest = [_lowest(free_solid(scene)[1]) for _ in each_step(scene, state)]
    found = last(scene)
    assert min(lowest) > -0.6 and found["position_block_z"] == pytest.approx(-0.45, abs=0.02)
    assert abs(found["turn_block_y"]) < 1e-3 and abs(found["velocity_block_z"]) < 1e-2
    hinge = {"point": [3.0, 0.5, 5.0], "axis": [0.0, 1.0, 0.0]}
    tables = thrown(tmp_path, at=[4.0, 0.5, 5.0], hinge=hinge)
    scene, state = make_scene(**tables | common, time={"scheme": "newmark", "step": 0.01, "end": 0.5})
    for _ in each_step(scene, state):
        found = last(scene)
        turned = found["turn_block_y"]
        w = np.sqrt(2 * 20 * G * np.sin(turned) / (20 * (1.0 + (0.25 + 0.09) / 12)))
        assert found["spin_block_y"] == pytest.approx(w, rel=0.01)
    assert turned > 0.9


def _lowest(solid: FreePose) -> float:
    return float(solid.motion.pose.points_to_space(solid.body.shape.tessellate()[0])[:, 2].min())


@pytest.mark.slow
def test_a_ball_from_a_file_goes_as_the_ball_does(tmp_path: Path) -> None:
    """An icosphere thrown on the cube off its middle, and a ball: what the body gives them differs by 6 % at most (the
    corner that meets it first is not quite below its centre: it takes a spin of a few percent as well)."""
    pyvista = pytest.importorskip("pyvista")
    made = pyvista.Icosphere(radius=0.3, nsub=3)
    made.save(tmp_path / "ball.stl")
    given = []
    for shape in ({"shape": "mesh", "file": str(tmp_path / "ball.stl")}, {"shape": "sphere", "radius": 0.3}):
        it = {"name": "it", "at": [0.52, 0.47, 1.32], "velocity": [0.3, 0.0, -2.0], "mass": 100 * made.volume}
        scene, state = make_scene(
            mesh=CUBE, material=SOFT | {"young": 1e5}, solver=FINE, obstacle=[it | shape],
            contact={"itself": False, "distance": 0.02}, time={"scheme": "backward-euler", "step": 4e-3, "end": 0.08},
        )  # fmt: skip
        march(scene, state)
        given.append(np.array([last(scene)[f"velocity_it_{axis}"] for axis in "xyz"]) - [0.3, 0.0, -2.0])
    assert given[1][2] > 2.3
    np.testing.assert_allclose(given[0], given[1], atol=0.06 * given[1][2])


@pytest.mark.slow
def test_a_free_striker_far_faster_than_its_steps_does_not_tunnel(tmp_path: Path) -> None:
    """A block of 100 kg at 100 m/s, steps of 10 ms: no facet is cut, and both go on with its momentum."""
    tables = thrown(tmp_path, at=[0.5, 0.5, 1.3], mass=100.0, velocity=[0.0, 0.0, -100.0])
    tables["material"] = SOFT | {"young": 1e6}
    scene, state = make_scene(**tables, time={"scheme": "backward-euler", "step": 0.01, "end": 0.02})
    term, _ = free_solid(scene)
    for _ in each_step(scene, state):
        np.testing.assert_allclose(momenta(scene, state)[0], [0.0, 0.0, -1e4], atol=1e-4)
        assert len(term.surface.current.parts[0].cut_elements(term.end_positions())) == 0
    assert mean_velocity(scene, state)[2] < -40


def test_a_driven_one_turns_and_drags(tmp_path: Path) -> None:
    """A block that turns at 2 rad/s over a cube, and grazes it: never cuts it, presses and drags it along, and what it
    does is what the body stores or friction takes."""
    scene, state = make_scene(
        mesh=CUBE, material=SOFT | {"young": 1e5}, boundary=[{"on": "bottom", "fix": "xyz"}], solver=FINE,
        obstacle=[block(tmp_path, (0.5, 0.4, 0.9)) | {"at": [0.3, 0.5, 1.5], "spin": [0.0, 2.0, 0.0], "friction": 0.3}],
        time={"scheme": "backward-euler", "step": 0.04, "end": 0.8},
    )  # fmt: skip
    (term,) = [each for each in scene.balance.terms if each.name == "solids"]
    forces = []
    for report in each_step(scene, state):
        assert len(term.surface.current.parts[0].cut_elements(term.end_positions())) == 0
        forces.append([last(scene)[f"contact_block_{axis}"] for axis in "xz"])
        assert report.kinetic + report.elastic + state.dissipated <= state.work * (1 + 1e-6) + 1e-9
    pressed = np.array(forces)
    assert pressed[:, 1].max() > 500 and abs(pressed[:, 0]).max() > 0.2 * pressed[:, 1].max()
    pose = term.group.bodies.posed_at(state.t)[0].pose
    np.testing.assert_allclose(pose.rotation_vector(), [0.0, 1.6, 0.0], atol=1e-12)
    assert last(scene)["gap_block"] > 0.1  # it is through


# --- what is written, and refused -----------------------------------------------------------------------------------


def test_it_is_drawn_and_told(tmp_path: Path) -> None:
    """Its columns, its triangles in surface.pvd where it is at the end, and what `check` says of it."""
    study = make_study(
        mesh=CUBE, material=SOFT, boundary=[{"on": "bottom", "fix": "xyz"}],
        obstacle=[block(tmp_path) | {"at": [0.5, 0.5, 1.6], "velocity": [0.0, 0.0, -0.5]}],
        time={"scheme": "backward-euler", "step": 0.1, "end": 0.1}, output={"picture": False},
    )  # fmt: skip
    said = "\n".join(check_study(study))
    assert "block (driven mesh)" in said and "block: 12 triangles, 2 x 2 x 1 m, 4 m^3" in said
    scene = build_scene(MPI.COMM_SELF, study)
    run = Run(scene, tmp_path / "out")
    run()
    (note,) = run.monitors.contact_monitor.notes(done=True)
    assert note.startswith("the obstacle block never met the body: it came no nearer than 0.0")
    points = points_of(sorted(tmp_path.glob("out/surface/obstacle_block_*.vtu"))[-1])
    np.testing.assert_allclose(points[:, 2].min(), 1.6 - 0.5 - 0.05, atol=1e-6)
    head = (tmp_path / "out" / "history.csv").read_text().splitlines()[0]
    assert all(f"{word}_block" in head for word in ("contact", "gap", "work"))


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"at": [0.5, 0.5, -0.49]}, "obstacle.0: block overlaps the body at the start, by 0[.]01 m; move it away"),
        ({"at": [0.5, 0.5, 0.5]}, "block overlaps the body at the start, by 0[.]5 m; move it away"),
        ({"file": "nowhere.stl"}, 'obstacle.0.file = "nowhere.stl": there is no such file'),
        ({"file": "empty.obj"}, "obstacle.0.file: .*empty.obj"),
        ({"file": "open.obj"}, "obstacle.0.file: .*is open: 3 edges belong to one triangle only"),
        ({"mass": 1.0, "density": 1.0}, "give mass or density, not both"),
        ({"guide": "z"}, "guide is for an obstacle that moves freely"),
        ({"radius": 1.0}, 'shape = "mesh" has no radius; remove it'),
    ],
)
def test_what_cannot_be_is_refused(
    more: dict[str, Any], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("empty.obj").write_text("v 0 0 0\n")
    Path("open.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises((InputError, ValueError), match=message):
        make_scene(mesh=CUBE, material=SOFT, obstacle=[block(tmp_path) | {"at": [0.5, 0.5, -0.6]} | more])


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"mesh": CUBE | {"size": [1.0, 1.0]}}, 'shape = "mesh": a 2D mesh has none; choose "box"'),
    ],
)
def test_scenes_that_have_none(tables: dict[str, Any], message: str, tmp_path: Path) -> None:
    obstacle = block(tmp_path) | {"at": [0.5, 0.5, -0.6][: len(tables.get("mesh", CUBE)["size"])]}
    with pytest.raises((InputError, ValueError), match=message):
        make_scene(**{"mesh": CUBE, "material": SOFT, "obstacle": [obstacle]} | tables)


def test_a_free_ball_bounces_on_a_held_solid(tmp_path: Path) -> None:
    """Dropped on the middle of a flat block from a file, beside the body: it never enters the block, and comes back."""
    held = block(tmp_path, (1.0, 1.0, 0.2)) | {"at": [3.0, 0.5, 0.0], "name": "table"}
    ball = {"name": "ball", "shape": "sphere", "radius": 0.1, "at": [3.0, 0.5, 0.25], "mass": 5.0,
            "velocity": [0.0, 0.0, -2.0]}  # fmt: skip
    scene, state = make_scene(
        mesh=CUBE, material=SOFT, solver=FINE, obstacle=[held, ball], contact={"itself": False, "distance": 0.02},
        time={"scheme": "newmark", "step": 2e-3, "end": 0.06},
    )  # fmt: skip
    heights, speeds = [], []
    for _ in each_step(scene, state):
        heights.append(last(scene)["position_ball_z"])
        speeds.append(last(scene)["velocity_ball_z"])
    assert min(heights) > 0.2 and max(speeds) > 0.9 and max(np.abs(speeds)) < 2 * (1 + 1e-6)


def test_a_free_solid_hits_a_free_ball(tmp_path: Path) -> None:
    """Centre to centre, beside the body: momentum of both stays, the energy does not grow, and they part."""
    thrown_block = block(tmp_path, (0.3, 0.3, 0.3)) | {"at": [3.0, 0.5, 0.5], "mass": 2.0, "velocity": [1.0, 0.0, 0.0]}
    ball = {"name": "ball", "shape": "sphere", "radius": 0.1, "at": [3.28, 0.5, 0.5], "mass": 5.0}
    scene, state = make_scene(
        mesh=CUBE, material=SOFT, solver=FINE, obstacle=[thrown_block, ball],
        contact={"itself": False, "distance": 0.02}, time={"scheme": "newmark", "step": 4e-3, "end": 0.12},
    )  # fmt: skip
    free = free_solid(scene)[0].group.bodies.free
    for report in each_step(scene, state):
        total = sum(pose.motion.momentum[:3] for pose in free.values())
        np.testing.assert_allclose(total, [2.0, 0.0, 0.0], atol=1e-9)
        assert report.kinetic + report.elastic <= 1.0 * (1 + 1e-6)
        x = free[0].posed.pose.points_to_space(free[0].body.shape.points)
        assert x[:, 0].max() < free[1].motion.pose.centre[0] - 0.1
    assert last(scene)["velocity_ball_x"] > last(scene)["velocity_block_x"] + 0.3


def two_solids(folder: Path, second: dict[str, Any], scheme: str = "newmark") -> tuple[Scene, Walk]:
    """A block from a file thrown at another one, beside the body."""
    first = block(folder, (0.3, 0.3, 0.3)) | {"at": [3.0, 0.5, 0.5], "mass": 2.0, "velocity": [1.0, 0.0, 0.0]}
    return make_scene(
        mesh=CUBE, material=SOFT, solver=FINE, obstacle=[first, first | {"name": "second", "velocity": None} | second],
        contact={"itself": False, "distance": 0.02}, time={"scheme": scheme, "step": 4e-3, "end": 0.12},
    )  # fmt: skip


@pytest.mark.parametrize("turned", (False, True))
def test_free_solids_hit_one_another(turned: bool, tmp_path: Path) -> None:
    """Beside the body: momentum of both stays, their surfaces never cut each other, and they part."""
    pytest.importorskip("ipctk")
    spin = {"spin": [0.0, 0.5, 1.5]} if turned else {}
    scene, state = two_solids(tmp_path, {"at": [3.35, 0.55, 0.52], "mass": 5.0} | spin)
    bodies = free_solid(scene)[0].group.bodies
    free = bodies.free.values()

    def angular() -> Values:
        motions = [pose.motion for pose in free]
        return np.sum([np.cross(each.pose.centre, each.momentum[:3]) + each.momentum[3:] for each in motions], axis=0)

    before = angular()
    for _ in each_step(scene, state):
        np.testing.assert_allclose(sum(pose.motion.momentum[:3] for pose in free), [2.0, 0.0, 0.0], atol=1e-9)
        sides = [(pose.posed.pose.points_to_space(pose.body.shape.points), pose.body.shape.triangles) for pose in free]
        assert bodies.pairs.are_open(bodies.posed) and penetration_depth(*sides, cut=False) is None
    np.testing.assert_allclose(angular(), before, atol=0.02 * np.abs(before).max())
    assert last(scene)["velocity_second_x"] > last(scene)["velocity_block_x"] + 0.1


def test_a_free_solid_comes_off_a_held_and_a_driven_one(tmp_path: Path) -> None:
    """A held one sends it back; a wall that is driven into it takes it along, by work that is told."""
    pytest.importorskip("ipctk")
    scene, state = two_solids(tmp_path, {"at": [3.35, 0.5, 0.5], "mass": None})
    for report in each_step(scene, state):
        assert report.kinetic + report.elastic <= 1.0 * (1 + 1e-6)
    assert last(scene)["velocity_block_x"] < -0.3
    scene, state = two_solids(tmp_path, {"at": [2.65, 0.5, 0.5], "mass": None, "velocity": [3.0, 0.0, 0.0]})
    for report in each_step(scene, state):
        assert report.kinetic + report.elastic <= 1.0 + state.work + 1e-6
    assert last(scene)["velocity_block_x"] > 2.5 and state.work > 1.0


@pytest.mark.parametrize("ratio", (1.1, 0.5))
def test_a_free_solid_rubs_on_a_held_one(ratio: float, tmp_path: Path) -> None:
    """Coulomb, with gravity aslant: it stays where mu is above the tangent, and slides with g (sin - mu cos) below."""
    pytest.importorskip("ipctk")
    slope = 0.3
    mu = ratio * np.tan(slope)
    floor = block(tmp_path, (2.0, 2.0, 0.4)) | {"at": [3.5, 0.5, 0.0], "name": "floor", "friction": mu}
    (tmp_path / "small").mkdir()
    small = block(tmp_path / "small", (0.4, 0.4, 0.2)) | {"at": [3.3, 0.5, 0.329], "mass": 5.0, "guide": "xz"}
    scene, state = make_scene(
        mesh=CUBE, material=SOFT, solver=FINE, obstacle=[floor, small], boundary=[{"on": "bottom", "fix": "xyz"}],
        contact={"itself": False, "distance": 0.03}, load={"gravity": [G * np.sin(slope), 0.0, -G * np.cos(slope)]},
        time={"scheme": "backward-euler", "step": 1e-2, "end": 0.36},
    )  # fmt: skip
    rows = []
    for _ in each_step(scene, state):
        rows.append((state.t, last(scene)["velocity_block_x"]))
    late = np.array([row for row in rows if row[0] > 0.24])
    rate = np.polyfit(*late.T, 1)[0]
    assert rate == pytest.approx(max(0.0, G * (np.sin(slope) - mu * np.cos(slope))), rel=0.03, abs=0.02)
