"""A crack that starts and runs under a plane wave, against Freund's equation of motion.

A pane is cracked to its centre; tractions at top and bottom send two plane waves to the crack, which reach it together.
Until they return the crack is semi-infinite, and its faces are loaded by twice the traction: K_I = 2 s sqrt(c_d t (1 -
2 nu) / pi) / (1 - nu) at rest, so that it starts at tau, and runs with v = c_R (1 - tau / t) (Freund 1990, 2.5 and 7.4;
energy release rate of a running crack G = (1 - v / c_R) G(at rest)).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from ..run_results import history
from .fracture_case import SEEDS, Figures, FractureCase, run_in, worst_of
from .precision_trials import Settings, Study

YOUNG, POISSON, DENSITY, ENERGY = 3.2e10, 0.2, 2450.0, 3.0  # Pa, 1, kg/m^3, J/m^2: glass of studies/branching.toml
LENGTH, HEIGHT, CRACK, TRACTION = 0.1, 0.08, 0.05, 1e6  # m, m, m, Pa
DILATATIONAL = float(np.sqrt(YOUNG * (1 - POISSON) / ((1 + POISSON) * (1 - 2 * POISSON) * DENSITY)))  # m/s
SHEAR = float(np.sqrt(YOUNG / (2 * (1 + POISSON)) / DENSITY))  # m/s
ARRIVAL, WINDOW = HEIGHT / 2 / DILATATIONAL, HEIGHT / DILATATIONAL  # s, until the waves come back
ERRORS = ("position", "start")
Values = npt.NDArray[np.float64]


def rayleigh_speed() -> float:
    """Speed of Rayleigh waves, m/s: root of (2 - q^2)^2 = 4 sqrt((1 - q^2) (1 - q^2 c_s^2 / c_d^2)), q = c_R / c_s."""
    from scipy.optimize import brentq

    ratio = (SHEAR / DILATATIONAL) ** 2
    q = brentq(lambda q: (2 - q**2) ** 2 - 4 * np.sqrt((1 - q**2) * (1 - ratio * q**2)), 0.5, 0.999)
    return float(q) * SHEAR


def start_time() -> float:
    """Time tau (s) after the arrival of the waves at which the crack starts."""
    toughness = np.sqrt(YOUNG * ENERGY / (1 - POISSON**2))
    share = toughness * (1 - POISSON) / (2 * 2 * TRACTION)
    return float(np.pi * share**2 / (DILATATIONAL * (1 - 2 * POISSON)))


def advance(t: Values) -> Values:
    """Advance (m) of the crack at times t (s) after the arrival: c_R (t - tau - tau log(t / tau))."""
    tau = start_time()
    since = np.maximum(t, tau)
    return np.asarray(rayleigh_speed() * (since - tau - tau * np.log(since / tau)))


def pane_study(settings: Settings, seed: int) -> Study:
    """Study of the pane up to the return of the waves."""
    h = float(settings["h"])
    fracture = {"strength": 1e9, "energy": ENERGY, "branching": settings.get("law") == "rate"}
    step = h / DILATATIONAL * float(settings.get("courant", 0.5))
    return {
        "title": "A crack under a plane wave",
        "mesh": {"builder": "box", "size": [LENGTH, HEIGHT], "h": h, "pattern": "unstructured", "seed": seed,
                 "order": settings["order"]},
        "material": {"energy": "linear", "young": YOUNG, "poisson": POISSON, "density": DENSITY},
        "fracture": fracture,
        "crack": [{"segment": [[-LENGTH / 10, HEIGHT / 2], [CRACK, HEIGHT / 2]]}],
        "boundary": [
            {"on": "top", "traction": [0.0, TRACTION]}, {"on": "bottom", "traction": [0.0, -TRACTION]},
            *({"on": side, "fix": "x"} for side in ("left", "right")),
        ],
        "time": {"scheme": settings["scheme"], "step": step, "end": ARRIVAL + WINDOW},
        "output": {"every": 1_000_000, "fields": [], "surface": False, "picture": False},
    }  # fmt: skip


def measure(settings: Settings, folder: Path) -> Figures:
    """Root mean square error of the tip's position over the time from arrival to return, over the last advance.

    Also the error of the start and the advance at the end, over the closed form.
    """
    runs = []
    for seed in SEEDS:
        out, seconds = run_in(pane_study(settings, seed), folder)
        rows = history(out)
        t, x = rows["time"] - ARRIVAL, rows["tip_x"] - CRACK
        moved = np.flatnonzero(x > 1e-9)
        if not len(moved):
            raise ValueError("the crack did not start")
        inside = (t > 0) & np.isfinite(x)
        exact = advance(t)
        runs.append({
            ERRORS[0]: float(np.sqrt(np.mean((x - exact)[inside] ** 2)) / advance(np.array([WINDOW]))[0]),
            ERRORS[1]: abs(float(t[moved[0]]) / start_time() - 1),
            "last advance over exact": float(x[inside][-1] / exact[inside][-1]), "seconds": seconds,
        })  # fmt: skip
    return worst_of(runs, ERRORS)


def _settings(h: float, order: int, scheme: str = "explicit", law: str = "griffith") -> Settings:
    """Settings of a trial."""
    return {"h": h, "order": order, "scheme": scheme, "law": law}


CASE = FractureCase(
    "running-crack", "Crack under a plane wave: position of the tip",
    f"Pane of glass, 100 x 80 mm, cracked to its centre; 1 MPa at top and bottom from t = 0. Closed form (Freund 1990) "
    f"until the waves return: the crack starts {start_time() * 1e6:.2f} microseconds after they arrive and runs with "
    f"v = c_R (1 - tau / t), up to 0.74 of c_R = {rayleigh_speed():.0f} m/s. Compared: position of the tip (root mean "
    "square over the time, as a share of the last advance, 17.3 mm) and start. Law `griffith`: a tip advances when G "
    "reaches G_c; `rate`: `fracture.branching`, which limits the speed to half of c_R. Errors are the largest of three "
    "random meshes.",
    measure, ERRORS,
    short=(_settings(4e-3, 1), _settings(2e-3, 1), _settings(1e-3, 1),
           _settings(2e-3, 1, "generalized-alpha")),
    full=(_settings(2e-3, 2), _settings(1e-3, 1, law="rate"), _settings(5e-4, 1), _settings(1e-3, 2),
          _settings(1e-3, 1, "generalized-alpha"), _settings(5e-4, 1, law="rate")),
    split="law", excluded=("explicit",), figures=("last advance over exact",), limit=600.0,
)  # fmt: skip
