"""One step of a linear body beside Akantu's: a single solve with a kept factorisation or preconditioner.

    python -m fracsim.studies.evidence.peers.linear_step --n 10 -o figures.json

The block of `make bench` with 24 n^3 tetrahedra, linear, under a growing lateral force on its end. Both programs use
the trapezoidal rule with consistent mass, so that equations and solution are the same. Steps alternate, so that
disturbances of the machine affect both. The first steps, with Akantu's factorisation and fracsim's set-up of multigrid,
are reported separately.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from ..report_section import Claim, ReportTable, Section, rerun_hint
from ..trial import Trial
from .akantu import ABSENT, AkantuProcess, akantu_python, problem_arrays

SIZES = (10, 20)  # 24k and 192k tetrahedra
WARM_UP_STEPS, TIMED_STEPS = 2, 28
TIME_STEP, TRACTION = 5e-3, 1e3  # s, Pa
MAX_TIME_RATIO, MAX_DIFFERENCE = 0.8, 1e-4  # of Akantu's step; of the displacement
SCHEMES: dict[str, dict[str, Any]] = {
    "newmark, consistent mass": {"scheme": "newmark", "mass": "consistent"},
    "newmark": {"scheme": "newmark"},
    "the defaults": {},
}
SAME_EQUATIONS = next(iter(SCHEMES))  # the scheme with Akantu's equations


def block_study(n: int, scheme: str) -> dict[str, Any]:
    """Study with n cells along a metre."""
    end = (WARM_UP_STEPS + TIMED_STEPS) * TIME_STEP
    return {
        "title": f"a linear block of {24 * n**3} tetrahedra",
        "mesh": {"builder": "box", "size": [1.0, 1.0, 4.0], "h": 1 / n},
        "material": {"energy": "linear", "young": 1e7, "poisson": 0.35, "density": 1000.0},
        "boundary": [
            {"on": "bottom", "fix": "xyz"},
            {"on": "top", "traction": {"time": [0.0, end], "value": [[0.0] * 3, [TRACTION, 0.0, 0.0]]}},
        ],
        "time": {"step": TIME_STEP, "end": end} | SCHEMES[scheme],
        "output": {"every": 1_000_000, "fields": [], "picture": False},
    }


def trials() -> list[Trial]:
    """Trials of both sizes; empty if Akantu is not installed."""
    if akantu_python() is None:
        return []
    return [_trial(n) for n in SIZES]


def _trial(n: int) -> Trial:
    """Trial with n cells along a metre."""
    script = ("fracsim.studies.evidence.peers.linear_step", "--n", str(n))
    return Trial("peers", "linear-step", f"n-{n}", script=script, settings={"n": n, "peer": "Akantu"}, limit=45.0 * n)


def compare(n: int) -> dict[str, Any]:
    """Seconds per step of Akantu and of fracsim's schemes, and relative difference of the displacements at the end."""
    with tempfile.TemporaryDirectory() as folder:
        runs = {scheme: _start_run(n, scheme, Path(folder, str(place))) for place, scheme in enumerate(SCHEMES)}
        theirs = AkantuProcess(problem_arrays(runs[SAME_EQUATIONS].scene, TIME_STEP), Path(folder))
        times: dict[str, list[tuple[float, float]]] = {scheme: [] for scheme in SCHEMES}
        for number in range(WARM_UP_STEPS + TIMED_STEPS):
            theirs.step((number + 1) / (WARM_UP_STEPS + TIMED_STEPS))
            for scheme, run in runs.items():
                wall, cpu = time.perf_counter(), time.process_time()
                run.step()
                times[scheme].append((time.perf_counter() - wall, time.process_time() - cpu))
        exact = theirs.end()
    ours = runs[SAME_EQUATIONS].state.u.reshape(exact.shape)
    return {
        "cells": runs[SAME_EQUATIONS].scene.domain.cell_count,
        "apart": float(np.abs(ours - exact).max() / np.abs(exact).max()),
        "akantu": {
            "wall": median(theirs.wall[WARM_UP_STEPS:]),
            "cpu": median(theirs.cpu[WARM_UP_STEPS:]),
            "first": theirs.cpu[0],
        },
        "ours": {scheme: _median_times(pairs) for scheme, pairs in times.items()},
    }


def _start_run(n: int, scheme: str, folder: Path) -> Any:
    """Run of a study before its first step."""
    from mpi4py import MPI

    from ....deformable_run import Run
    from ....scene import build_scene
    from ....study.reader import validate

    return Run(build_scene(MPI.COMM_WORLD, validate(block_study(n, scheme), scheme)), folder)


def _median_times(pairs: list[tuple[float, float]]) -> dict[str, float]:
    """Median wall and processor times after the first steps, and processor time of the first."""
    wall, cpu = zip(*pairs[WARM_UP_STEPS:], strict=True)
    return {"wall": median(wall), "cpu": median(cpu), "first": pairs[0][1]}


def main() -> None:
    """Compare and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--n", type=int, default=SIZES[0])
    parser.add_argument("-o", "--out", type=Path, required=True)
    given = parser.parse_args()
    given.out.write_text(json.dumps(compare(given.n), indent=1) + "\n")


# --- the section ----------------------------------------------------------------------------------------------------

TITLE = "A linear step beside Akantu's"


def sections(records: list[dict[str, Any]]) -> list[Section]:
    """Section with table and claims; a sentence if Akantu is not installed."""
    results = [record for record in records if record["case"] == "linear-step"]
    done = [record["figures"] for record in results if record["figures"]]
    if not done:
        return [Section(TITLE, results[0]["message"] if results else ABSENT)]
    text = (
        f"Block of 24 n^3 tetrahedra, {TIMED_STEPS} steps of {TIME_STEP:g} s after the first {WARM_UP_STEPS}, in "
        f"turn, one "
        f"process and "
        f"thread each; medians. '{SAME_EQUATIONS}' solves Akantu's equations. Akantu keeps the factors of a "
        f"direct solver, we "
        "keep multigrid and start CG from earlier solutions. First: the first step with its set-up."
        f"{rerun_hint(results)}"
    )
    columns = ("tetrahedra", "program", "wall s a step", "core-seconds a step", "over Akantu's", "first, core-seconds")
    rows = tuple(row for figures in done for row in _rows(figures))
    return [Section(TITLE, text, _claims(done), (ReportTable("peers-linear-step", TITLE, columns, rows),))]


def _rows(figures: dict[str, Any]) -> list[tuple[Any, ...]]:
    """Rows of one size, one a program."""
    theirs = figures["akantu"]
    programs = {"Akantu": theirs} | {f"fracsim, {scheme}": item for scheme, item in figures["ours"].items()}
    return [
        (figures["cells"], name, item["wall"], item["cpu"], item["cpu"] / theirs["cpu"], item["first"])
        for name, item in programs.items()
    ]


def _claims(done: list[dict[str, Any]]) -> tuple[Claim, ...]:
    """Claims on the time ratio and the displacements."""
    ratios = {figures["cells"]: figures["ours"][SAME_EQUATIONS]["cpu"] / figures["akantu"]["cpu"] for figures in done}
    apart = {figures["cells"]: figures["apart"] for figures in done}
    return (
        Claim(
            f"A linear step takes at most {MAX_TIME_RATIO:g} of Akantu's core-seconds",
            ", ".join(f"{ratio:.2f} at {cells:,} tetrahedra" for cells, ratio in ratios.items()),
            all(ratio <= MAX_TIME_RATIO for ratio in ratios.values()),
        ),
        Claim(
            f"Both end at the same displacement, to {MAX_DIFFERENCE:g} of the greatest",
            ", ".join(f"{item:.1e} at {cells:,} tetrahedra" for cells, item in apart.items()),
            all(item <= MAX_DIFFERENCE for item in apart.values()),
        ),
    )


if __name__ == "__main__":
    main()
