"""Obstacles in surface.pvd and in pictures: where the study says that they are."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import pyvista
from mpi4py import MPI

from fracsim.contact.obstacle import tessellate_obstacle
from fracsim.contact.pose import Pose, PosedShape
from fracsim.contact.shapes import HalfSpace, Sphere
from fracsim.deformable_run import Run
from fracsim.output.surface.vtk_files import read_pvd
from fracsim.report.pictures.picture import render
from fracsim.report.pictures.picture_options import PictureOptions
from fracsim.report.pictures.surroundings import OBSTACLE_COLOUR
from fracsim.scene import build_scene
from support.scenes import make_study

Values = npt.NDArray[np.float64]

# a disk that comes down at 1 m/s beside a block above a floor, which it never meets
TABLES: dict[str, Any] = {
    "mesh": {"builder": "box", "size": [1.0, 0.5], "h": 0.25},
    "obstacle": [
        {"name": "floor", "shape": "plane", "at": [7.0, -0.25], "normal": [0.0, 1.0]},
        {"name": "disk", "shape": "sphere", "radius": 0.2, "at": [1.25, 0.5], "velocity": [0.0, -1.0]},
    ],
    "time": {"scheme": "backward-euler", "step": 0.05, "end": 0.2},
    "output": {"interval": 0.1, "picture": False},
}


def begun(folder: Path, **how: Any) -> Run:
    return Run(build_scene(MPI.COMM_SELF, make_study(**TABLES)), folder, **how)


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("shown")
    begun(folder)()
    return folder


def at(folder: Path, t: float) -> Any:
    """The blocks that VTK shows at a time."""
    reader = pyvista.get_reader(folder / "surface.pvd")
    assert reader.time_values == pytest.approx([0.0, 0.1, 0.2])
    reader.set_active_time_value(min(reader.time_values, key=lambda each: abs(each - t)))
    return reader.read()


@pytest.mark.parametrize("t", (0.0, 0.1, 0.2))
def test_each_stands_where_it_is_at_every_frame(shown: Path, t: float) -> None:
    """The body, the floor with its top at y = -0.25 below it, and the disk: its rim 0.2 m from (1.25, 0.5 - t), its
    triangles of the area of a polygon of 48 corners."""
    body, floor, disk = at(shown, t)
    assert "piece" in body.point_data
    top = floor.points[floor.points[:, 1] == floor.points[:, 1].max()]
    assert top[:, 1] == pytest.approx(-0.25) and top[:, 0].min() < 0 and top[:, 0].max() > 1
    assert np.linalg.norm(disk.points - [1.25, 0.5 - t, 0.0], axis=1) == pytest.approx(0.2, rel=1e-6)
    assert disk.compute_cell_sizes()["Area"].sum() == pytest.approx(24 * np.sin(np.pi / 24) * 0.2**2, rel=1e-6)


def test_what_does_not_move_is_written_once(shown: Path) -> None:
    names = sorted(path.name for path in (shown / "surface").iterdir() if path.name.startswith("obstacle"))
    assert names == ["obstacle_disk_000000.vtu", "obstacle_disk_000001.vtu", "obstacle_disk_000002.vtu",
                     "obstacle_floor_000000.vtu"]  # fmt: skip
    parts = {(each.part, each.name) for each in read_pvd(shown / "surface.pvd")}
    assert parts == {(0, "body"), (1, "floor"), (2, "disk")}


def test_a_restart_shows_them_on(shown: Path, tmp_path: Path) -> None:
    """Stopped at 0.1 s and resumed: as without the stop; a new run in the folder deletes them."""
    stopped = begun(tmp_path)
    stopped.write_frame()
    for _ in range(2):
        stopped.step()
    stopped.write_frame()
    stopped.checkpoint()
    begun(tmp_path, restart=True)()
    for t in (0.0, 0.1, 0.2):
        for found, wanted in zip(at(tmp_path, t), at(shown, t), strict=True):
            np.testing.assert_allclose(found.points, wanted.points, atol=1e-12)
    begun(tmp_path)
    assert not any((tmp_path / "surface").iterdir())


def test_a_picture_has_them(shown: Path, tmp_path: Path) -> None:
    """Above the floor, which is wide, all of their colour is a disk: pi / 4 of its bounding box."""
    from imageio.v3 import imread

    pixels = np.asarray(imread(render(shown, tmp_path / "picture.png", PictureOptions(zoom=0.6))))[..., :3].astype(int)
    solid = np.abs(pixels - [int(OBSTACLE_COLOUR[i : i + 2], 16) for i in (1, 3, 5)]).max(axis=2) <= 2
    floor = solid.mean(axis=1) > 0.5
    assert floor.any()
    rows, columns = np.nonzero(solid & ~floor[:, None])
    assert rows.max() < np.flatnonzero(floor)[0]
    assert len(rows) / (np.ptp(rows) * np.ptp(columns)) == pytest.approx(np.pi / 4, rel=0.05)


@pytest.mark.parametrize("dim", (2, 3))
def test_a_plane_is_a_slab_behind_it_near_the_body(dim: int) -> None:
    """Closed and facing outwards: the divergence theorem gives its thickness times the area of its patch; nothing of it
    stands before the plane, and its face is centred where the body's box is projected to."""
    rng = np.random.default_rng(dim)
    direction, point = rng.normal(size=dim), rng.normal(size=dim)
    n = direction / np.linalg.norm(direction)
    lower, upper = np.full(dim, 2.0), np.full(dim, 3.0)
    placed = PosedShape(HalfSpace(tuple(direction)), Pose.at_point(point))
    points, triangles, segments = tessellate_obstacle(placed, lower, upper)
    points = placed.pose.points_to_space(points)
    side = 2 * np.sqrt(dim)
    height = (points - point) @ n
    assert height.max() == pytest.approx(0, abs=1e-12) and height.min() == pytest.approx(-0.01 * side)
    face = points[height > -1e-9]
    middle = (lower + upper) / 2
    np.testing.assert_allclose(face.mean(axis=0), middle - (middle - point) @ n * n, atol=1e-12)
    x = points[segments if dim == 2 else triangles]
    measure = np.linalg.det(x).sum() / (2 if dim == 2 else 6)
    assert measure == pytest.approx(0.01 * side**dim)


def test_a_hollow_disk_is_not_filled() -> None:
    placed = PosedShape(Sphere(0.5, 2, hollow=True), Pose.at_point(np.zeros(2)))
    _, triangles, segments = tessellate_obstacle(placed, np.zeros(2), np.ones(2))
    assert len(triangles) == 0 and len(segments) == 48
