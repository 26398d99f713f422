"""When frames are written, and that films and files for other programs run evenly in simulated time."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt
import pytest
from imageio.v3 import imread
from mpi4py import MPI

from cases import BAR, changed, fracsim, study, write_study
from fracsim.deformable_run import Run, run_study
from fracsim.errors import InputError
from fracsim.output.surface.body_surface import BodySurface
from fracsim.output.surface.vtk_files import SurfaceFiles
from fracsim.report.export import export_surfaces
from fracsim.report.pictures.frames import film_repetitions
from fracsim.report.pictures.picture import FilmOptions, render
from fracsim.report.pictures.picture_options import PictureOptions
from fracsim.scene import build_scene
from fracsim.solvers.newton import SolveResult
from fracsim.study import Study
from support.solids import lattice

Values = npt.NDArray[np.float64]
QUIET = {"every": None, "picture": False, "fields": [], "surface": True}


def times_of(folder: Path) -> list[float]:
    """Times of the frames in surface.pvd, s; those in fields.xdmf, if there is one, are the same."""
    parts = ElementTree.parse(folder / "surface.pvd").iter("DataSet")
    times = sorted({float(each.attrib["timestep"]) for each in parts})
    if (xdmf := folder / "fields.xdmf").exists():
        assert [float(each.attrib["Value"]) for each in ElementTree.parse(xdmf).iter("Time")] == times
    return times


def written(tables: dict[str, Any], folder: Path) -> list[float]:
    """Times of the frames of a bar's run."""
    run_study(MPI.COMM_SELF, study(tables), folder)
    return times_of(folder)


def test_frames_of_the_demo_are_evenly_spaced(tmp_path: Path) -> None:
    """90 steps of 5 ms, nothing said of frames: a frame every 10 ms, where there were 40 gaps of 10 ms and 10 of 5."""
    times = written(changed(BAR, time={"step": 5e-3, "end": 0.45}, output=QUIET), tmp_path / "out")
    np.testing.assert_allclose(times, 0.01 * np.arange(46), atol=1e-12)


@pytest.mark.parametrize("steps", [1, 7, 34, 49, 75, 76, 90, 99, 125, 250, 997, 4999, 5001, 10**7])
def test_there_are_about_fifty_frames_whole_steps_apart(steps: int) -> None:
    """As many as steps, where these are few; evenly up to the last one, where 34 to 75 frames allow it."""
    data = study(BAR, time={"step": 1e-3, "end": steps * 1e-3}, output={"every": None})
    between = data.frame_interval / 1e-3
    assert between == pytest.approx(round(between), rel=1e-9)
    assert steps / round(between) <= 75 and (steps < 34 or steps / round(between) >= 25)
    if any(steps % count == 0 for count in range(-(-steps // 75), steps // 34 + 1)) and steps <= 5000:
        assert steps % round(between) == 0


@pytest.mark.parametrize(("interval", "every"), [(None, 0.012), (0.02, 0.02)])
def test_explicit_frames_are_at_their_times(interval: float | None, every: float, tmp_path: Path) -> None:
    """Steps are as the body allows, and end where a frame is due: the default is a fiftieth of the run."""
    data = changed(BAR, time={"scheme": "explicit", "step": 0.1, "end": 0.6}, output={**QUIET, "interval": interval})
    times = written(data, tmp_path / "out")
    np.testing.assert_allclose(times, every * np.arange(round(0.6 / every) + 1), rtol=1e-6)


def test_frames_are_at_their_times_where_steps_fail(tmp_path: Path) -> None:
    """Halved steps that grow back are off the grid of the others: one is shortened where a frame is due."""
    data = study(BAR, time={"step": 0.01, "end": 0.3}, output={**QUIET, "interval": 0.03})
    scene = build_scene(MPI.COMM_SELF, data)
    stepper = scene.stepper
    attempt, count = stepper._attempt, iter(range(1000))  # type: ignore[attr-defined]

    def failing(state: Any, dt: float) -> SolveResult:
        return SolveResult(False, 1, 1, "as the test asks") if next(count) in (2, 3, 9) else attempt(state, dt)

    stepper._attempt = failing  # type: ignore[attr-defined]
    Run(scene, tmp_path / "out")()
    assert stepper.failures.steps_failed == 3
    np.testing.assert_allclose(times_of(tmp_path / "out"), 0.03 * np.arange(11), rtol=1e-6)


def test_frames_are_at_their_times_where_steps_follow_a_table(tmp_path: Path) -> None:
    steps = {"time": [0.0, 0.05], "value": [0.004, 0.011]}
    times = written(
        changed(BAR, time={"step": steps, "end": 0.2}, output={**QUIET, "interval": 0.02}), tmp_path / "out"
    )
    np.testing.assert_allclose(times, 0.02 * np.arange(11), rtol=1e-6)


def test_an_interval_below_the_step_does_not_shorten_steps(tmp_path: Path) -> None:
    """It is for steps that are shortened for other reasons, as where edges break."""
    times = written(changed(BAR, output={**QUIET, "interval": 0.004}), tmp_path / "out")
    np.testing.assert_allclose(times, [0.0, 0.01, 0.02, 0.03], rtol=1e-9)


def test_frames_of_rigid_bodies_are_evenly_spaced(tmp_path: Path) -> None:
    pytest.importorskip("mujoco", reason="an environment made without a network")
    tables = {
        "title": "dropped", "mesh": {"builder": "box", "size": [0.2, 0.2, 0.2], "h": 0.1},
        "material": {"energy": "linear", "young": 1e10, "poisson": 0.2, "density": 2000.0},
        "load": {"gravity": [0.0, 0.0, -9.81]}, "body": [{"position": [0.0, 0.0, 0.05]}],
        "obstacle": [{"name": "floor", "shape": "plane", "at": [0.0] * 3, "normal": [0.0, 0.0, 1.0]}],
        "time": {"scheme": "rigid", "step": 5e-3, "end": 0.45}, "output": {"picture": False},
    }  # fmt: skip
    run_study(MPI.COMM_SELF, Study.model_validate(tables), tmp_path / "out")
    np.testing.assert_allclose(times_of(tmp_path / "out"), 0.01 * np.arange(46), atol=1e-12)


def test_a_restart_goes_on_with_the_same_times(tmp_path: Path) -> None:
    data = study(BAR, time={"step": 5e-3, "end": 0.45}, output=QUIET)
    run = Run(build_scene(MPI.COMM_SELF, data), tmp_path / "out")
    run.write_frame()
    for _ in range(7):
        run.step()
    run.checkpoint()
    run.history.close()
    Run(build_scene(MPI.COMM_SELF, data), tmp_path / "out", restart=True)()
    np.testing.assert_allclose(times_of(tmp_path / "out"), [0.0, *0.01 * np.arange(4, 46)], atol=1e-12)


def test_an_interval_that_is_no_multiple_of_the_step_is_told_of(tmp_path: Path) -> None:
    path = write_study(tmp_path / "bar.toml", BAR, output={**QUIET, "interval": 0.014}, time={"end": 0.04})
    note = "output.interval = 0.014 s is no multiple of time.step = 0.01 s: there is a frame every 0.01 s, 1 step"
    assert note in fracsim("check", path).stdout
    ran = fracsim("run", path, "-o", tmp_path / "out")
    assert ran.returncode == 0 and note in ran.stderr
    np.testing.assert_allclose(times_of(tmp_path / "out"), 0.01 * np.arange(5), rtol=1e-9)


# --- films and files ---


@pytest.mark.parametrize(
    ("times", "shown"),
    [
        ([0.0], [1]),
        ([0.0, 0.1, 0.2, 0.30000000000000004], [1, 1, 1, 1]),
        ([0.0, 1.0, 2.0, 4.0, 5.0], [1, 1, 2, 1, 1]),  # one is missing: the one before it is held
        ([0.0, 1.0, 1.4, 2.0, 3.0, 4.0], [1, 1, 0, 1, 1, 1]),  # one more than there should be, as where a run stopped
        ([0.0, 2.0, 4.0, 5.0], [1, 1, 1, 1]),  # the end comes early, and is shown
    ],
)
def test_pictures_of_a_film_are_evenly_spaced_in_time(times: list[float], shown: list[int]) -> None:
    assert film_repetitions(times).tolist() == shown


def test_a_film_has_few_pictures_where_few_frames_are_close() -> None:
    times = np.concatenate([1e-6 * np.arange(50), np.linspace(0.1, 1.0, 10)])
    counts = film_repetitions(times.tolist())
    assert counts.sum() <= 4 * len(times) + 1 and counts[-1] > 0
    # equal times are equal parts of the film
    assert counts[50:59] == pytest.approx(counts[50:59].mean(), abs=1)


@pytest.fixture(scope="module")
def uneven(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A block that moves, with frames at 0, 10, 20 and 40 ms."""
    folder = tmp_path_factory.mktemp("uneven") / "block"
    folder.mkdir()
    mesh = lattice(2, 1, 1)
    surface, files = BodySurface(mesh, 1.0), SurfaceFiles(folder, 3)
    for t in (0.0, 0.01, 0.02, 0.04):
        files.write_frame(surface.make_frame(t, np.full_like(mesh.points, t), np.ones_like(mesh.points)))
    return folder


def test_a_film_lasts_as_long_as_the_motion(uneven: Path, tmp_path: Path) -> None:
    """Five pictures of 10 ms at 10 a second, the third of them held; a folder has the four frames."""
    from PIL import Image

    options, film_options = PictureOptions(size=(160, 120), bare=True), FilmOptions(10)
    film = Image.open(render(uneven, tmp_path / "film.gif", options, film=film_options))
    lengths = []
    for frame in range(film.n_frames):
        film.seek(frame)
        lengths.append(film.info["duration"])
    assert sum(lengths) == 500 and Counter(lengths) in (Counter({100: 3, 200: 1}), Counter({100: 5}))
    render(uneven, tmp_path / "pictures", PictureOptions(size=(160, 120), bare=True))
    assert len(list((tmp_path / "pictures").iterdir())) == 4


def test_a_film_of_some_frames_at_a_speed(uneven: Path, tmp_path: Path) -> None:
    """Frames 10 ms apart at a tenth of the true speed: a picture each 100 ms."""
    from PIL import Image

    options = PictureOptions(size=(160, 120), bare=True)
    film = Image.open(render(uneven, tmp_path / "f.gif", options, film=FilmOptions(frames=":3", speed=0.1)))
    assert film.n_frames == 3 and film.info["duration"] == 100
    for wrong, message in ((FilmOptions(frames="4:"), "has 4 frames"), (FilmOptions(frames="2"), "must be the first")):
        with pytest.raises(InputError, match=message):
            render(uneven, tmp_path / "g.gif", options, film=wrong)
    with pytest.raises(InputError, match=r"--speed 20: must be 0.01 to 1.2 here"):
        render(uneven, tmp_path / "g.gif", options, film=FilmOptions(speed=20))
    with pytest.raises(InputError, match=r"--speed 0\.1: of a film"):
        render(uneven, tmp_path / "pictures", options, film=FilmOptions(speed=0.1))
    with pytest.raises(InputError, match="--frames :3: of a film or a folder"):
        render(uneven, tmp_path / "g.png", options, film=FilmOptions(frames=":3"))


def test_the_camera_moves_with_the_body_on_request(uneven: Path, tmp_path: Path) -> None:
    """A block that moves along (1, 1, 1) m: beside the ways of the camera its picture stays the same."""
    pictures = {}
    for follow in (True, False):
        options = PictureOptions(size=(160, 120), bare=True, follow=follow, magnify=20)
        folder = render(uneven, tmp_path / str(follow), options)
        pictures[follow] = [imread(path).astype(int) for path in sorted(folder.iterdir())]
    assert len(pictures[True]) == 4
    for picture in pictures[True][1:]:
        assert np.abs(picture - pictures[True][0]).max(axis=2).mean() < 0.5
    assert np.abs(pictures[False][3] - pictures[False][0]).max(axis=2).mean() > 5


def test_usd_has_simulated_time(uneven: Path, tmp_path: Path) -> None:
    """Seconds are time codes over timeCodesPerSecond; a code is the time between two frames."""
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    (path,) = export_surfaces(uneven, "usd", tmp_path)
    stage = Usd.Stage.Open(str(path))
    points = UsdGeom.Mesh(stage.GetPrimAtPath("/run/body/skin")).GetPointsAttr()
    codes = points.GetTimeSamples()
    assert codes == [0.0, 1.0, 2.0, 4.0] and (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, 4.0)
    seconds = np.array(codes) / stage.GetTimeCodesPerSecond()
    np.testing.assert_allclose(seconds, [0.0, 0.01, 0.02, 0.04], rtol=1e-12)
    moved = [np.asarray(points.Get(code)).min() for code in codes]  # as far as the time says
    np.testing.assert_allclose(moved, seconds, atol=1e-7)
    velocities = UsdGeom.Mesh(points.GetPrim()).GetVelocitiesAttr()  # m/s: as they are in the run
    assert np.all(np.asarray(velocities.Get(2.0)) == 1.0)


def test_files_of_a_frame_have_its_time(uneven: Path, tmp_path: Path) -> None:
    pytest.importorskip("trimesh")
    (glb,) = export_surfaces(uneven, "glb", tmp_path, frame=2)
    length = struct.unpack("<I", glb.read_bytes()[12:16])[0]
    scene = json.loads(glb.read_bytes()[20 : 20 + length])["scenes"][0]
    assert scene["extras"]["time"] == 0.02
    (obj,) = export_surfaces(uneven, "obj", tmp_path, frame=2)
    assert obj.read_text().splitlines()[1] == "# t = 0.02 s"
    (ply,) = export_surfaces(uneven, "ply", tmp_path, frame=2)
    assert b"\ncomment t = 0.02 s\n" in ply.read_bytes()[:300]


def test_a_frame_is_read_without_a_lock(tmp_path: Path) -> None:
    """A run goes on writing to fields.h5 while a picture of it is drawn."""
    import h5py

    from fracsim.report.pictures.frames import field_frames, load_grid

    assert fracsim("run", write_study(tmp_path / "bar.toml", BAR), "-o", tmp_path / "out").returncode == 0
    script = f"import h5py; h5py.File({str(tmp_path / 'out/fields.h5')!r}, 'r+').close()"
    read = h5py.File
    opened: list[Any] = []

    def open_and_write(*arguments: Any, **options: Any) -> Any:
        file = read(*arguments, **options)
        opened.append(subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False))
        return file

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fracsim.report.pictures.frames.h5py.File", open_and_write)
        load_grid(field_frames(tmp_path / "out")[0])
    assert len(opened) == 2 and all(done.returncode == 0 for done in opened), opened[0].stderr
