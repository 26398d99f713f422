"""What a restart finds of the rows and frames of the run before it: what is missing is named, never lost in silence."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from mpi4py import MPI

from cases import BAR, changed, fracsim_here, write_study
from fracsim.deformable_run import Run
from fracsim.errors import Exit
from fracsim.scene import build_scene
from fracsim.study.reader import validate

LONG: dict[str, Any] = changed(BAR, time={"step": 0.01, "end": 0.12}, output={"surface": True})


@pytest.fixture(scope="module")
def stopped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study, and in `out` nine of its twelve steps, with a checkpoint after the eighth."""
    folder = tmp_path_factory.mktemp("rows")
    write_study(folder / "bar.toml", LONG)
    run = Run(build_scene(MPI.COMM_SELF, validate(LONG, "bar.toml")), folder / "out")
    for step in range(1, 10):
        run.step()
        run.write_frame()
        if step == 8:
            run.checkpoint()
    return folder


def lines(folder: Path) -> list[bytes]:
    return (folder / "history.csv").read_bytes().splitlines(keepends=True)


def resumed(stopped: Path, tmp_path: Path, change: Callable[[Path], Any]) -> tuple[Path, str, list[int]]:
    """The folder of a run that went on in a changed one, the notes it said, and the steps that have rows."""
    out = shutil.copytree(stopped / "out", tmp_path / "out")
    change(out)
    done = fracsim_here("run", stopped / "bar.toml", "-o", out, "--restart")
    assert done.returncode == 0, done.stderr
    head, *rows = lines(out)
    assert head == lines(stopped / "out")[0] and all(row.endswith(b"\r\n") for row in rows)
    return out, done.stderr, [int(row.split(b",")[0]) for row in rows]


def rewritten(change: Callable[[list[bytes]], list[bytes]]) -> Callable[[Path], Any]:
    return lambda out: (out / "history.csv").write_bytes(b"".join(change(lines(out))))


def test_nothing_is_said_where_nothing_is_missing(stopped: Path, tmp_path: Path) -> None:
    """The row after the checkpoint is that of a step that is taken once more; a byte order mark is no other table."""
    _, said, steps = resumed(stopped, tmp_path, rewritten(lambda rows: [b"\xef\xbb\xbf" + rows[0], *rows[1:]]))
    assert "note: " not in said and steps == [*range(1, 13)]


def without_line_end(rows: list[bytes]) -> list[bytes]:
    """The row of step 8 loses its last digits, and all after it: as many columns as before, and another number."""
    return [*rows[:8], rows[8][:-5]]


@pytest.mark.parametrize(
    ("change", "why", "missing"),
    [
        (lambda out: (out / "history.csv").unlink(), "is gone", "1 to 8"),
        (rewritten(lambda rows: []), "is empty", "1 to 8"),
        (rewritten(lambda rows: rows[:1]), "is cut or damaged", "1 to 8"),
        (rewritten(lambda rows: [rows[0][:20]]), "is cut or damaged", "1 to 8"),
        (rewritten(lambda rows: rows[:4]), "is cut or damaged", "4 to 8"),
        (rewritten(without_line_end), "is cut or damaged", "8"),
        (rewritten(lambda rows: [*rows[:3], *rows[4:6], *rows[7:]]), "is cut or damaged", "3, 6"),
        (rewritten(lambda rows: [*rows[:3], b"\0" * 70 + b"\r\n", *rows[4:]]), "is cut or damaged", "3"),
        (rewritten(lambda rows: [*rows[:5], rows[5].replace(b"5,", b"x,", 1), *rows[6:]]), "is cut or damaged", "5"),
    ],
    ids=["gone", "empty", "head alone", "in its head", "later rows", "in its last number", "rows between", "zeros",
         "words"],
)  # fmt: skip
def test_rows_that_are_missing_are_named(
    stopped: Path, tmp_path: Path, change: Callable[[Path], Any], why: str, missing: str
) -> None:
    """With the file and the steps; the run goes on, and the rows that are there stay."""
    out, said, steps = resumed(stopped, tmp_path, change)
    word = "step" if missing.isdigit() else "steps"
    note = (
        f"note: {out / 'history.csv'} {why}: the rows of {word} {missing} are missing, of the 8 that the run had taken"
    )
    assert note in said and said.count("note: ") == 1
    gone = {step for a, b in re.findall(r"(\d+)(?: to (\d+))?", missing) for step in range(int(a), int(b or a) + 1)}
    assert steps == [step for step in range(1, 13) if step not in gone]


@pytest.mark.parametrize("content", [b"\xff\xfe\x00s", "step,é\r\n".encode("latin-1"), b"\x00" * 400 + b"\n"])
def test_what_is_not_text_is_set_aside(stopped: Path, tmp_path: Path, content: bytes) -> None:
    """Under a name that is free, and is said."""

    def change(out: Path) -> None:
        (out / "history.csv").write_bytes(content)
        (out / "history.csv.unreadable").write_text("an earlier one")

    out, said, steps = resumed(stopped, tmp_path, change)
    assert (out / "history.csv.unreadable2").read_bytes() == content and steps == [9, 10, 11, 12]
    assert (out / "history.csv.unreadable").read_text() == "an earlier one"
    assert "the rows of steps 1 to 8 are missing" in said and f"it is {out / 'history.csv.unreadable2'}" in said


def test_rows_that_are_there_twice_are_said(stopped: Path, tmp_path: Path) -> None:
    """As two runs in one folder left them: the last ones stay, in order."""
    _, said, steps = resumed(stopped, tmp_path, rewritten(lambda rows: [*rows[:6], *rows[3:]]))
    assert "had the rows of steps 3 to 5 twice: the last ones are kept" in said and steps == [*range(1, 13)]


@pytest.mark.parametrize("name", ["fields.h5", "surface.pvd", "pieces.csv"])
def test_frames_that_are_missing_are_counted(stopped: Path, tmp_path: Path, name: str) -> None:
    """Of each file by itself."""
    out, said, _ = resumed(stopped, tmp_path, lambda out: (out / name).unlink())
    assert f"note: {out / name} has 0 of the 8 frames that the run had written: the others are missing" in said
    assert said.count("note: ") == (2 if name == "surface.pvd" else 1)  # pieces.csv is of the same frames


@pytest.mark.parametrize("name", ["surface.pvd", "pieces.csv", "fields.h5"])
def test_files_of_frames_that_are_not_text_are_refused(stopped: Path, tmp_path: Path, name: str) -> None:
    """Before anything is changed."""
    out = shutil.copytree(stopped / "out", tmp_path / "out")
    (out / name).write_bytes(b"\xff\xfe\x00")
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    done = fracsim_here("run", stopped / "bar.toml", "-o", out, "--restart")
    assert done.returncode == Exit.BAD_INPUT
    assert f"--restart: cannot read {out / name}" in done.stderr and "move it away" in done.stderr
    assert before == {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}


def test_a_rigid_run_names_them_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("mujoco", reason="an environment made without a network")
    from fracsim.deformable_run import run_study

    def study(end: float) -> Any:
        return validate({
            "title": "falls", "mesh": {"builder": "box", "size": [0.6, 0.2, 0.2], "h": 0.1},
            "material": {"energy": "linear", "young": 1e10, "poisson": 0.2, "density": 2000.0},
            "body": [{"position": [0.0, 0.0, 0.0]}], "load": {"gravity": [0.0, 0.0, -9.81]},
            "time": {"scheme": "rigid", "step": 2e-3, "end": end},
            "output": {"every": 1, "picture": False, "checkpoint": 1e-9},
        }, "falls.toml")  # fmt: skip

    run_study(MPI.COMM_SELF, study(0.01), tmp_path)
    rows = lines(tmp_path)
    (tmp_path / "history.csv").write_bytes(b"".join([*rows[:2], *rows[3:]]))
    (tmp_path / "surface.pvd").unlink()
    capsys.readouterr()
    run_study(MPI.COMM_SELF, study(0.02), tmp_path, restart=True)
    said = capsys.readouterr().err
    assert "the rows of step 2 are missing, of the 5 that the run had taken" in said
    assert "surface.pvd has 0 of the" in said and "nothing" not in said
