"""Round bodies roll as spheres, capsules and cylinders do, and break as their meshes do."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("mujoco", reason="an environment made without a network")

from fracsim.contact.shape_base import frame_about
from fracsim.contact.shapes import Capsule, RoundedCylinder, Sphere
from fracsim.meshes import BUILDERS
from fracsim.meshes.parameters import RoundSolid
from fracsim.rigid.bodies import Bodies
from fracsim.rigid.engine import Engine
from fracsim.rigid.fragment_geometry import FragmentGeometry
from fracsim.rigid.mujoco_model import ContactParameters
from fracsim.rigid.obstacles import cylinder_parts, obstacle_primitive
from fracsim.rigid.round_shape import RoundShape
from fracsim.scene.rigid_scene import RigidScene, build_rigid_scene
from fracsim.study import Study
from fracsim.study.check import check_study

Values = npt.NDArray[np.float64]
G, RADIUS, LENGTH, DENSITY = 9.81, 0.1, 0.2, 2000.0
UP = np.array([0.0, 0.0, 1.0])
# a / (g sin theta) = 1 / (1 + I / (m r^2))
ROLLING = {"sphere": 5 / 7, "cylinder": 2 / 3, "capsule": 1 / (1 + 0.46)}
MESHES: dict[str, dict[str, Any]] = {
    "sphere": {"builder": "sphere", "radius": RADIUS},
    "cylinder": {"builder": "cylinder", "radius": RADIUS, "length": LENGTH, "axis": "y"},
    "capsule": {"builder": "capsule", "radius": RADIUS, "length": LENGTH, "axis": "y"},
}
FLOOR = {"name": "floor", "shape": "plane", "at": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0], "friction": 0.6}


def scene(mesh: dict[str, Any], obstacles: list[dict[str, Any]], **more: Any) -> RigidScene:
    """Of a study without fracture; `more`: further tables, or other values of the usual ones."""
    tables = {
        "title": "rolling",
        "mesh": mesh,
        "material": {"young": 1e10, "poisson": 0.2, "density": DENSITY},
        "obstacle": obstacles,
        "contact": {"friction": 0.6},
        "load": {"gravity": [0.0, 0.0, -G]},
        "time": {"scheme": "rigid", "step": 2e-3, "end": 0.4},
        "output": {"picture": False},
    }
    return build_rigid_scene(Study.model_validate(tables | more))


def tilted(theta: float) -> dict[str, Any]:
    """Gravity of an incline that falls along x."""
    return {"gravity": [G * np.sin(theta), 0.0, -G * np.cos(theta)]}


def acceleration(built: RigidScene, direction: Values, body: int = 0) -> float:
    """Of the centre along a direction, m/s^2, after a quarter of the run; the body stays at its height."""
    state, times, speeds, heights = built.initial_state, [], [], []
    across = np.cross(direction, [0.0, 1.0, 0.0])
    while not built.ended(state):
        state, _ = built.stepper.advance(state)
        times.append(state.t)
        speeds.append(float(state.bodies.velocity[body] @ direction))
        heights.append(float(state.bodies.position[body] @ across))
    assert np.ptp(heights) < 1e-6
    start = len(times) // 4
    return float(np.polyfit(times[start:], speeds[start:], 1)[0])


@pytest.mark.parametrize("theta", [0.1, 0.4])
@pytest.mark.parametrize("h", [0.05, 0.02])
@pytest.mark.parametrize("kind", ["sphere", "cylinder", "capsule"])
def test_round_bodies_roll_down_an_incline(kind: str, h: float, theta: float) -> None:
    """a = g sin(theta) / (1 + I / (m r^2)). Meshes have 12 and 31 nodes around."""
    built = scene(MESHES[kind] | {"h": h}, [FLOOR], body=[{"position": [0, 0, RADIUS]}], load=tilted(theta))
    expected = ROLLING[kind] * G * np.sin(theta)
    assert acceleration(built, np.array([1.0, 0.0, 0.0])) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("kind", ["sphere", "cylinder", "capsule"])
def test_they_roll_on_a_box_wherever_they_are_placed(kind: str) -> None:
    """A box for the incline, and bodies built along x that are rotated onto y, as the second of two instances."""
    mesh = MESHES[kind] | {"h": 0.05} | ({} if kind == "sphere" else {"axis": "x"})
    turn, middle = [0.0, 0.0, np.pi / 2], LENGTH / 2 if kind == "cylinder" else 0.0
    body = {"position": [0, -1.0 - middle, RADIUS], "rotation": turn, "copies": [1, 2, 1], "spacing": [0.0, 1.0, 0.0]}
    box = FLOOR | {"shape": "box", "at": [1.0, 0.0, -0.1], "size": [6.0, 4.0, 0.2]}
    del box["normal"]
    built = scene(mesh, [box], body=[body], load=tilted(0.2))
    found = acceleration(built, np.array([1.0, 0.0, 0.0]), body=1)
    assert found == pytest.approx(ROLLING[kind] * G * np.sin(0.2), rel=1e-3)


@pytest.mark.parametrize("kind", ["sphere", "cylinder", "capsule"])
def test_free_obstacles_roll_likewise(kind: str) -> None:
    """On a plane with an inclined normal; the edges of a cylinder are rounded in its inertia, which is 0.1 % less."""
    theta, normal = 0.3, np.array([np.sin(0.3), 0.0, np.cos(0.3)])
    sizes = {"radius": RADIUS} | ({} if kind == "sphere" else {"length": LENGTH, "axis": [0.0, 1.0, 0.0]})
    at = {"at": (RADIUS * normal).tolist(), "density": DENSITY, "friction": 0.6}
    plane, thing = FLOOR | {"normal": normal.tolist()}, {"name": "thing", "shape": kind} | sizes | at
    built = scene({"builder": "box", "size": [0.1, 0.1, 0.1], "h": 0.1}, [plane, thing], body=[{"position": [0, 9, 9]}])
    found = acceleration(built, np.array([np.cos(theta), 0.0, -np.sin(theta)]), body=1)
    assert found == pytest.approx(ROLLING[kind] * G * np.sin(theta), rel=2e-3)


@pytest.mark.parametrize("theta", [0.1, 0.4])
def test_a_box_slides_down_an_incline(theta: float) -> None:
    """a = g (sin(theta) - mu cos(theta))."""
    mesh, mu = {"builder": "box", "size": [0.2, 0.2, 0.1], "h": 0.05}, 0.05
    built = scene(mesh, [FLOOR | {"friction": mu}], load=tilted(theta))
    expected = G * (np.sin(theta) - mu * np.cos(theta))
    assert acceleration(built, np.array([1.0, 0.0, 0.0])) == pytest.approx(expected, rel=1e-3)


def test_a_coin_that_falls_comes_to_lie_flat_on_the_floor() -> None:
    """Its rim stays above the floor to a fifth of g dt^2 as it tumbles, in steps in which it turns by 0.1 rad."""
    mesh = {"builder": "cylinder", "radius": RADIUS, "length": 0.03, "h": 0.05}
    body = {"position": [0, 0, 0.3], "rotation": [0.4, 0.3, 0.2], "spin": [3.0, 20.0, 5.0]}
    built = scene(mesh, [FLOOR], body=[body], time={"scheme": "rigid", "step": 5e-3, "end": 3.0})
    state, lowest = built.initial_state, []
    while not built.ended(state):
        state, _ = built.stepper.advance(state)
        upright = abs(float((state.bodies.rotation[0] @ Rotation.from_rotvec([0.4, 0.3, 0.2]).as_matrix())[2, 2]))
        rim = 0.015 * upright + RADIUS * np.sqrt(max(1 - upright**2, 0.0))
        lowest.append(float(state.bodies.position[0, 2]) - rim)
    assert min(lowest) > -1e-3 and upright > 1 - 1e-4 and abs(lowest[-1]) < 1e-4


@pytest.mark.parametrize("restitution", [0.0, 0.9])
@pytest.mark.parametrize("kind", ["sphere", "cylinder", "capsule"])
def test_a_round_body_that_lands_without_friction_keeps_its_spin(kind: str, restitution: float) -> None:
    """30 rad/s about the horizontal axis, and e times the speed of a point mass that falls as far."""
    body = {"position": [0, 0, 0.3], "velocity": [0, 0, -3.0], "spin": [0.0, 30.0, 0.0]}
    contact = {"friction": 0.0, "restitution": restitution}
    built = scene(MESHES[kind] | {"h": 0.05}, [FLOOR | {"friction": 0.0}], body=[body], contact=contact)
    state, speeds = built.initial_state, []
    for _ in range(60):
        state, _ = built.stepper.advance(state)
        speeds.append(float(state.bodies.velocity[0, 2]))
    assert state.bodies.spin[0] == pytest.approx([0.0, 30.0, 0.0], abs=0.01)
    assert max(speeds) == pytest.approx(restitution * np.sqrt(9.0 + 2 * G * 0.2), abs=0.02)


@pytest.mark.parametrize("shift", [0.0, 0.05])
def test_a_log_rests_on_two_logs(shift: float) -> None:
    """Between walls, for a second: it lies at r + sqrt(3) r, level, with both other ones on the floor."""
    walls = [
        FLOOR | {"name": name, "at": [side * (2 * RADIUS + 1e-4), 0.0, 0.0], "normal": [-side, 0.0, 0.0]}
        for name, side in (("left", -1.0), ("right", 1.0))
    ]
    top = RADIUS * (1 + np.sqrt(3))
    bodies = [{"position": [x, 0.0, RADIUS]} for x in (-RADIUS, RADIUS)] + [{"position": [0.0, shift, top + 1e-3]}]
    time = {"scheme": "rigid", "step": 5e-3, "end": 1.0}
    built = scene(MESHES["cylinder"] | {"h": 0.05}, [FLOOR, *walls], body=bodies, time=time)
    state = built.initial_state
    while not built.ended(state):
        state, _ = built.stepper.advance(state)
    assert np.allclose(state.bodies.position[:, 2], [RADIUS, RADIUS, top], atol=1e-4)
    assert np.allclose(state.bodies.position[:, 1] - LENGTH / 2, [0.0, 0.0, shift], atol=1e-4)
    axis = state.bodies.rotation[2, :, 1]
    assert np.allclose(axis, [0.0, 1.0, 0.0], atol=1e-3)


def test_depths_of_cylinders_are_no_more_than_they_can_be() -> None:
    """Of a disk that stands in another one by 5.7 mm MuJoCo finds 152 mm, along its axis."""
    disk = obstacle_primitive(RoundedCylinder(0.1, 0.03, 1e-4, (0.0, 0.0, 1.0)), "disk")
    axes = np.array([[0.0181, -0.0199, 0.9996], [0.2023, -0.9785, -0.0403]])
    rotation = np.array([frame_about(axis / np.linalg.norm(axis)) for axis in axes])
    position, zero = np.array([[0.2965, 0.6451, 0.0403], [0.31, 0.6053, 0.1496]]), np.zeros((2, 3))
    inertia = np.tile(np.eye(3) * 1e-2, (2, 1, 1))
    bodies = Bodies(np.ones(2), zero, inertia, position, rotation, zero, zero)
    parts = [[*cylinder_parts(disk)] for _ in range(2)]
    engine = Engine(bodies, parts, [], ContactParameters(5e-3, -G * UP, 0.4), hull_points=[np.empty((0, 3))] * 2)
    ((_, _, depth),) = engine.find_penetrations(bodies)
    # the prism in each is up to 3.4 mm below the cylinder
    assert 4e-3 < depth < 6e-3


# --- shape and inertia ---


@pytest.mark.parametrize(
    ("solid", "shape"),
    [
        (RoundSolid("sphere", (0.0, 0.0, 0.0), 0.3), Sphere(0.3)),
        (RoundSolid("capsule", (0.0, 0.0, 0.0), 0.3, 0.7, 0), Capsule(0.3, 0.7, (1.0, 0.0, 0.0))),
        (RoundSolid("cylinder", (0.0, 0.0, 0.0), 0.3, 0.7, 1), RoundedCylinder(0.3, 0.7, 1e-9, (0.0, 1.0, 0.0))),
    ],
)
def test_inertia_is_that_of_the_solid(solid: RoundSolid, shape: Any) -> None:
    """Against the sums over slices of the obstacles of deformable bodies."""
    found = RoundShape(solid).moments(np.array([shape.volume])).inertia[0]
    assert np.allclose(found, shape.inertia(1.0), rtol=1e-7, atol=1e-9 * shape.volume)


def test_a_mesh_that_is_not_round_collides_as_it_is() -> None:
    """One node of the boundary off the sphere by a thousandth of the radius."""
    builder: Any = BUILDERS["sphere"](radius=RADIUS, h=0.05)
    mesh = builder.build()
    shape = RoundShape.of_mesh(mesh, builder.round_solid)
    points = mesh.points.copy()
    outer = int(np.linalg.norm(points, axis=1).argmax())
    points[outer] *= 0.999
    assert shape is not None and RoundShape.of_mesh(replace(mesh, points=points), builder.round_solid) is None
    round_part = FragmentGeometry(mesh, None, shape).update_shapes({})
    polyhedron = FragmentGeometry(mesh).update_shapes({})
    assert round_part.convex_parts[0][0].kind == "sphere" and not len(round_part.hull_points[0])  # type: ignore[union-attr]
    assert isinstance(polyhedron.convex_parts[0][0], np.ndarray)
    assert round_part.moments.volume == polyhedron.moments.volume
    # a polyhedron within the sphere has a smaller radius of gyration
    assert 1.0 < round_part.moments.second[0, 0, 0] / polyhedron.moments.second[0, 0, 0] < 1.1


def test_check_says_what_collides() -> None:
    """One line: as a round solid, or as polyhedra that roll more slowly."""

    def line(mesh: dict[str, Any]) -> str:
        built = Study.model_validate(
            {
                "title": "t", "mesh": mesh, "material": {"young": 1e10, "poisson": 0.2, "density": DENSITY},
                "time": {"scheme": "rigid", "step": 2e-3, "end": 0.4},
            }
        )  # fmt: skip
        return "\n".join(check_study(built))

    assert "collide as a cylinder" in line(MESHES["cylinder"] | {"h": 0.05})
    assert "roll more slowly" in line({"builder": "vase", "h": 0.05})
    assert "roll more slowly" not in line({"builder": "box", "h": 0.1})


# --- fracture ---


def test_round_bodies_that_break_keep_their_momenta() -> None:
    """Two cylinders that spin and collide in free space: mass, momentum and angular momentum are those of before."""
    mesh = {"builder": "cylinder", "radius": RADIUS, "length": LENGTH, "axis": "y", "h": 0.05}
    bodies = [
        {"position": [-0.11, 0.0, 0.0], "velocity": [20.0, 0.0, 0.0], "spin": [0.0, 30.0, 0.0]},
        {"position": [0.11, 0.02, 0.03], "velocity": [-20.0, 0.0, 0.0], "spin": [10.0, 30.0, 0.0]},
    ]
    tables = {
        "fracture": {"strength": 1e6, "kernel": "neighbours"}, "brittle": {"surfaces": 12}, "body": bodies,
        "load": {"gravity": [0.0, 0.0, 0.0]}, "time": {"scheme": "rigid", "step": 1e-3, "end": 0.01},
    }  # fmt: skip
    built = scene(mesh, [], **tables)
    state = built.initial_state
    first, size = state.bodies, float(state.bodies.mass[0]) * 20.0 * RADIUS
    while not built.ended(state):
        state, _ = built.stepper.advance(state)
    assert len(state.bodies) > 4
    assert state.bodies.mass.sum() == pytest.approx(first.mass.sum(), rel=1e-12)
    assert np.allclose(state.bodies.momentum, first.momentum, atol=1e-9 * size / RADIUS)
    assert np.allclose(state.bodies.angular_momentum, first.angular_momentum, atol=1e-9 * size)
