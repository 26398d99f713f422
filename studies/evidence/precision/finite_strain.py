"""Finite strain that linear elements represent exactly: the remaining error is that of Newton and Krylov tolerances.

Uniaxial: a unit cube stretched to 1.5 with free sides. Simple shear: the top of a unit cube moves by 0.5, its sides
under the tractions P N of the exact solution, which are dead loads.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..closed_forms import STRESSES, uniaxial
from ..run_results import last_frame, study
from ..trial import Trial
from .case_section import AccuracyCase, Records, measured_errors
from .precision_trials import MINIMAL_OUTPUT, Study, study_trial

YOUNG, POISSON = 1e6, 0.3
STRETCH = {"neo-hookean": 1.5, "stvk": 1.2}
SHEAR = {"neo-hookean": 0.5, "stvk": 0.2}
LOAD_STEPS = 5
TOLERANCES = ((1e-2, 1e-2), (1e-3, 1e-3), (1e-4, 1e-3), (1e-4, 1e-5), (1e-6, 1e-5), (1e-8, 1e-6), (1e-10, 1e-8))
DEFAULT = (1e-6, 1e-5)  # of fracsim.solvers.linear_solver, which a test compares


def _ramp(value: list[Any]) -> dict[str, Any]:
    """Table that grows from 0 at t = 0 to the value at t = 1."""
    return {"time": [0.0, 1.0], "value": [[x if x == "free" else 0.0 for x in value], value]}


def loaded_cube(title: str, energy: str, boundary: list[dict[str, Any]], tolerances: tuple[float, float]) -> Study:
    """Study of a unit cube of unstructured tetrahedra, loaded in five steps."""
    given = {} if tolerances == DEFAULT else {"snes_rtol": tolerances[0], "ksp_rtol": tolerances[1]}
    return {
        "title": title,
        "mesh": {"builder": "box", "size": [1.0, 1.0, 1.0], "h": 0.125, "pattern": "unstructured"},
        "material": {"energy": energy, "young": YOUNG, "poisson": POISSON, "density": 1000.0},
        "boundary": boundary,
        "time": {"scheme": "quasi-static", "step": 1 / LOAD_STEPS, "end": 1.0},
        "solver": given,
        "output": MINIMAL_OUTPUT,
    }


def stretched_cube(energy: str, tolerances: tuple[float, float] = DEFAULT) -> Study:
    """Study of uniaxial tension: three symmetry planes, one face pulled."""
    return loaded_cube(
        "uniaxial", energy,
        [
            {"on": "left", "fix": "x"},
            {"on": "front", "fix": "y"},
            {"on": "bottom", "fix": "z"},
            {"on": "right", "displacement": _ramp([STRETCH[energy] - 1, "free", "free"])},
        ],
        tolerances,
    )  # fmt: skip


def sheared_cube(energy: str, tolerances: tuple[float, float] = DEFAULT) -> Study:
    """Study of simple shear u_x = g z: bottom and top prescribed, tractions P N on the four sides."""
    P = STRESSES[energy](shear_gradient(energy), YOUNG, POISSON)
    return loaded_cube(
        "simple shear", energy,
        [
            {"on": "bottom", "fix": "xyz"},
            {"on": "top", "displacement": _ramp([SHEAR[energy], 0.0, 0.0])},
            *({"on": side, "traction": _ramp([float(sign * x) for x in P[:, axis]])}
              for side, axis, sign in (("left", 0, -1), ("right", 0, 1), ("front", 1, -1), ("back", 1, 1))),
        ],
        tolerances,
    )  # fmt: skip


def shear_gradient(energy: str) -> Any:
    """Deformation gradient F of simple shear."""
    F = np.eye(3)
    F[0, 2] = SHEAR[energy]
    return F


def trials() -> list[Trial]:
    """Trials over the tolerances with the neo-Hookean energy, and of stvk with the defaults."""
    results = []
    for case, make in (("uniaxial", stretched_cube), ("shear", sheared_cube)):
        runs = [("neo-hookean", pair) for pair in TOLERANCES] + [("stvk", DEFAULT)]
        results += [
            study_trial(case, f"{energy}-snes-{snes:g}-ksp-{ksp:g}", make(energy, (snes, ksp)), "finite_strain:measure",
                  {"energy": energy, "snes_rtol": snes, "ksp_rtol": ksp})
            for energy, (snes, ksp) in runs
        ]  # fmt: skip
    return results


def measure(run: Path) -> dict[str, float]:
    """Largest displacement error over the largest displacement."""
    about, frame = study(run), last_frame(run)
    energy = about["material"]["energy"]
    F = shear_gradient(energy)
    if about["title"] == "uniaxial":
        side, _ = uniaxial(energy, STRETCH[energy], YOUNG, POISSON)
        F = np.diag([STRETCH[energy], side, side])
    exact = frame["points"] @ (F - np.eye(3)).T
    return {"displacement": float(np.abs(frame["displacement"] - exact).max() / np.abs(exact).max())}


def _text(records: Records) -> str:
    """Text of the section."""
    return (
        "Largest nodal error against the closed form, which linear elements represent: errors are those of the "
        "solver's tolerances. The first guess of a step extrapolates the last one; a loose test may accept it as it is."
    )


CASES = [
    AccuracyCase(case, title, _text, ("energy", "snes_rtol", "ksp_rtol"), measured_errors("displacement"),
                 ("displacement",),
         split="energy", limit_share=0.01)
    for case, title in (("uniaxial", "Finite strain: uniaxial"), ("shear", "Finite strain: simple shear"))
]  # fmt: skip
