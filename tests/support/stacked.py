"""Four plates that land on one another, for the tests of stacks on several ranks."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from mpi4py import MPI

from support.scenes import make_scene

MESH = Path(__file__).parents[1] / "meshes" / "stack.msh"


def main(path: str) -> None:
    """Two steps; energies of the share of rank 0 after each of them, J."""
    scene, state = make_scene(
        mesh={"file": str(MESH)}, material={"energy": "neo-hookean", "young": 1e7, "poisson": 0.3, "density": 1000.0},
        load={"gravity": [0.0, 0.0, -9.81]}, contact={"friction": 0.0}, solver={},
        obstacle=[{"name": "table", "shape": "plane", "normal": [0, 0, 1], "at": [0, 0, -1e-4], "friction": 0.0}],
        time={"scheme": "backward-euler", "step": 5e-3, "end": 0.01},
    )  # fmt: skip
    energies = []
    for _ in range(2):
        state.advance()
        energies.append([scene.balance.energies.kinetic_energy(state.v), state.elastic])
    if MPI.COMM_WORLD.rank == 0:
        np.savez(path, energies=energies)


if __name__ == "__main__":
    main(sys.argv[1])
