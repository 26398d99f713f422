"""Whose an output folder is: files of the user's are never replaced or deleted, runs that can go on not by accident."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from mpi4py import MPI

from cases import BAR, STRIP, changed, fracsim, fracsim_here, study, swept_here, write_study
from fracsim.deformable_run import Run, run_study
from fracsim.errors import InputError
from fracsim.scene import build_scene

TEARING = changed(STRIP, output={"fields": ["damage"]})


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def run(folder: Path, data: dict[str, object] = TEARING, **how: bool) -> None:
    Run(build_scene(MPI.COMM_SELF, study(data)), folder, **how)()  # type: ignore[arg-type]


# --- folders of the user's ------------------------------------------------------------------------------------------


def users_folder(folder: Path) -> Path:
    """A study of the user's own, with its surface and a picture; returns the study."""
    (folder / "surface").mkdir(parents=True)
    (folder / "surface" / "part.stl").write_text("solid part")
    (folder / "surface" / "surface_000000.vtu").write_text("mine, too")
    (folder / "last.png").write_bytes(b"the last picture of my aunt")
    path = write_study(folder / "study.toml", BAR)
    path.write_text("# my study\n" + path.read_text())
    return path


@pytest.mark.parametrize("ranks", [0, 2])
def test_a_folder_of_the_users_is_left_alone(tmp_path: Path, ranks: int) -> None:
    path = users_folder(tmp_path)
    before = contents(tmp_path)
    result = fracsim("run", path, "-o", tmp_path, "--overwrite", ranks=ranks)
    assert result.returncode == 2
    said = "the folder holds what fracsim did not write (last.png, study.toml, surface); give an empty or a new folder"
    assert result.stderr.count(said) == 1 and "Traceback" not in result.stderr
    assert contents(tmp_path) == before


def test_one_foreign_file_is_enough(tmp_path: Path) -> None:
    """Whatever its name, and though nothing would be written over it; hidden files say nothing."""
    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(InputError, match=r"did not write \(thesis\.tex\)"):
        run(tmp_path, BAR)
    (tmp_path / "thesis.tex").rename(tmp_path / ".gitignore")
    run(tmp_path, BAR)
    assert (tmp_path / ".gitignore").exists()


def test_a_run_does_not_replace_its_own_study(tmp_path: Path) -> None:
    """The study.toml of a run taken as a study, changed, and run where it lies: it has fracsim's head."""
    run(tmp_path, BAR)
    path = tmp_path / "study.toml"
    path.write_text(path.read_text().replace("young = 1000000.0", "young = 2000000.0"))
    before = contents(tmp_path)
    result = fracsim("run", path, "-o", tmp_path)
    assert result.returncode == 2 and f"the run would replace its own input {path}; give another" in result.stderr
    assert contents(tmp_path) == before


def test_a_run_does_not_replace_its_own_mesh(tmp_path: Path) -> None:
    """A mesh read from a file of an earlier run in the same folder."""
    run(tmp_path, BAR)
    frame = tmp_path / "surface" / "surface_000001.vtu"
    frame.parent.mkdir()
    frame.write_text("")
    with pytest.raises(InputError, match=r"would replace its own input .*surface_000001\.vtu"):
        run_study(MPI.COMM_SELF, study({**BAR, "mesh": {"file": str(frame)}}), tmp_path)
    assert frame.exists()


# --- folders of runs ------------------------------------------------------------------------------------------------


def test_a_run_that_ended_may_be_run_again_and_what_lies_beside_it_stays(tmp_path: Path) -> None:
    out = tmp_path / "out"
    run(out)
    frames = sorted(path.name for path in (out / "surface").iterdir())
    mine = [
        out / name for name in ("notes.md", "log.txt", "surface/part.stl", "surface/surface_old.vtu", "report.html")
    ]
    for path in mine:
        path.write_text("mine")
    run(out, changed(TEARING, output={"every": 5}))
    assert [path.read_text() for path in mine] == ["mine"] * len(mine)
    left = sorted(path.name for path in (out / "surface").iterdir() if path not in mine)
    assert left == frames[:3] and len(frames) == 11, "frames of the first run, which wrote more of them, are gone"
    run(out, BAR)  # this one has no surface
    assert sorted(path.name for path in (out / "surface").iterdir()) == ["part.stl", "surface_old.vtu"]
    assert not (out / "surface.pvd").exists() and not (out / "pieces.csv").exists()


@pytest.mark.parametrize(
    "where",
    [
        "deformable_run.make_output_folder",
        "monitors.InvertedCellMonitor",
        "output.frame_files.FieldEvaluator",
        "output.frame_files.FieldsFile",
        "deformable_run.FrameSchedule",
    ],
)
def test_a_run_that_was_killed_is_recognised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str) -> None:
    """At any moment of its set-up, in a new folder and in one of an earlier run."""
    short = changed(TEARING, time={"end": 0.005})
    for folder in (tmp_path / "new", tmp_path / "old"):
        if folder.name == "old":
            run(folder, short)
        with monkeypatch.context() as patch:
            patch.setattr(f"fracsim.{where}", _killed)
            with pytest.raises(SystemExit):
                run(folder, short)
        run(folder, short)
        assert json.loads((folder / "summary.json").read_text())["outcome"] == "done"


def _killed(*_: object, **__: object) -> None:
    raise SystemExit


def test_a_run_killed_while_it_clears_is_recognised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """study.toml, by which a folder is known, goes last: half of an old run is still known for one."""
    run(tmp_path)
    with monkeypatch.context() as patch:
        unlink, count = Path.unlink, iter(range(3))
        patch.setattr(Path, "unlink", lambda *a, **k: unlink(*a, **k) if next(count, None) is not None else _killed())
        with pytest.raises(SystemExit):
            run(tmp_path)
    assert (tmp_path / "study.toml").exists() and not (tmp_path / "history.csv").exists()
    run(tmp_path)


def test_a_run_that_can_go_on_is_not_thrown_away(tmp_path: Path) -> None:
    """Stopped at the wall-time limit: refused by one message on two ranks, with nothing changed; --overwrite helps."""
    bar, out = write_study(tmp_path / "bar.toml", BAR), tmp_path / "out"
    assert fracsim("run", bar, "-o", out, "--wall-limit", "0").returncode == 4
    before = contents(out)
    refused = fracsim("run", bar, "-o", out, ranks=2)
    assert refused.returncode == 2 and refused.stderr.count("a run that has not ended left a checkpoint there") == 1
    assert fracsim("run", bar, "-o", out, "--restart", "--overwrite").returncode == 2
    assert contents(out) == before
    assert fracsim("run", bar, "-o", out, "--overwrite").returncode == 0
    assert not (out / "checkpoint").exists()


def test_an_ended_run_that_goes_on_can_be_lost_again(tmp_path: Path) -> None:
    """Ended, continued with a later end, and killed there: it has not ended any more."""
    data = changed(BAR, output={"checkpoint": 1e-9})
    run(tmp_path, data)
    longer = changed(data, time={"end": 0.06})
    Run(build_scene(MPI.COMM_SELF, study(longer)), tmp_path, restart=True)  # and no step taken
    with pytest.raises(InputError, match="a run that has not ended left a checkpoint"):
        run(tmp_path, longer)
    run(tmp_path, longer, restart=True)
    run(tmp_path, longer)


# --- sweeps ---------------------------------------------------------------------------------------------------------


def test_a_sweep_leaves_folders_of_the_users_alone(tmp_path: Path) -> None:
    """Its log, too, is not written into them."""
    bar, out = write_study(tmp_path / "bar.toml", BAR), tmp_path / "out"
    (out / "h-0.125").mkdir(parents=True)
    for name in ("log.txt", "mine.txt"):
        (out / "h-0.125" / name).write_text("mine")
    before = contents(out)
    result = fracsim_here("sweep", bar, "--set", "mesh.h=0.25,0.125", "-o", out)  # starts nothing
    assert result.returncode == 2 and "h-0.125: the folder holds what fracsim did not write (mine.txt)" in result.stderr
    assert contents(out) == before


def test_a_sweep_of_another_study_does_not_throw_runs_away(tmp_path: Path) -> None:
    bar, out = write_study(tmp_path / "bar.toml", BAR), tmp_path / "out"
    arguments = ("sweep", bar, "--set", "mesh.h=0.25", "-o", out)
    fracsim("run", bar, "--set", "mesh.h=0.25", "-o", out / "h-0.25", "--wall-limit", "0")
    write_study(bar, BAR, material={"young": 2e6})
    before = contents(out)
    for more in ((), ("--list",)):
        refused = fracsim_here(*arguments, *more)  # starts nothing
        assert refused.returncode == 2 and "a run of another study that has not ended left a" in refused.stderr
    assert contents(out) == before
    assert fracsim(*arguments, "--list", "--overwrite").stdout.strip().endswith("h-0.25 --overwrite")
    assert swept_here(*arguments[1:], "--overwrite").returncode == 0
    assert json.loads((out / "h-0.25" / "summary.json").read_text())["outcome"] == "done"
