"""Unbroken shells touch with their triangles: closest points by brute force, and sliding across the edges."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

pytest.importorskip("mujoco", reason="an environment made without a network")

from fracsim.meshes import BUILDERS
from fracsim.rigid import collision_detection, mujoco_model
from fracsim.rigid.fragment_geometry import FragmentGeometry
from fracsim.rigid.rigid_stepper import RigidState
from fracsim.rigid.shell_contact import ShellSurface
from fracsim.scene.rigid_scene import RigidScene, build_rigid_scene
from fracsim.study import Study

Values = npt.NDArray[np.float64]
G = 9.81
FLOOR = {"name": "floor", "shape": "plane", "at": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0], "friction": 0.6}


def scene(mesh: dict[str, Any], body: list[dict[str, Any]], step: float, **more: Any) -> RigidScene:
    """Of a study of shells that do not break; `more`: further tables, or other values of the usual ones."""
    tables = {
        "title": "shells", "mesh": mesh, "body": body, "obstacle": [FLOOR],
        "material": {"young": 1e10, "poisson": 0.3, "density": 600.0}, "contact": {"friction": 0.3},
        "load": {"gravity": [0.0, 0.0, -G]}, "time": {"scheme": "rigid", "step": step, "end": 100 * step},
        "output": {"picture": False},
    }  # fmt: skip
    return build_rigid_scene(Study.model_validate(tables | more))


def corners(built: RigidScene, state: RigidState, body: int, *, middle: bool) -> Values:
    """(m, 3, 3) current corners of the triangles of a body: of its middle surface, or of both sides of it."""
    mesh = built.instance_mesh
    shell = mesh.shell
    assert shell is not None
    points = shell.middle if middle else mesh.points
    x = points @ built.poses.rotation[body].T + built.poses.position[body]
    x = state.bodies.to_current(x, np.full(len(x), body))
    count = len(x) // 2
    return np.concatenate([x[shell.triangles], x[shell.triangles + count]])[: len(shell.triangles) * (2 - middle)]


def distance(points: Values, triangles: Values) -> float:
    """Least distance of points (n, 3) from triangles (m, 3, 3), each with each."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    normal = np.cross(b - a, c - a)
    square = np.einsum("mi,mi->m", normal, normal)
    arm = points[:, None] - a
    v = np.einsum("nmi,mi->nm", np.cross(arm, c - a), normal) / square
    w = np.einsum("nmi,mi->nm", np.cross(b - a, arm), normal) / square
    height = np.einsum("nmi,mi->nm", arm, normal) ** 2 / square
    inside = (v >= 0) & (w >= 0) & (v + w <= 1)
    least = np.where(inside, height, np.inf)
    for start, side in ((a, b - a), (a, c - a), (b, c - b)):
        along = np.clip(np.einsum("nmi,mi->nm", points[:, None] - start, side) / (side * side).sum(axis=1), 0, 1)
        off = points[:, None] - start - along[:, :, None] * side
        least = np.minimum(least, np.einsum("nmi,nmi->nm", off, off))
    return float(np.sqrt(least.min()))


def surface_points(triangles: Values, count: int = 4) -> Values:
    """Points (n, 3) on triangles, `count` intervals along a side."""
    steps = [(i, j, count - i - j) for i in range(count + 1) for j in range(count + 1 - i)]
    return np.unique(np.einsum("wk,mkd->wmd", np.array(steps) / count, triangles).reshape(-1, 3).round(9), axis=0)


def surface_distance(first: Values, second: Values) -> float:
    """Distance of two surfaces, from points on either to all triangles of the other."""
    return min(distance(surface_points(first), second), distance(surface_points(second), first))


def crosses(first: Values, second: Values) -> bool:
    """Whether a side of a triangle of one surface goes through a triangle of the other."""
    for sides, triangles in ((first, second), (second, first)):
        start, end = sides.reshape(-1, 3), np.roll(sides, -1, axis=1).reshape(-1, 3)
        a = triangles[:, 0]
        normal = np.cross(triangles[:, 1] - a, triangles[:, 2] - a)
        before, after = (np.einsum("nmi,mi->nm", x[:, None] - a, normal) for x in (start, end))
        rows, columns = np.nonzero(before * after < 0)
        share = before[rows, columns] / (before - after)[rows, columns]
        x = start[rows] + share[:, None] * (end - start)[rows]
        corner = triangles[columns]
        across = np.cross(np.roll(corner, -1, axis=1) - corner, x[:, None] - corner)
        if np.any(np.all(np.einsum("kij,kj->ki", across, normal[columns]) > 0, axis=1)):
            return True
    return False


# --- boats ---


@pytest.mark.parametrize(("h", "thickness"), [(0.28, 0.04), (0.2, 0.04), (0.2, 0.02)])
def test_a_boat_dropped_into_a_boat_comes_to_lie_in_it(h: float, thickness: float) -> None:
    """The surfaces touch to 0.1 mm (convex parts left 34 to 55 mm), and the middle surfaces never cross."""
    mesh = {"builder": "boat", "h": h, "thickness": thickness}
    built = scene(mesh, [{"position": [0, 0, 0.5]}, {"position": [0.0, 0.03, 1.1]}], 5e-3)
    state = built.initial_state
    for step in range(500):
        state, _ = built.stepper.advance(state)
        if step % 25 == 0:
            assert not crosses(*(corners(built, state, body, middle=True) for body in (0, 1)))
    found = surface_distance(*(corners(built, state, body, middle=False) for body in (0, 1)))
    assert found < 1e-4 < 2 * thickness
    # the upper boat lies within the lower one, at rest but for some rocking
    lower, upper = state.bodies.position
    assert 0.05 < upper[2] - lower[2] < 0.2 and np.linalg.norm(upper[:2] - lower[:2]) < 0.2
    assert np.abs(state.bodies.velocity).max() < 0.2


@pytest.mark.parametrize("thickness", [0.04, 0.01])
def test_no_boat_goes_through_another(thickness: float) -> None:
    """At 20 m/s, 100 mm in a step."""
    mesh = {"builder": "boat", "h": 0.28, "thickness": thickness}
    thrown = {"position": [0.2, 0.03, 1.2], "rotation": [0.2, 0.1, 0.3], "velocity": [0, 0, -20], "spin": [1, 2, 0.5]}
    built = scene(mesh, [{"position": [0, 0, 0.5]}, thrown], 5e-3)
    state = built.initial_state
    for _ in range(60):
        state, _ = built.stepper.advance(state)
        assert not crosses(*(corners(built, state, body, middle=True) for body in (0, 1)))


# --- edges between triangles ---


def write_tray(path: Path) -> None:
    """A tray of 6 by 1.2 m with flanges of 0.2 m along both sides, in triangles of 0.15 m."""
    x, y = np.linspace(0, 6.0, 41), np.linspace(-0.6, 0.6, 9)
    profile = np.array([[-0.6, 0.2], *([v, 0.0] for v in y), [0.6, 0.2]])
    points = np.concatenate([np.column_stack([np.full(len(profile), v), profile]) for v in x])
    a = (len(profile) * np.arange(len(x) - 1)[:, None] + np.arange(len(profile) - 1)).ravel()
    b, c, d = a + len(profile), a + len(profile) + 1, a + 1
    triangles = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    lines = [f"v {p[0]} {p[1]} {p[2]}" for p in points] + [f"f {t[0]} {t[1]} {t[2]}" for t in triangles + 1]
    path.write_text("\n".join(lines))


@pytest.mark.parametrize(
    ("shape", "friction", "height", "expected"),
    [
        ({"shape": "box", "size": [0.3, 0.2, 0.1]}, 0.0, 0.05, 4.0),
        ({"shape": "box", "size": [0.3, 0.2, 0.1]}, 0.2, 0.05, 4.0 - 0.2 * G * 0.6),
        ({"shape": "sphere", "radius": 0.1}, 0.3, 0.1, 4.0 * 5 / 7),
    ],
)
def test_what_slides_on_a_shell_passes_the_edges_of_triangles(
    tmp_path: Path, shape: dict[str, Any], friction: float, height: float, expected: float
) -> None:
    """v - mu g t of a box, and 5/7 v of a ball that comes to roll; sides of prisms would stop both."""
    write_tray(tmp_path / "tray.obj")
    rough = FLOOR | {"at": [0.0, 0.0, -0.01], "friction": 5.0}
    slider = {"name": "slider", "density": 2000.0, "at": [0.5, 0.03, 0.01 + height], "velocity": [4.0, 0.0, 0.0]}
    built = scene(
        {"shell": str(tmp_path / "tray.obj"), "thickness": 0.02}, [{}], 2e-3,
        obstacle=[rough, slider | shape | {"friction": friction}], contact={"friction": friction},
    )  # fmt: skip
    state = built.initial_state
    for _ in range(300):
        state, _ = built.stepper.advance(state)
    assert state.bodies.velocity[1, 0] == pytest.approx(expected, rel=5e-3)
    assert state.bodies.position[1, 2] == pytest.approx(0.01 + height, abs=1e-3)


def test_directions_that_are_normals_of_a_ridge() -> None:
    """Two triangles that fall off to both sides of the y axis by 0.2 rad: between both normals on the ridge, beyond the
    rim, and not below the ridge, nor out of one triangle into the other."""
    s, c = np.sin(0.2), np.cos(0.2)
    points = np.array([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [c, 0.5, -s], [-c, 0.5, -s]])
    surface = ShellSurface(points, np.array([[0, 2, 1], [0, 1, 3]]), 0.1, [])
    assert np.allclose(surface.normals, [[s, 0, c], [-s, 0, c]])
    ridge, rim, node, face = [0, 0.5, 0], [c / 2, 0.25, -s / 2], [0, 0, 0], [c / 2, 0.5, -s / 2]
    cases = [
        (ridge, [0, 0, 1], True), (ridge, [s, 0, c], True), (ridge, [-np.sin(0.3), 0, np.cos(0.3)], False),
        (ridge, [-0.5, 0, -0.8], False), (ridge, [-c, 0, s], False), (rim, [0.5, -np.sqrt(0.75), 0], True),
        (node, [0, -1, 0], True), (node, [0, -0.6, 0.8], True), (face, [s, 0, c], True), (face, [-s, 0, -c], True),
    ]  # fmt: skip
    for point, direction, expected in cases:
        unit = np.array([direction], float) / np.linalg.norm(direction)
        assert surface.are_normals(np.array([0]), unit, np.array([point], float))[0] == expected, (point, direction)


def test_closed_convex_shells_are_one_hull_and_open_ones_prisms() -> None:
    """An ornament without and with a neck; more triangles than admitted are convex parts."""
    closed, opened = (BUILDERS["ornament"](neck=neck, h=0.02).build() for neck in (0.0, 0.012))  # type: ignore[call-arg]
    (parts,) = FragmentGeometry(closed).update_shapes({}).convex_parts
    assert len(parts) == 1
    shapes = FragmentGeometry(opened).update_shapes({})
    assert opened.shell is not None and shapes.shells[0] is not None
    assert len(shapes.convex_parts[0]) == len(opened.shell.triangles)
    few = FragmentGeometry(opened, None, None, max_prisms=10).update_shapes({})
    assert few.shells == [None] and len(few.convex_parts[0]) <= 32


def test_memory_for_contacts_grows(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same motion from the least memory on."""
    pair = [{"position": [0, 0, 0.5]}, {"position": [0.1, 0.03, 1.05], "velocity": [0, 0, -5]}]
    sizes: list[int] = []
    enlarge = collision_detection._MujocoSearch._enlarge_memory

    def counted(search: Any) -> None:
        enlarge(search)
        sizes.append(search._spec.memory)

    monkeypatch.setattr(collision_detection._MujocoSearch, "_enlarge_memory", counted)

    def position() -> Values:
        built = scene({"builder": "boat", "h": 0.28}, pair, 5e-3)
        state = built.initial_state
        for _ in range(40):
            state, _ = built.stepper.advance(state)
        return state.bodies.position

    expected = position()
    assert not sizes
    monkeypatch.setattr(mujoco_model, "SETTINGS", replace(mujoco_model.SETTINGS, min_bytes=2**16, bytes_per_part=2**8))
    assert np.array_equal(position(), expected) and sizes
