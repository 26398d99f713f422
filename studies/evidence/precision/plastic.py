"""A pulled elastoplastic bar with linear hardening against its bilinear curve E, E K / (E + K).

Flow at a rate nu relaxes the stress beyond yield by exp(-nu dt) a step: the curve is that of nu -> infinity.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..references import bilinear_stress
from ..results import history
from ..trial import Trial
from .common import QUIET, Study, trial
from .page import Case, Order, Records, by_figures

YOUNG, YIELD, HARDENING, STRAIN = 2e11, 3e8, 2e10, 6e-3  # Pa, Pa, Pa, four times the strain at yield
RATES = (1e2, 1e3, 1e4)  # 1/s, of a test that lasts 1 s
STEPS = (10, 20, 40, 80)


def bar(steps: int, rate: float) -> Study:
    """A bar between planes of symmetry, free sideways, pulled slowly."""
    pull = {"time": [0.0, 1.0], "value": [[0.0, "free", "free"], [STRAIN, "free", "free"]]}
    return {
        "title": "A bar pulled beyond yield",
        "mesh": {"builder": "box", "size": [1.0, 0.25, 0.25], "h": 0.125},
        "material": {"energy": "corotated", "young": YOUNG, "poisson": 0.3, "density": 7850.0},
        "plasticity": {"yield_stress": YIELD, "measure": "von-mises", "flow_rate": rate, "hardening": HARDENING},
        "boundary": [
            {"on": "left", "fix": "x"},
            {"on": "front", "fix": "y"},
            {"on": "bottom", "fix": "z"},
            {"on": "right", "displacement": pull},
        ],
        "time": {"scheme": "quasi-static", "step": 1 / steps, "end": 1.0},
        "probe": [{"name": "grip", "on": "right"}],
        "output": QUIET,
    }


def trials() -> list[Trial]:
    """dt by flow rate; none where the program has no plasticity."""
    from ....study import Study as Schema

    if "plasticity" not in Schema.model_fields:
        return []
    return [
        trial("plastic", f"rate-{rate:g}-steps-{steps}", bar(steps, rate), "plastic:measure",
              {"flow_rate": rate, "dt": 1 / steps})
        for rate in RATES
        for steps in STEPS
    ]  # fmt: skip


def measure(run: Path) -> dict[str, float]:
    """Relative error of the stress at the end: force over the undeformed section (strains are small)."""
    stress = abs(float(history(run)["reaction_grip_x"][-1])) / 0.25**2
    return {"stress": abs(stress / bilinear_stress(STRAIN, YOUNG, YIELD, HARDENING) - 1)}


def _text(records: Records) -> str:
    return (
        "Stress at four times the strain at yield against the bilinear curve of rate-independent plasticity. A finite "
        "rate nu holds the stress above the curve by about E K / (E + K) times the strain rate over nu."
    )


CASES: list[Any] = [
    Case("plastic", "Elastoplastic bar", _text, ("flow_rate", "dt"), by_figures("stress"), ("stress",),
         (Order("stress", "dt", 1.0, tuple(f"rate-100-steps-{steps}" for steps in STEPS), "flow rate 100/s"),),
         split="flow_rate"),
]  # fmt: skip
