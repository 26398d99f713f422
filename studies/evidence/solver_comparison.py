"""Default linear solver beside CG with multigrid and a direct solver throughout, for ten quasi-static studies.

    python -m fracsim.studies.evidence.solver_comparison NAME -o figures.json

Processor seconds in the steps with set-up, each solver in turn. For short runs the minimum of several rounds is taken
after one that is not counted, since its first solver fills the caches. Other load on the machine only adds time:
medians of two solvers with identical iterations differed by a factor of 1.3 on a busy machine.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from .precision import brazilian_disk
from .precision.precision_trials import MINIMAL_OUTPUT
from .precision.solver_settings import DIRECT
from .report_section import Claim, ReportTable, Section, rerun_hint
from .trial import Trial

MAX_RATIO = 1.3  # of the best
SHORT_RUN = 5.0  # s of the fastest solver; a longer run is timed once
ROUND_SECONDS, MIN_ROUNDS, MAX_ROUNDS = 2.0, 3, 15  # s of the fastest solver in all rounds of a short run
SOLVERS: dict[str, dict[str, Any]] = {"default": {}, "CG": {"ksp_type": "cg", "pc_type": "gamg"}, "factors": DIRECT}
STEEL = {"energy": "linear", "young": 210e9, "poisson": 0.3, "density": 7850.0}
RUBBER = {"energy": "neo-hookean", "young": 1e6, "poisson": 0.35, "density": 1000.0}


def loaded_box(
    size: list[float], h: float, material: dict[str, Any], load: list[float], steps: int, order: int = 1
) -> Any:
    """Study of a box (m) fixed at x = 0, with a traction (Pa) on the other end that grows over the steps."""
    value = [[0.0] * len(size), load]
    return {
        "title": "a box under a traction",
        "mesh": {"builder": "box", "size": size, "h": h, "order": order},
        "material": material,
        "boundary": [
            {"on": "left", "fix": "xyz"[: len(size)]},
            {"on": "right", "traction": {"time": [0.0, 1.0], "value": value}},
        ],
        "time": {"scheme": "quasi-static", "step": 1 / steps, "end": 1.0},
        "output": MINIMAL_OUTPUT,
    }


CASES: dict[str, Any] = {
    "plane, slender": loaded_box([1.0, 0.02], 0.00125, STEEL, [0.0, -1e4], 5),
    "plane, nearly incompressible": loaded_box([2.0, 1.0], 1 / 40, RUBBER | {"poisson": 0.4999}, [1e5, -2e4], 5),
    "plane, large": loaded_box([2.0, 1.0], 1 / 160, RUBBER, [1e5, -2e4], 5),
    "plane, breaking": brazilian_disk.split_disk(16, 0.0),
    "slender": loaded_box([1.0, 0.05, 0.05], 0.0125, RUBBER, [0.0, 0.0, -20.0], 10),
    "compact": loaded_box([1.0, 1.0, 1.0], 1 / 12, RUBBER, [1e5, 0.0, -2e4], 5),
    "nearly incompressible": loaded_box([2.0, 1.0, 1.0], 1 / 8, RUBBER | {"poisson": 0.499}, [1e5, 0.0, -2e4], 5),
    "quadratic": loaded_box([1.0, 0.1, 0.1], 0.025, STEEL, [0.0, 0.0, -1e5], 5, order=2),
    "thin": loaded_box([1.0, 1.0, 0.01], 0.02, STEEL, [0.0, 0.0, -1e3], 5),
    "small": loaded_box([0.4, 0.1, 0.1], 0.034, RUBBER, [1e4, 0.0, -1e3], 20),
}


def trials() -> list[Trial]:
    """One trial for each study."""
    script = "fracsim.studies.evidence.solver_comparison"
    return [
        Trial("ladder", "solvers", name.replace(", ", "-").replace(" ", "-"), script=(script, name),
              settings={"of": name}, limit=600.0)
        for name in CASES
    ]  # fmt: skip


def measure(name: str) -> dict[str, Any]:
    """Seconds and iterations of each solver, and its relative difference from the direct solver's displacement.

    The difference is the largest over all nodes, relative to the largest displacement.
    """
    runs: dict[str, list[dict[str, Any]]] = {solver: [_time_run(name, solver)] for solver in SOLVERS}
    quickest = min(item[0]["seconds"] for item in runs.values())
    if quickest < SHORT_RUN:
        rounds = [{solver: _time_run(name, solver) for solver in SOLVERS} for _ in range(_round_count(quickest))]
        runs = {solver: [round[solver] for round in rounds] for solver in SOLVERS}
    exact = runs["factors"][0]["u"]
    return {
        "dofs": len(exact),
        **{solver: {key: item[0][key] for key in ("newton", "krylov")} | {
            "seconds": min(run["seconds"] for run in item),
            "apart": float(np.abs(item[0]["u"] - exact).max() / np.abs(exact).max()),
        } for solver, item in runs.items()},
    }  # fmt: skip


def _round_count(seconds: float) -> int:
    """Number of rounds if the fastest solver takes `seconds`."""
    return min(max(math.ceil(ROUND_SECONDS / seconds), MIN_ROUNDS), MAX_ROUNDS)


def _time_run(name: str, solver: str) -> dict[str, Any]:
    """Run a study with one solver: processor seconds, iterations and displacement."""
    from mpi4py import MPI

    from ...deformable_run import Run
    from ...scene import build_scene
    from ...study.reader import validate
    from .run_results import history

    with tempfile.TemporaryDirectory() as folder:
        run = Run(build_scene(MPI.COMM_WORLD, validate(CASES[name] | {"solver": SOLVERS[solver]}, name)), Path(folder))
        began = time.process_time()
        while not run.scene.ended(run.state):
            run.step()
        seconds, rows = time.process_time() - began, history(Path(folder))
        run.scene.destroy()
    counts = {key: int(rows[f"{key}_its"].sum()) for key in ("newton", "krylov")}
    return {"seconds": seconds, "u": run.state.u.copy(), **counts}


def main() -> None:
    """Measure one study and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", choices=CASES)
    parser.add_argument("-o", "--out", type=Path, required=True)
    given = parser.parse_args()
    given.out.write_text(json.dumps(measure(given.name), indent=1) + "\n")


# --- the section ----------------------------------------------------------------------------------------------------


def section(records: list[dict[str, Any]]) -> Section:
    """Section with table and claim."""
    done = [(record["settings"]["of"], record["figures"]) for record in records if record["figures"]]
    share = {name: figures["default"]["seconds"] / _best_seconds(figures) for name, figures in done}
    text = (
        f"Quasi-static studies, processor seconds in the steps (each solver in turn; for short runs the minimum of "
        f"{MIN_ROUNDS} to {MAX_ROUNDS} rounds). CG: with multigrid throughout. Factors: MUMPS throughout. The default "
        "starts with CG and changes to factors where they cost less than the iterations did, by their operation count "
        "once they are computed, with at most 100,000 dofs in 2D and 10,000 in 3D."
        f"{rerun_hint(records)}"
    )
    worst = max(share, key=share.__getitem__, default="")
    measured = f"{share[worst]:.2f} at most ({worst}), of {len(share)} studies" if share else "nothing"
    claim = Claim(f"The default takes at most {MAX_RATIO:g} times the better of CG and factors", measured,
                  all(item <= MAX_RATIO for item in share.values()) if share else None)  # fmt: skip
    columns = ("study", "dofs", *(f"{solver}, s" for solver in SOLVERS), "default over best",
               *(f"{solver}: Newton / Krylov" for solver in SOLVERS), "default apart from factors",
               "outcome")  # fmt: skip
    rows = tuple(_row(record, share.get(record["settings"]["of"])) for record in records)
    return Section("Default linear solver", text, (claim,), (ReportTable("ladder-solvers", "Solvers", columns, rows),))


def _best_seconds(figures: dict[str, Any]) -> float:
    """Seconds of the better of CG and the direct solver."""
    return float(min(figures[solver]["seconds"] for solver in ("CG", "factors")))


def _row(record: dict[str, Any], share: float | None) -> tuple[Any, ...]:
    """Row of the table."""
    name, figures = record["settings"]["of"], record["figures"]
    if not figures:
        return (name, *[None] * 9, f"{record['outcome']}: {record['message']}")
    seconds = (figures[solver]["seconds"] for solver in SOLVERS)
    counts = (f"{figures[solver]['newton']} / {figures[solver]['krylov']}" for solver in SOLVERS)
    return (name, figures["dofs"], *seconds, share, *counts, figures["default"]["apart"], record["outcome"])


if __name__ == "__main__":
    main()
