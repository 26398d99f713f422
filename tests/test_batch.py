"""Scripts for batch systems run under bash as Slurm runs them, and the page on them shows their text."""

from __future__ import annotations

import json
import os
import re
import subprocess
from pathlib import Path

import pytest

from cases import BAR, fracsim_here, write_study

ROOT = Path(__file__).parent.parent
SCRIPTS = ROOT / "docs" / "batch"
PAGE = (ROOT / "docs" / "batch.md").read_text()
# variables that Slurm sets in a job, without those of pytest's own MPI
ALONE = {name: value for name, value in os.environ.items() if not name.startswith(("OMPI_COMM", "PMI", "PRTE_"))}
JOB = ALONE | {"SLURM_JOB_ID": "7", "SLURM_NTASKS": "1"}


@pytest.fixture
def slurm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of a job, with a `scontrol` that notes what it was asked for in queued.txt."""
    scontrol = tmp_path / "bin" / "scontrol"
    scontrol.parent.mkdir()
    scontrol.write_text(f'#!/bin/sh\necho "$@" >>{tmp_path}/queued.txt\n')
    scontrol.chmod(0o755)
    (tmp_path / "queued.txt").touch()
    monkeypatch.setitem(JOB, "PATH", f"{scontrol.parent}:{os.environ['PATH']}")
    return tmp_path


def batch(name: str, folder: Path, *arguments: str, at_once: bool = False, task: int = 0) -> tuple[int, str]:
    """Exit code and errors of a script; `at_once`: its run stops after the first step."""
    text = (SCRIPTS / name).read_text()
    script = folder / name
    script.write_text(re.sub(r"^limit=\d+", "limit=0", text, flags=re.MULTILINE) if at_once else text)
    given = JOB | ({"SLURM_ARRAY_JOB_ID": "7", "SLURM_ARRAY_TASK_ID": str(task)} if task else {})
    done = subprocess.run(
        ["bash", str(script), *arguments],
        env=given,
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    return done.returncode, done.stderr


def steps(folder: Path) -> int:
    return len((folder / "history.csv").read_text().splitlines()) - 1


@pytest.mark.parametrize("ranks", [1, pytest.param(2, marks=pytest.mark.ranks)])
def test_a_job_goes_on_until_its_run_is_done(ranks: int, slurm: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stopped by the time limit the run leaves a checkpoint and the job is queued again, under the same number."""
    monkeypatch.setitem(JOB, "SLURM_NTASKS", str(ranks))
    write_study(slurm / "bar.toml", BAR)
    code, errors = batch("job.sh", slurm, "bar.toml", "out", at_once=True)
    assert code == 4 and "stopped by the wall-time limit" in errors and steps(slurm / "out") == 1
    assert (slurm / "queued.txt").read_text() == "requeue 7\n"
    code, errors = batch("job.sh", slurm, "bar.toml", "out")
    assert code == 0, errors
    assert steps(slurm / "out") == 3 and json.loads((slurm / "out" / "summary.json").read_text())["ranks"] == ranks
    assert (slurm / "queued.txt").read_text() == "requeue 7\n"


@pytest.mark.parametrize(("restarts", "key", "code"), [("0", "yuong", 2), ("20", "young", 4)])
def test_jobs_that_come_to_nothing_are_not_queued_again(
    restarts: str, key: str, code: int, slurm: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A wrong study; a run that has had twenty jobs."""
    monkeypatch.setitem(JOB, "SLURM_RESTART_COUNT", restarts)
    study = write_study(slurm / "bar.toml", BAR)
    study.write_text(study.read_text().replace("young", key))
    assert batch("job.sh", slurm, "bar.toml", "out", at_once=True)[0] == code
    assert (slurm / "queued.txt").read_text() == ""


def test_tasks_of_an_array_run_the_cases_of_a_sweep(slurm: Path) -> None:
    """Each its own; a case that was stopped goes on, and there is no third."""
    sweep = (str(write_study(slurm / "bar.toml", BAR)), "--set", "time.step=0.01,0.015", "-o", "out")
    first, second = slurm / "out" / "step-0.01", slurm / "out" / "step-0.015"
    code, errors = batch("array.sh", slurm, *sweep, at_once=True, task=1)
    assert code == 4 and steps(first) == 1 and not second.exists(), errors
    assert (slurm / "queued.txt").read_text() == "requeue 7_1\n"
    assert [batch("array.sh", slurm, *sweep, task=task)[0] for task in (1, 2)] == [0, 0]
    assert (steps(first), steps(second)) == (3, 2)
    code, errors = batch("array.sh", slurm, *sweep, task=3)
    assert code == 2 and "the sweep has no case 3" in errors


def test_the_page_shows_the_scripts() -> None:
    shown = re.findall(r"```bash\n(#!/bin/bash\n.*?)```", PAGE, re.DOTALL)
    assert shown == [(SCRIPTS / name).read_text() for name in ("job.sh", "array.sh")]


@pytest.mark.parametrize("name", ["job.sh", "array.sh"])
def test_runs_stop_some_minutes_before_the_job(name: str) -> None:
    text = (SCRIPTS / name).read_text()
    hours, minutes, seconds = map(int, re.findall(r"--time=(\d+):(\d+):(\d+)", text)[0])
    assert 3600 * hours + 60 * minutes + seconds - int(re.findall(r"^limit=(\d+)", text, re.MULTILINE)[0]) == 300


@pytest.mark.parametrize("name", ["PMI_SIZE", "OMPI_COMM_WORLD_SIZE"])
def test_processes_that_mpi_did_not_join_are_refused(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As srun starts them with a protocol that MPI does not speak: each would take the folder for itself."""
    monkeypatch.setenv(name, "4")
    refused = fracsim_here("run", write_study(tmp_path / "bar.toml", BAR), "-o", tmp_path / "out")
    assert refused.returncode == 2 and not (tmp_path / "out").exists()
    assert "4 processes were started" in refused.stderr and "srun --mpi=pmix" in refused.stderr
