"""A stiff block that bounces on a floor without friction: no loss of energy in closed form.

The block is thrown at 1 m/s as if from 0.05 m. The barrier is wide: it takes 50 ms to turn the block round.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .fracture_case import Figures, FractureCase, steps_of
from .precision_trials import Settings, Study

GRAVITY, SPEED, MASS = 10.0, 1.0, 100.0  # m/s^2, m/s, kg
HEIGHT = SPEED**2 / (2 * GRAVITY)  # m
ERROR = "height of the return"


def block_study(scheme: str, step: float) -> Study:
    """Study of a square of 1 m over a floor."""
    return {
        "title": "A block that bounces",
        "mesh": {"builder": "box", "size": [1.0, 1.0], "h": 1.0},
        "material": {"energy": "linear", "young": 1e7, "poisson": 0.0, "density": MASS},
        "load": {"gravity": [0.0, -GRAVITY]},
        "initial": {"velocity": [0.0, -SPEED]},
        "contact": {"distance": 0.03, "stiffness": 3e3, "itself": False},
        "obstacle": [{"name": "floor", "shape": "plane", "at": [0.0, -0.031], "normal": [0.0, 1.0]}],
        "solver": {"snes_rtol": 1e-9, "ksp_rtol": 1e-9},
        "time": {"scheme": scheme, "step": step, "end": 0.4},
    }


def return_height(scene: Any, state: Any) -> float:
    """Height to which the centre will return, by its place and velocity, over that from which it fell."""
    mass = scene.balance.mass.lumped.reshape(-1, 2)[:, :1]
    y, v = ((mass * field.reshape(-1, 2))[:, 1].sum() / MASS for field in (state.u, state.v))
    return float((v**2 / (2 * GRAVITY) + y) / HEIGHT)


def measure(settings: Settings, folder: Path) -> Figures:
    """Lost height of the return, and steps from first contact to the return."""
    from mpi4py import MPI

    from ....scene import build_scene
    from ....study.reader import validate

    study = block_study(str(settings["scheme"]), float(settings["dt"]))
    if settings["scheme"] == "explicit":
        del study["solver"], study["contact"]["distance"]
    scene = build_scene(MPI.COMM_SELF, validate(study, "bounce"))
    seconds: list[float] = []
    touched = 0
    for state, _ in steps_of(scene, seconds):
        share = return_height(scene, state)  # of the end where the block stays on the floor
        force = dict(zip(scene.probes.columns, scene.probes(), strict=True))["contact_floor_y"]
        if touched and force == 0:
            break
        touched += force != 0
    return {ERROR: abs(1 - share), "share": share, "steps of contact": float(touched), "seconds": sum(seconds)}


STEPS = (1e-3, 2.5e-4)
SCHEMES = ("newmark", "generalized-alpha", "backward-euler")
RUNS = (*((scheme, dt) for scheme in SCHEMES for dt in STEPS), ("explicit", 1e-3))
CASE = FractureCase(
    "bounce", "Block that bounces: height of the return",
    "A stiff block meets a floor at 1 m/s; the barrier turns it round in 50 ms. Closed form: it returns to its height. "
    "Explicit contact has a range and a stiffness of its own.",
    measure, (ERROR,),
    short=tuple({"scheme": scheme, "dt": dt} for scheme, dt in RUNS), split="scheme",
    excluded=("explicit",), figures=("share",),
)  # fmt: skip
