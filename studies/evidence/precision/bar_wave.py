"""Smooth pulse and step in a bar (nu = 0), E = rho = c0 = L = 1, against d'Alembert's solution before reflection.

The bar is a strip of four cells. With nu = 0 cross-sections stay plane, whatever the number of cells
(tests/test_waves.py).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..closed_forms import bar_displacement, bar_velocity, pulse
from ..run_results import last_frame, study
from ..trial import Trial
from .case_section import AccuracyCase, ExpectedOrder, Records, measured_errors
from .precision_trials import MINIMAL_OUTPUT, TIGHT_TOLERANCES, Study, study_trial

DURATION, END, PULL = 0.6, 0.9, 1e-3  # s, s, Pa
KNOTS = 400
CELLS = (32, 64, 128, 256)
EULER_CELLS, EULER_STEPS = 128, (64, 512, 1024, 2048)  # of backward Euler; steps in a second
SECOND_ORDER = ("newmark", "generalized-alpha", "explicit")


def bar_study(cells: int, scheme: str, step: float, load: str) -> Study:
    """Study of a strip of 4 cells across, pulled at x = 1 by a pulse sin^4 or by a constant traction."""
    h = 1 / cells
    t = np.linspace(0.0, DURATION, KNOTS + 1)
    smooth = {"time": t.tolist(), "value": [[float(PULL * p), 0.0] for p in pulse(t, DURATION)]}
    results: Study = {
        "title": f"A {load} in a bar",
        "mesh": {"builder": "box", "size": [1.0, 4 * h], "h": h},
        "material": {"energy": "linear", "young": 1.0, "poisson": 0.0, "density": 1.0},
        "boundary": [{"on": "right", "traction": smooth if load == "pulse" else [PULL, 0.0]}],
        "time": {"scheme": scheme, "step": step, "end": END},
        "output": MINIMAL_OUTPUT | {"fields": ["velocity"]},
    }
    return results if scheme == "explicit" else results | {"solver": TIGHT_TOLERANCES}


def trials() -> list[Trial]:
    """Trials of both loads: dt = h / 2 for schemes of order 2 (explicit: the stable step), dt for backward Euler."""
    results = []
    for load in ("pulse", "step"):
        for scheme in SECOND_ORDER:
            results += [_trial(load, cells, scheme, 0.5 / cells) for cells in CELLS if load == "pulse" or cells > 32]
    results += [_trial("pulse", EULER_CELLS, "backward-euler", 1 / count) for count in EULER_STEPS]
    results += [_trial("step", cells, "backward-euler", 0.5 / cells) for cells in CELLS if cells > 32]
    results.append(_trial("pulse", 256, "explicit", 0.5 / 256, ranks=2))
    return results


def _trial(load: str, cells: int, scheme: str, step: float, ranks: int = 1) -> Trial:
    """Trial of one load, mesh, scheme and step."""
    settings: dict[str, Any] = {"scheme": scheme, "h": 1 / cells, "dt": step}
    if scheme == "explicit":
        del settings["dt"]
    name = f"{scheme}-{cells}-{round(1 / step)}" + (f"-ranks-{ranks}" if ranks > 1 else "")
    return study_trial(
        f"wave-{load}", name, bar_study(cells, scheme, step, load), "bar_wave:measure", settings, ranks=ranks
    )


def measure(run: Path) -> dict[str, float]:
    """Relative L2 errors of velocity and displacement at the end, sampled at the nodes."""
    frame, smooth = last_frame(run), "pulse" in study(run)["title"]
    x, t = frame["points"][:, 0], frame["time"]
    since = t - (1 - x)
    velocity = bar_velocity(x, t, DURATION) if smooth else (since > 0) + 0.5 * (since == 0)
    displacement = bar_displacement(x, t, DURATION) if smooth else np.maximum(since, 0.0)
    exact = {"velocity": velocity, "displacement": displacement}
    return {
        key: float(np.linalg.norm(frame[key][:, 0] / PULL - values) / np.linalg.norm(values))
        for key, values in exact.items()
    }


def _text(records: Records) -> str:
    """Text of the section on the pulse."""
    return (
        "Errors at t = 0.9 in L2 over the bar. Every pair of h and dt = h / 2 keeps the ratio, so that errors of mesh "
        "and step fall together; backward Euler is swept over dt at h = 1/128. Explicit steps are set by the stable "
        "one. Theory: order 2 (backward Euler: 1)."
    )


def _step_text(records: Records) -> str:
    """Text of the section on the step."""
    return (
        "A jump: all schemes smear or ring at the front. Theory for a scheme of order p (Brenner, Thomee and Wahlbin "
        "1975): a jump converges in L2 with p / (2 (p + 1)), 1/3 for p = 2 and 1/4 for p = 1, a kink with three times "
        "that. Velocities of a sudden load are never good to 1 %; displacements are."
    )


def _trial_names(scheme: str, pairs: tuple[tuple[int, int], ...]) -> tuple[str, ...]:
    """Names of trials with (cells, steps per second)."""
    return tuple(f"{scheme}-{cells}-{count}" for cells, count in pairs)


SECOND_ORDER_RUNS = ((64, 128), (128, 256), (256, 512))
EULER_RUNS = tuple((EULER_CELLS, count) for count in EULER_STEPS[1:])
CASES = [
    AccuracyCase(
        "wave-pulse", "Bar wave: smooth pulse", _text, ("scheme", "h", "dt"),
        measured_errors("velocity", "displacement"),
        ("velocity", "displacement"),
        tuple(
            ExpectedOrder(error, variable, order, _trial_names(scheme, names), scheme)
            for error in ("velocity", "displacement")
            for scheme, variable, order, names in (
                ("newmark", "h", 2.0, SECOND_ORDER_RUNS),
                ("generalized-alpha", "h", 2.0, SECOND_ORDER_RUNS),
                ("explicit", "h", 2.0, SECOND_ORDER_RUNS),
                ("backward-euler", "dt", 1.0, EULER_RUNS),
            )
        ),
        split="scheme", excluded=("explicit",),
    ),
    AccuracyCase(
        "wave-step", "Bar wave: sudden load", _step_text, ("scheme", "h", "dt"),
        measured_errors("velocity", "displacement"),
        ("displacement", "velocity"),
        tuple(
            ExpectedOrder(error, "h", order, _trial_names(scheme, SECOND_ORDER_RUNS), scheme)
            for scheme, p in (("newmark", 2), ("generalized-alpha", 2), ("explicit", 2), ("backward-euler", 1))
            for error, order in (("velocity", p / (2 * (p + 1))), ("displacement", 3 * p / (2 * (p + 1))))
        ),
        split="scheme", excluded=("explicit",),
    ),
]  # fmt: skip
