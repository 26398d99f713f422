"""Processor time of a small job from command to end, beside Akantu's.

    python -m fracsim.studies.evidence.peers.start_up -o figures.json

3,000 tetrahedra and ten steps with little computation: the time is that of imports, reading, building and writing.
Akantu receives its mesh as arrays and writes one. Processor time includes child processes; programs alternate; kernels
and bytecode are compiled beforehand.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from ..report_section import Claim, ReportTable, Section, rerun_hint
from ..trial import Trial
from .akantu import ABSENT, WORKER, akantu_python, problem_arrays
from .linear_step import TIME_STEP, block_study

RUNS, STEPS, MAX_SECONDS = 7, 10, 0.7  # LIMIT: s
JOBS: dict[str, dict[str, Any]] = {
    "linear": {},
    "neo-hookean": {"material": {"energy": "neo-hookean", "young": 1e7, "poisson": 0.35, "density": 1000.0}},
    "linear, and may break": {"fracture": {"strength": 1e8}},
}


def job_study(name: str) -> dict[str, Any]:
    """Study of ten steps of the block with 3,000 tetrahedra."""
    results = block_study(5, "newmark, consistent mass") | JOBS[name]
    return results | {"time": results["time"] | {"end": STEPS * TIME_STEP}}


def trials() -> list[Trial]:
    """One trial, with Akantu if it is installed."""
    script = ("fracsim.studies.evidence.peers.start_up",)
    return [Trial("peers", "start-up", "3k", script=script, settings={"peer": "Akantu" if akantu_python() else "none"})]


def measure() -> dict[str, float]:
    """Median processor seconds of each job, and of Akantu if it is installed."""
    with tempfile.TemporaryDirectory() as folder:
        commands = {name: _fracsim_command(name, Path(folder, f"name-{place}")) for place, name in enumerate(JOBS)}
        if akantu_python():
            commands["Akantu"] = _akantu_command(Path(folder))
        for command in commands.values():
            command()  # compiles
        seconds: dict[str, list[float]] = {name: [] for name in commands}
        for _ in range(RUNS):
            for name, command in commands.items():
                seconds[name].append(_processor_seconds(command))
    return {name: median(results) for name, results in seconds.items()}


def _fracsim_command(name: str, folder: Path) -> Callable[[], None]:
    """Function that runs a job of fracsim."""
    import tomli_w

    path = folder.with_suffix(".toml")
    path.write_text(tomli_w.dumps(job_study(name)))
    command = ["fracsim", "run", str(path), "-o", str(folder), "--overwrite"]
    return lambda: _run(command)


def _akantu_command(folder: Path) -> Callable[[], None]:
    """Function that runs the job in Akantu."""
    from mpi4py import MPI

    from ....scene import build_scene
    from ....study.reader import validate

    python, files = akantu_python(), [str(folder / name) for name in ("problem.npz", "result.npz")]
    assert python is not None
    np.savez(
        files[0], **problem_arrays(build_scene(MPI.COMM_WORLD, validate(job_study("linear"), "linear")), TIME_STEP)
    )
    shares = "".join(f"{(number + 1) / STEPS}\n" for number in range(STEPS))
    return lambda: _run([python, "-I", str(WORKER), *files], shares)


def _run(command: list[str], given: str = "") -> None:
    """Run a command with text on its stdin."""
    # modules are compiled once, whatever the environment says
    environment = os.environ | {"PYTHONDONTWRITEBYTECODE": ""}
    subprocess.run(command, input=given, text=True, check=True, capture_output=True, timeout=120, env=environment)


def _processor_seconds(command: Callable[[], None]) -> float:
    """Processor seconds of the child processes of `command`."""
    began = os.times()
    command()
    ended = os.times()
    return ended.children_user + ended.children_system - began.children_user - began.children_system


def main() -> None:
    """Measure and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--out", type=Path, required=True)
    given = parser.parse_args()
    given.out.write_text(json.dumps(measure(), indent=1) + "\n")


# --- the section ----------------------------------------------------------------------------------------------------


def sections(records: list[dict[str, Any]]) -> list[Section]:
    """Section with table and claim; empty if it was not run."""
    results = next((record for record in records if record["case"] == "start-up"), None)
    if results is None or not results["figures"]:
        return []
    figures = results["figures"]
    text = (
        f"3,000 tetrahedra, {STEPS} steps, from the command to its end: processor seconds, medians of {RUNS} runs in "
        f"turn.{'' if 'Akantu' in figures else f' {ABSENT}'}{rerun_hint([results])}"
    )
    worst = max(figures[name] for name in JOBS)
    shown = ", ".join(f"{name} {seconds:.2f}" for name, seconds in figures.items())
    claim = Claim(f"A small job takes at most {MAX_SECONDS:g} s of processor time", shown, worst <= MAX_SECONDS)
    table = ReportTable("peers-start-up", "Start-up", ("job", "processor seconds"), tuple(figures.items()))
    return [Section("Start-up", text, (claim,), (table,))]


if __name__ == "__main__":
    main()
