"""Signals and the wall-time limit: heeded from the first moment on, inside long steps, and by a process that hangs."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from mpi4py import MPI

from cases import BAR, DUCTILE_TABLES, STRIP, changed, mpirun, study, write_study
from fracsim.deformable_run import Run, run_study
from fracsim.errors import Exit, Stopped
from fracsim.output import interrupt
from fracsim.output.interrupt import InterruptHandler
from fracsim.scene import build_scene
from fracsim.study import Study
from support.quadratic import RUNS as QUADRATIC
from support.scenes import make_study
from support.shattered import RUNS as SHATTERED
from support.tearing import RUNS as TEARING
from support.torn import RUNS as TORN

Data = dict[str, Any]

SOLVER = {"snes_rtol": 1e-11, "ksp_rtol": 1e-9}
BREAKING: Data = changed(
    STRIP, solver=SOLVER, fracture={"radius": 0.2}, damping={"mass": 1.0, "stiffness": 1e-4},
    boundary=[
        {"on": "left", "fix": "xy"},
        {"on": "right", "velocity": {"time": [0.0, 0.02], "value": [[0.0, 0.0], [1.2, 0.0]]}},
    ],
)  # fmt: skip
STRIPS: dict[str, Data] = {
    "passes": changed(BREAKING, fracture={"passes": 3}, time={"scheme": "backward-euler"}),
    "flow": changed(BREAKING, **DUCTILE_TABLES),
    "at rest": changed(
        STRIP, solver=SOLVER, fracture={"strength": 5e4, "radius": 0.2}, time={"scheme": "quasi-static", "end": 0.1}
    ),
}
OTHERS: dict[str, Data] = {
    "contact": TORN["struck"] | {"time": {"scheme": "backward-euler", "step": 0.05, "end": 0.15}, "solver": SOLVER},
    "energy": TEARING["notched"],
}


# with contact, ties, brittle surfaces, cohesive cracks, cracks that close, quadratic cells, ...
EVERY: dict[str, Data] = {
    f"{kind} {name}": tables
    for kind, runs in {"torn": TORN, "tearing": TEARING, "shattered": SHATTERED, "quadratic": QUADRATIC}.items()
    for name, tables in runs.items()
    if make_study(**tables).time.scheme != "explicit"
}


def columns(folder: Path) -> dict[str, npt.NDArray[Any]]:
    """Columns of history.csv, without times and counts of iterations, which depend on the solver's past, and without
    the tip that moved last, which a restart does not know."""
    with (folder / "history.csv").open(newline="") as file:
        head, *rows = csv.reader(file)
    values = dict(zip(head, np.array(rows, float).T, strict=True))
    return {
        name: each for name, each in values.items() if not name.endswith(("_its", "wall_step")) and name[:4] != "tip_"
    }


def assert_same(folder: Path, reference: Path, rtol: float = 1e-6) -> None:
    found, expected = columns(folder), columns(reference)
    assert found.keys() == expected.keys()
    for name, values in expected.items():
        exact = name in ("step", "broken_edges", "split_cells", "pieces")
        size = 0.0 if exact else rtol * np.abs(values).max() + 1e-12
        np.testing.assert_allclose(found[name], values, rtol=0, atol=size, err_msg=name)


class Asked:
    """Counts how often long steps ask whether to go on; a signal comes just before the time of a number."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.count, self.number = 0, 0
        abandons = InterruptHandler.must_abandon_step

        def counted(of: InterruptHandler) -> bool:
            self.count += 1
            if self.count == self.number:
                os.kill(os.getpid(), signal.SIGTERM)
            return abandons(of)

        monkeypatch.setattr(InterruptHandler, "must_abandon_step", counted)
        monkeypatch.setattr(interrupt, "MAX_UNINTERRUPTED_SECONDS", -1.0)  # every step is long

    def begin(self, number: int = 0) -> None:
        self.count, self.number = 0, number


def run_fresh(data: Study, folder: Path, *, restart: bool = False) -> None:
    scene = build_scene(MPI.COMM_SELF, data)
    try:
        Run(scene, folder, restart=restart)()
    finally:
        scene.destroy()


def assert_abandoned_steps_are_lost_alone(data: Study, folder: Path, asked: Asked, shares: tuple[float, ...]) -> None:
    """A run that is stopped inside a step, after such shares of all that its steps ask, goes on from the start of the
    step as if it had never been stopped."""
    asked.begin()
    run_fresh(data, folder / "whole")
    asks = asked.count
    assert asks > 1
    for number in {max(1, int(share * asks)) for share in shares}:
        asked.begin(number)
        with pytest.raises(
            Stopped, match=r"stopped by signal SIGTERM at .*; the step that was under way begins anew\. Ch"
        ):
            run_fresh(data, folder / str(number))
        asked.begin()
        run_fresh(data, folder / str(number), restart=True)
        assert_same(folder / str(number), folder / "whole")


@pytest.mark.parametrize("name", [*STRIPS, *OTHERS])
def test_a_long_step_is_abandoned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """Between two Newton iterations, in several steps and in several passes of one."""
    data = study(STRIPS[name]) if name in STRIPS else make_study(**OTHERS[name] | {"output": {"picture": False}})
    assert_abandoned_steps_are_lost_alone(data, tmp_path, Asked(monkeypatch), (0.3, 1.0))


@pytest.mark.slow
@pytest.mark.parametrize("name", EVERY)
def test_a_step_of_any_study_is_abandoned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    tables = EVERY[name] | {"output": {"picture": False, "surface": False}}
    data = make_study(**{"solver": SOLVER} | tables)
    assert_abandoned_steps_are_lost_alone(data, tmp_path, Asked(monkeypatch), (0.5,))


RIGID: Data = {
    "title": "dropped",
    "mesh": {"builder": "box", "size": [0.6, 0.2, 0.2], "h": 0.1},
    "material": {"energy": "linear", "young": 1e10, "poisson": 0.2, "density": 2000.0},
    "fracture": {"strength": 3e5, "kernel": "neighbours"},
    "brittle": {"surfaces": 4},
    "body": [{"position": [0.0, 0.0, 0.05], "rotation": [0.0, -0.1, 0.0], "velocity": [0.0, 0.0, -4.0]}],
    "obstacle": [{"name": "floor", "shape": "plane", "at": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}],
    "load": {"gravity": [0.0, 0.0, -9.81]},
    "time": {"scheme": "rigid", "step": 2e-3, "end": 0.04},
    "output": {"every": 10, "picture": False},
}


def test_analyses_of_rigid_bodies_are_abandoned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before an analysis, also where surfaces have opened in it that nobody is to know of: from the checkpoint the run
    goes on to the same pieces."""
    pytest.importorskip("mujoco", reason="an environment made without a network")
    data, asked = Study.model_validate(RIGID), Asked(monkeypatch)
    run_study(MPI.COMM_SELF, data, tmp_path / "whole")
    whole = columns(tmp_path / "whole")
    asks = asked.count
    assert asks > 3 and whole["pieces"][-1] > 1
    for number in (2, asks // 2):
        folder = tmp_path / str(number)
        asked.begin(number)
        with pytest.raises(Stopped, match=r"the step that was under way begins anew\. Checkpoint"):
            run_study(MPI.COMM_SELF, data, folder)
        asked.begin()
        run_study(MPI.COMM_SELF, data, folder, restart=True)
        found = columns(folder)
        for name in ("step", "broken_edges", "pieces"):
            np.testing.assert_array_equal(found[name], whole[name], err_msg=name)
        size = np.abs(whole["kinetic"]).max()
        np.testing.assert_allclose(found["kinetic"], whole["kinetic"], rtol=0, atol=1e-5 * size)


def test_the_wall_limit_abandons_a_long_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A step that is short is completed; one that is not is given up."""
    data = study(STRIPS["passes"])
    with pytest.raises(Stopped, match=r"the wall-time limit at t = 0\.005 s after 1 steps\. Checkpoint"):
        monkeypatch.setattr(interrupt, "MAX_UNINTERRUPTED_SECONDS", 1e9)
        Run(build_scene(MPI.COMM_SELF, data), tmp_path / "short", wall_limit=0.0)()
    with pytest.raises(Stopped, match=r"the wall-time limit at t = 0 s after 0 steps; the step that was under way"):
        monkeypatch.setattr(interrupt, "MAX_UNINTERRUPTED_SECONDS", -1.0)
        Run(build_scene(MPI.COMM_SELF, data), tmp_path / "long", wall_limit=0.0)()


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGQUIT, signal.SIGXCPU, signal.SIGUSR2])
def test_signals_that_end_a_run(tmp_path: Path, number: signal.Signals) -> None:
    """Each in its second step, with a checkpoint; what the process did at it before is as it was."""
    scene = build_scene(MPI.COMM_SELF, study(BAR))
    inherited = signal.signal(number, signal.SIG_DFL)  # a shell may have had it ignored, in the background
    run, before = Run(scene, tmp_path), signal.getsignal(number)
    advance, count = scene.stepper.advance, iter(range(1, 100))

    def signalled(state: Any) -> Any:
        if next(count) == 2:
            os.kill(os.getpid(), number)
        return advance(state)

    scene.stepper.advance = signalled  # type: ignore[method-assign]
    with pytest.raises(Stopped, match=rf"stopped by signal {number.name} at t = 0\.02 s after 2 steps\. Checkpoint: "):
        run()
    assert signal.getsignal(number) is before
    signal.signal(number, inherited)


# --- processes ------------------------------------------------------------------------------------------------------

LONG: Data = changed(BAR, time={"step": 1e-4, "end": 10.0}, output={"every": 1000})
START = """
import ctypes, os, sys, time
import fracsim.cli, fracsim.deformable_run
def ready():
    open({folder!r} + f"/ready-{{os.getpid()}}", "w").close()
step = fracsim.deformable_run.Run.step
def hang(run):
    if run.state.step == 2:  # in C, holding the interpreter, waiting for a lock for ever
        ready()
        C, lock = ctypes.PyDLL(None), ctypes.create_string_buffer(64)
        C.pthread_mutex_lock(lock), C.pthread_mutex_lock(lock)
    return step(run)
def late(run):
    if run.state.step == 2:
        ready()
    return step(run)
def slow_import(begin=fracsim.cli.import_dolfinx):
    ready()
    for _ in range(300):
        time.sleep(0.1)
if {what!r} == "slow_import":
    fracsim.cli.import_dolfinx = slow_import
else:
    fracsim.deformable_run.Run.step = {what}
sys.argv = ["fracsim", "run", {study!r}, "-o", {folder!r} + "/out"]
fracsim.cli.program()
"""


def begun(
    folder: Path, what: str, ranks: int = 0, prefix: tuple[str, ...] = (), between: tuple[str, ...] = ()
) -> subprocess.Popen[str]:
    """A long run whose third step, or whose imports, do as START says; on all ranks where that is."""
    bar = write_study(folder / "bar.toml", LONG)
    code = START.format(folder=str(folder), study=str(bar), what=what)
    whole = [*prefix, *(mpirun(ranks) if ranks else []), *between, sys.executable, "-c", code]
    process = subprocess.Popen(whole, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    wait_until(lambda: len(ready(folder)) == max(ranks, 1))
    return process


def ready(folder: Path) -> list[int]:
    """Processes that are."""
    return [int(each.name.partition("-")[2]) for each in folder.glob("ready-*")]


def wait_until(holds: Callable[[], object], seconds: float = 40) -> None:
    until = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < until, "it did not come about"
        time.sleep(0.02)


def is_there(process: int) -> bool:
    """Whether a process runs; one that has ended and is not waited for does not."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_while_a_run_imports_ends_it(tmp_path: Path, number: signal.Signals) -> None:
    process = begun(tmp_path, "slow_import")
    process.send_signal(number)
    said, error = process.communicate(timeout=20)
    why, code = ("interrupted", 130) if number == signal.SIGINT else ("stopped by signal SIGTERM", Exit.STOPPED)
    assert (process.returncode, said) == (code, "")
    assert error == f"fracsim: {why} before the first step; nothing was written\n"
    assert not (tmp_path / "out").exists()


def test_a_second_signal_ends_a_process_that_hangs(tmp_path: Path) -> None:
    """At once, though Python is not asked; a signal that was sent twice (as timeout(1) does) is one request."""
    process = begun(tmp_path, "hang")
    process.send_signal(signal.SIGTERM)
    time.sleep(0.2)
    process.send_signal(signal.SIGTERM)
    time.sleep(1.2)
    assert process.poll() is None
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=5) == -signal.SIGTERM
    process.communicate()


def test_a_handler_that_python_does_not_know_gives_way_to_the_default(monkeypatch: pytest.MonkeyPatch) -> None:
    """A profiler that is loaded before Python may have installed it: Python tells None."""
    install, installed = signal.signal, signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(signal, "signal", lambda number, handler: install(number, handler) and None)
    with InterruptHandler(MPI.COMM_SELF, None):
        assert signal.getsignal(signal.SIGTERM) not in (installed, signal.SIG_DFL)
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    install(signal.SIGTERM, installed)


def test_a_signal_that_is_ignored_ends_nothing(tmp_path: Path) -> None:
    """As under nohup: PETSc takes SIGHUP for itself as it is imported."""
    process = begun(tmp_path, "late", prefix=("nohup",))
    process.send_signal(signal.SIGHUP)
    rows = tmp_path / "out" / "history.csv"
    size = rows.stat().st_size
    wait_until(lambda: rows.stat().st_size > size + 1000)
    process.send_signal(signal.SIGUSR1)
    said, error = process.communicate(timeout=20)
    assert process.returncode == Exit.STOPPED and "stopped by signal SIGUSR1 at t = " in said + error


ABANDONED = """
import os, signal, sys
from mpi4py import MPI
from fracsim.output import interrupt
interrupt.MAX_UNINTERRUPTED_SECONDS = -1.0
asked, calls = interrupt.InterruptHandler.must_abandon_step, iter(range(1, 1000))
def abandons(of):
    if next(calls) == 9 and MPI.COMM_WORLD.rank == 1:
        os.kill(os.getpid(), signal.SIGUSR1)
    return asked(of)
interrupt.InterruptHandler.must_abandon_step = abandons
sys.argv = ["fracsim", "run", {study!r}, "-o", {out!r}]
from fracsim.cli import program
program()
"""


def test_ranks_abandon_a_step_together(tmp_path: Path) -> None:
    """A signal that comes to one of two ranks ends both in the same Newton iteration; one rank goes on from there."""
    strip, out = write_study(tmp_path / "strip.toml", STRIPS["passes"]), tmp_path / "out"
    code = ABANDONED.format(study=str(strip), out=str(out))
    whole = [*mpirun(2), sys.executable, "-c", code]
    done = subprocess.run(whole, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == Exit.STOPPED, done.stderr
    assert done.stderr.count("fracsim: stopped by signal SIGUSR1 at t = ") == 1
    assert done.stderr.count("the step that was under way begins anew. Checkpoint: ") == 1
    Run(build_scene(MPI.COMM_SELF, study(STRIPS["passes"])), out, restart=True)()
    Run(build_scene(MPI.COMM_SELF, study(STRIPS["passes"])), tmp_path / "whole")()
    assert_same(out, tmp_path / "whole")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="asks the kernel of Linux")
@pytest.mark.parametrize("between", [(), ("sh", "-c", 'exec 3>&1; "$@"; exit', "sh")], ids=["mpirun", "a shell"])
def test_ranks_end_with_mpirun(tmp_path: Path, between: tuple[str, ...]) -> None:
    """It is killed; so are its ranks, whatever they wait for, and whether it or a shell of a script started them."""
    process = begun(tmp_path, "hang", ranks=2, between=between)
    ranks = ready(tmp_path)
    assert all(map(is_there, ranks))
    process.kill()
    try:
        wait_until(lambda: not any(map(is_there, ranks)), 5)
    finally:
        for rank in filter(is_there, ranks):
            os.kill(rank, signal.SIGKILL)
        process.communicate()
