"""Break time of a pulled bar, and recoil of a bar that breaks at its clamp.

Break: a uniform bar under a growing displacement. The stress E u / L reaches the strength at a known time, and the bar
breaks in the first step after it.

Recoil: a bar (nu = 0, E = rho = c0 = L = 1) is clamped at one end under a uniform body force that grows with (1 -
cos(pi t / T)) / 2. The stress is largest at the clamp, where the bar breaks; it is known in closed form
(closed_forms.clamp_stress). Until the wave returns, the free end then moves at the released stress over rho c0: the
released stress leaves the end as a wave.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..closed_forms import clamp_stress
from ..run_results import first_break, history
from ..trial import Trial
from .case_section import AccuracyCase, ExpectedOrder, Records, measured_errors
from .precision_trials import MINIMAL_OUTPUT, Study, study_trial

UNIT_MATERIAL = {"energy": "linear", "young": 1.0, "poisson": 0.0, "density": 1.0}

# --- break time ---

STRENGTH, BREAK_TIME = 1e-3, 1.0  # Pa, s
STEP_COUNTS = (10, 20, 40, 80)  # whole steps before the break


def pulled_bar(steps: int, h: float = 0.125) -> Study:
    """Study in which E u / L reaches the strength at t = 1, a third into a step; it ends one step later."""
    step = BREAK_TIME / (steps + 1 / 3)
    end = (steps + 1) * step
    return {
        "title": "A bar pulled until it breaks",
        "mesh": {"builder": "box", "size": [1.0, 0.25], "h": h},
        "material": UNIT_MATERIAL,
        "fracture": {"strength": STRENGTH},
        "boundary": [
            {"on": "left", "fix": "x"},
            {"on": "bottom", "fix": "y"},
            {"on": "right", "displacement": {"time": [0.0, end], "value": [[0.0, "free"], [STRENGTH * end, "free"]]}},
        ],
        "time": {"scheme": "quasi-static", "step": step, "end": end},
        "output": MINIMAL_OUTPUT | {"surface": False},
    }


def measure_break(run: Path) -> dict[str, float]:
    """Relative error of the break time."""
    return {"break time": abs(first_break(run) / BREAK_TIME - 1)}


# --- recoil ---

RISE, FORCE, AFTER = 6.0, 1.1e-3, 1.1  # s, N/m^3, s after the break
WINDOW = 0.3  # s after the break from which the velocity is taken
CELL_COUNTS = (16, 32, 64, 96)
SCHEMES = ("newmark", "generalized-alpha", "explicit", "backward-euler")


def exact_break() -> tuple[float, Any, Any]:
    """(break time, times, stress at the clamp at those times)."""
    t = np.linspace(0.0, RISE + 2.0, 80001)
    stress = clamp_stress(t, _force(t))
    first = int(np.argmax(stress >= STRENGTH))
    return float(np.interp(STRENGTH, stress[first - 1 : first + 1], t[first - 1 : first + 1])), t, stress


def _force(t: Any) -> Any:
    """Body force at the times t, N/m^3."""
    return FORCE * (1 - np.cos(np.pi * np.minimum(t, RISE) / RISE)) / 2


def recoiling_bar(cells: int, scheme: str) -> Study:
    """Study of a strip of two cells across; dt = h / 2 (explicit: the stable step)."""
    h = 1 / cells
    t = np.linspace(0.0, RISE, 301)
    return {
        "title": "A bar torn off its clamp",
        "mesh": {"builder": "box", "size": [1.0, 2 * h], "h": h},
        "material": UNIT_MATERIAL,
        "fracture": {"strength": STRENGTH},
        "boundary": [{"on": "left", "fix": "xy"}],
        "load": {"body_force": {"time": t.tolist(), "value": [[float(b), 0.0] for b in _force(t)]}},
        "time": {"scheme": scheme, "step": h / 2, "end": exact_break()[0] + AFTER},
        "probe": [{"name": "end", "on": {"point": [h, 0.0], "normal": [1.0, 0.0]}, "record": "displacement"}],
        "output": MINIMAL_OUTPUT | {"surface": False},
    }


def measure_recoil(run: Path) -> dict[str, float]:
    """Relative errors of the break time and of the mean velocity of the free end; number of fragments."""
    rows, (broke, times, stress) = history(run), exact_break()
    last = rows["time"][-1]
    u = np.interp([broke + WINDOW, last], rows["time"], rows["probe_end_x"])
    inside = (times >= broke + WINDOW) & (times <= last)
    return {
        "break time": abs(first_break(run) / broke - 1),
        "velocity": abs(float((u[1] - u[0]) / (last - broke - WINDOW) / stress[inside].mean()) - 1),
        "pieces": float(rows["pieces"][-1]),
    }


def trials() -> list[Trial]:
    """Trials over dt for the break time, and over h with dt for the recoil, by scheme."""
    results = [
        study_trial("break", f"steps-{count}", pulled_bar(count), "bar_fracture:measure_break",
              {"dt": BREAK_TIME / (count + 1 / 3), "h": 0.125})
        for count in STEP_COUNTS
    ]  # fmt: skip
    results.append(
        study_trial("break", "steps-40-fine", pulled_bar(40, 0.0625), "bar_fracture:measure_break",
              {"dt": BREAK_TIME / (40 + 1 / 3), "h": 0.0625})
    )  # fmt: skip
    results += [
        study_trial("recoil", f"{scheme}-{cells}", recoiling_bar(cells, scheme), "bar_fracture:measure_recoil",
              {"scheme": scheme, "h": 1 / cells})
        for scheme in SCHEMES
        for cells in CELL_COUNTS
    ]  # fmt: skip
    return results


def _break_text(records: Records) -> str:
    """Text of the section on the break time."""
    return (
        "A uniform bar breaks in the first step at whose end the stress has reached the strength: late by less than a "
        "step. Steps are chosen so that the exact time lies a third into one, which makes the lateness two thirds of "
        "dt and the order 1. The mesh does not matter."
    )


def _recoil_text(records: Records) -> str:
    """Text of the section on the recoil."""
    return (
        f"Closed form: break at t = {exact_break()[0]:.5f}, released stress over rho c0 as velocity of the torn end "
        f"(mean from {WINDOW} to {AFTER} L / c0 after the break). Stress is that of the middle of a cell, h / 2 from "
        "the clamp: order 1 for the break time; dt = h / 2, a break at a step's end, order 1 too. The coarsest "
        "bar is left out of the fit of the velocity: its torn cells, a sixteenth of the bar, ring."
    )


CASES = [
    AccuracyCase("break", "Uniaxial break time", _break_text, ("dt", "h"), measured_errors("break time"),
                 ("break time",),
         (ExpectedOrder("break time", "dt", 1.0, tuple(f"steps-{count}" for count in STEP_COUNTS)),)),
    AccuracyCase("recoil", "Break and recoil", _recoil_text, ("scheme", "h"), measured_errors("break time", "velocity"),
         ("velocity", "break time"),
         (*(ExpectedOrder("break time", "h", 1.0, tuple(f"{scheme}-{cells}" for cells in CELL_COUNTS),
                          scheme) for scheme in SCHEMES),
          *(ExpectedOrder("velocity", "h", 1.0, tuple(f"{scheme}-{cells}" for cells in CELL_COUNTS[1:]), scheme)
            for scheme in SCHEMES)),
         split="scheme", excluded=("explicit",)),
]  # fmt: skip
