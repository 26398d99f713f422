"""What `make attack` makes of trials: it counts them, and sees those that fail, crash or hang."""

from __future__ import annotations

import os
import random
import signal
import tempfile
import time
import tomllib
from pathlib import Path

import pytest

from attack import checkpoints, corpus, meshes, studies, trial

ENDS = {
    0: ("ran", None),
    1: ("wrong", "told so"),
    2: ("wrong", "ZeroDivisionError"),
    3: ("crashed", "ended by signal 9"),
    4: ("hangs", "did not end in time"),
}


def some(number: int, chance: random.Random, place: Path) -> str:
    """A trial of each end."""
    match number:
        case 1:
            raise trial.Wrong("told so")
        case 2:
            number // 0
        case 3:
            os.kill(os.getpid(), signal.SIGKILL)  # MPI, where a test before this one has begun it, takes SIGSEGV
        case 4:
            time.sleep(60)
    return "ran"


def test_trials_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Folders of those that failed stay."""
    monkeypatch.setattr(trial, "PATIENCE", 0.1)
    tally = trial.run_trials("some", some, list(ENDS), 1, tmp_path)
    wrong = dict(tally.failures)
    assert tally.trials == len(ENDS) and tally.ends == {"ran": 1, "wrong": 2, "crashed": 1, "hangs": 1}
    for number, (_, said) in ENDS.items():
        assert (tmp_path / f"some-{number}").exists() == (said is not None) == (number in wrong)
        assert said is None or said in wrong[number]


def leaves_a_file(number: int, chance: random.Random, place: Path) -> str:
    """A trial that fails, as a run that is killed, with something left in the temporary folder."""
    Path(tempfile.gettempdir(), "prterun.left").touch()
    raise trial.Wrong(f"{tempfile.gettempdir()} {os.environ['TMPDIR']}")


def test_a_trial_has_a_temporary_folder_of_its_own(tmp_path: Path) -> None:
    """Which goes with it: what killed runs leave there is in the way of no later one."""
    tally = trial.run_trials("some", leaves_a_file, [0, 1], 1, tmp_path)
    for number, wrong in tally.failures:
        own = tmp_path / f"some-{number}" / "tmp"
        assert wrong.startswith(f"{own} {own}") and own.parent.exists() and not own.exists()
    assert len(tally.failures) == 2


def test_files_of_all_formats_are_changed(tmp_path: Path) -> None:
    """Each file is read as it is, and has the cells that were written."""
    meshes.prepare(tmp_path)
    goods = {good.name: good for good in meshes._GOOD}
    assert {Path(name).suffix for name in goods} >= {
        *(".msh", ".vtk", ".vtu", ".vtp", ".pvtu", ".vtkhdf", ".exo", ".e", ".inp", ".unv", ".bdf", ".med", ".mesh"),
        *(".obj", ".stl", ".ply", ".off"),
    }
    for name in ("ascii.vtu", "binary.vtu", "raw.vtu", "zlib.vtu", "lzma.vtu", "a.vtk", "b.vtk", "a.pvtu", "a.vtkhdf"):
        assert goods[name].cells == 12, name
    for name in ("g2a.msh", "g2b.msh", "g4a.msh", "g4b.msh", "g.unv", "g.bdf", "g.inp"):
        assert goods[name].cells == goods["g4b.msh"].cells > 12, name
    assert goods["e6_tet10.e"].cells == 760 and len(list(goods["a8_main.inp"].folder.iterdir())) == 2


def test_changes_come_of_the_seed_alone(tmp_path: Path) -> None:
    """So that a trial can be repeated; most of the changed studies are still TOML, and none is the one it was."""
    base = corpus.STUDIES["strip"]
    texts = [studies.mutated(base, random.Random(f"1 studies {number}")) for number in range(200)]
    assert texts == [studies.mutated(base, random.Random(f"1 studies {number}")) for number in range(200)]
    assert len(set(texts)) > 180

    def is_toml(text: bytes) -> bool:
        try:
            return bool(tomllib.loads(text.decode()))
        except (UnicodeDecodeError, tomllib.TOMLDecodeError):
            return False

    assert 150 < sum(map(is_toml, texts)) < 200
    whole = bytes(range(256)) * 8 + b"1.0 2.0 3.0\n" * 50
    files = [meshes.mutated(whole, random.Random(number)) for number in range(50)]
    assert files == [meshes.mutated(whole, random.Random(number)) for number in range(50)] and whole not in files[:5]


def test_another_run_is_told_by_its_numbers(tmp_path: Path) -> None:
    """A row too few, and a number that differs by 1e-5."""
    for name, rows in {"a": ["1,1.0", "2,2.0"], "b": ["1,1.0", "2,2.00002"], "c": ["1,1.0"]}.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "history.csv").write_text("\n".join(["step,kinetic", *rows]) + "\n")
    assert not corpus.differences(tmp_path / "a", tmp_path / "a")
    assert "kinetic" in corpus.differences(tmp_path / "b", tmp_path / "a")[0]
    assert "rows" in corpus.differences(tmp_path / "c", tmp_path / "a")[0]


def test_damage_is_seen_by_content(tmp_path: Path) -> None:
    """An HDF5 file says the same where it is whole, and another thing where one number differs."""
    import h5py

    path = tmp_path / "state.h5"
    with h5py.File(path, "w") as file:
        file["u"], file.attrs["t"] = [1.0, 2.0], 0.5
    good = checkpoints.content_of(path)
    assert good == checkpoints.content_of(path)
    with h5py.File(path, "r+") as file:
        file["u"][1] = 3.0
    assert checkpoints.content_of(path) != good
