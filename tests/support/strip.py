"""A clamped strip that stores some share of its fracture energy a metre, whose crack is held and then let go."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from mpi4py import MPI

from fracsim.scene import build_scene

from .scenes import make_study
from .tips import run_when_ready

PLACE = {"notch": 1.0, "steady": 1.3, "late": 2.5}  # m


@dataclass(frozen=True)
class Run:
    """`length`: how far the crack got, m.    `speed`: over c_R.    `tips`: most of them at a time."""

    length: float
    speed: float
    tips: int


def run_of_a_strip(ratio: float, scheme: str, kind: str, n: int, order: int = 1, **fracture: Any) -> Run:
    """How far the crack of a clamped strip, 1 m high, that stores `ratio` G_c a metre runs, and how fast.

    The strip is 3 m long and is pulled slowly with its crack, of 1 m, held; then it is let go, for 3 m at c_R.
    """
    young, poisson, at = 1e4, 0.3, 0.5 + 0.2 / n
    constrained = young * (1 - poisson) / ((1 + poisson) * (1 - 2 * poisson))
    shear = np.sqrt(young / 2 / (1 + poisson))
    rayleigh = shear * 0.9274
    opening, ready = np.sqrt(2 * ratio / constrained), 6 / shear
    s, end = np.linspace(0, 1, 30), ready + 3 / rayleigh
    ramp = {"time": (ready * s).tolist(), "value": [[0.0, x] for x in opening * s**3 * (10 - 15 * s + 6 * s**2)]}
    study = make_study(
        mesh={"builder": "box", "size": [3.0, 1.0], "h": 1 / n, "pattern": kind, "order": order},
        material={"energy": "linear", "young": young, "poisson": poisson, "density": 1.0},
        fracture={"strength": 1e9, "energy": 1.0} | fracture, crack=[{"segment": [[0.0, at], [PLACE["notch"], at]]}],
        boundary=[{"on": "bottom", "fix": "xy"}, {"on": "top", "displacement": ramp}], damping={"mass": 4 * shear},
        time={"scheme": scheme, "step": (0.1 if scheme == "explicit" else 0.5) / n / shear, "end": end},
    )  # fmt: skip
    t, places = run_when_ready(build_scene(MPI.COMM_SELF, study), ready)
    t, x = np.append(0.0, t), np.array([PLACE["notch"], *(each[:, 0].max() for each in places)])
    steady = (x > PLACE["steady"]) & (x < PLACE["late"])
    speed = float(np.polyfit(t[steady], x[steady], 1)[0]) / rayleigh if steady.sum() > 5 else 0.0
    return Run(float(x.max()) - PLACE["notch"], speed, max(map(len, places), default=1))
