"""Runs that end early, and going on: the same result as a run that was never interrupted, on any number of ranks."""

from __future__ import annotations

import copy
import csv
import dataclasses
import importlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt
import pytest
from mpi4py import MPI

from cases import BAR, DUCTILE_TABLES, STRIP, WEDGE, changed, command, fracsim, mpirun, study, write_study
from fracsim.deformable_run import Run, run_study
from fracsim.errors import Exit, InputError, NotConverged, Stopped
from fracsim.output.frame_files import FieldEvaluator
from fracsim.output.run_folder import study_differences
from fracsim.scene import build_scene
from fracsim.study.mesh_source import build_mesh, save_mesh
from fracsim.study.reader import add_missing_defaults, study_text

Data = dict[str, Any]
Values = npt.NDArray[Any]

# Tight tolerances: what is left of the difference between two ways to the same state is their solver error.
SOLVER = {"snes_rtol": 1e-11, "ksp_rtol": 1e-9}
TEARING: Data = changed(
    STRIP, solver=SOLVER, fracture={"radius": 0.2}, damping={"mass": 1.0, "stiffness": 1e-4},
    output={"fields": ["damage", "chi", "piece"]},
)  # fmt: skip
# breaks in its third step and in its fourth
DUCTILE: Data = changed(
    TEARING, **DUCTILE_TABLES, boundary=[
        {"on": "left", "fix": "xy"},
        {"on": "right", "velocity": {"time": [0.0, 0.02], "value": [[0.0, 0.0], [1.2, 0.0]]}},
    ],
)  # fmt: skip
# kept apart from `wall_step`, which is a time, and the iteration counts, which depend on the preconditioner's history
PHYSICAL = [
    "time", "dt", "kinetic", "elastic", "dissipated", "external_work", "broken_edges", "split_cells", "pieces",
    "reaction_grip_x", "reaction_grip_y", "probe_tip_x", "probe_tip_y",
]  # fmt: skip


def run(data: Data, folder: Path, *, restart: bool = False, wall_limit: float | None = None) -> dict[str, Any]:
    scene = build_scene(MPI.COMM_SELF, study(data))
    return Run(scene, folder, restart=restart, wall_limit=wall_limit)()


def history(folder: Path) -> dict[str, Values]:
    with (folder / "history.csv").open(newline="") as file:
        rows = list(csv.reader(file))
    return dict(zip(rows[0], np.array(rows[1:], float).T, strict=True))


def last_frame(folder: Path) -> dict[str, Values]:
    with h5py.File(folder / "fields.h5") as file:
        frame = file["frames"][max(file["frames"])]
        return {"time": frame.attrs["time"]} | {name: data[()] for name, data in frame.items()}


def assert_same_run(folder: Path, reference: Path, columns: list[str] = PHYSICAL, rtol: float = 1e-6) -> None:
    """History rows and the last frame of two runs agree to solver tolerance, damage exactly."""
    rows, wanted = history(folder), history(reference)
    assert rows["step"].tolist() == wanted["step"].tolist()
    for name in columns:
        scale = np.abs(wanted[name]).max()
        assert np.allclose(rows[name], wanted[name], rtol=rtol, atol=rtol * scale + 1e-12), name
    found, frame = last_frame(folder), last_frame(reference)
    assert found.keys() == frame.keys() and found["time"] == pytest.approx(frame["time"])
    for name in ("damage", "chi", "piece"):
        assert name not in frame or np.array_equal(found[name], frame[name]), name
    size = np.abs(frame["displacement"]).max()
    assert np.abs(found["displacement"] - frame["displacement"]).max() < rtol * size
    with h5py.File(folder / "fields.h5") as file, h5py.File(reference / "fields.h5") as other:
        assert len(file["frames"]) == len(other["frames"])


# --- going on -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tearing strip without interruption."""
    folder = tmp_path_factory.mktemp("whole") / "out"
    summary = run(TEARING, folder)
    assert summary["broken_edges"] > 0
    return folder


def stopped_after(data: Data, folder: Path, steps: int) -> None:
    """Run and end by a signal in step number `steps`."""
    scene = build_scene(MPI.COMM_SELF, study(data))
    advance, count = scene.stepper.advance, iter(range(1, 1000))

    def counted(state: Any) -> Any:
        if next(count) == steps:
            os.kill(os.getpid(), signal.SIGTERM)
        return advance(state)

    scene.stepper.advance = counted  # type: ignore[method-assign]
    with pytest.raises(Stopped) as end:
        Run(scene, folder)()
    t = steps * scene.study.time.step
    assert str(end.value).startswith(f"stopped by signal SIGTERM at t = {t:g} s after {steps} steps")
    assert f"Checkpoint: {folder / 'checkpoint' / 'state.h5'}; go on with --restart" in str(end.value)


def test_a_restart_gives_the_same_run(tmp_path: Path, whole: Path) -> None:
    breaking = np.flatnonzero(history(whole)["broken_edges"])[0] + 1  # the first step that breaks edges
    for steps in (2, int(breaking)):
        folder = tmp_path / str(steps)
        stopped_after(TEARING, folder, steps)
        assert json.loads((folder / "summary.json").read_text())["outcome"] == "stopped"
        assert len(history(folder)["step"]) == steps
        summary = run(TEARING, folder, restart=True)
        assert summary["outcome"] == "done"
        assert_same_run(folder, whole)


@pytest.mark.parametrize("unilateral", [False, True])
def test_a_restart_takes_the_explicit_step_of_its_damage(tmp_path: Path, unilateral: bool) -> None:
    """Cells that lost edges are faster or slower: the first step after a restart is that of the body that went on."""
    data = changed(
        STRIP, fracture={"approach": "edge", "unilateral": unilateral, "strength": 1e9}, material={"energy": "linear"},
        mesh={"pattern": "unstructured"}, time={"scheme": "explicit", "step": 1.0, "end": 10.0},
        output={"fields": ["damage"]},
    )  # fmt: skip
    going = Run(build_scene(MPI.COMM_SELF, study(data)), tmp_path)
    fracture, report = going.scene.fracture, going.step()
    assert fracture is not None
    fracture.graph.break_edges(np.random.default_rng(3).uniform(size=len(fracture.graph.broken)) < 0.4)
    fracture.degradation.update_from_graph()
    fracture.mark_changed()
    going.state = state = going.scene.stepper.with_forces(going.state)
    going.record_breaks()
    going.checkpoint()
    again = Run(build_scene(MPI.COMM_SELF, study(data)), tmp_path, restart=True)
    assert again.state.step == state.step > 0
    assert again.step().dt == going.step().dt != report.dt


@pytest.mark.parametrize("scheme", ["newmark", "quasi-static"])
def test_a_restart_with_other_schemes(tmp_path: Path, scheme: str) -> None:
    data = changed(BAR, time={"scheme": scheme, "end": 0.06}, solver=SOLVER, material={"energy": "corotated"})
    run(data, tmp_path / "whole")
    stopped_after(data, tmp_path / "parts", 3)
    run(data, tmp_path / "parts", restart=True)
    columns = [name for name in PHYSICAL if "tip" not in name] + ["reaction_grip_z"]
    assert_same_run(tmp_path / "parts", tmp_path / "whole", columns)


@pytest.fixture(scope="module")
def flowed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A strip that yields and tears, without interruption."""
    folder = tmp_path_factory.mktemp("flowed") / "out"
    assert run(DUCTILE, folder)["broken_edges"] > 0 and last_frame(folder)["plastic_strain"].max() > 0.01
    return folder


def assert_same_flow(folder: Path, reference: Path) -> None:
    """The same run, and the same plastic strain at its end."""
    assert_same_run(folder, reference)
    found, wanted = (last_frame(each)["plastic_strain"] for each in (folder, reference))
    assert np.abs(found - wanted).max() < 1e-6 * wanted.max()


def test_a_flowing_body_goes_on(tmp_path: Path, flowed: Path) -> None:
    """F_p and the accumulated plastic strain are in the checkpoint."""
    stopped_after(DUCTILE, tmp_path / "parts", int(np.flatnonzero(history(flowed)["broken_edges"])[0] + 1))
    run(DUCTILE, tmp_path / "parts", restart=True)
    assert_same_flow(tmp_path / "parts", flowed)
    plain = {key: value for key, value in DUCTILE.items() if key != "plasticity"} | {"output": TEARING["output"]}
    with pytest.raises(InputError, match=r"the body in .* has flowed; the study needs its \[plasticity\] table"):
        run(plain, tmp_path / "parts", restart=True)


def test_peak_reactions_and_totals_survive_a_restart(tmp_path: Path, whole: Path) -> None:
    stopped_after(TEARING, tmp_path / "out", 6)
    summary, wanted = run(TEARING, tmp_path / "out", restart=True), json.loads((whole / "summary.json").read_text())
    for key in ("steps", "time", "broken_edges", "split_cells", "pieces", "external_work", "dissipated"):
        assert summary[key] == pytest.approx(wanted[key], rel=1e-6), key
    assert summary["peak_reactions"] == pytest.approx(wanted["peak_reactions"], rel=1e-6)


def test_rows_and_frames_after_the_checkpoint_are_written_anew(tmp_path: Path, whole: Path) -> None:
    """A run with a checkpoint some steps ago that was then killed: what it wrote since is dropped."""
    stopped_after(TEARING, tmp_path / "early", 3)
    shutil.copytree(whole, tmp_path / "late")
    shutil.copytree(tmp_path / "early" / "checkpoint", tmp_path / "late" / "checkpoint")
    run(TEARING, tmp_path / "late", restart=True)
    assert_same_run(tmp_path / "late", whole)


def test_a_new_run_forgets_the_old_one(tmp_path: Path) -> None:
    """Once it is told to."""
    stopped_after(BAR, tmp_path / "out", 2)
    with pytest.raises(InputError, match=r"left a checkpoint there \(checkpoint/state\.h5\); go on with --res"):
        run(BAR, tmp_path / "out")
    Run(build_scene(MPI.COMM_SELF, study(BAR)), tmp_path / "out", overwrite=True)()
    assert not (tmp_path / "out" / "checkpoint" / "state.h5").exists()
    with pytest.raises(InputError, match="--restart: there is no checkpoint"):
        run(BAR, tmp_path / "out", restart=True)


def test_a_checkpoint_of_another_mesh_is_refused(tmp_path: Path) -> None:
    stopped_after(BAR, tmp_path / "out", 2)
    before = {path: path.read_bytes() for path in (tmp_path / "out").rglob("*") if path.is_file()}
    with pytest.raises(InputError, match=r"--restart: .*state\.h5 belongs to another mesh; run without --restart"):
        run(changed(BAR, mesh={"h": 0.125}), tmp_path / "out", restart=True)
    assert before == {path: path.read_bytes() for path in (tmp_path / "out").rglob("*") if path.is_file()}


def test_a_checkpoint_without_fracture_can_go_on_with_it(tmp_path: Path) -> None:
    """[fracture] may be added (nothing is broken then), and a torn body cannot lose it."""
    plain = changed(STRIP, fracture=None, output={"fields": []}, probe=[])
    torn = changed(STRIP, output={"fields": []}, probe=[])
    stopped_after(plain, tmp_path / "plain", 2)
    assert run(torn, tmp_path / "plain", restart=True)["broken_edges"] > 0
    stopped_after(torn, tmp_path / "torn", 8)
    with pytest.raises(InputError, match=r"the body in .* has broken edges; the study needs its \[fracture\] table"):
        run(plain, tmp_path / "torn", restart=True)


def test_a_damaged_checkpoint_is_refused(tmp_path: Path) -> None:
    stopped_after(BAR, tmp_path / "out", 2)
    (tmp_path / "out" / "checkpoint" / "state.h5").write_bytes(b"junk")
    with pytest.raises(InputError, match=r"--restart: cannot read .*state\.h5"):
        run(BAR, tmp_path / "out", restart=True)


# --- another study --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"material": {"young": 2e6}}, "material.young was 1000000.0, is 2000000.0"),
        ({"material": {"energy": "stvk"}}, 'material.energy was "neo-hookean", is "stvk"'),
        ({"fracture": {"radius": 0.1}}, "fracture.radius was 0.2, is 0.1"),
        (
            {"fracture": {"approach": "edge"}, "material": {"energy": "linear"}, "output": {"fields": []}},
            'material.energy was "neo-hookean", is "linear"; fracture.approach was "chi", is "edge"',
        ),
        ({"time": {"scheme": "newmark"}}, 'time.scheme was "generalized-alpha", is "newmark"'),
        ({"time": {"mass": "consistent"}}, 'time.mass was "lumped", is "consistent"'),
        ({"damping": None}, "damping.mass was 1.0, is absent; damping.stiffness was 0.0001, is absent"),
        ({"load": {"gravity": [0.0, -9.81]}}, "load.gravity was absent, is [0.0, -9.81]"),
        ({"brittle": {"surfaces": 3}}, "brittle.surfaces was absent, is 3"),
        ({"probe": []}, 'probe.0.name was "grip", is absent; probe.0.on was "right", is absent; probe.1.name was "'),
        (
            {"boundary": [{"on": "left", "fix": "xy"}, {"on": "right", "velocity": [2.0, 0.0]}]},
            "boundary.1.velocity was [1.0, 0.0], is [2.0, 0.0]",
        ),
    ],
)
def test_a_restart_of_another_study_is_refused(tmp_path: Path, stopped: Path, tables: Data, message: str) -> None:
    """With the keys, before anything is built, and nothing is written."""
    out = shutil.copytree(stopped, tmp_path / "out")
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    with pytest.raises(InputError) as refused:
        run_study(MPI.COMM_SELF, study(changed(TEARING, **tables)), out, restart=True)
    assert f"--restart: {out / 'checkpoint' / 'state.h5'} is of another study: {message}" in str(refused.value)
    assert (
        "Only time.step, time.end, time.adapt, time.smallest, time.breaking_step, time.until, [solver], [output]"
        in str(refused.value)
    )
    assert before == {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}


def test_tables_that_an_earlier_version_did_not_know_are_empty() -> None:
    """A list of tables is absent where it is empty, and not where it has an entry."""
    then: dict[str, object] = {"mesh": {"h": 0.1}}
    assert list(study_differences(then, then | {"crack": []})) == []
    (found,) = study_differences(then, then | {"crack": [{"segment": [0.0, 1.0]}]})
    assert found.startswith("crack.0.segment was absent")


def test_keys_that_an_earlier_version_did_not_know_have_their_defaults() -> None:
    """An older study.toml is that of today but for what it says otherwise; what is no study of today stays."""
    now = tomllib.loads(study_text(study(TEARING)))
    then = copy.deepcopy(now)
    assert then["fracture"].pop("crumbs") is True and then["mesh"].pop("order") == 1
    assert add_missing_defaults(then) == now
    then["fracture"]["strength"] *= 2
    assert [each.split()[0] for each in study_differences(add_missing_defaults(then), now)] == ["fracture.strength"]
    assert add_missing_defaults({"mesh": {"forgotten": 1}}) == {"mesh": {"forgotten": 1}}


@pytest.mark.parametrize("ranks", [0, 2])
def test_the_study_compared_is_that_of_the_checkpoint(tmp_path: Path, stopped: Path, ranks: int) -> None:
    """Not study.toml beside it, which may be what the user changed and gives as the study."""
    out = shutil.copytree(stopped, tmp_path / "out")
    path = out / "study.toml"
    path.write_text(path.read_text().replace("density = 1000.0", "density = 1500.0"))
    result = fracsim("run", path, "-o", out, "--restart", ranks=ranks)
    assert result.returncode == Exit.BAD_INPUT
    assert result.stderr.count("is of another study: material.density was 1000.0, is 1500.0. Only") == 1
    path.write_text(path.read_text().replace("density = 1500.0", "density = 1000.0"))
    assert fracsim("run", path, "-o", out, "--restart").returncode == Exit.DONE


def test_other_groups_on_the_same_mesh_are_another_mesh(tmp_path: Path) -> None:
    """A mesh file whose facet groups changed: what was held on the left would be held on the right."""
    path = tmp_path / "bar.msh"
    data = build_mesh(study(BAR).mesh)
    save_mesh(data, path)
    bar = {**BAR, "mesh": {"file": str(path)}}
    stopped_after(bar, tmp_path / "out", 2)
    groups = {**data.facet_groups, "left": data.facet_groups["right"], "right": data.facet_groups["left"]}
    save_mesh(dataclasses.replace(data, facet_groups=groups), path)
    with pytest.raises(InputError, match="belongs to another mesh"):
        run(bar, tmp_path / "out", restart=True)


@pytest.mark.parametrize("scheme", ["newmark", "rigid"])
def test_another_obstacle_file_is_refused(tmp_path: Path, scheme: str) -> None:
    """An obstacle of another shape under the same name; with the earlier file the run goes on."""
    wedge, out = tmp_path / "wedge.obj", tmp_path / "out"
    wedge.write_text(WEDGE)
    obstacle = {"name": "wedge", "shape": "mesh", "file": str(wedge), "at": [0.5, 0.1, 1.0]}
    data = {**BAR, "obstacle": [obstacle]}
    if scheme == "rigid":
        data = {name: data[name] for name in ("title", "mesh", "material", "obstacle")}
    data["time"] = {"scheme": scheme, "step": 0.01, "end": 0.1}
    with pytest.raises(Stopped):
        run_study(MPI.COMM_SELF, study(data), out, wall_limit=0.0)
    wedge.write_text(WEDGE.replace("0.1", "0.2"))
    with pytest.raises(InputError, match="has changed since"):
        run_study(MPI.COMM_SELF, study(data), out, restart=True)
    with h5py.File(out / "checkpoint" / "state.h5", "r") as stored:
        assert "# file obstacle.0.file: " in str(stored["notes"]["study"][()])
    wedge.write_text(WEDGE)
    run_study(MPI.COMM_SELF, study(data), out, restart=True)


def test_what_may_change_changes(tmp_path: Path, stopped: Path) -> None:
    """End, steps, solver, output and title; a shorter step is taken at once."""
    out = shutil.copytree(stopped, tmp_path / "out")
    other = changed(
        TEARING, title="strip, on", time={"end": 0.03, "step": 0.001, "adapt": False, "smallest": 1e-6},
        solver={"snes_rtol": 1e-8}, output={"fields": ["velocity"], "every": 2, "surface": False, "checkpoint": 100.0},
    )  # fmt: skip
    done = run(other, out, restart=True)
    assert done["title"] == "strip, on" and done["time"] == pytest.approx(0.03)
    assert np.allclose(history(out)["dt"], [0.005] * 4 + [0.001] * 10)


def test_an_end_before_the_checkpoint_is_told(
    tmp_path: Path, stopped: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """No step is taken, and a note says so; a run that is continued with the end that it had has no such note."""
    folder, time_ = tmp_path / "out", TEARING["time"]
    shutil.copytree(stopped, folder)
    rows = (folder / "history.csv").read_text()
    run(changed(TEARING, time={"end": time_["step"]}), folder, restart=True)
    assert f"time.end = {time_['step']:g} s lies before the checkpoint, at t = " in capsys.readouterr().err
    assert (folder / "history.csv").read_text() == rows
    once = tmp_path / "once"
    # ends after 1.5 steps, and the second is not shortened
    for restart in (False, True):
        run(changed(TEARING, time={"end": 1.5 * time_["step"]}, output={"checkpoint": 1e-9}), once, restart=restart)
    assert "lies before the checkpoint" not in capsys.readouterr().err


@pytest.mark.parametrize("text", ["step,time\r\n1,0.005\r\n", "nothing of a history"])
def test_a_history_with_other_columns_is_refused(tmp_path: Path, stopped: Path, text: str) -> None:
    out = shutil.copytree(stopped, tmp_path / "out")
    (out / "history.csv").write_text(text)
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    with pytest.raises(InputError, match=r"history\.csv has other columns than this study \(.*move it away to go on"):
        run(TEARING, out, restart=True)
    assert before == {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}


def test_fields_that_cannot_be_read_are_refused(tmp_path: Path, stopped: Path) -> None:
    """As a kill in the middle of a frame may leave them."""
    out = shutil.copytree(stopped, tmp_path / "out")
    (out / "fields.h5").write_bytes((out / "fields.h5").read_bytes()[:1000])
    rows = (out / "history.csv").read_bytes()
    with pytest.raises(InputError, match=r"cannot read .*fields\.h5 .*; move it away to go on without its frames"):
        run(TEARING, out, restart=True)
    assert (out / "history.csv").read_bytes() == rows
    (out / "fields.h5").unlink()
    assert run(TEARING, out, restart=True)["outcome"] == "done"


# --- a set-up that does not come to its end -------------------------------------------------------------------------


@pytest.fixture(scope="module")
def stopped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tearing strip, stopped after 4 of 10 steps."""
    folder = tmp_path_factory.mktemp("stopped") / "out"
    stopped_after(TEARING, folder, 4)
    return folder


FRAMES, SURFACE = "output.frame_files", "output.surface.surface_output"
OPENING = (
    "deformable_run.make_output_folder", "deformable_run.History", f"{FRAMES}.FieldEvaluator", f"{FRAMES}.FieldsFile",
    f"{SURFACE}.SurfaceFiles", f"{SURFACE}.BodySurface", "deformable_run.FrameSchedule",
    "output.atomic_write.os.replace",
)  # fmt: skip


def contents(folder: Path) -> frozenset[tuple[Path, bytes]]:
    return frozenset((path.relative_to(folder), path.read_bytes()) for path in folder.rglob("*") if path.is_file())


def test_a_restart_killed_in_its_first_moments_loses_nothing(
    tmp_path: Path, stopped: Path, whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is on the disk before and after each part of its set-up is what a kill leaves: each goes on to the same end.

    There are rows and frames that are later than the checkpoint, so that all files are written anew.
    """
    out, states = shutil.copytree(whole, tmp_path / "out"), []
    shutil.copytree(stopped / "checkpoint", out / "checkpoint")

    def watched(work: Any) -> Any:
        def call(*arguments: Any, **options: Any) -> Any:
            states.append(shutil.copytree(out, tmp_path / f"state-{len(states)}"))
            result = work(*arguments, **options)
            states.append(shutil.copytree(out, tmp_path / f"state-{len(states)}"))
            return result

        return call

    with monkeypatch.context() as patch:
        for where in OPENING:
            owner, _, name = f"fracsim.{where}".rpartition(".")
            owned = os if owner.endswith(".os") else importlib.import_module(owner)
            patch.setattr(owned, name, watched(getattr(owned, name)))
        Run(build_scene(MPI.COMM_SELF, study(TEARING)), out, restart=True)
    assert all(history(state)["step"][:4].tolist() == [1, 2, 3, 4] for state in states)
    different = {contents(state): state for state in states}
    assert len(states) > 20 and len(different) > 6
    for state in different.values():
        run(TEARING, state, restart=True)
        assert_same_run(state, whole)
        assert not list(state.rglob("*.new"))


@pytest.mark.parametrize("restart", [False, True])
def test_a_signal_during_the_set_up_is_neither_lost_nor_destroys(
    tmp_path: Path, stopped: Path, whole: Path, monkeypatch: pytest.MonkeyPatch, restart: bool
) -> None:
    """SIGUSR1 while the scene is built: nothing is written, and what was there is as it was."""
    out = shutil.copytree(stopped if restart else whole, tmp_path / "out")
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}

    def build(*arguments: Any) -> Any:
        os.kill(os.getpid(), signal.SIGUSR1)
        return build_scene(*arguments)

    monkeypatch.setattr("fracsim.deformable_run.build_scene", build)
    with pytest.raises(Stopped, match=r"^stopped by signal SIGUSR1 while the run was set up; nothing was written$"):
        run_study(MPI.COMM_SELF, study(TEARING), out, restart=restart)
    assert before == {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}


@pytest.mark.parametrize("restart", [False, True])
def test_a_signal_while_the_output_is_opened_ends_before_the_first_step(
    tmp_path: Path, stopped: Path, whole: Path, monkeypatch: pytest.MonkeyPatch, restart: bool
) -> None:
    """With a checkpoint, from which the run goes on to the same end."""
    out = shutil.copytree(stopped, tmp_path / "out") if restart else tmp_path / "out"
    with monkeypatch.context() as patch:

        def frames(*arguments: Any) -> Any:
            os.kill(os.getpid(), signal.SIGTERM)
            return FieldEvaluator(*arguments)

        patch.setattr("fracsim.output.frame_files.FieldEvaluator", frames)
        with pytest.raises(
            Stopped, match=r"signal SIGTERM before the first step, at t = .* s\. Checkpoint: .*state\.h5"
        ):
            run_study(MPI.COMM_SELF, study(TEARING), out, restart=restart)
    run(TEARING, out, restart=True)
    assert_same_run(out, whole)


@pytest.mark.parametrize("ranks", [0, 2])
def test_a_signal_right_after_the_start(tmp_path: Path, ranks: int) -> None:
    """As soon as the handlers are there, long before the first step: exit code 4, one message, no output."""
    bar = write_study(tmp_path / "bar.toml", BAR)
    slow = f"""
import os, sys, time
import fracsim.deformable_run
build = fracsim.deformable_run.build_scene
def slowly(*arguments):
    open({str(tmp_path)!r} + f"/ready-{{os.getpid()}}", "w").close()
    time.sleep({1.5 if ranks else 0.5})
    return build(*arguments)
fracsim.deformable_run.build_scene = slowly
sys.argv = ["fracsim", "run", {str(bar)!r}, "-o", {str(tmp_path / "out")!r}]
from fracsim.cli import main
main()
"""
    arguments = [*(mpirun(ranks) if ranks else []), sys.executable, "-c", slow]
    process = subprocess.Popen(arguments, stderr=subprocess.PIPE, text=True)
    until = time.monotonic() + 30
    while time.monotonic() < until and len(list(tmp_path.glob("ready-*"))) < max(ranks, 1):
        time.sleep(0.02)
    process.send_signal(signal.SIGUSR1)
    _, error = process.communicate(timeout=50)
    assert process.returncode == Exit.STOPPED, error
    assert error.count("fracsim: stopped by signal SIGUSR1 while the run was set up; nothing was written") == 1
    assert not (tmp_path / "out").exists()


# --- figures over all parts of a run --------------------------------------------------------------------------------

# squeezed beyond nothing and let out again in the first half, which takes halved steps, and still in the second
SQUEEZED: Data = changed(
    BAR, material={"energy": "stvk"}, time={"scheme": "backward-euler", "end": 0.08}, solver={"snes_max_it": 6},
    boundary=[
        {"on": "left", "fix": "xyz"},
        {"on": "right", "displacement": {"time": [0.0, 0.02, 0.04], "value": [[0, 0, 0], [-1.2, 0, 0], [0.01, 0, 0]]}},
    ],
)  # fmt: skip


def test_monitors_go_on_with_a_restart(tmp_path: Path) -> None:
    """What was seen before the checkpoint, and never again after it, is in the summary of the whole."""
    part = run(changed(SQUEEZED, time={"end": 0.06}, output={"checkpoint": 1e-9}), tmp_path)
    assert part["smallest_J"] < 0.2 and part["inverted_cells"] > 0 and part["steps_failed"] > 0
    (tmp_path / "history.csv").unlink()  # peaks are not taken from its rows
    found = run(SQUEEZED, tmp_path, restart=True)
    assert found["time"] == pytest.approx(0.08)
    for key in ("smallest_J", "inverted_cells", "steps_failed"):
        assert found[key] == part[key], key
    assert found["peak_reactions"]["reaction_grip_x"] == part["peak_reactions"]["reaction_grip_x"] > 0
    for key in ("wall", "cpu"):
        assert found[key] > part[key] > 0, key
    for key in ("setup", "solve", "energies"):  # a checkpoint does not know how long it takes itself, which is output
        assert found["seconds"][key] >= part["seconds"][key] > 0, key  # equal where a stage takes less than is printed
    assert sum(found["seconds"].values()) > sum(part["seconds"].values())
    assert found["peak_memory_MiB"] >= part["peak_memory_MiB"]


def test_a_gain_of_energy_is_told_after_a_restart(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Seen before the checkpoint alone."""
    first = Run(build_scene(MPI.COMM_SELF, study(BAR)), tmp_path, wall_limit=0.0)
    first.monitors.energy_balance.rise, first.monitors.energy_balance.scale = 3.0, 4.0
    with pytest.raises(Stopped):
        first()
    capsys.readouterr()
    run(BAR, tmp_path, restart=True)
    assert "the body gained 3 J of energy from nowhere, 75% of all" in capsys.readouterr().err


# --- ending early ---------------------------------------------------------------------------------------------------


def test_the_wall_limit_ends_a_run(tmp_path: Path) -> None:
    with pytest.raises(Stopped, match=r"stopped by the wall-time limit at t = 0\.01 s after 1 steps\. Checkpoint: "):
        run(BAR, tmp_path / "out", wall_limit=0.0)
    assert run(BAR, tmp_path / "out", restart=True)["steps"] == 3


def test_a_run_that_does_not_converge(tmp_path: Path) -> None:
    """One Newton iteration does not solve a large rotation, and no smaller step is allowed."""
    data = changed(
        BAR, material={"energy": "neo-hookean"}, time={"adapt": False}, solver={"snes_max_it": 1},
        boundary=[{"on": "left", "fix": "xyz"}, {"on": "right", "velocity": [-30, 5, 0]}],
    )  # fmt: skip
    with pytest.raises(NotConverged) as end:
        run(data, tmp_path / "out")
    message = str(end.value)
    assert message.startswith("no solution at t = 0.01 s with a step of 0.01 s (time.adapt is off). Newton's method")
    assert "Last good time: 0 s." in message
    assert f"Checkpoint: {tmp_path / 'out' / 'checkpoint' / 'state.h5'}; go on with --restart" in message
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["outcome"] == "not converged"
    # with more iterations it goes on from there
    assert run(changed(data, solver={"snes_max_it": 25}), tmp_path / "out", restart=True)["outcome"] == "done"


def test_the_exit_code_of_a_run_that_does_not_converge(tmp_path: Path) -> None:
    bar = write_study(tmp_path / "bar.toml", BAR, material={"energy": "neo-hookean"})
    hard = ["time.adapt=false", "solver.snes_max_it=1", "boundary.1.velocity=[-30, 5, 0]"]
    options = [option for each in hard for option in ("--set", each)]
    result = fracsim("run", bar, "-o", tmp_path / "out", *options, ranks=2)
    assert result.returncode == Exit.NOT_CONVERGED
    assert result.stderr.count("fracsim: no solution at t = 0.01 s") == 1
    assert "Traceback" not in result.stderr


@pytest.mark.parametrize(("name", "ranks"), [("SIGTERM", 0), ("SIGUSR1", 2)])
def test_a_signal_ends_a_run_with_a_checkpoint(tmp_path: Path, name: str, ranks: int) -> None:
    """On two ranks mpirun passes the signal on to its ranks."""
    code, error = signalled(tmp_path, name, ranks)
    assert code == Exit.STOPPED, error
    assert error.count(f"fracsim: stopped by signal {name} at t = ") == 1


def test_ending_mpirun_itself_leaves_a_checkpoint(tmp_path: Path) -> None:
    """mpirun returns a code of its own and drops the message, but gives its ranks a moment."""
    code, _ = signalled(tmp_path, "SIGTERM", 2)
    assert code != 0


def signalled(folder: Path, name: str, ranks: int) -> tuple[int, str]:
    """Exit code and stderr of a long run that gets a signal after some steps; its checkpoint is there."""
    bar = write_study(folder / "bar.toml", BAR, time={"step": 1e-4, "end": 10.0}, output={"every": 1000})
    arguments = command("run", bar, "-o", folder / "out", ranks=ranks)
    process = subprocess.Popen(arguments, stderr=subprocess.PIPE, text=True)
    rows = folder / "out" / "history.csv"
    until = time.monotonic() + 40
    while time.monotonic() < until and (not rows.exists() or rows.stat().st_size < 1000):
        time.sleep(0.05)
    process.send_signal(signal.Signals[name])
    _, error = process.communicate(timeout=50)
    assert (folder / "out" / "checkpoint" / "state.h5").exists()
    assert json.loads((folder / "out" / "summary.json").read_text())["outcome"] == "stopped"
    return process.returncode, error


# --- any number of ranks --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ranks", [0, pytest.param(3, marks=pytest.mark.ranks)])
def test_a_checkpoint_of_two_ranks_goes_on_with_others(tmp_path: Path, flowed: Path, ranks: int) -> None:
    """From one rank to two ranks after two steps; up to the first step that breaks edges, with a checkpoint after every
    step; then to the end on others. The yielding strip: F_p, damage and all else change ranks twice."""
    strip, out = write_study(tmp_path / "strip.toml", DUCTILE), tmp_path / "out"
    broken = history(flowed)["broken_edges"]
    steps = int(np.flatnonzero(broken)[0] + 1)
    stopped_after(DUCTILE, out, 2)
    assert steps > 2
    part = ["--set", f"time.end={0.005 * steps}", "--set", "output.checkpoint=1e-9"]
    first = fracsim("run", strip, "-o", out, "--restart", *part, ranks=2)
    assert first.returncode == 0, first.stderr
    assert first.stdout.count("Results in") == 1 and f"{steps} steps to t = " in first.stdout
    assert history(out)["broken_edges"][-1] == broken[steps - 1]
    second = fracsim("run", strip, "-o", out, "--restart", ranks=ranks)
    assert second.returncode == 0, second.stderr
    assert_same_flow(out, flowed)
