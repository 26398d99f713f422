"""Vibrating cantilever: error of the time schemes on one mesh, and error of its frequency over the mesh.

A traction p sin^4(pi t / T1) acts on the end for 0 < t < T1; the beam then vibrates freely until 2 T1. T1 = 12 ms is
about its period.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..closed_forms import euler_frequency, pulse, timoshenko_frequency
from ..run_results import history
from ..trial import Trial
from .case_section import AccuracyCase, ExpectedOrder, Records, relative_error, trial_figure
from .precision_trials import MINIMAL_OUTPUT, TIGHT_TOLERANCES, Study, script_trial, study_trial

LENGTH, DEPTH, YOUNG, POISSON, DENSITY = 1.0, 0.1, 210e9, 0.3, 7850.0
PEAK_TRACTION, PERIOD = 1e5, 0.012  # Pa, s
KNOTS, SAMPLES = 200, 16
MESH = 0.025  # m, of the sweep over dt

STEPS = {  # steps in a period
    "newmark": (20, 40, 80, 160),
    "generalized-alpha": (20, 40, 80, 160),
    "backward-euler": (80, 640, 1280, 2560),
}
SIZES = (0.025, 0.0125, 0.01, 0.00625, 0.005)
QUADRATIC_MESHES = ((0.1, "lumped"), (0.05, "lumped"), (0.1, "consistent"), (0.05, "consistent"))
FULL_SIZE = 0.005


def beam_study(
    h: float, scheme: str, step: float, end: float = 2 * PERIOD, *, order: int = 1, mass: str = "lumped"
) -> Study:
    """Study of 1 x 0.1 m of steel in plane stress."""
    t = np.linspace(0.0, PERIOD, KNOTS + 1)
    push = [[0.0, float(PEAK_TRACTION * p)] for p in pulse(t, PERIOD)]
    return {
        "title": "A vibrating cantilever",
        "mesh": {"builder": "box", "size": [LENGTH, DEPTH], "h": h, "order": order},
        "material": {"energy": "linear", "plane": "stress", "young": YOUNG, "poisson": POISSON, "density": DENSITY},
        "boundary": [
            {"on": "left", "fix": "xy"},
            {"on": "right", "traction": {"time": t.tolist(), "value": push}},
        ],
        "time": {"scheme": scheme, "step": step, "end": end, "mass": mass},
        "solver": dict(TIGHT_TOLERANCES),
        "probe": [{"name": "tip", "on": "right", "record": "displacement"}],
        "output": MINIMAL_OUTPUT,
    }


def static_study(h: float) -> Study:
    """Mesh, material and clamp of the study, which the reference of the frequency uses."""
    results = beam_study(h, "newmark", 1.0, 1.0)
    return results | {"boundary": results["boundary"][:1]}


def trials() -> list[Trial]:
    """Trials over dt by scheme on a coarse mesh, with an explicit reference; and over h with small steps."""
    results = [
        study_trial("beam", f"{scheme}-{count}", beam_study(MESH, scheme, PERIOD / count), "vibrating_beam:measure",
              {"scheme": scheme, "dt": PERIOD / count, "h": MESH})
        for scheme, counts in STEPS.items()
        for count in counts
    ]  # fmt: skip
    explicit = beam_study(MESH, "explicit", PERIOD)
    del explicit["solver"]
    results.append(
        study_trial("beam", "explicit", explicit, "vibrating_beam:measure", {"scheme": "explicit", "h": MESH})
    )
    results += [
        study_trial("frequency", f"h-{h:g}", beam_study(h, "newmark", PERIOD / 100, 3 * PERIOD),
                    "vibrating_beam:measure",
              {"scheme": "newmark", "dt": PERIOD / 100, "h": h, "order": 1}, full=h == FULL_SIZE)
        for h in SIZES
    ]  # fmt: skip
    results += [
        study_trial("frequency", f"order-2-h-{h:g}-{mass}",
                    beam_study(h, "newmark", PERIOD / 100, 3 * PERIOD, order=2, mass=mass), "vibrating_beam:measure",
              {"scheme": "newmark", "dt": PERIOD / 100, "h": h, "order": 2, "mass matrix": mass})
        for h, mass in QUADRATIC_MESHES
    ]  # fmt: skip
    results += [
        script_trial("frequency", f"quadratic-h-{h:g}", "quadratic_reference", {"case": "frequency", "h": h},
               {"h": h, "elements": "quadratic"})
        for h in (0.025, 0.0125)
    ]  # fmt: skip
    return results


def measure(run: Path) -> dict[str, float]:
    """Displacement of the end at 16 equally spaced times, m, and frequency of its free vibration, Hz."""
    rows = history(run)
    t, tip = np.append(0.0, rows["time"]), np.append(0.0, rows["probe_tip_y"])
    samples = np.arange(1, SAMPLES + 1) * 2 * PERIOD / SAMPLES
    return {f"tip_{i}": float(np.interp(s, t, tip)) for i, s in enumerate(samples)} | {
        "frequency": swing_frequency(t, tip)
    }


def swing_frequency(t: Any, tip: Any) -> float:
    """Frequency in Hz from the zeros of the free vibration."""
    free = t > PERIOD
    t, tip = t[free], tip[free]
    at = np.flatnonzero(tip[1:] * tip[:-1] < 0)
    zeros = t[at] - tip[at] * (t[at + 1] - t[at]) / (tip[at + 1] - tip[at])
    return float((len(zeros) - 1) / 2 / (zeros[-1] - zeros[0])) if len(zeros) > 1 else float("nan")


def _samples(figures: dict[str, float]) -> Any:
    """Sampled displacements of the end."""
    return np.array([figures[f"tip_{i}"] for i in range(SAMPLES)])


def _time_step_errors(records: Records) -> dict[str, dict[str, float]]:
    """Root mean square difference of the samples from the reference's, relative to these."""
    exact = _samples(next(record["figures"] for record in records if record["name"] == "explicit"))
    size = np.linalg.norm(exact)
    return {
        record["name"]: {"motion": float(np.linalg.norm(_samples(record["figures"]) - exact) / size)}
        for record in records
        if record["figures"] and record["name"] != "explicit"
    }


def _mesh_errors(records: Records) -> dict[str, dict[str, float]]:
    """Relative error of the frequency by trial."""
    exact = trial_figure(records, "quadratic-h-0.0125", "frequency")
    return {
        record["name"]: {"frequency": relative_error(record["figures"]["frequency"], exact)}
        for record in records
        if record["figures"]
    }


def _text(records: Records) -> str:
    """Text of the section on the schemes."""
    explicit = next(record for record in records if record["name"] == "explicit")
    steps = explicit["summary"]["steps"]
    return (
        "Displacement of the end over two periods, every run on the same mesh. Reference: central differences with "
        f"{steps} steps, (omega dt)^2 / 24 = {(np.pi * 4 / steps) ** 2 / 24:.0e} off at the first frequency: another "
        "scheme with the same forces and lumped masses. Theory: order 1 for backward Euler, 2 for the others."
    )


def _frequency_text(records: Records) -> str:
    """Text of the section on the frequency."""
    coarse, fine = (trial_figure(records, f"quadratic-h-{h:g}", "frequency") for h in (0.025, 0.0125))
    euler = euler_frequency(LENGTH, DEPTH, YOUNG, DENSITY)
    thick = timoshenko_frequency(LENGTH, DEPTH, YOUNG, POISSON, DENSITY)
    return (
        f"Frequency of the free swing. Reference: {fine:.4f} Hz, quadratic elements, which moves by "
        f"{relative_error(coarse, fine):.1e} of itself over the last halving of h. Timoshenko's beam: {thick:.2f} Hz, "
        f"Euler's: {euler:.2f} Hz. Theory: order 2 with linear cells."
    )


CASES = [
    AccuracyCase(
        "beam", "Vibrating beam: steps", _text, ("scheme", "dt"), _time_step_errors, ("motion",),
        (
            ExpectedOrder("motion", "dt", 1.0, tuple(f"backward-euler-{n}" for n in (640, 1280, 2560)),
                          "backward Euler"),
            ExpectedOrder("motion", "dt", 2.0, tuple(f"newmark-{n}" for n in (40, 80, 160)), "Newmark"),
            ExpectedOrder("motion", "dt", 2.0, tuple(f"generalized-alpha-{n}" for n in (40, 80, 160)),
                          "generalized-alpha"),
        ),
        split="scheme", excluded=("explicit",),
    ),
    AccuracyCase(
        "frequency", "Vibrating beam: mesh", _frequency_text, ("h", "order", "mass matrix"), _mesh_errors,
        ("frequency",),
        (ExpectedOrder("frequency", "h", 2.0, tuple(f"h-{h:g}" for h in SIZES[1:])),), split="order",
    ),
]  # fmt: skip
