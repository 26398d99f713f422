"""Spall of a bar by a triangular pulse: distance of the first plane from the free end, and speed of the piece."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..run_results import columns
from ..spalling import Pulse
from .fracture_case import Figures, FractureCase, run_in
from .precision_trials import Settings, Study

PULSE = Pulse(young=3e10, density=2400.0, length=0.2, peak=2e7, rise=3e-6, fall=17e-6)
STRENGTH, HEIGHT, END = 8e6, 0.008, 9e-5  # Pa, m, s
ERRORS = ("first plane", "speed of the piece")


def bar_study(settings: Settings) -> Study:
    """Study of the bar, struck at its left end, in explicit steps; it breaks by strength alone."""
    times = [0.0, PULSE.rise, PULSE.rise + PULSE.fall, 1.0]
    random = settings["mesh"] == "random"
    mesh: dict[str, Any] = {"h": settings["h"], "order": settings["order"]}
    return {
        "title": "A bar that spalls",
        "mesh": {"builder": "box", "size": [PULSE.length, HEIGHT]}
        | mesh | {"pattern": "unstructured" if random else "structured"},
        "material": {"energy": "linear", "young": PULSE.young, "poisson": 0.0, "density": PULSE.density},
        "fracture": {"strength": STRENGTH, "crumbs": False},
        "boundary": [
            *({"on": side, "fix": "y"} for side in ("bottom", "top")),
            {"on": "left", "pressure": {"time": times, "value": [0.0, PULSE.peak, 0.0, 0.0]}},
        ],
        "time": {"scheme": "explicit", "step": settings.get("step", 1e-6), "end": END},
        "output": {"every": 1_000_000, "fields": [], "picture": False},
    }  # fmt: skip


def measure(settings: Settings, folder: Path) -> Figures:
    """Errors of the length of the last piece and of its speed at the end."""
    out, seconds = run_in(bar_study(settings), folder)
    rows = columns(out / "pieces.csv")
    if rows["piece"].max() == 0:
        raise ValueError("nothing spalled")
    last = max((row for row in range(len(rows["time"])) if rows["time"][row] == rows["time"][-1]),
               key=lambda row: float(rows["centre_x"][row]))  # fmt: skip
    plane, speed = float(rows["volume"][last]) / HEIGHT, float(rows["velocity_x"][last])
    return {
        ERRORS[0]: abs(plane / PULSE.first_plane(STRENGTH) - 1),
        ERRORS[1]: abs(speed / PULSE.piece_speed(STRENGTH) - 1),
        "plane": plane, "speed": speed, "pieces": float(rows["piece"].max()) + 1, "seconds": seconds,
    }  # fmt: skip


def _settings(h: float, order: int, mesh: str, **step: float) -> Settings:
    """Settings of a trial."""
    return {"h": h, "order": order, "mesh": mesh, **step}


CASE = FractureCase(
    "spall", "Spall of a bar: first plane",
    f"Bar of 200 mm (E 30 GPa, 2400 kg/m3, strength 8 MPa), struck by 20 MPa that rise in 3 and fall in 17 "
    f"microseconds. Closed form: the first plane is at {PULSE.first_plane(STRENGTH) * 1e3:.2f} mm from the free end, "
    f"and the piece leaves with {PULSE.piece_speed(STRENGTH):.3f} m/s (Rinehart 1951; docs/theory.md#spall-of-a-bar). "
    "Explicit steps are set by the stable one unless `step` is given.",
    measure, ERRORS,
    short=(_settings(1e-3, 1, "lattice"), _settings(5e-4, 1, "lattice"), _settings(1e-3, 1, "random"),
           _settings(1e-3, 2, "lattice"), _settings(1e-3, 1, "lattice", step=2.5e-8)),
    full=(_settings(5e-4, 1, "random"), _settings(1e-3, 2, "random"), _settings(5e-4, 1, "lattice", step=2.5e-8),
          _settings(5e-4, 2, "lattice"), _settings(5e-4, 2, "random"), _settings(2.5e-4, 1, "lattice"),
          _settings(2.5e-4, 2, "random")),
    figures=("plane", "speed", "pieces"), limit=600.0,
)  # fmt: skip
