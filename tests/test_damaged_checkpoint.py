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

from cases import STRIP, changed, fracsim_here, write_study
from fracsim.errors import Exit
from fracsim.run import Run
from fracsim.scene import build_scene
from fracsim.study.file import validate
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
    while not run.breaks.figures[0]:
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


@pytest.mark.parametrize("kind", ["fifo", "folder"])
def test_what_is_no_file_is_not_opened(stopped: Path, tmp_path: Path, kind: str) -> None:
    """A FIFO would hang."""

    def damage(path: Path) -> None:
        path.unlink()
        os.mkfifo(path) if kind == "fifo" else path.mkdir()

    assert "there is no checkpoint" in refused(stopped, tmp_path, damage)
