"""What test_brittle_parallel compares: studies with brittle surfaces run on any number of ranks, in input order."""

from __future__ import annotations

from typing import Any

from fracsim.fracture.edge_history import EdgeHistory
from fracsim.scene import Scene

from .scenes import make_scene, march
from .torn import MESHES, TIGHT, Found, result_of

STONE = {"young": 1.0, "poisson": 0.2, "density": 1.0}
JERK_2D = [{"on": "left", "fix": "xy"}, {"on": "right", "velocity": [0.2, 0.05]}]
JERK_3D = [{"on": "left", "fix": "xyz"}, {"on": "right", "velocity": [0.2, 0.0, 0.05]}]
STEPS = {"scheme": "newmark", "step": 0.05, "end": 0.25}  # surfaces start in the first four steps
RUNS: dict[str, dict[str, Any]] = {
    "averaged": {
        "mesh": MESHES["2d"], "material": STONE | {"energy": "corotated"}, "boundary": JERK_2D, "time": STEPS,
        "fracture": {"strength": 0.1, "radius": 0.15}, "brittle": {"surfaces": 5, "spacing": 0.1, "per_pass": 2},
    },
    "curved": {
        "mesh": MESHES["3d"], "material": STONE | {"energy": "corotated"}, "boundary": JERK_3D, "time": STEPS,
        "fracture": {"strength": 0.1, "heterogeneity": {"modulus": 10.0, "seed": 1}},
        "brittle": {"surfaces": 4, "shape": "curved", "per_pass": 2},
    },
    "averaged-curved": {
        "mesh": MESHES["2d"], "material": STONE | {"energy": "neo-hookean"}, "boundary": JERK_2D, "time": STEPS,
        "fracture": {"strength": 0.1, "radius": 0.15}, "brittle": {"surfaces": 4, "shape": "curved", "per_pass": 1},
    },
    "grains": {
        "mesh": MESHES["3d"], "material": STONE | {"energy": "corotated"}, "boundary": JERK_3D, "time": STEPS,
        "fracture": {"strength": 0.1}, "brittle": {"surfaces": 4, "grains": {"count": 12, "seed": 3, "spread": 0.2}},
    },
    "bias": {
        "mesh": MESHES["3d"], "material": STONE | {"energy": "linear"}, "boundary": JERK_3D, "time": STEPS,
        "fracture": {"strength": 0.1, "approach": "edge"},
        "brittle": {"surfaces": 3, "grains": {"count": 25, "seed": 3, "mode": "bias"}},
    },
    # torn along grains, then pushed together: pieces touch where grains are cut
    "shut": {
        "mesh": MESHES["2d"], "material": STONE | {"energy": "neo-hookean"},
        "boundary": [{"on": "left", "fix": "xy"}, {"on": "right", "displacement": {
            "time": [0.0, 0.125, 0.4], "value": [[0.0, 0.0], [0.07, 0.02], [-0.1, 0.0]]}}],
        "fracture": {"strength": 0.1}, "brittle": {"surfaces": 3, "grains": {"count": 8, "seed": 3}},
        "contact": {"itself": "pieces", "friction": 0.2},
        "time": {"scheme": "backward-euler", "step": 0.025, "end": 0.3},
    },
    # a lattice stretched alike in all directions: every cell is tied and every direction a principal one
    "ties": {
        "mesh": {"builder": "box", "size": [1.0, 0.5], "h": 0.0625},
        "material": STONE | {"energy": "linear", "poisson": 0.0},
        "boundary": [
            {"on": "left", "displacement": [0.0, "free"]}, {"on": "bottom", "displacement": ["free", 0.0]},
            {"on": "right", "displacement": {"time": [0.0, 1.0], "value": [[0.0, "free"], [0.2, "free"]]}},
            {"on": "top", "displacement": {"time": [0.0, 1.0], "value": [["free", 0.0], ["free", 0.1]]}},
        ],
        "fracture": {"strength": 0.1}, "brittle": {"surfaces": 3},
        "time": {"scheme": "quasi-static", "step": 0.125, "end": 0.625},
    },
}  # fmt: skip


def run(name: str) -> Found:
    """A study to its end."""
    scene, state = make_scene(**RUNS[name], solver=TIGHT)
    rows = [[float(report.broken), report.kinetic, report.elastic] for report in march(scene, state)]
    return result_of(name, scene, state, rows) | surfaces_of(name, scene)


def surfaces_of(name: str, scene: Scene) -> Found:
    """Where surfaces started and where edges are cut, by sorted keys."""
    return {f"{name}-starts": scene.fracture.criterion.starts} | cuts_of(name, scene)


def cuts_of(name: str, scene: Scene) -> Found:
    """Where edges are cut, by sorted keys."""
    record = EdgeHistory(scene.fracture.graph)
    record.record_breaks(0.0, scene.fracture.criterion.cut_positions)
    gathered = record.graph.gather_broken(record.cut_positions[:, None])
    return {} if gathered is None else {f"{name}-cut": gathered[1][:, 0]}


def compared() -> Found:
    """All runs, each array under the name of its run, with "brittle-" before it."""
    return {f"brittle-{key}": values for name in RUNS for key, values in run(name).items()}
