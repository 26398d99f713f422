"""fracsim sweep: combinations, resuming, failures, the list for job arrays."""

from __future__ import annotations

import csv
import dataclasses
import json
import os
import shlex
import signal
import subprocess
import time
from pathlib import Path

import pytest

from cases import BAR, WEDGE, command, fracsim, fracsim_here, mpirun, study, swept_here, write_study
from fracsim import __version__
from fracsim.errors import InputError
from fracsim.report import sweep
from fracsim.report.runs import read_last_message
from fracsim.report.sweep import case_folder_name, split_values, sweep_cases
from fracsim.study.mesh_source import build_mesh, save_mesh
from fracsim.study.reader import input_file_lines

KEYS = ("--set", "mesh.h=0.25,0.125", "--set", "time.step=0.01,0.015")


def rows(out: Path) -> list[dict[str, str]]:
    with (out / "sweep.csv").open(newline="") as file:
        return list(csv.DictReader(file))


# --- combinations ---------------------------------------------------------------------------------------------------


def test_commas_inside_brackets_and_quotes_part_nothing() -> None:
    assert split_values("[1, 1, 1],[2,1,1]") == ["[1, 1, 1]", "[2,1,1]"]
    assert split_values('"a,b",c') == ['"a,b"', "c"]
    assert split_values("{a = [1,2], b = 3},4") == ["{a = [1,2], b = 3}", "4"]
    assert split_values("1e-3") == ["1e-3"]


def test_every_combination_has_a_readable_folder_of_its_own(tmp_path: Path) -> None:
    sets = ["mesh.h=0.02,0.01", "time.scheme=newmark,explicit", "mesh.size=[1,1,1],[2,1,1]"]
    cases = sweep_cases(sets, tmp_path)
    assert len({case.folder for case in cases}) == 2 * 2 * 2
    assert cases[0].overrides == ["mesh.h=0.02", "time.scheme=newmark", "mesh.size=[1,1,1]"]
    assert cases[1].values["mesh.size"] == "[2,1,1]", "the last key changes fastest"
    assert cases[0].folder.name.startswith("h-0.02_scheme-newmark_size-1-1-1")


def test_names_that_lose_characters_stay_apart() -> None:
    assert case_folder_name({"h": "0.02", "scheme": "newmark"}) == "h-0.02_scheme-newmark"
    assert (
        case_folder_name({"size": "[1,11]"})
        != case_folder_name({"size": "[11,1]"})
        != case_folder_name({"size": "[1-11]"})
    )
    assert len(case_folder_name({"a": "x" * 300})) < 120
    assert "/" not in case_folder_name({"file": "../part.msh"}) and not case_folder_name(
        {"file": "../part.msh"}
    ).startswith(".")


def test_keys_with_the_same_end_are_written_out(tmp_path: Path) -> None:
    (case,) = sweep_cases(["solver.a.tol=1", "other.tol=2"], tmp_path)
    assert case.folder.name == "solver.a.tol-1_other.tol-2"


@pytest.mark.parametrize(
    ("sets", "words"),
    [
        ([], "a sweep needs values"),
        (["mesh.h"], "write key=a,b,c"),
        (["mesh.h=1,,2"], "empty value"),
        (["mesh.h=1,2,1"], "1 comes up twice"),
        (["mesh.h=1", "mesh.h=2"], "mesh.h is given twice"),
    ],
)
def test_what_is_no_sweep(sets: list[str], words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=words):
        sweep_cases(sets, tmp_path)


# --- running --------------------------------------------------------------------------------------------------------


def test_a_sweep_runs_every_case_and_then_none_again(tmp_path: Path) -> None:
    bar, out = write_study(tmp_path / "bar.toml", BAR), tmp_path / "out"
    keys = ("--set", "mesh.h=0.25", "--set", "time.step=0.01,0.015")
    done = swept_here(bar, *keys, "-o", out)
    assert done.returncode == 0, done.stderr
    table = rows(out)
    assert [(row["mesh.h"], row["time.step"], row["steps"]) for row in table] == [
        ("0.25", "0.01", "3"), ("0.25", "0.015", "2"),
    ]  # fmt: skip
    for row in table:
        summary = json.loads((out / row["case"] / "summary.json").read_text())
        assert float(row["peak_reaction_grip_x"]) == summary["peak_reactions"]["reaction_grip_x"] > 0
    before = {path: path.stat().st_mtime_ns for path in out.glob("*/summary.json")}
    again = fracsim_here("sweep", bar, *keys, "-o", out)  # starts nothing
    assert again.returncode == 0 and again.stdout.count("done before") == 2
    assert {path: path.stat().st_mtime_ns for path in out.glob("*/summary.json")} == before


def test_a_changed_study_is_run_again(tmp_path: Path) -> None:
    bar, out = write_study(tmp_path / "bar.toml", BAR), tmp_path / "out"
    swept_here(bar, "--set", "mesh.h=0.25", "-o", out)
    write_study(bar, BAR, material={"young": 2e6})
    assert "done before" not in swept_here(bar, "--set", "mesh.h=0.25", "-o", out).stdout


@pytest.mark.parametrize("kind", ["mesh", "obstacle"])
def test_a_changed_file_is_run_again(tmp_path: Path, kind: str) -> None:
    """A case is run again if its mesh or obstacle file has other contents, not if it was only written anew."""
    part, wedge, out = tmp_path / "part.msh", tmp_path / "wedge.obj", tmp_path / "out"
    data = build_mesh(study(BAR).mesh)
    save_mesh(data, part)
    wedge.write_text(WEDGE)
    obstacle = {"name": "wedge", "shape": "mesh", "file": str(wedge), "at": [0.5, 0.1, 1.0]}
    bar = write_study(tmp_path / "bar.toml", {**BAR, "mesh": {"file": str(part)}, "obstacle": [obstacle]})
    keys = ("--set", "time.step=0.015", "-o", out)
    assert swept_here(bar, *keys).returncode == 0
    path = part if kind == "mesh" else wedge
    path.write_bytes(path.read_bytes())
    assert "done before" in swept_here(bar, *keys).stdout
    if kind == "mesh":
        save_mesh(dataclasses.replace(data, points=1.5 * data.points), part)
    else:
        wedge.write_text(WEDGE.replace("0.1", "0.2"))
    assert "done before" not in swept_here(bar, *keys).stdout


def test_a_file_beside_the_mesh_file_counts(tmp_path: Path) -> None:
    """XDMF of meshio keeps points and cells in HDF5, and names it alone."""
    mesh = tmp_path / "part.xdmf"
    mesh.write_text("<Xdmf/>")
    data = study({**BAR, "mesh": {"file": str(mesh)}})
    (key,) = [line.rpartition(": ")[0] for line in input_file_lines(data)]
    assert key == "file mesh.file"
    mesh.with_suffix(".h5").write_bytes(b"1")
    first = input_file_lines(data)
    mesh.with_suffix(".h5").write_bytes(b"2")
    assert len(first) == 2 and first[0] == input_file_lines(data)[0] and first[1] != input_file_lines(data)[1]


def test_a_failing_case_leaves_the_others_alone(tmp_path: Path) -> None:
    """A solver that may take no Newton iteration does not converge; the next one does."""
    out = tmp_path / "out"
    options = ("--set", "solver.snes_max_it=0,20", "--set", "time.adapt=false")
    done = swept_here(write_study(tmp_path / "bar.toml", BAR), *options, "-o", out)
    assert done.returncode == 3
    assert (
        "1 of 2 runs did not end well: snes_max_it-0_adapt-false (not converged: no solution at t = 0.01" in done.stderr
    )
    assert [row["outcome"].partition(":")[0] for row in rows(out)] == ["not converged", "done"]


def test_a_case_of_another_version_is_kept_and_named(tmp_path: Path) -> None:
    bar, out = write_study(tmp_path / "bar.toml", BAR), tmp_path / "out"
    swept_here(bar, "--set", "mesh.h=0.25", "-o", out)
    summary = out / "h-0.25" / "summary.json"
    values = json.loads(summary.read_text())
    values["versions"]["fracsim"] = "0.0.1"
    summary.write_text(json.dumps(values))
    words = f"done before, by fracsim 0.0.1; this is {__version__}: delete its folder to run it again"
    again = swept_here(bar, "--set", "mesh.h=0.25", "-o", out)
    assert again.returncode == 0 and words in again.stdout and rows(out)[0]["outcome"] == words
    values["versions"]["fracsim"] = __version__
    summary.write_text(json.dumps(values))
    assert swept_here(bar, "--set", "mesh.h=0.25", "-o", out).stdout.splitlines()[0].endswith("h-0.25: done before")


def test_notes_of_a_case_are_counted_and_in_the_table(tmp_path: Path) -> None:
    """A pulse that no step of the first case ends at; the second case has no note."""
    pulse = {"time": [0.004, 0.005, 0.006], "value": [0.0, 1.0, 0.0]}
    held = [{"on": "left", "fix": "xyz"}, {"on": "right", "pressure": pulse}]
    plain = {"scheme": "quasi-static", "end": 0.02}
    bar = write_study(tmp_path / "bar.toml", BAR, boundary=held, probe=[], time=plain)
    out = tmp_path / "out"
    done = swept_here(bar, "--set", "time.step=0.01,0.005", "-o", out)
    first, second = (line for line in done.stdout.splitlines() if line.startswith("["))
    assert first.endswith(f"done (1 note in {out / 'step-0.01' / 'log.txt'})") and second.endswith("done")
    notes = [row["notes"] for row in rows(out)]
    assert notes[0].startswith("boundary.1.pressure has a peak at t = 0.005 s") and notes[1] == ""


@pytest.mark.parametrize(
    ("log", "words"),
    [
        ("fracsim: note: a\nfracsim: no solution\nmpirun: one process ended\n\n", "fracsim: no solution"),
        ("Traceback\n  fracsim: indented\nboom\n \n", "boom"),
        ("\n  \n", ""),
    ],
)
def test_the_last_words_are_the_programs_own_where_it_spoke(log: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "log.txt").write_text(log)
    assert read_last_message(tmp_path / "log.txt") == words


def test_nothing_runs_where_one_combination_is_wrong(tmp_path: Path) -> None:
    out = tmp_path / "out"
    options = ("--set", "mesh.h=0.25,-1")
    done = fracsim_here("sweep", write_study(tmp_path / "bar.toml", BAR), *options, "-o", out)
    assert done.returncode == 2 and "h--1" in done.stderr and "Nothing was run" in done.stderr
    assert not out.exists()


def test_two_ways_to_write_a_value_are_one_case(tmp_path: Path) -> None:
    bar, out = write_study(tmp_path / "bar.toml", BAR), tmp_path / "out"
    done = fracsim_here("sweep", bar, "--set", "mesh.h=0.25,0.125", "--set", "time.step=0.01,1e-2", "-o", out)
    assert done.returncode == 2 and "--set: time.step = 0.01 and 1e-2 are the same value" in done.stderr
    assert not out.exists()


def test_the_folder_of_a_run_is_not_that_of_a_sweep(tmp_path: Path) -> None:
    bar, out = write_study(tmp_path / "bar.toml", BAR), tmp_path / "out"
    assert fracsim_here("run", bar, "-o", out).returncode == 0
    before = sorted(out.iterdir())
    done = fracsim_here("sweep", bar, "--set", "mesh.h=0.25,0.125", "-o", out)
    assert done.returncode == 2 and f"--out {out}: the folder is that of a run" in done.stderr
    assert sorted(out.iterdir()) == before


def test_the_list_has_a_whole_command_a_line(tmp_path: Path) -> None:
    bar, out = write_study(tmp_path / "bar.toml", BAR), tmp_path / "out of the way"
    listed = fracsim("sweep", bar, *KEYS, "-o", out, "--list")
    lines = listed.stdout.splitlines()
    assert listed.returncode == 0 and len(lines) == 4 and not out.exists()
    words = shlex.split(lines[1])
    assert words[:2] == ["fracsim", "run"] and words[-1] == str(out / "h-0.25_step-0.015")
    assert fracsim(*words[1:]).returncode == 0
    assert json.loads((out / "h-0.25_step-0.015" / "summary.json").read_text())["steps"] == 2


def test_the_list_of_a_sweep_that_is_done_does_nothing(tmp_path: Path) -> None:
    """Each line by a shell, as a job array does, leaves what is there as it is; lines keep their numbers."""
    bar, out = write_study(tmp_path / "bar.toml", BAR), tmp_path / "out of the way"
    keys = ("--set", "mesh.h=0.25", "--set", "time.step=0.01,0.015")
    assert swept_here(bar, *keys, "-o", out).returncode == 0
    (out / "h-0.25_step-0.015" / "summary.json").unlink()
    lines = fracsim("sweep", bar, *keys, "-o", out, "--list").stdout.splitlines()
    assert len(lines) == 2 and lines[1].startswith("fracsim run")
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*")}
    assert subprocess.run(lines[0], shell=True, check=True, capture_output=True).stdout == b""
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*")} == before


@pytest.mark.parametrize("name", ["PMI_SIZE", "PMIX_RANK", "OMPI_COMM_WORLD_SIZE"])
def test_the_list_needs_no_clean_environment(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a job of Slurm these are there without mpirun. The first process lists, the others say nothing; one process
    alone may sweep, and its runs do not see them."""
    bar, out = write_study(tmp_path / "bar.toml", BAR), tmp_path / "out"
    monkeypatch.setenv(name, "0" if name == "PMIX_RANK" else "1")
    assert "PMI" not in " ".join(sweep._run_environment()) and "OMPI_COMM" not in " ".join(sweep._run_environment())
    sweep._refuse_mpirun()
    monkeypatch.setenv(name, "1" if name == "PMIX_RANK" else "4")
    listed = fracsim("sweep", bar, *KEYS, "-o", out, "--list")
    assert listed.returncode == 0 and len(listed.stdout.splitlines()) == (0 if name == "PMIX_RANK" else 4)
    with pytest.raises(InputError, match="call it without mpirun"):
        sweep._refuse_mpirun()


def test_a_stopped_sweep_goes_on_from_its_checkpoint(tmp_path: Path) -> None:
    """SIGTERM ends the running case with a checkpoint; the same command goes on from it, not from the start."""
    bar = write_study(tmp_path / "bar.toml", BAR, time={"step": 1e-4, "end": 0.05}, output={"every": 1000})
    out = tmp_path / "out"
    arguments = ("sweep", bar, "--set", "time.end=0.05,0.001", "-o", out)
    process = subprocess.Popen(command(*arguments), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    history = out / "end-0.05" / "history.csv"
    deadline = time.monotonic() + 40
    while not (history.exists() and len(history.read_text().splitlines()) > 20) and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate(timeout=30)
    assert process.returncode == 4 and "interrupted after 0 of 2 runs" in said
    steps = len(history.read_text().splitlines()) - 1
    assert 20 <= steps < 500, "the run must have been stopped on its way"
    line = fracsim(*arguments, "--list").stdout.splitlines()[0]
    assert line.endswith("--restart")
    named = fracsim(*arguments, "--set", "material.young=1e6", "--list").stdout
    assert "--restart" not in named, "the same study by another name has folders of its own"
    first = history.read_text().splitlines()[: steps + 1]
    assert swept_here(*arguments[1:]).returncode == 0
    assert history.read_text().splitlines()[: steps + 1] == first, "the rows before the stop are those of that run"
    assert json.loads((out / "end-0.05" / "summary.json").read_text())["steps"] == 500


def test_runs_on_two_ranks(tmp_path: Path) -> None:
    bar, out = write_study(tmp_path / "bar.toml", BAR), tmp_path / "out"
    done = fracsim("sweep", bar, "--set", "mesh.h=0.125", "-o", out, "--ranks", "2")
    assert done.returncode == 0, done.stderr
    assert rows(out)[0]["ranks"] == "2"


def test_a_sweep_is_not_started_by_mpirun(tmp_path: Path) -> None:
    bar = write_study(tmp_path / "bar.toml", BAR)
    done = subprocess.run(
        [*mpirun(2), *command("sweep", bar, *KEYS, "-o", tmp_path / "out")],
        capture_output=True, text=True, timeout=60, env=dict(os.environ), check=False,
    )  # fmt: skip
    assert done.returncode == 2 and done.stderr.count("call it without mpirun") == 1
