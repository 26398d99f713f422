"""Pulled elastoplastic bar with linear hardening: bilinear curve E, E K / (E + K), and viscoplastic flow.

Strains stay below 0.1 %, so that the force over the undeformed section is the true stress to that accuracy.
"""

from __future__ import annotations

from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from ..closed_forms import bilinear_stress, flowing_stress
from ..run_results import history, study
from ..trial import Trial
from .case_section import AccuracyCase, ExpectedOrder, Records, measured_errors
from .precision_trials import MINIMAL_OUTPUT, Study, study_trial

YOUNG, POISSON, YIELD, HARDENING = 2e11, 0.3, 3e7, 2e10  # Pa, -, Pa, Pa
STRAIN = 6e-4  # four times that at yield
RATE = 20.0  # 1/s, of a test that lasts 1 s
SLOW_RATE = f"{RATE:g}"
STEPS = {  # by flow rate and update
    ("none", "extrapolated"): (10, 20, 40),
    ("none", "implicit"): (10, 40),
    ("none", "staggered"): (10, 40, 160),
    (SLOW_RATE, "extrapolated"): (10, 20, 40, 80, 160),
}


def bar_study(steps: int, rate: float | None, update: str = "extrapolated") -> Study:
    """Study of a bar between symmetry planes with free sides, pulled in one second; `rate` None: rate-independent."""
    flow = {} if rate is None else {"flow_rate": rate}
    pull = {"time": [0.0, 1.0], "value": [[0.0, "free", "free"], [STRAIN, "free", "free"]]}
    return {
        "title": "A bar pulled beyond yield",
        "mesh": {"builder": "box", "size": [1.0, 0.25, 0.25], "h": 0.125},
        "material": {"energy": "corotated", "young": YOUNG, "poisson": POISSON, "density": 7850.0},
        "plasticity": {"yield_stress": YIELD, "hardening": HARDENING, "update": update} | flow,
        "boundary": [
            {"on": "left", "fix": "x"},
            {"on": "front", "fix": "y"},
            {"on": "bottom", "fix": "z"},
            {"on": "right", "displacement": pull},
        ],
        "time": {"scheme": "quasi-static", "step": 1 / steps, "end": 1.0},
        "probe": [{"name": "grip", "on": "right"}],
        "output": MINIMAL_OUTPUT,
    }


def trials() -> list[Trial]:
    """Trials over dt by flow rate and update; empty if the program has no plasticity."""
    from ....study import Study as Schema

    if "plasticity" not in Schema.model_fields:
        return []
    return [
        study_trial("plastic", f"rate-{rate}-{update}-steps-{count}",
              bar_study(count, None if rate == "none" else float(rate), update),
              "plastic_bar:measure", {"update": update, "flow_rate": rate, "dt": 1 / count})
        for (rate, update), counts in STEPS.items()
        for count in counts
    ]  # fmt: skip


def measure(run: Path) -> dict[str, float]:
    """Relative error of the stress at the end, force over the undeformed section."""
    rate = study(run)["plasticity"].get("flow_rate", inf)
    stress = abs(float(history(run)["reaction_grip_x"][-1])) / 0.25**2
    exact = (
        bilinear_stress(STRAIN, YOUNG, YIELD, HARDENING)
        if rate == inf
        else flowing_stress(STRAIN, STRAIN, (YOUNG, POISSON), np.array([YIELD, HARDENING, rate]))
    )
    return {"stress": abs(stress / exact - 1)}


def _text(records: Records) -> str:
    """Text of the section."""
    return (
        "Stress at four times the strain at yield. Independent of the rate: the bilinear curve. Steps solved with "
        "their own flow (implicit) meet it at any size, steps solved with the flow of the step before (extrapolated) "
        "soon after flow has begun, and steps whose flow follows them (staggered) to first order. At a flow rate of "
        f"{RATE:g} 1/s: the curve plus the excess that the rate leaves. Theory: order 1 in dt."
    )


FITTED_SLOW = tuple(f"rate-{SLOW_RATE}-extrapolated-steps-{steps}" for steps in STEPS[SLOW_RATE, "extrapolated"][1:])
FITTED_STAGGERED = tuple(f"rate-none-staggered-steps-{steps}" for steps in STEPS["none", "staggered"])
CASES: list[Any] = [
    AccuracyCase("plastic", "Elastoplastic bar", _text, ("update", "flow_rate", "dt"), measured_errors("stress"),
                 ("stress",),
         (ExpectedOrder("stress", "dt", 1.0, FITTED_SLOW, f"flow rate {RATE:g}/s:"),
          ExpectedOrder("stress", "dt", 1.0, FITTED_STAGGERED, "staggered:")), split="update"),
]  # fmt: skip
