"""One run at a time writes into an output folder: a second ends with exit code 2, and nothing of the first is lost."""

from __future__ import annotations

import contextlib
import csv
import errno
import fcntl
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from cases import BAR, command, fracsim, fracsim_here, write_study
from fracsim.errors import Exit, InputError
from fracsim.output.lock import LOCK_FILE, FolderLock, describe_lock_holder

# Holds a lock on a folder by flock(1)'s own means, and says so.
HOLD = """
import fcntl, sys
file = open(sys.argv[1] + "/.fracsim.lock", "a+")
fcntl.flock(file, fcntl.LOCK_EX)
file.truncate(0); file.write("process 4711 on elsewhere, since 2026-01-01 00:00:00\\n"); file.flush()
print("held", flush=True)
sys.stdin.read()
"""


@contextlib.contextmanager
def held(folder: Path) -> Iterator[subprocess.Popen[str]]:
    """Another process holds the lock on a folder."""
    folder.mkdir(exist_ok=True)
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None and process.stdout.readline() == "held\n"
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def steps(folder: Path) -> list[int]:
    with (folder / "history.csv").open(newline="") as file:
        return [int(row["step"]) for row in csv.DictReader(file)]


def test_a_second_run_is_refused_and_the_first_loses_nothing(tmp_path: Path) -> None:
    """Begun anew, or gone on with, while the first writes: the process that holds the lock is named."""
    bar = write_study(tmp_path / "bar.toml", BAR, time={"step": 1e-4, "end": 10.0}, output={"every": 1000})
    out = tmp_path / "out"
    first = subprocess.Popen(command("run", bar, "-o", out), stderr=subprocess.PIPE, text=True)
    until = time.monotonic() + 40
    while time.monotonic() < until and not ((out / "history.csv").exists() and len(steps(out)) > 20):
        time.sleep(0.05)
    for more in ((), ("--overwrite",), ("--restart",)):
        done = fracsim_here("run", bar, "-o", out, *more)
        assert done.returncode == Exit.BAD_INPUT
        words = f"a run is going on there (process {first.pid} on {socket.gethostname()}, since 20"
        assert words in done.stderr and done.stderr.count("\n") == 1, done.stderr
    first.send_signal(signal.SIGUSR1)
    assert first.wait(timeout=30) == Exit.STOPPED
    assert steps(out) == list(range(1, len(steps(out)) + 1))
    assert not (out / LOCK_FILE).exists()


def test_a_killed_run_leaves_no_lock(tmp_path: Path) -> None:
    with held(tmp_path) as process:
        with pytest.raises(InputError, match=r"process 4711 on elsewhere"):
            FolderLock(tmp_path).acquire()
        process.kill()
        process.wait()
        assert (tmp_path / LOCK_FILE).exists() and describe_lock_holder(tmp_path) is None
        with FolderLock(tmp_path) as lock:
            assert lock.acquire()
    assert not (tmp_path / LOCK_FILE).exists()


@pytest.mark.parametrize("kind", ["link", "hard link", "folder", "pipe"])
def test_a_lock_file_is_a_plain_file(tmp_path: Path, kind: str) -> None:
    """What lies under its name is left as it is."""
    path, precious, out = tmp_path / "out" / LOCK_FILE, tmp_path / "precious", tmp_path / "out"
    precious.write_text("mine")
    out.mkdir()
    {
        "link": lambda: path.symlink_to(precious),
        "hard link": lambda: os.link(precious, path),
        "folder": path.mkdir,
        "pipe": lambda: os.mkfifo(path),
    }[kind]()
    done = fracsim("run", write_study(tmp_path / "bar.toml", BAR), "-o", out)
    assert done.returncode == Exit.BAD_INPUT and f"{LOCK_FILE} is not a plain file" in done.stderr
    assert precious.read_text() == "mine" and sorted(each.name for each in out.iterdir()) == [LOCK_FILE]


def test_a_file_system_without_locks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As NFS without its lock daemon: a note, and the run goes on."""

    def flock(*_: Any) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", flock)
    done = fracsim_here("run", write_study(tmp_path / "bar.toml", BAR), "-o", tmp_path / "out")
    assert done.returncode == 0 and steps(tmp_path / "out") == [1, 2, 3]
    assert done.stderr.count(f"note: the file system of {tmp_path / 'out'} has no locks (No locks available)") == 1


def test_a_sweep_leaves_a_run_that_goes_on_alone(tmp_path: Path) -> None:
    """Neither its log nor its summary is touched; a second sweep in the same folder is refused."""
    bar, out = write_study(tmp_path / "bar.toml", BAR), tmp_path / "out"
    arguments = ("sweep", bar, "--set", "time.end=0.01", "-o", out)
    out.mkdir()
    case = out / "end-0.01"
    with held(case):
        (case / "log.txt").write_text("of the first")
        done = fracsim(*arguments)
        assert done.returncode == Exit.NOT_CONVERGED, done.stderr
        assert "refused: a run is going on there (process 4711" in done.stdout
        assert (case / "log.txt").read_text() == "of the first"
    with held(out):
        done = fracsim(*arguments)
        assert done.returncode == Exit.BAD_INPUT and "process 4711" in done.stderr


def test_what_is_shown_of_a_run_that_goes_on_is_a_part(tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert fracsim("run", write_study(tmp_path / "bar.toml", BAR), "-o", out).returncode == 0
    with held(out):
        done = fracsim("report", out)
        assert done.returncode == 0
        assert f"note: a run goes on in {out} (process 4711 on elsewhere" in done.stderr
