"""A body that flies towards obstacles that are far at first; run with mpirun by test_clearance."""

from __future__ import annotations

import sys

import numpy as np
from mpi4py import MPI

from support.scenes import make_scene, march
from test_clearance import BAR, RUBBER, TIMES, axe

OBSTACLES = {
    "plane": {"name": "it", "shape": "plane", "at": [0.0, 0.0, -0.9], "normal": [0.0, 0.0, 1.0]},
    "ball": {"name": "it", "shape": "sphere", "radius": 0.2, "at": [0.5, 0.25, -1.1], "mass": 5.0},
    "axe": axe(at=[0.5, 0.25, -3.8]),
}


def main(path: str) -> None:
    """Save the time, the gap and the readings after each step (collective)."""
    arrays = {}
    for scheme, time in TIMES.items():
        for name, obstacle in OBSTACLES.items():
            scene, state = make_scene(
                mesh=BAR, material=RUBBER, obstacle=[obstacle], initial={"velocity": [0.5, 0.0, -10.0]},
                time=time | {"end": 0.1}, solver={"snes_rtol": 1e-9, "ksp_rtol": 1e-9},
            )  # fmt: skip
            gap = [column.startswith("gap_") for column in scene.probes.columns].index(True)
            rows = []
            while state.t < 0.1 * (1 - 1e-12):
                march(scene, state, 1)
                readings = scene.probes()
                rows.append([state.t, readings[gap], *readings])
            arrays[f"{scheme} {name}"] = np.array(rows)
    if MPI.COMM_WORLD.rank == 0:
        np.savez(path, **arrays)  # type: ignore[arg-type]


if __name__ == "__main__":
    main(sys.argv[1])
