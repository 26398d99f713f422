"""A clamped strip that stores some share of its fracture energy a metre, whose crack is held and then let go.

With `fracture.branching` a tip runs at c_R (1 - G_c / G*), at most at c_R / 2
(docs/theory.md#crack-speed-and-branching). A strip that stores 1.5 G_c a metre has one crack, at that limit.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
import numpy.typing as npt

from .fracture_case import Figures, FractureCase
from .precision_trials import Settings, Study

YOUNG, POISSON, LENGTH = 1e4, 0.3, 3.0  # Pa, 1, m; the strip is 1 m high, its density 1 kg/m^3, G_c 1 J/m^2
NOTCH, STEADY, LATE = 1.0, 1.3, 2.5  # m: end of the crack at the start, and where its speed is taken
SHEAR = float(np.sqrt(YOUNG / 2 / (1 + POISSON)))  # m/s
RAYLEIGH, READY = SHEAR * 0.9274, 6 / SHEAR  # m/s; s, when the strip is pulled
STORED, LIMIT = 1.5, 0.5  # of G_c a metre; of c_R
ERROR = "speed"
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class StripCrack:
    """Crack of a strip.

    Attributes:
        length: of its growth, m.
        speed: over c_R; 0 where it hardly moved.
        tips: largest number at a time.
        seconds: processor time of the steps.
    """

    length: float
    speed: float
    tips: int
    seconds: float


def strip_study(ratio: float, scheme: str, pattern: str, n: int, order: int = 1, **fracture: Any) -> Study:
    """Study of a strip that stores `ratio` G_c a metre when it is pulled, and is watched for 3 m at c_R then."""
    at = 0.5 + 0.2 / n
    constrained = YOUNG * (1 - POISSON) / ((1 + POISSON) * (1 - 2 * POISSON))
    s = np.linspace(0, 1, 30)
    opening = np.sqrt(2 * ratio / constrained) * s**3 * (10 - 15 * s + 6 * s**2)
    moved = [[0.0, x] for x in opening.tolist()]
    step = (0.1 if scheme == "explicit" else 0.4) / n / SHEAR
    return {
        "title": "A strip that tears",
        "mesh": {"builder": "box", "size": [LENGTH, 1.0], "h": 1 / n, "pattern": pattern, "order": order},
        "material": {"energy": "linear", "young": YOUNG, "poisson": POISSON, "density": 1.0},
        "fracture": {"strength": 1e9, "energy": 1.0} | fracture,
        "crack": [{"segment": [[0.0, at], [NOTCH, at]]}],
        "boundary": [
            {"on": "bottom", "fix": "xy"},
            {"on": "top", "displacement": {"time": (READY * s).tolist(), "value": moved}},
        ],
        "damping": {"mass": 4 * SHEAR},
        "time": {"scheme": scheme, "step": step, "end": READY + LENGTH / RAYLEIGH},
    }  # fmt: skip


def run_when_ready(scene: Any, ready: float) -> tuple[Values, list[Values]]:
    """(n,) s since `ready`, and (m, d) tips then, m, of each step in which a crack grows; it is held until `ready`."""
    from ....fracture.energy.tip_criterion import TipCriterion

    criterion, state = scene.fracture.criterion, scene.start()
    assert isinstance(criterion, TipCriterion)
    toughness, times, tips = criterion.toughness, [], []
    criterion.toughness = np.inf
    while not scene.ended(state):
        state, report = scene.stepper.advance(state)
        criterion.toughness = toughness if state.t > ready else np.inf
        if report.broken and len(points := criterion.find_tips().point):
            times.append(state.t - ready)
            tips.append(points)
    return np.array(times), tips


def crack_of_strip(scene: Any) -> StripCrack:
    """How far and how fast the crack of a strip runs."""
    began = process_time()
    times, tips = run_when_ready(scene, READY)
    seconds = process_time() - began
    t, x = np.append(0.0, times), np.array([NOTCH, *(points[:, 0].max() for points in tips)])
    steady = (x > STEADY) & (x < LATE)
    speed = float(np.polyfit(t[steady], x[steady], 1)[0]) / RAYLEIGH if steady.sum() > 5 else 0.0
    return StripCrack(float(x.max()) - NOTCH, speed, max(map(len, tips), default=1), seconds)


def measure(settings: Settings, folder: Path) -> Figures:
    """Error of the crack's speed."""
    from mpi4py import MPI

    from ....scene import build_scene
    from ....study.reader import validate

    n, order = int(settings["n"]), int(settings["order"])
    study = strip_study(STORED, str(settings["scheme"]), "unstructured", n, order, branching=True)
    crack = crack_of_strip(build_scene(MPI.COMM_SELF, validate(study, "strip")))
    return {ERROR: abs(crack.speed / LIMIT - 1), "speed over c_R": crack.speed, "tips": float(crack.tips),
            "seconds": crack.seconds}  # fmt: skip


def _settings(n: int, order: int = 1, scheme: str = "explicit") -> Settings:
    """Settings of a trial."""
    return {"n": n, "order": order, "scheme": scheme}


CASE = FractureCase(
    "strip", "Crack in a clamped strip: speed",
    "A strip of 3 x 1 m stores 1.5 G_c a metre; its crack is let go when the strip is at rest. With "
    "`fracture.branching` the energy drives the crack up to the largest speed of the law, c_R / 2, which is the "
    "reference: what is measured is whether mesh and steps follow the law. `n`: cells over the height.",
    measure, (ERROR,),
    short=(_settings(6), _settings(12), _settings(12, scheme="generalized-alpha"), _settings(6, 2)),
    full=(_settings(24), _settings(12, 2)), excluded=("explicit",), figures=("speed over c_R", "tips"),
)  # fmt: skip
