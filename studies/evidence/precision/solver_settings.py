"""Preconditioners and tolerances for a rubber block under its weight and a load: ten steps, 12 000 tetrahedra.

Displacements of two points at the end, against the same study solved to 1e-12 (Newton) and 1e-10 (Krylov).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .. import stability_studies
from ..run_results import history
from ..trial import Trial
from .case_section import AccuracyCase, Records
from .linear_statics import cantilever
from .precision_trials import GROUP, MINIMAL_OUTPUT, Study, study_trial

CELL_SIZE = 0.0125  # m
REFERENCE = {"snes_rtol": 1e-12, "ksp_rtol": 1e-10}
DIRECT = {"ksp_type": "preonly", "pc_type": "lu", "pc_factor_mat_solver_type": "mumps"}
SETTINGS: dict[str, dict[str, Any]] = {
    "default": {},
    "ksp-1e-2": {"ksp_rtol": 1e-2},
    "ksp-1e-3": {"ksp_rtol": 1e-3},
    "ksp-1e-8": {"ksp_rtol": 1e-8},
    "snes-1e-1-ksp-1e-1": {"snes_rtol": 1e-1, "ksp_rtol": 1e-1},
    "snes-1e-2-ksp-1e-2": {"snes_rtol": 1e-2, "ksp_rtol": 1e-2},
    "snes-1e-3-ksp-1e-3": {"snes_rtol": 1e-3, "ksp_rtol": 1e-3},
    "snes-1e-4-ksp-1e-3": {"snes_rtol": 1e-4, "ksp_rtol": 1e-3},
    "snes-1e-4": {"snes_rtol": 1e-4},
    "once": {"snes_type": "ksponly"},
    "boomeramg": {"pc_type": "hypre"},
    "bjacobi-ilu": {"pc_type": "bjacobi"},
    "jacobi": {"pc_type": "jacobi"},
    "mumps": DIRECT,
}


def rubber_block(solver: dict[str, Any]) -> Study:
    """Study of 0.4 x 0.1 x 0.1 m, clamped at x = 0, with gravity and a growing traction on its end."""
    return {
        "title": "A rubber block that sags",
        "mesh": {"builder": "box", "size": [0.4, 0.1, 0.1], "h": CELL_SIZE},
        "material": {"energy": "neo-hookean", "young": 1e5, "poisson": 0.35, "density": 300.0},
        "boundary": [
            {"on": "left", "fix": "xyz"},
            {"on": "right", "traction": {"time": [0.0, 0.05], "value": [[0.0, 0.0, 0.0], [1000.0, 0.0, -1000.0]]}},
        ],
        "load": {"gravity": [0.0, 0.0, -9.81]},
        "time": {"scheme": "backward-euler", "step": 5e-3, "end": 0.05},
        "solver": solver,
        "probe": [{"name": "tip", "on": "right", "record": "displacement"}, {"name": "mid", "point": [0.2, 0.05, 0.1]}],
        "output": MINIMAL_OUTPUT,
    }


def trials() -> list[Trial]:
    """Trials of all settings, of the default on two ranks, and of the reference."""
    results = [
        study_trial(
            "solver",
            name,
            rubber_block(given),
            "solver_settings:measure",
            {"solver": name} | _shown_settings(given),
            repeats=2,
        )
        for name, given in SETTINGS.items()
    ]
    results.append(
        study_trial(
            "solver",
            "default-ranks-2",
            rubber_block({}),
            "solver_settings:measure",
            {"solver": "default"} | _shown_settings({}),
            ranks=2,
        )
    )
    # why CG is not left looser: on a slender body under a force the residual does not fall
    slender = cantilever(0.01) | {"solver": {"ksp_rtol": 1e-3}}
    results.append(
        Trial(GROUP, "solver", "ksp-1e-3-slender", study=slender, settings=_shown_settings({"ksp_rtol": 1e-3}))
    )
    # nor Newton: on slivers the first guess has hardly any residual, and is far off
    sliver = sliver_block() | {"solver": {"snes_rtol": 1e-4}}
    results.append(
        Trial(GROUP, "solver", "snes-1e-4-slivers", study=sliver, settings=_shown_settings({"snes_rtol": 1e-4}),
              measure="stability_measures:measure_stretch")
    )  # fmt: skip
    return [
        *results,
        study_trial("solver", "reference", rubber_block(REFERENCE), "solver_settings:measure", {"solver": "reference"}),
    ]


def sliver_block() -> Study:
    """Study of a block stretched across its thin side, cells 1e4 times as long as thick (group "stability")."""
    return stability_studies.stretched_block(
        1.3, mesh={"builder": "box", "size": [1e-4, 4.0, 4.0], "h": 1.0}, strength=2e5
    )


def _shown_settings(given: dict[str, Any]) -> dict[str, Any]:
    """Settings shown in the table, with the program's defaults if nothing is given."""
    from ....solvers.linear_solver import DEFAULT_OPTIONS

    keys = ("snes_rtol", "ksp_rtol", "snes_type", "ksp_type")
    plain = {"pc_type": "gamg"} | {key: DEFAULT_OPTIONS[key] for key in keys}
    return plain | {key: value for key, value in given.items() if key in plain}


def measure(run: Path) -> dict[str, float]:
    """Displacements at the end, m, and total iterations."""
    rows = history(run)
    places = {f"{name}_{axis}": float(rows[f"probe_{name}_{axis}"][-1]) for name in ("tip", "mid") for axis in "xyz"}
    return places | {"newton": float(rows["newton_its"].sum()), "krylov": float(rows["krylov_its"].sum())}


def _errors(records: Records) -> dict[str, dict[str, float]]:
    """Relative error of the displacements by trial."""
    exact = next(record["figures"] for record in records if record["name"] == "reference" and record["figures"])
    keys = [key for key in exact if key[:3] in ("tip", "mid")]
    size = np.linalg.norm([exact[key] for key in keys])
    return {
        record["name"]: {
            "displacement": float(np.linalg.norm([record["figures"][key] - exact[key] for key in keys]) / size)
        }
        for record in records
        if "tip_x" in record["figures"] and record["name"] != "reference"
    }


def _text(records: Records) -> str:
    """Text of the section."""
    counts = ", ".join(
        f"{record['name']} {record['figures']['newton']:.0f}/{record['figures']['krylov']:.0f}"
        for record in records
        if "newton" in record["figures"]
    )
    off = next((record["figures"].get("error") for record in records if record["name"] == "snes-1e-4-slivers"), None)
    slivers = "" if off is None else f" With Newton to 1e-4 a block of slivers is off by {off:.0%} (snes-1e-4-slivers)."
    return slivers.lstrip() + f" Newton and Krylov iterations in ten steps: {counts}."


CASES = [
    AccuracyCase("solver", "Solver settings", _text, ("pc_type", "ksp_type", "snes_type", "snes_rtol", "ksp_rtol"),
                 _errors,
         ("displacement",), split="pc_type", excluded=("ksponly",), limit_share=0.01),
]  # fmt: skip
