"""Runs of cracks that take an energy, compared between ranks: arrays in the order of the input mesh."""

from __future__ import annotations

from typing import Any

import numpy as np

from .scenes import make_scene, march
from .shattered import cuts_of
from .torn import TIGHT, Found, result_of

_SOFT = {"young": 1e4, "poisson": 0.3, "density": 1.0}
_PLATE = {"builder": "box", "size": [1.0, 1.0], "h": 1 / 16, "pattern": "unstructured"}

RUNS: dict[str, dict[str, Any]] = {
    "notched": {  # pulled open at one end: it gets on with the load
        "mesh": _PLATE | {"size": [1.5, 1.0]}, "material": _SOFT | {"energy": "linear"},
        "fracture": {"strength": 1e5, "energy": 1.0}, "crack": [{"segment": [[0.0, 0.52], [0.5, 0.52]]}],
        "boundary": [
            {"on": "bottom", "fix": "xy"},
            {"on": {"box": [[-0.1, 0.99], [0.3, 1.01]]},
             "displacement": {"time": [0, 1, 11], "value": [[0, 0], [0, 0.02], [0, 0.12]]}},
        ],
        "time": {"scheme": "quasi-static", "step": 1.0, "end": 5.0},
    },
    "begun": {
        "mesh": _PLATE | {"size": [2.0, 0.8]}, "material": _SOFT | {"energy": "neo-hookean"},
        "fracture": {"strength": 400.0, "energy": 0.01, "heterogeneity": {"modulus": 20.0, "seed": 2}},
        "boundary": [{"on": "left", "velocity": [-4.0, 0.0]}, {"on": "right", "velocity": [4.0, 0.0]}],
        "time": {"scheme": "explicit", "step": 1e-3, "end": 0.0022},
    },
    "front": {  # pulled open at one end: it gets on with the load
        "mesh": {"builder": "box", "size": [1.5, 0.4, 1.0], "h": 1 / 8, "pattern": "unstructured"},
        "material": _SOFT | {"energy": "linear"}, "fracture": {"strength": 1e5, "energy": 1.0},
        "crack": [{"polygon": [[-0.1, -0.1, 0.52], [0.4, -0.1, 0.52], [0.4, 0.5, 0.52], [-0.1, 0.5, 0.52]]}],
        "boundary": [
            {"on": "bottom", "fix": "xyz"}, {"on": "front", "fix": "y"},
            {"on": {"box": [[-0.1, -0.1, 0.99], [0.3, 0.5, 1.01]]},
             "displacement": {"time": [0, 1, 11], "value": [[0, 0, 0], [0, 0, 0.02], [0, 0, 0.12]]}},
        ],
        "time": {"scheme": "quasi-static", "step": 1.0, "end": 5.0},
    },
    "shaken": {
        "mesh": _PLATE, "material": _SOFT | {"energy": "corotated"}, "fracture": {"strength": 1e5, "energy": 0.05},
        "crack": [{"segment": [[0.0, 0.52], [0.5, 0.52]]}],
        "boundary": [{"on": "bottom", "velocity": [0.0, -0.4]}, {"on": "top", "velocity": [0.0, 0.4]}],
        "time": {"scheme": "newmark", "step": 5e-4, "end": 0.008},
    },
    "forked": {
        "mesh": _PLATE, "material": _SOFT | {"energy": "linear"},
        "fracture": {"strength": 1e5, "energy": 0.02, "branching": True},
        "crack": [{"segment": [[0.0, 0.52], [0.3, 0.52]]}],
        "boundary": [{"on": "bottom", "velocity": [0.0, -0.8]}, {"on": "top", "velocity": [0.0, 0.8]}],
        "time": {"scheme": "newmark", "step": 5e-4, "end": 0.012},
    },
}  # fmt: skip
RUNS["cohesive"] = {
    "mesh": _PLATE | {"size": [0.6, 0.3], "h": 1 / 14}, "material": _SOFT | {"energy": "linear"},
    "fracture": {"strength": 100.0, "energy": 0.6, "law": "cohesive"},
    "crack": [{"segment": [[0.0, 0.16], [0.15, 0.16]]}],
    "boundary": [
        {"on": "bottom", "fix": "xy"},
        {"on": {"box": [[-0.1, 0.29], [0.3, 0.31]]},
         "displacement": {"time": [0, 1], "value": [[0, 0], [0.003, 0.04]]}},
    ],
    "time": {"scheme": "quasi-static", "step": 0.05, "end": 1.0},
}  # fmt: skip
# torn apart by waves from both ends
RUNS["torn"] = RUNS["cohesive"] | {
    "crack": [], "boundary": [{"on": "left", "velocity": [-2.0, 0.0]}, {"on": "right", "velocity": [2.0, 0.0]}],
    "time": {"scheme": "explicit", "step": 1e-3, "end": 0.02},
}  # fmt: skip
RUNS["drawn"] = RUNS["torn"] | {"time": {"scheme": "generalized-alpha", "step": 5e-4, "end": 0.02}}
# the plate of "notched", which yields outside the elastic zone of its tip
RUNS["yielding"] = RUNS["notched"] | {
    "material": _SOFT | {"energy": "corotated"},
    "plasticity": {"yield_stress": 40.0, "hardening": 500.0, "update": "implicit"},
    "time": {"scheme": "quasi-static", "step": 0.5, "end": 5.0},
}  # fmt: skip
# a front that is passed over until it has nearly what it takes
RUNS["waiting"] = {
    "mesh": {"builder": "box", "size": [2.0, 0.3, 1.0], "h": 1 / 6, "pattern": "unstructured"},
    "material": _SOFT | {"energy": "linear"}, "fracture": {"strength": 1e5, "energy": 1.0},
    "crack": [{"polygon": [[-0.1, -0.1, 0.52], [1.0, -0.1, 0.52], [1.0, 0.5, 0.52], [-0.1, 0.5, 0.52]]}],
    "boundary": [{"on": "bottom", "fix": "xyz"}, {"on": "top", "velocity": [0.0, 0.0, 0.25]}], "damping": {"mass": 2e3},
    "time": {"scheme": "explicit", "step": 5e-4, "end": 0.07},
}  # fmt: skip
# many cracks at once, which with crumbs cut eight nodes off
RUNS["shivered"] = RUNS["begun"] | {
    "mesh": _PLATE | {"size": [2.0, 0.8], "h": 1 / 10},
    "fracture": {"strength": 300.0, "energy": 0.005, "crumbs": False},
    "time": {"scheme": "explicit", "step": 1e-3, "end": 0.008},
}
# steps are solved again as edges break; crack faces of some ranks alone have no room before the floor
RUNS["dropped"] = {
    "mesh": {"builder": "box", "size": [2.0, 2.0], "h": 1 / 3, "pattern": "unstructured"},
    "material": {"energy": "linear", "young": 2e7, "poisson": 0.3, "density": 1100.0},
    "fracture": {"strength": 2.2e4, "energy": 21.0, "crumbs": False}, "damping": {"mass": 4.6},
    "obstacle": [{"name": "floor", "shape": "plane", "at": [0.0, 0.0], "normal": [0.0, 1.0]}],
    "initial": {"velocity": [0.0, -9.3]}, "time": {"scheme": "newmark", "step": 6e-3, "end": 0.054},
}  # fmt: skip


def run(name: str) -> Found:
    """A study to its end."""
    scene, state = make_scene(**RUNS[name], solver=TIGHT)
    rows = [[float(report.broken), report.kinetic, report.elastic] for report in march(scene, state)]
    dissipated = {f"{name}-dissipated": np.array([state.dissipated])}
    return result_of(name, scene, state, rows) | cuts_of(name, scene) | dissipated


def compared() -> Found:
    """All runs, each array under the name of its run, with "tearing-" before it."""
    return {f"tearing-{key}": values for name in RUNS for key, values in run(name).items()}
