"""How the process of a command begins and ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from cases import BAR, command, fracsim, write_study
from fracsim.errors import Exit


def process(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)


def shell(line: str, *arguments: str | Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """A line of the shell with `$run` for a run that takes `arguments`."""
    run = " ".join(map(str, command("run", *arguments)))
    known = {name: value for name, value in os.environ.items() if name != "HOME" or "HOME" not in environment}
    return subprocess.run(
        ["bash", "-c", line.replace("$run", run)], capture_output=True, text=True, timeout=60, check=False,
        env=known | {name: value for name, value in environment.items() if value},
    )  # fmt: skip


@pytest.mark.parametrize("streams", ["2>&1 | true", ">&- 2>&- <&-", "> /dev/full 2>&1"])
def test_a_run_goes_on_where_nobody_reads_what_it_says(tmp_path: Path, streams: str) -> None:
    """Its reader has gone, its streams are closed, or its log is full: the run comes to its end all the same, and no
    file of it takes the place of a stream (bash: the exit codes of all commands of a line)."""
    bar, out = write_study(tmp_path / "bar.toml", BAR), tmp_path / "out"
    done = shell(f"$run {streams}; echo ${{PIPESTATUS[0]}}", bar, "-o", out)
    assert done.stdout.split() == ["0"] and done.stderr == ""
    rows = (out / "history.csv").read_text().splitlines()
    assert len(rows) == 4 and all(len(row.split(",")) == len(rows[0].split(",")) for row in rows)


def test_a_list_that_nobody_reads_ends_quietly() -> None:
    words = " ".join(command("list"))
    done = subprocess.run(
        ["bash", "-c", f"{words} | true; echo ${{PIPESTATUS[0]}}"],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.stdout.split() == ["0"] and done.stderr == ""


def test_surroundings_that_are_missing(tmp_path: Path) -> None:
    """The working folder is gone: exit code 2. No HOME: the system knows the user's home folder."""
    bar = write_study(tmp_path / "bar.toml", BAR)
    gone = tmp_path / "gone"
    done = shell(f"mkdir {gone}; cd {gone}; rmdir {gone}; $run", bar, "-o", tmp_path / "out")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "fracsim: the working folder has been deleted: change to another one, for example with cd ~\n"
    done = shell("$run", bar, "-o", tmp_path / "out", HOME="")
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("limit", ["nan", "inf"])
def test_a_wall_limit_is_a_number_of_seconds(tmp_path: Path, limit: str) -> None:
    done = fracsim("run", write_study(tmp_path / "bar.toml", BAR), "-o", tmp_path / "out", "--wall-limit", limit)
    assert done.returncode == 2 and "must be a number of seconds, 0 or more" in done.stderr
    assert not (tmp_path / "out").exists()


def test_names_of_300_letters(tmp_path: Path) -> None:
    """Of folders and files that are written or read: one sentence, exit code 2."""
    bar, long = write_study(tmp_path / "bar.toml", BAR), tmp_path / ("a" * 300)
    for arguments in (
        ("run", bar, "-o", long),
        ("sweep", bar, "--set", "time.end=0.01,0.02", "-o", long),
        ("render", long),
        ("report", long),
        ("export", long, "--format", "ply"),
        ("mesh", bar, "-o", f"{long}.vtu"),
    ):
        done = fracsim(*arguments)
        assert done.returncode == 2, (arguments[0], done.stderr)
        assert done.stderr.startswith("fracsim: ") and done.stderr.count("\n") == 1 and "too long" in done.stderr


@pytest.mark.parametrize("number", (signal.SIGABRT, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGSEGV))
def test_a_crash_ends_the_process(number: signal.Signals) -> None:
    """By the signal itself, with where Python was: no handler of PETSc or MPI runs, which may wait for ever."""
    done = process(f"""
import os
from fracsim import process
process._is_own_process = True
process.start_run()
os.kill(os.getpid(), {int(number)})
""")
    assert done.returncode == -number
    assert "Fatal Python error" in done.stderr
    assert "Process received signal" not in done.stderr and "PETSC ERROR" not in done.stderr


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGQUIT, signal.SIGTERM])
def test_a_signal_between_imports_and_the_run_is_heeded(number: signal.Signals) -> None:
    """PETSc, which begins with DOLFINx, takes over two of them, and would end the process by MPI_Abort."""
    code = f"""
import os, signal, sys, time
signal.signal({int(number)}, signal.SIG_DFL)  # a shell may have had it ignored, in the background
sys.argv = ["fracsim", "run"]
from fracsim import process
process.start_process()
process.import_dolfinx()
os.kill(os.getpid(), {int(number)})
time.sleep(5)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == Exit.STOPPED, done.stderr
    assert done.stderr == f"fracsim: stopped by signal {number.name} before the first step; nothing was written\n"


# --- another DOLFINx ------------------------------------------------------------------------------------------------


@pytest.fixture
def newer(tmp_path: Path) -> dict[str, str]:
    """The environment of a process that finds a DOLFINx 0.12 before any other."""
    (tmp_path / "dolfinx").mkdir()
    (tmp_path / "dolfinx" / "__init__.py").write_text('__version__ = "0.12.0"\n')
    (tmp_path / "fenics_dolfinx-0.12.0.dist-info").mkdir()
    (tmp_path / "fenics_dolfinx-0.12.0.dist-info" / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: fenics-dolfinx\nVersion: 0.12.0\n"
    )
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("FRACSIM_", "XDG_"))}
    return kept | {"PYTHONPATH": str(tmp_path), "FRACSIM_CACHE": str(tmp_path / "cache")}


def test_another_dolfinx_is_refused_by_the_program(newer: dict[str, str], tmp_path: Path) -> None:
    """In one message; what needs no DOLFINx goes on."""
    done = fracsim("run", "bar-2d", "-o", tmp_path / "out", env=newer)
    assert done.returncode == Exit.BAD_INPUT and done.stderr.count("\n") == 1, done.stderr
    assert done.stderr.startswith("fracsim: DOLFINx 0.12.0 is installed, and fracsim runs with 0.9 to 0.11")
    assert not (tmp_path / "out").exists()
    assert fracsim("check", "bar-2d", env=newer).returncode == 0


def test_another_dolfinx_is_passed_over_by_env(newer: dict[str, str]) -> None:
    """No other Python here has one that fits, since all of them look there first."""
    env = Path(__file__).parent.parent / "env"
    done = subprocess.run(
        [env, "true"], env=newer | {"FRACSIM_WAY": "native"}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1 and done.stderr.count("\n") == 1
    assert "env: no Python here can import DOLFINx 0.9 to 0.11 (" in done.stderr
    assert "has 0.12.0, which fracsim does not run with yet)" in done.stderr


def test_the_wheel_asks_for_a_python_that_fits(tmp_path: Path) -> None:
    env = Path(__file__).parent.parent / "env"
    ways = {"FRACSIM_WAY": "wheel", "FRACSIM_PYTHON": str(tmp_path / "python"), "FRACSIM_CACHE": str(tmp_path)}
    environment = {key: value for key, value in os.environ.items() if key != "FRACSIM_INSIDE"} | ways
    done = subprocess.run([env, "true"], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1 and done.stderr.count("\n") == 1
    assert done.stderr.startswith(
        "env: the wheel of DOLFINx needs Python 3.12 or later, x86-64 and glibc 2.34 or later"
    )
