"""What a run tells of how far it is: to a terminal, to a log, on one rank and under mpirun."""

from __future__ import annotations

import io
import os
import pty
import re
import subprocess
import time
from pathlib import Path

import pytest

from cases import BAR, STRIP, command, fracsim_here, write_study
from fracsim.output.progress import PROGRESS_VARIABLE, ProgressReporter, ProgressState

STEP = re.compile(r"\[\d+:\d\d\] +\d+\.\d% +t = \S+ s  step \d+  broken edges \d+  pieces \d+  left \d+:\d\d  \S.*")


def on_terminal(words: list[str], folder: Path) -> tuple[str, str]:
    """What a command says on stdout, which is a file, and on stderr, which is a terminal of 80 columns."""
    master, slave = pty.openpty()
    os.set_blocking(master, False)
    import termios

    termios.tcsetwinsize(slave, (24, 80))
    known = {name: value for name, value in os.environ.items() if name != PROGRESS_VARIABLE}
    with (folder / "said").open("w+") as out:
        process = subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=out, stderr=slave, env=known)
        os.close(slave)
        said, until = b"", time.monotonic() + 50
        while time.monotonic() < until:
            try:
                said += os.read(master, 1 << 16)
            except BlockingIOError:
                time.sleep(0.02)
            except OSError:  # nobody has the other end open any more
                break
        os.close(master)
        assert process.wait(timeout=10) == 0, said
        out.seek(0)
        return out.read(), said.decode()


@pytest.mark.parametrize("ranks", [0, 2])
def test_a_terminal_has_a_line_that_rewrites_itself(tmp_path: Path, ranks: int) -> None:
    """No longer than the terminal is wide; under mpirun, where stderr of ranks is a pipe, as without it."""
    bar = write_study(tmp_path / "bar.toml", BAR)
    out, said = on_terminal(command("run", bar, "-o", tmp_path / "out", ranks=ranks), tmp_path)
    assert out.startswith("bar: 3 steps to t = 0.03 s")
    lines = said.replace("\n", "").split("\r")
    assert all(len(line) < 80 for line in lines) and said.endswith("\n")
    assert any("building the mesh" in line for line in lines)
    last = [line for line in lines if line.strip()][-1]
    assert "100.0%  t = 0.03 s  step 3  broken edges 0  pieces 1" in last


def test_a_log_has_a_line_each_so_many_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the set-up and of steps, however long they take, and of nothing but what can be printed."""
    log = io.StringIO()
    monkeypatch.setattr("sys.stderr", log)
    monkeypatch.setenv(PROGRESS_VARIABLE, "0.05")

    def wait_for(count: int) -> None:
        until = time.monotonic() + 20
        while log.getvalue().count("\n") < count and time.monotonic() < until:
            time.sleep(0.01)

    with ProgressReporter(first=True, end=2.0) as progress, ProgressReporter(first=False, end=2.0) as silent:
        silent.set_stage("nobody hears of this")
        progress.set_stage("building the mesh")
        wait_for(1)
        progress.update(ProgressState(0.5, 0.5, 1, 7, 2, "Newton 3"))
        wait_for(log.getvalue().count("\n") + 2)
    lines = log.getvalue().splitlines()
    assert re.fullmatch(r"\[0:\d\d\] building the mesh", lines[0])
    assert re.fullmatch(STEP, lines[-1]) and re.fullmatch(STEP, lines[-2]), lines
    assert " 25.0%  t = 0.5 s  step 1  broken edges 7  pieces 2  left 0:0" in lines[-1]
    assert lines[-1].endswith("  Newton 3")


@pytest.mark.parametrize(("wish", "lines"), [("off", 0), ("", 0), ("soon", 1)])
def test_a_run_that_takes_no_time_says_nothing_to_a_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wish: str, lines: int
) -> None:
    """Nor does one whose progress nobody wants; a wish that makes no sense is told of."""
    monkeypatch.setenv(PROGRESS_VARIABLE, wish)
    done = fracsim_here("run", write_study(tmp_path / "bar.toml", BAR), "-o", tmp_path / "out")
    assert done.returncode == 0 and done.stderr.count("\n") == lines
    assert not lines or f'{PROGRESS_VARIABLE}=soon is none of "live", "off" or a number of seconds' in done.stderr


def test_steps_of_a_run_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the figures of its history."""
    monkeypatch.setenv(PROGRESS_VARIABLE, "1e-3")
    out = tmp_path / "out"
    done = fracsim_here("run", write_study(tmp_path / "strip.toml", STRIP), "-o", out)
    told = [line for line in done.stderr.splitlines() if STEP.fullmatch(line)]
    assert told and "\r" not in done.stderr and "\x1b" not in done.stderr
    rows = [row.split(",") for row in (out / "history.csv").read_text().splitlines()]
    broken = {int(row[0]): int(row[rows[0].index("broken_edges")]) for row in rows[1:]}
    for line in told:
        step, edges = map(int, re.findall(r"step (\d+)  broken edges (\d+)", line)[0])
        assert edges == broken[step]
