"""A body that is set down nearer to an obstacle than its barrier begins, or touches it, begins at rest."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest

from fracsim.contact.shapes import Capsule, RoundedBox, RoundedCylinder, Sphere
from fracsim.errors import InputError
from support.scenes import Walk, displacement, make_scene, march

G = 9.81
SOFT = {"energy": "linear", "young": 1e7, "poisson": 0.3, "density": 1000.0}
SIZE = {2: [0.1, 0.05], 3: [0.1, 0.1, 0.05]}
SCHEMES = {"backward-euler": 2e-3, "newmark": 2e-3, "generalized-alpha": 2e-3, "explicit": 1e-4}


def block(dim: int, obstacles: list[dict[str, Any]], scheme: str = "backward-euler", **tables: Any) -> tuple[Any, Walk]:
    """A block of 0.1 x 0.05 m (3D: 0.1 x 0.1 x 0.05), its foot at a height of 0."""
    given: dict[str, Any] = {
        "mesh": {"builder": "box", "size": SIZE[dim], "h": 0.025}, "material": SOFT, "obstacle": obstacles,
        "time": {"scheme": scheme, "step": SCHEMES.get(scheme, 1e-3), "end": 1.0}, "solver": {},
    }  # fmt: skip
    return make_scene(**(given | tables))


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize(("dim", "gap", "mu"), [(3, 1e-5, 0.3), (2, 0.0, 0.3), (2, 1e-5, 0.7)])
def test_it_slides_as_coulomb_says(dim: int, gap: float, mu: float, scheme: str) -> None:
    """A slope of 30 degrees, gravity being turned. From rest v = g (sin - mu cos) t, or none with mu > tan; it does not
    rise. (Before: thrown 6 mm up within 0.04 s.)"""
    down = [G * np.sin(np.pi / 6), *[0.0] * (dim - 2), -G * np.cos(np.pi / 6)]
    slope = {"name": "slope", "shape": "plane", "normal": [0.0] * (dim - 1) + [1.0], "friction": mu}
    slope["at"] = [0.0] * (dim - 1) + [-gap]
    stiff = 1e-4 if scheme == "explicit" and mu < 0.5 else 1e-3
    scene, walk = block(dim, [slope], scheme, load={"gravity": down}, damping={"stiffness": stiff})
    m, end = (
        scene.balance.mass.lumped.reshape(-1, dim)[:, 0],
        (0.04 if mu < 0.5 else 0.02) if scheme == "explicit" else 0.1,
    )
    seen, highest = [], 0.0
    while walk.t < end:
        walk.advance()
        seen.append((walk.t, float(m @ walk.v.reshape(-1, dim)[:, 0] / m.sum())))
        highest = max(highest, float(displacement(scene, walk)[:, -1].max()))
    t, v = np.array(seen[len(seen) // 3 :]).T
    exact = max(G * (np.sin(np.pi / 6) - mu * np.cos(np.pi / 6)), 0.0)
    assert np.polyfit(t, v, 1)[0] == pytest.approx(exact, rel=0.02, abs=0.05)
    assert highest < 5e-5 and v[-1] == pytest.approx(exact * t[-1], rel=0.1, abs=2e-3)


SHAPES: dict[str, tuple[int, dict[str, Any]]] = {
    "plane": (3, {"shape": "plane", "normal": [0.0, 0.0, 1.0], "at": [0.0, 0.0, 0.0]}),
    "line": (2, {"shape": "plane", "normal": [0.0, 1.0], "at": [0.0, 0.0]}),
    "sphere under a corner": (3, {"shape": "sphere", "radius": 0.02, "at": [0.0, 0.0, -0.02]}),
    "sphere under a facet": (3, {"shape": "sphere", "radius": 1e-3, "at": [0.04, 0.045, -1e-3]}),
    "disk": (2, {"shape": "sphere", "radius": 0.02, "at": [0.05, -0.02]}),
    "capsule": (3, {"shape": "capsule", "radius": 0.02, "length": 0.3, "axis": [1.0, 0.0, 0.0],
                    "at": [0.05, 0.05, -0.02]}),
    "cylinder": (3, {"shape": "cylinder", "radius": 0.2, "length": 0.1, "axis": [0.0, 0.0, 1.0],
                     "at": [0.05, 0.05, -0.05]}),
    "box": (3, {"shape": "box", "size": [0.3, 0.3, 0.1], "at": [0.05, 0.05, -0.05]}),
    "thin box": (3, {"shape": "box", "size": [0.3, 0.3, 1e-4], "at": [0.05, 0.05, -5e-5]}),
    "rectangle": (2, {"shape": "box", "size": [0.3, 0.1], "at": [0.05, -0.05]}),
    "bowl": (3, {"shape": "box", "size": [0.3, 0.3, 0.2], "hollow": True, "at": [0.05, 0.05, 0.1]}),
    "driven": (3, {"shape": "sphere", "radius": 0.02, "at": [0.0, 0.0, -0.02], "velocity": [0.0, 0.0, 0.0]}),
    "free": (3, {"shape": "box", "size": [0.3, 0.3, 0.1], "at": [0.05, 0.05, -0.05], "mass": 1.0}),
    "free disk": (2, {"shape": "sphere", "radius": 0.02, "at": [0.05, -0.02], "mass": 1.0}),
}  # fmt: skip


@pytest.mark.parametrize("scheme", ["backward-euler", "generalized-alpha", "explicit"])
@pytest.mark.parametrize(
    ("name", "gap"), [(name, gap) for name in SHAPES for gap in (1e-5, 0.0) if gap or "facet" not in name]
)
def test_nothing_moves_beside_an_obstacle(name: str, gap: float, scheme: str) -> None:
    """Without a load, beside each shape, held, driven or free: no energy, force or motion after a few steps. Gaps to
    the body are 0.01 mm or none; the barrier begins at 0.7 mm (3D). (What touches a facet between its corners is
    refused.)"""
    dim, entry = SHAPES[name]
    entry = entry | {"name": "it", "at": [*entry["at"][:-1], entry["at"][-1] - gap]}
    scene, walk = block(dim, [entry], scheme)
    for report in march(scene, walk, 3):
        assert report.kinetic + report.elastic < 1e-18
    told = dict(zip(scene.probes.columns, scene.probes(), strict=True))
    assert np.abs(walk.u).max() < 1e-12 and all(abs(told[key]) < 1e-9 for key in told if key.startswith("contact_"))


@pytest.mark.parametrize("name", ["plane", "box", "thin box", "bowl", "free", "disk"])
def test_what_gave_way_is_still_there(name: str) -> None:
    """A block that moves into each at 1 m/s is stopped: no node of it comes further than a millimetre."""
    dim, entry = SHAPES[name]
    entry = {key: value for key, value in entry.items() if key != "mass"} | {"name": "it"}
    scene, walk = block(dim, [entry], initial={"velocity": [0.0] * (dim - 1) + [-1.0]})
    lowest = 0.0
    for _ in range(10):
        walk.advance()
        foot = scene.domain.nodes[: scene.domain.node_count, -1] + displacement(scene, walk)[:, -1]
        lowest = min(lowest, float(foot.min()))
    assert -1e-3 < lowest < 0 or lowest == 0


def test_free_obstacles_are_set_down_on_others() -> None:
    """A free box 1e-5 m above a plane and a free ball on it, without a load: none moves, nor the block beside them."""
    entries = [
        {"name": "floor", "shape": "plane", "normal": [0.0, 0.0, 1.0], "at": [0.0, 0.0, -0.2]},
        {"name": "box", "shape": "box", "size": [0.1, 0.1, 0.1], "at": [0.4, 0.0, -0.15 + 1e-5], "mass": 1.0},
        {"name": "ball", "shape": "sphere", "radius": 0.05, "at": [0.4, 0.0, -0.05 + 2e-5], "mass": 0.1},
    ]
    scene, walk = block(3, entries)
    for report in march(scene, walk, 3):
        assert report.kinetic + report.elastic < 1e-18
    told = dict(zip(scene.probes.columns, scene.probes(), strict=True))
    assert told["position_box_z"] == pytest.approx(-0.15 + 1e-5, abs=1e-12)
    assert told["position_ball_z"] == pytest.approx(-0.05 + 2e-5, abs=1e-12)


@pytest.mark.parametrize("shape", [Sphere(0.1), Sphere(0.1, hollow=True), Capsule(0.1, 0.3), RoundedCylinder(0.1, 0.3),
                                   RoundedCylinder(0.1, 0.3, hollow=True), RoundedBox((0.2, 0.3, 0.4), 0.03),
                                   RoundedBox((0.2, 0.3)),
                                   RoundedBox((0.2, 0.3, 0.4), hollow=True)])  # fmt: skip
def test_an_inset_shape_is_further_off_by_as_much(shape: Any) -> None:
    """At points outside the obstacle: never less, as much where they see a face or a ball (but where they see an edge
    of the inset one), and before rounded edges less than twice as much."""
    points = np.random.default_rng(3).uniform(-0.4, 0.4, (4000, shape.dim))
    outside = points[shape.distance(points) > 0]
    for by in (1e-3, 0.02):
        inset = shape.inset(by)
        more = inset.distance(outside) - shape.distance(outside)
        assert more.min() > by - 1e-12 and more.max() < 2 * by
        along = np.abs(shape.normal(outside)).max(axis=1) > 1 - 1e-12
        if isinstance(shape, Sphere | Capsule):
            along[:] = True
        assert along.sum() > 5 and np.median(more[along]) == pytest.approx(by, abs=1e-12)
    assert shape.hollow == (shape.max_inset == np.inf)


def stl_of_a_box(path: Path, lower: list[float], upper: list[float]) -> str:
    from fracsim.meshes import BUILDERS
    from fracsim.meshes.topology import boundary_facets

    mesh = BUILDERS["box"](size=tuple(np.subtract(upper, lower)), h=1.0).build()
    meshio.Mesh(mesh.points + np.array(lower), [("triangle", boundary_facets(mesh.cells))]).write(path)
    return str(path)


@pytest.mark.parametrize("free", [False, True])
def test_nothing_moves_beside_an_obstacle_from_a_file(free: bool, tmp_path: Path) -> None:
    """A box of triangles 1e-5 m below the block, held, or free and 1e-5 m above a plane that it feels as well."""
    pytest.importorskip("ipctk")
    file = stl_of_a_box(tmp_path / "box.stl", [-0.1, -0.1, -0.2], [0.2, 0.2, -1e-5])
    entries: list[dict[str, Any]] = [{"name": "it", "shape": "mesh", "file": file, "at": [0.0, 0.0, 0.0]}]
    if free:
        entries[0]["mass"] = 1.0
        entries.append({"name": "floor", "shape": "plane", "normal": [0.0, 0.0, 1.0], "at": [0.0, 0.0, -0.20001]})
    scene, walk = block(3, entries)
    for report in march(scene, walk, 3):
        assert report.kinetic + report.elastic < 1e-18
    assert np.abs(walk.u).max() < 1e-12
    with pytest.raises(
        InputError, match=r"contact\.distance = 0\.001 m is more than .* file and the body.* give at most"
    ):
        block(3, entries, contact={"itself": False, "distance": 1e-3})


def test_what_overlaps_is_refused_as_before() -> None:
    with pytest.raises(InputError, match=r"it overlaps the body at the start, by 1e-05 m; move it away"):
        block(2, [SHAPES["line"][1] | {"name": "it", "at": [0.0, 1e-5]}])
    ball = {"name": "ball", "shape": "sphere", "radius": 0.05, "at": [0.4, -0.15 - 1e-3], "mass": 0.1}
    with pytest.raises(InputError, match=r"ball moves freely and overlaps it at the start, by 0\.001 m"):
        block(2, [SHAPES["line"][1] | {"name": "it", "at": [0.0, -0.2]}, ball])


def test_a_free_ball_near_a_floor_keeps_its_radius() -> None:
    """On a slope it rolls with 5/7 g sin, though floor and ball begin nearer than the distance of contact.

    The floor is moved back, as it is under the body. The ball was inset as well, and rolled with 46 mm of 50.
    """
    down, radius = np.array([G / 2, 0.0, -G * np.cos(np.pi / 6)]), 0.05
    floor = {"name": "floor", "shape": "plane", "normal": [0.0, 0.0, 1.0], "at": [0.0, 0.0, 0.0], "friction": 0.5}
    ball = {"name": "ball", "shape": "sphere", "radius": radius, "at": [0.0, 2.0, 0.0508], "mass": 1.0}
    scene, walk = block(3, [floor, ball], load={"gravity": [*down]}, contact={"distance": 0.005})
    march(scene, walk, 100)
    found = dict(zip(scene.probes.columns, scene.probes(), strict=True))
    speed, spin = found["velocity_ball_x"], found["spin_ball_y"]
    assert speed == pytest.approx(5 / 7 * down[0] * 0.2, rel=0.02)
    assert speed / spin == pytest.approx(radius, rel=0.01)
    assert found["position_ball_z"] == pytest.approx(radius, rel=0.01)
