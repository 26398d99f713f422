"""A rigid bar that falls askew on a floor and breaks, in steps of dt, dt / 2 and dt / 4.

Closed form: the lowest corner falls freely until the blow. The crack must not depend on the step.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from ..run_results import columns, first_break
from .fracture_case import Figures, FractureCase, run_in
from .precision_trials import Settings, Study

GRAVITY, SPEED, CLEARANCE, TILT = 9.81, 3.0, 0.02, 0.1  # m/s^2, m/s, m, rad
SIZE, STRENGTH, CONTACT_TIME = (3.0, 1.0, 1.0), 2e5, 2e-3  # m, Pa, s
FINEST = 2.5e-4  # s: step of the crack with which others are compared
ERRORS = ("time of the blow", "crack")


def bar_study(step: float, h: float) -> Study:
    """Study of a bar of 3 x 1 x 1 m, tilted about y, that moves down on the plane z = 0."""
    lowest = -SIZE[0] * np.sin(TILT)  # z of the lowest corner, when the bar has turned about the origin
    return {
        "title": "A rigid bar that falls askew",
        "mesh": {"builder": "box", "size": list(SIZE), "h": h},
        "material": {"young": 1e9, "poisson": 0.2, "density": 1000.0},
        "fracture": {"strength": STRENGTH},
        "brittle": {"surfaces": 6},
        "body": [{"position": [0.0, 0.0, CLEARANCE - float(lowest)], "rotation": [0.0, TILT, 0.0],
                  "velocity": [0.0, 0.0, -SPEED]}],
        "obstacle": [{"name": "floor", "shape": "plane", "at": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0],
                      "friction": 0.5}],
        "contact": {"friction": 0.5, "contact_time": CONTACT_TIME},
        "load": {"gravity": [0.0, 0.0, -GRAVITY]},
        "time": {"scheme": "rigid", "step": step, "end": 0.012},
        "output": {"every": 1, "picture": False},
    }  # fmt: skip


def blow_time() -> float:
    """Time (s) at which the lowest corner reaches the floor in free fall."""
    return float((np.sqrt(SPEED**2 + 2 * GRAVITY * CLEARANCE) - SPEED) / GRAVITY)


def fragment_volumes(run: Path) -> npt.NDArray[np.float64]:
    """Volumes (m^3) of the fragments after the first blow, the largest first."""
    rows = columns(run / "pieces.csv")
    broken = rows["time"][np.flatnonzero(rows["piece"] > 0)[0]]
    return np.sort(rows["volume"][rows["time"] == broken])[::-1]


def measure(settings: Settings, folder: Path) -> Figures:
    """Errors of the time of the blow and of the volumes of the fragments, beside those of the finest step."""
    h = float(settings["h"])
    run, _ = run_in(bar_study(FINEST, h), folder)
    expected = fragment_volumes(run)
    run, seconds = run_in(bar_study(float(settings["dt"]), h), folder)
    volumes = fragment_volumes(run)
    size = max(len(expected), len(volumes))
    padded = [np.pad(item, (0, size - len(item))) for item in (volumes, expected)]
    return {
        ERRORS[0]: abs(first_break(run) / blow_time() - 1),
        ERRORS[1]: float(np.abs(padded[0] - padded[1]).sum() / expected.sum()),
        "fragments": float(len(volumes)), "seconds": seconds,
    }  # fmt: skip


CASE = FractureCase(
    "rigid-blow", "Rigid bar that falls and breaks: time of the blow",
    f"A rigid bar falls askew on a floor and breaks. Closed form: the blow comes after {blow_time() * 1e3:.3f} ms of "
    "free fall of its lowest corner; steps see it at their ends. `crack` is the share of the volume by which the "
    f"fragments differ from those of steps of {FINEST * 1e3:g} ms.",
    measure, ERRORS,
    short=tuple({"dt": dt, "h": 0.25} for dt in (1e-3, 5e-4, 2.5e-4)),
    full=tuple({"dt": dt, "h": 0.125} for dt in (1e-3, 5e-4, 2.5e-4)),
    split="h", figures=("fragments",),
)  # fmt: skip
