"""A free ball that lands on a block and begins to roll; run with mpirun by test_rolling_ball."""

from __future__ import annotations

import sys

import numpy as np

from support.scenes import each_step, make_scene

COLUMNS = ("contact_ball_x", "contact_ball_z", "velocity_ball_x", "velocity_ball_z", "spin_ball_y", "gap_ball")


def main(target: str) -> None:
    scene, state = make_scene(
        mesh={"builder": "box", "size": [0.08, 0.08, 0.02], "h": 0.01},
        material={"energy": "neo-hookean", "young": 1e6, "poisson": 0.3, "density": 1000.0},
        boundary=[{"on": "bottom", "fix": "xyz"}], load={"gravity": [0.0, 0.0, -9.81]},
        obstacle=[{"name": "ball", "shape": "sphere", "radius": 0.015, "at": [0.04, 0.04, 0.0351], "density": 3000.0,
                   "friction": 0.3, "velocity": [0.1, 0.0, -0.3]}],
        solver={"snes_rtol": 1e-11, "ksp_rtol": 1e-9}, time={"scheme": "backward-euler", "step": 5e-4, "end": 2.5e-3},
    )  # fmt: skip
    rows = []
    for _ in each_step(scene, state):
        told = dict(zip(scene.probes.columns, scene.probes(), strict=True))
        rows.append([told[name] for name in COLUMNS])
    if scene.domain.comm.rank == 0:
        np.savez(target, rows=np.array(rows))


if __name__ == "__main__":
    main(sys.argv[1])
