"""A checkpoint that is damaged is refused: exit 2 with its name, and nothing in the folder is changed."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from cases import STRIP, changed, fracsim, fracsim_here, write_study
from fracsim.deformable_run import Run, run_study
from fracsim.errors import Exit
from fracsim.scene import build_scene
from fracsim.study.reader import validate
from support import damaged_checkpoint as damaged

TORN: dict[str, Any] = changed(
    STRIP, mesh={"size": [1.0, 0.5], "h": 0.25}, probe=[], plasticity={"yield_stress": 1.2e4, "hardening": 1e5},
    fracture={"strength": 1.5e4, "radius": 0.3}, output={"fields": [], "surface": False},
)  # fmt: skip


@pytest.fixture(scope="module")
def stopped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a study, and in `out` the run of it after edges have broken, with a checkpoint."""
    folder = tmp_path_factory.mktemp("torn")
    write_study(folder / "torn.toml", TORN)
    run = Run(build_scene(MPI.COMM_SELF, validate(TORN, "torn.toml")), folder / "out")
    while not run.breaks.counts[0]:
        run.step()
    assert not run.ended
    run.write_frame()
    run.checkpoint()
    return folder


def refused(stopped: Path, tmp_path: Path, damage: Callable[[Path], None]) -> str:
    """What a restart from a damaged checkpoint says; it has the right exit code, and touches nothing."""
    out = shutil.copytree(stopped / "out", tmp_path / "out")
    path = out / "checkpoint" / "state.h5"
    damage(path)
    before = {each: (each.read_bytes(), each.stat().st_mtime_ns) for each in out.rglob("*") if each.is_file()}
    done = fracsim_here("run", stopped / "torn.toml", "-o", out, "--restart")
    assert done.returncode == Exit.BAD_INPUT, done.stderr
    assert done.stderr.count("fracsim: ") == 1 and "Traceback" not in done.stderr
    assert before == {each: (each.read_bytes(), each.stat().st_mtime_ns) for each in out.rglob("*") if each.is_file()}
    assert str(path) in done.stderr.replace("\n", "")
    return done.stderr


def test_whole_it_goes_on(stopped: Path, tmp_path: Path) -> None:
    """Else nothing here would say anything. A checkpoint that was sealed once more is as good."""
    out = shutil.copytree(stopped / "out", tmp_path / "out")
    damaged.resealed(out / "checkpoint" / "state.h5", lambda file: None)
    assert fracsim_here("run", stopped / "torn.toml", "-o", out, "--restart").returncode == 0


@pytest.mark.parametrize("kind", damaged.RAW)
def test_bytes_are_another(stopped: Path, tmp_path: Path, kind: str) -> None:
    assert "digest" in refused(stopped, tmp_path, damaged.RAW[kind])


@pytest.mark.parametrize("kind", damaged.EDITS)
def test_what_cannot_be_is_refused_whatever_the_digest_says(stopped: Path, tmp_path: Path, kind: str) -> None:
    """As a program with a fault would have written it."""
    said = refused(stopped, tmp_path, lambda path: damaged.resealed(path, damaged.EDITS[kind]))
    assert "digest" not in said


@pytest.mark.parametrize("kind", ["no u", "u nan", "weakened permuted", "t nan", "u elsewhere", "an array more"])
def test_what_was_changed_is_refused_by_its_digest(stopped: Path, tmp_path: Path, kind: str) -> None:
    assert "damaged: its digest" in refused(stopped, tmp_path, lambda path: damaged.edit(path, damaged.EDITS[kind]))


def test_numbers_that_could_be_are_refused_by_the_digest(stopped: Path, tmp_path: Path) -> None:
    """A later time, a share of the damage: no check of values finds these."""

    def later(file: Any) -> None:
        file.attrs["t"] = 1e9
        file["chi"][...] = np.clip(0.5 * file["chi"][()], 0.0, 1.0)

    assert "damaged: its digest" in refused(stopped, tmp_path, lambda path: damaged.edit(path, later))


@pytest.mark.ranks
def test_on_two_ranks_there_is_one_message(stopped: Path, tmp_path: Path) -> None:
    """Of what rank 0 sees, and of edges, for which all ranks look."""
    for kind, said in (("chi above 1", "chi is not all from"), ("weakened no edges", "are none of the mesh")):
        out = shutil.copytree(stopped / "out", tmp_path / kind)
        damaged.resealed(out / "checkpoint" / "state.h5", damaged.EDITS[kind])
        done = fracsim("run", stopped / "torn.toml", "-o", out, "--restart", ranks=2)
        assert done.returncode == Exit.BAD_INPUT and done.stderr.count(said) == 1, done.stderr
        assert done.stderr.count("fracsim: --restart: cannot read") == 1 and "Traceback" not in done.stderr


@pytest.mark.parametrize("name", ["is_new", "share", "stiffness", "left_out"])
def test_histories_of_contact_that_do_not_fit_are_refused(name: str, tmp_path: Path) -> None:
    """Arrays with other rows: how many there are, and of what, is known to the surface alone."""
    pytest.importorskip("ipctk", reason="an environment made without a network")
    study = {
        "title": "touches itself", "mesh": {"builder": "box", "size": [0.4, 0.2, 0.2], "h": 0.1}, "contact": {},
        "material": {"energy": "neo-hookean", "young": 1e6, "poisson": 0.3, "density": 1000.0},
        "fracture": {"strength": 1e4},
        "boundary": [{"on": "left", "fix": "xyz"}, {"on": "right", "velocity": [2.0, 0.0, 0.0]}],
        "time": {"scheme": "backward-euler", "step": 2e-3, "end": 8e-3},
        "output": {"every": 10, "picture": False, "checkpoint": 1e-9},
    }  # fmt: skip
    run_study(MPI.COMM_SELF, validate(study, "torn.toml"), tmp_path / "out")
    write_study(tmp_path / "torn.toml", study, time={"end": 0.012})
    edit = damaged.array(f"term.contact.{name}", lambda values: values[:0] if len(values) else np.array([5.0]))
    assert "do not fit" in refused(tmp_path, tmp_path / "again", lambda path: damaged.resealed(path, edit))


@pytest.mark.parametrize("kind", ["fifo", "folder"])
def test_what_is_no_file_is_not_opened(stopped: Path, tmp_path: Path, kind: str) -> None:
    """A FIFO would hang."""

    def damage(path: Path) -> None:
        path.unlink()
        os.mkfifo(path) if kind == "fifo" else path.mkdir()

    said = "is a named pipe, not a file" if kind == "fifo" else "is a folder, not a file"
    assert said in refused(stopped, tmp_path, damage)


# --- of rigid bodies --------------------------------------------------------------------------------------------------

FALLING: dict[str, Any] = {
    "title": "falls", "mesh": {"builder": "box", "size": [0.6, 0.2, 0.2], "h": 0.1},
    "material": {"energy": "linear", "young": 1e10, "poisson": 0.2, "density": 2000.0},
    "fracture": {"strength": 3e5, "kernel": "neighbours"}, "brittle": {"surfaces": 4},
    "body": [{"position": [0.0, 0.0, 0.05], "rotation": [0.0, -0.1, 0.0], "velocity": [0.0, 0.0, -4.0]}],
    "obstacle": [{"name": "floor", "shape": "plane", "at": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}],
    "load": {"gravity": [0.0, 0.0, -9.81]}, "time": {"scheme": "rigid", "step": 2e-3, "end": 0.03},
    "output": {"every": 10, "picture": False, "checkpoint": 1e-9},
}  # fmt: skip


@pytest.fixture(scope="module")
def fallen(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same of a bar that has fallen and broken, at its end, and a study that ends later."""
    pytest.importorskip("mujoco", reason="an environment made without a network")
    folder = tmp_path_factory.mktemp("fallen")
    assert run_study(MPI.COMM_SELF, validate(FALLING, "torn.toml"), folder / "out")["broken_edges"] > 0
    write_study(folder / "torn.toml", FALLING, time={"end": 0.036})
    return folder


def _few(file: Any) -> None:
    """One body less."""
    for name in [each for each in file if each.startswith("body.")]:
        values = file[name][:-1]
        del file[name]
        file[name] = values


RIGID: dict[str, damaged.Edit] = {
    **{f"no {name}": damaged.without(name) for name in (
        "body.mass", "body.turn", "overlap.depth", "known.quiet", "broken_at", "worked", "broken", "cut", "starts_of",
        "start", "work", "t",
    )},
    **{f"{name} nan": damaged.at(name, np.nan)
       for name in ("body.place", "body.spin", "known.borne", "worked", "broken_at")},
    "body.velocity of 1e300": damaged.at("body.velocity", 1e300), "a body less": _few,
    "body.turn flat": damaged.array("body.turn", lambda turn: turn.reshape(len(turn), -1)),
    "broken negative": damaged.at("broken", -1), "broken far out": damaged.at("broken", 10**9),
    "broken short": damaged.array("broken", lambda keys: keys[1:]), "starts_of far out": damaged.at("starts_of", 7),
    "broken_at short": damaged.array("broken_at", lambda at: at[:-1]),
    "worked long": damaged.array("worked", lambda worked: np.append(worked, 0.0)),
    **{f"{name} long": damaged.array(name, lambda values: np.concatenate([values, values[:1]]))
       for name in ("known.quiet", "known.borne")},
    "known.names of fractions": damaged.array("known.names", lambda names: names + 0.5),
    "start nan": damaged.number("start", np.nan), "step -5": damaged.number("step", -5),
    "t nan": damaged.number("t", np.nan), "an array more": lambda file: file.__setitem__("more", [1.0]),
}  # fmt: skip


@pytest.mark.parametrize("kind", RIGID)
def test_rigid_bodies_that_cannot_be_are_refused(fallen: Path, tmp_path: Path, kind: str) -> None:
    said = refused(fallen, tmp_path, lambda path: damaged.resealed(path, RIGID[kind]))
    assert "digest" not in said


def test_rigid_bodies_go_on_from_a_whole_one(fallen: Path, tmp_path: Path) -> None:
    out = shutil.copytree(fallen / "out", tmp_path / "out")
    damaged.resealed(out / "checkpoint" / "state.h5", lambda file: None)
    assert fracsim_here("run", fallen / "torn.toml", "-o", out, "--restart").returncode == 0
    said = refused(fallen, tmp_path / "edited", lambda path: damaged.edit(path, RIGID["body.place nan"]))
    assert "damaged: its digest" in said
