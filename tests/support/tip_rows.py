"""Strips with cracks whose tips are recorded: in one process, and on any number of ranks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from fracsim.deformable_run import Run
from fracsim.scene import build_scene
from fracsim.studies.evidence.run_results import columns

from .scenes import make_study
from .torn import TIGHT, Found

LENGTH, STRESS = 0.4, 1.0


def strip(**tables: Any) -> Any:
    """A strip of width 1 m with an edge crack of 0.4 m, pulled by a stress of 1 Pa along y in plane strain."""
    return make_study(**{
        "material": {"energy": "linear", "young": 1e3, "poisson": 0.3, "density": 1.0},
        "mesh": {"builder": "box", "size": [1.0, 3.0], "h": 0.05, "pattern": "unstructured"},
        "fracture": {"strength": 1e3, "energy": 1.0},
        "crack": [{"segment": [[-0.1, 1.5], [LENGTH, 1.5]]}],
        "boundary": [
            {"on": "top", "traction": [0.0, STRESS]}, {"on": "bottom", "traction": [0.0, -STRESS]},
            {"on": {"box": [[1.0, 1.45], [1.0, 1.55]]}, "fix": "xy"},
            {"on": {"box": [[1.0, 2.98], [1.0, 3.02]]}, "fix": "x"},
        ],
        "time": {"scheme": "quasi-static", "step": 1.0, "end": 1.0}, "output": {"picture": False},
    } | tables)  # fmt: skip


def edge_crack_intensity(a: float) -> float:
    """K_I, Pa sqrt(m), of an edge crack of length a, m, in a strip (Tada, Paris, Irwin: Stress analysis of cracks)."""
    factor = 1.122 - 0.231 * a + 10.55 * a**2 - 21.71 * a**3 + 30.382 * a**4
    return float(STRESS * np.sqrt(np.pi * a) * factor)


def wedged(**tables: Any) -> Any:
    """A beam of 3 m by 0.6 m with cracks from both ends that open by the same displacement: each grows step by step."""
    up, down = ([[0.0, sign * value] for value in (0.0, 2.2e-3)] for sign in (1, -1))
    opened = [
        {"on": {"box": [[x - 0.01, y - 0.01], [x + 0.01, y + 0.01]]}, "displacement": {"time": [0, 25], "value": way}}
        for x in (0.0, 3.0) for y, way in ((0.6, up), (0.0, down))
    ]  # fmt: skip
    return strip(
        mesh={"builder": "box", "size": [3.0, 0.6], "h": 0.06, "pattern": "unstructured"},
        fracture={"strength": 1e3, "energy": 1e-4}, boundary=opened, probe=[{"name": "grip", "on": "left"}],
        crack=[{"segment": [[-0.1, 0.3], [0.8, 0.3]]}, {"segment": [[2.2, 0.3], [3.1, 0.3]]}],
        time={"scheme": "quasi-static", "step": 1.0, "end": 25.0}, **tables,
    )  # fmt: skip


def compared(folder: Path) -> Found:
    """Rows of tips.csv of the beam."""
    study = wedged(solver=TIGHT)
    Run(build_scene(MPI.COMM_WORLD, study), folder)()
    if MPI.COMM_WORLD.rank:
        return {}
    return {"tips-rows": np.column_stack(list(columns(folder / "tips.csv").values()))}
