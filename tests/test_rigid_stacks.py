"""Stacks of rigid blocks on a slope, and the contact points of faces."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial import ConvexHull, HalfspaceIntersection
from scipy.spatial.transform import Rotation

pytest.importorskip("mujoco", reason="an environment made without a network")

import mujoco

import fracsim
from fracsim.rigid import contact_solver
from fracsim.rigid.face_contacts import FaceContacts
from fracsim.rigid_run import contact_notes
from fracsim.scene.rigid_scene import RigidScene, build_rigid_scene
from fracsim.study import Study

Values = npt.NDArray[np.float64]
# tan(theta) of the slope is 0.208
GRAVITY = [2.0, 0.0, -9.604]


def stack(blocks: int, h: float, step: float, **more: Any) -> RigidScene:
    """Blocks of 0.2 x 0.2 x 0.1 m on one another; `more`: other tables."""
    floor = {"name": "floor", "shape": "plane", "at": [0, 0, 0], "normal": [0, 0, 1], "friction": 0.3}
    tables = {
        "title": "stack",
        "mesh": {"builder": "box", "size": [0.2, 0.2, 0.1], "h": h},
        "material": {"young": 1e9, "poisson": 0.2, "density": 1000.0},
        "body": [{"copies": [1, 1, blocks], "spacing": [0.0, 0.0, 0.1]}],
        "obstacle": [floor],
        "contact": {"friction": 0.3},
        "load": {"gravity": GRAVITY},
        "time": {"scheme": "rigid", "step": step, "end": 1.0},
        "output": {"picture": False},
    }
    return build_rigid_scene(Study.model_validate(tables | more))


def run(built: RigidScene) -> tuple[Values, float]:
    """Largest distance that each body was from its start, m, and the largest kinetic energy, J."""
    state = built.initial_state
    start, moved, energy = state.bodies.position, np.zeros(len(state.bodies)), 0.0
    while not built.ended(state):
        state, report = built.stepper.advance(state)
        moved = np.maximum(moved, np.linalg.norm(state.bodies.position - start, axis=1))
        energy = max(energy, report.kinetic_energy)
    return moved, energy


@pytest.mark.parametrize(("blocks", "h", "step"), [(5, 0.1, 5e-3), (4, 0.1, 5e-3), (5, 0.05, 5e-3), (5, 0.1, 1e-3)])
def test_a_stack_rests_on_a_slope(blocks: int, h: float, step: float) -> None:
    """Friction holds it, and the resultant force goes through the lowest face."""
    moved, energy = run(stack(blocks, h, step))
    assert moved.max() < 2e-5 and energy < 1e-6


def test_a_stack_rests_on_a_box() -> None:
    """The floor is a box instead of a plane, with a corner within the lowest face."""
    box = {"name": "floor", "shape": "box", "at": [0.07, 0.08, -0.05], "size": [0.2, 0.2, 0.1], "friction": 0.3}
    assert run(stack(4, 0.1, 5e-3, obstacle=[box]))[0].max() < 2e-5


@pytest.mark.parametrize(("friction", "slides"), [(0.21, False), (0.205, True)])
def test_a_stack_slides_below_the_limit_of_friction(friction: float, slides: bool) -> None:
    """The limit is tan(theta); below it the stack slides on the floor as one body, with g_x - mu g_z."""
    floor = {"name": "floor", "shape": "plane", "at": [0, 0, 0], "normal": [0, 0, 1], "friction": friction}
    moved, _ = run(stack(3, 0.1, 5e-3, obstacle=[floor]))
    expected = (2.0 - friction * 9.604) / 2 if slides else 0.0
    assert np.allclose(moved, expected, rtol=0.02, atol=2e-5)


LANDING = {"velocity": [1.0, 0.0, -2.0], "copies": [1, 1, 5], "spacing": [0.0, 0.0, 0.1]}
ROUGH = {"gradient_work": 1, "refining_work": 1, "gradient_iterations": 1, "search_rounds": 1}


def test_a_solve_that_ends_early_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """One iteration of projected gradients is too few for a stack that lands; the usual number is enough."""
    built = stack(5, 0.1, 5e-3, body=[LANDING])
    assert built.stepper.advance(built.initial_state)[1].contact_error == 0.0
    settings = replace(contact_solver.SETTINGS, max_newton_contacts=1, **ROUGH)
    monkeypatch.setattr(contact_solver, "SETTINGS", settings)
    built = stack(5, 0.1, 5e-3, body=[LANDING])
    state, report = built.stepper.advance(built.initial_state)
    assert report.contact_error > 0.25 * 2 * 9.81 * 5e-3
    (note,) = contact_notes([(state.t, report.contact_error), (0.01, 1e-9)])
    assert "did not converge in 2 steps" in note and f"t = 0.005 s are off by up to {report.contact_error:.2g}" in note
    assert not contact_notes([])


@pytest.mark.parametrize("refines", [True, False])
def test_a_block_that_lands_aslant_has_the_friction_of_its_impulse(
    refines: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """v_x = 1 - mu v_z. With the slip speed before the impact MuJoCo lets the block sink in: told, or mended."""
    limits = {"slip_rounds": 1} | ({} if refines else ROUGH)
    monkeypatch.setattr(contact_solver, "SETTINGS", replace(contact_solver.SETTINGS, **limits))
    built = stack(1, 0.1, 5e-3, body=[{"velocity": [1.0, 0.0, -2.0]}])
    state, report = built.stepper.advance(built.initial_state)
    velocity = state.bodies.velocity[0]
    expected = [1.0 + 2.0 * 5e-3 - 0.3 * (2.0 + 9.604 * 5e-3), 0.0, 0.0]
    assert np.allclose(velocity, expected, atol=2e-3) == refines
    assert (report.contact_error == 0.0) == refines


def test_contact_of_a_slab_that_is_shot_through_converges(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """A thousand contacts, of which some close only by the impulses of others, in the step of the impact."""
    fracsim.run("rigid-slab", tmp_path / "out", overrides=["time.end=0.002", "output.picture=false"])
    assert "did not converge" not in capfd.readouterr().err
    with (tmp_path / "out" / "history.csv").open() as file:
        assert int(list(csv.DictReader(file))[-1]["broken_edges"]) > 5000


# --- points of faces ---


def prism(corners: int, radius: float, turn: float = 0.0) -> Values:
    """Corners of a prism between z = 0 and z = 1."""
    angle = turn + 2 * np.pi * np.arange(corners) / corners
    ring = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.concatenate([np.column_stack([ring, np.full(corners, z)]) for z in (0.0, 1.0)])


def points_of(hulls: tuple[Values, Values], turn: Values, shift: Values) -> tuple[Values, Values, int]:
    """Points and gaps of contact, and their number in MuJoCo, of two hulls; the second one is above, and moved."""
    spec = mujoco.MjSpec()
    for number, hull in enumerate(hulls):
        mesh, body = spec.add_mesh(), spec.worldbody.add_body()
        mesh.name, mesh.uservert = f"hull{number}", hull.reshape(-1)
        if number:
            body.pos, body.quat = shift, Rotation.from_rotvec(turn).as_quat(scalar_first=True)
            body.add_freejoint()
        geom = body.add_geom()
        geom.type, geom.meshname, geom.margin = mujoco.mjtGeom.mjGEOM_MESH, mesh.name, 1e-3
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_collision(model, data)
    contact = data.contact
    found = [
        contact.geom.astype(np.int64), contact.pos.copy(), contact.frame.reshape(-1, 3, 3).copy(),
        contact.dist.copy(), contact.friction[:, 0].copy(),
    ]  # fmt: skip
    _, points, _, gaps, _ = FaceContacts.from_model(model).complete(found, data.geom_xpos, data.geom_xmat)
    return points, gaps, data.ncon


def overlap_area(first: Values, second: Values) -> float:
    """Area in which two convex polygons (n, 2) overlap, by half planes."""
    planes = np.concatenate([ConvexHull(first).equations, ConvexHull(second).equations])
    return float(ConvexHull(HalfspaceIntersection(planes, np.zeros(2)).intersections).volume)


@pytest.mark.parametrize("corners", [(4, 4), (4, 6), (6, 6), (3, 8), (12, 12)])
def test_points_of_faces_span_their_overlap(corners: tuple[int, int]) -> None:
    """Turned and shifted at random by 1e-7 to 1e-3: at most eight points, of the whole area up to 10 %; gaps are those
    of the planes."""
    rng = np.random.default_rng(2)
    for size in (1e-7, 1e-6, 1e-5, 1e-4, 1e-3) * 4:
        hulls = prism(corners[0], 1.0), prism(corners[1], 1.0, 0.3 * (corners[0] != corners[1]))
        turn, shift = rng.normal(size=3) * size * [1e-2, 1e-2, 1.0], rng.normal(size=3) * size
        shift[2] = 1 + 1e-5
        points, gaps, count = points_of(hulls, turn, shift)
        above = hulls[1] @ Rotation.from_rotvec(turn).as_matrix().T + shift
        exact = overlap_area(hulls[0][: corners[0], :2], above[: corners[1], :2])
        assert len(points) <= 8 and count == 4
        assert 0.9 * exact < ConvexHull(points[:, :2]).volume < (1 + 1e-6) * exact
        heights = shift[2] + np.cross(turn, points - shift)[:, 2] - 1
        np.testing.assert_allclose(gaps, heights, atol=1e-7)
        # corners that nearly coincide are one point
        assert max(corners) > 4 or len(points) == 4
