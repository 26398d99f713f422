"""The split surface of whole runs: written as the study asks, picked up by a restart, drawn."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import pyvista
from mpi4py import MPI

from cases import BAR, STRIP, changed, study
from fracsim.deformable_run import Run
from fracsim.errors import InputError, Stopped
from fracsim.report.pictures.colour_maps import colour_range, select_array
from fracsim.report.pictures.frames import FrameSource, explode_fragments, find_frames, load_grid
from fracsim.report.pictures.picture import render
from fracsim.report.pictures.picture_options import PictureOptions
from fracsim.scene import build_scene

Data = dict[str, Any]
SOLVER = {"snes_rtol": 1e-11, "ksp_rtol": 1e-9}
TEARING = changed(STRIP, solver=SOLVER, output={"fields": ["damage", "von_mises", "strain", "stress"]})


def run(data: Data, folder: Path, **how: Any) -> Run:
    made = Run(build_scene(MPI.COMM_SELF, study(data)), folder, **how)
    made()
    return made


@pytest.fixture(scope="module")
def torn(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return run(TEARING, tmp_path_factory.mktemp("torn"))


def last(folder: Path) -> Any:
    return pyvista.read(find_frames(folder)[-1].file)


def test_a_run_writes_its_surface(torn: Run) -> None:
    """A frame for each of fields.xdmf at the same times; pieces of the last one are those of history.csv."""
    assert torn.frames.fields is not None
    assert [shot.t for shot in find_frames(torn.folder)] == pytest.approx(torn.frames.fields.times, rel=1e-11)
    grid = last(torn.folder)
    assert len(np.unique(grid.point_data["piece"])) == torn.breaks.counts[2] > 1
    assert {"von_mises", "strain", "origin", "age", "cell"} <= set(grid.cell_data)
    assert list(grid.field_data["origins"])[-1] == "crack" or "crack" in list(grid.field_data["origins"])


def test_all_that_is_written_is_a_number(torn: Run) -> None:
    """Of every frame of the surface, whole, torn and flat: viewers draw NaN in a colour of its own."""
    for shot in find_frames(torn.folder):
        grid = pyvista.read(shot.file)
        for data in (grid.point_data, grid.cell_data):
            assert not [name for name, values in data.items() if not np.isfinite(np.asarray(values)).all()]


def test_mass_and_momentum_of_the_pieces(torn: Run) -> None:
    """Masses add up to rho V = 1000 * 0.25, and mass times velocity to the momentum sum(m v) of the nodes."""
    with (torn.folder / "pieces.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if float(row["time"]) == pytest.approx(torn.state.t)]
    mass = np.array([float(row["mass"]) for row in rows])
    velocity = np.array([[float(row["velocity_x"]), float(row["velocity_y"])] for row in rows])
    assert mass.sum() == pytest.approx(250.0, rel=1e-10)
    nodes = (torn.scene.balance.mass.lumped * torn.state.v).reshape(-1, 2).sum(axis=0)
    assert mass @ velocity == pytest.approx(nodes, rel=1e-8, abs=1e-8 * np.abs(nodes).max())


def test_cuts_by_forces_move_the_crack_only(torn: Run, tmp_path: Path) -> None:
    """The same edges break, cut elsewhere than in the middle; the area of the body in 2D stays that of the mesh."""
    other = run(changed(TEARING, output={"cut": "forces"}), tmp_path)
    assert other.breaks.record is not None and torn.breaks.record is not None
    assert np.array_equal(other.breaks.record.graph.broken, torn.breaks.record.graph.broken)
    cut = other.breaks.record.cut_positions[other.breaks.record.graph.broken]
    assert np.isnan(torn.breaks.record.cut_positions).all()
    assert np.all((cut >= 0.1) & (cut <= 0.9)) and np.ptp(cut) > 0.05
    for made in (other, torn):
        grid = last(made.folder)
        grid.points = grid.points - grid.point_data["displacement"]
        assert area(grid) == pytest.approx(0.25, rel=1e-6)  # written in single precision


def area(grid: Any) -> float:
    """Area of the triangles of a 2D surface, by the shoelace formula."""
    corners = np.asarray(grid.points)[grid.cells_dict[5]]
    a, b = (corners[:, k] - corners[:, 0] for k in (1, 2))
    return float(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum() / 2)


def test_a_restart_goes_on_with_the_same_pieces_and_ages(torn: Run, tmp_path: Path) -> None:
    """Stopped in the middle of tearing and continued: points, piece numbers and ages as without the stop."""
    stopped = Run(build_scene(MPI.COMM_SELF, study(TEARING)), tmp_path)
    reason, steps = stopped.interrupt.stop_reason, iter(range(6))
    stopped.interrupt.stop_reason = lambda: reason() or ("" if next(steps, None) is not None else "the test")  # type: ignore[method-assign]
    with pytest.raises(Stopped):
        stopped()
    assert stopped.breaks.record is not None and stopped.breaks.record.graph.broken.any()
    run(TEARING, tmp_path, restart=True)
    found, wanted = last(tmp_path), last(torn.folder)
    assert np.array_equal(found.point_data["piece"], wanted.point_data["piece"])
    np.testing.assert_allclose(found.cell_data["age"], wanted.cell_data["age"], atol=1e-12)
    np.testing.assert_allclose(found.points, wanted.points, atol=1e-6)


@pytest.mark.parametrize("wanted", (None, False))
def test_no_surface_where_none_is_wanted(wanted: bool | None, tmp_path: Path) -> None:
    """Without [fracture], or with surface = false, there is none and nothing is kept for it."""
    data = BAR if wanted is None else changed(TEARING, output={"surface": False})
    assert run(data, tmp_path).frames.surface is None
    assert not (tmp_path / "surface.pvd").exists() and not (tmp_path / "surface").exists()


def test_an_intact_body_may_have_one(tmp_path: Path) -> None:
    """surface = true without [fracture] writes the boundary: 2 (n m + n l + m l) squares of two triangles each."""
    run(changed(BAR, output={"surface": True}), tmp_path)
    assert last(tmp_path).n_cells == 2 * 2 * (4 * 1 + 4 * 1 + 1 * 1)


# --- pictures -------------------------------------------------------------------------------------------------------


def picture(path: Path) -> npt.NDArray[np.uint8]:
    from imageio.v3 import imread

    return np.asarray(imread(path))


@pytest.mark.parametrize(
    "look",
    (
        PictureOptions(),
        PictureOptions("von_mises"),
        PictureOptions("piece", explode=0.5),
        PictureOptions("age", zoom=2.0),
        PictureOptions("stress:xy"),
        PictureOptions("displacement"),
        PictureOptions("displacement:y"),
    ),
)
def test_looks_differ_and_show_something(torn: Run, look: PictureOptions, tmp_path: Path) -> None:
    pixels = picture(render(torn.folder, tmp_path / "shot.png", look))[..., :3]
    assert np.any(pixels != 255, axis=2).mean() > 0.02


def test_components_are_those_of_the_mesh(torn: Run) -> None:
    """stress:yy of the surface is the second column that fields.h5 has for the same cell, and says so to ParaView."""
    grid = last(torn.folder)
    wanted = np.asarray(
        load_grid(FrameSource(0.0, torn.folder / "fields.h5", -1 + len(find_frames(torn.folder))))["stress"]
    )
    cells = np.asarray(grid.cell_data["cell"])
    assert select_array(grid, "stress:yy") == "stress:yy"
    np.testing.assert_array_equal(grid.cell_data["stress:yy"], wanted[cells, 1])
    stress = grid.GetCellData().GetArray("stress")
    assert [stress.GetComponentName(i) for i in range(6)] == ["XX", "YY", "ZZ", "XY", "YZ", "XZ"]


def test_split_cells_have_no_strain(torn: Run) -> None:
    """Their nodes belong to several pieces that fly apart: F of the cell says nothing about either."""
    frame = load_grid(FrameSource(0.0, torn.folder / "fields.h5", len(find_frames(torn.folder)) - 1))
    assert torn.scene.fracture is not None
    split = torn.scene.fracture.graph.split
    assert split.any()
    gathered = torn.scene.domain.input_numbering.gather_cells(split.astype(float))
    assert np.all(np.asarray(frame["strain"])[gathered > 0] == 0) and np.asarray(frame["strain"]).max() > 0


def test_the_range_of_the_colours() -> None:
    """Symmetric where both signs occur; a few values beyond the rest do not stretch it."""
    values = np.concatenate([np.linspace(-1.0, 2.0, 1001), [1e6]])
    low, high = colour_range(values) or (0.0, 0.0)
    assert -low == high == pytest.approx(2.0, rel=0.03)
    assert colour_range(np.zeros(3)) == (0.0, 0.0) and colour_range(np.full(3, np.nan)) is None


def test_an_animation_moves(tmp_path: Path) -> None:
    """A GIF with a picture a frame, the first unlike the last."""
    run(changed(TEARING, output={"every": 10}), tmp_path / "run")
    frames = picture(render(tmp_path / "run", tmp_path / "all.gif"))
    assert len(frames) == len(find_frames(tmp_path / "run")) == 2
    assert np.any(frames[0] != frames[-1])


@pytest.mark.parametrize(
    ("look", "frame", "name", "message"),
    (
        (PictureOptions("colour"), -1, "a.png", "--field colour: this run has: "),
        (
            PictureOptions("stress"),
            -1,
            "a.png",
            "--field stress: stress is a tensor; add a component: stress:xx, stress:yy",
        ),
        (
            PictureOptions("stress:rr"),
            -1,
            "a.png",
            "stress has no component rr; its components are xx, yy, zz, xy, yz, xz",
        ),
        (PictureOptions("damage:x"), -1, "a.png", "damage has no component x; it has no components"),
        (PictureOptions("origin"), -1, "a.png", "--field origin: this run has: "),
        (PictureOptions(view="below"), -1, "a.png", "--view below: must be one of iso, front"),
        (PictureOptions(view="0,0,0"), -1, "a.png", "--view 0,0,0: a direction must be finite and not zero"),
        (PictureOptions(), 99, "a.png", "--frame 99: "),
        (PictureOptions(), -1, "a.jpg", "pictures are .png, films .gif or .mp4"),
        (PictureOptions(material="bred"), -1, "a.png", "--look bred: must be one of plain, bread"),
        (PictureOptions(material="#b9712c,red"), -1, "a.png", "--look: red is no colour"),
    ),
)
def test_what_cannot_be_drawn(
    torn: Run, look: PictureOptions, frame: int, name: str, message: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=message):
        render(torn.folder, tmp_path / name, look, frame=frame)


def test_exploding_moves_pieces_rigidly() -> None:
    """Two pieces move apart along the line of their centres by the share asked for; inside a piece nothing changes."""
    points = np.array([[0.0, 0, 0], [1, 0, 0], [4, 0, 0], [5, 0, 0]])
    moved = explode_fragments(points, np.array([0, 0, 1, 1]), 0.5)
    assert moved[:, 0].tolist() == [-1.0, 0.0, 5.0, 6.0]
