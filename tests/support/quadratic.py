"""Runs with quadratic displacement, compared between ranks: arrays in the order of the input mesh, then its edges."""

from __future__ import annotations

from typing import Any

from . import tearing
from .scenes import make_scene, march
from .torn import MESHES, SOFT, TIGHT, Found, result_of

_PULLED = [{"on": "left", "fix": "xyz"}, {"on": "right", "velocity": [0.4, 0.0, 0.1]}]


def _quadratic(name: str, **mesh: Any) -> dict[str, Any]:
    """A run of `tearing`."""
    tables = tearing.RUNS[name]
    return tables | {"mesh": tables["mesh"] | {"order": 2} | mesh}


RUNS: dict[str, dict[str, Any]] = {
    # flows and tears; what does either is straight
    "block": {
        "mesh": MESHES["3d"] | {"order": 2}, "material": SOFT | {"energy": "corotated"}, "boundary": _PULLED,
        "fracture": {"strength": 0.13, "radius": 0.25}, "plasticity": {"yield_stress": 0.1, "hardening": 0.1},
        "damping": {"mass": 0.1, "stiffness": 0.01}, "time": {"scheme": "backward-euler", "step": 0.05, "end": 0.2},
    },
    "plate": {
        "mesh": MESHES["2d"] | {"order": 2}, "material": SOFT | {"energy": "neo-hookean"},
        "boundary": [{"on": "left", "fix": "xy"}, {"on": "right", "velocity": [0.4, 0.1]}],
        "fracture": {"strength": 0.2, "unilateral": True},
        "time": {"scheme": "explicit", "step": 0.01, "end": 0.25},
    },
    # a bar that tears, whose halves are then pressed together beside a wall that is in the way
    "closed": {
        "mesh": {"builder": "box", "size": [1.0, 0.3], "h": 0.15, "pattern": "unstructured", "order": 2},
        "material": SOFT | {"energy": "neo-hookean"}, "fracture": {"strength": 0.2, "crumbs": False},
        "boundary": [
            {"on": "left", "fix": "xy"},
            {"on": "right", "displacement": {"time": [0.0, 0.6, 1.2], "value": [[0.0, 0.0], [0.4, 0.0], [-0.1, 0.0]]}},
        ],
        "contact": {"itself": True},
        "obstacle": [{"name": "wall", "shape": "plane", "at": [0.0, -0.001], "normal": [0.0, 1.0]}],
        "time": {"scheme": "backward-euler", "step": 0.05, "end": 1.2},
    },
    "disk": {
        "mesh": {"builder": "disk", "radius": 1.0, "h": 0.3, "arc": 60.0, "order": 2},
        "material": SOFT | {"energy": "stvk"},
        "boundary": [{"on": "bottom", "fix": "xy"}, {"on": "top", "pressure": 0.05}, {"on": "rim", "force": [0.1, 0]}],
        "time": {"scheme": "newmark", "step": 0.1, "end": 0.5, "mass": "consistent"},
    },
    # tips go by the force on them, in the plane and in space
    "tearing": _quadratic("notched"), "waiting": _quadratic("waiting", h=1 / 4),
}  # fmt: skip


def run(name: str) -> Found:
    """A study to its end."""
    scene, state = make_scene(**{"solver": TIGHT} | RUNS[name])
    rows = [[float(report.broken), report.kinetic, report.elastic] for report in march(scene, state)]
    return result_of(name, scene, state, rows)


def compared() -> Found:
    """All runs, each array under the name of its run, with "order-" before it."""
    return {f"order-{key}": values for name in RUNS for key, values in run(name).items()}
