"""A driven block that pushes another one, and blocks that overlap; run with mpirun by test_self_contact."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from mpi4py import MPI

from fracsim.output.contact_checks import IntersectionMonitor
from support.scenes import Values, make_scene, march, positions
from test_self_contact import driven_block, self_contact


def main(path: str) -> None:
    """Save the displacement after each step, and what the monitor of overlapping blocks has recorded (collective)."""
    comm, arrays = MPI.COMM_WORLD, dict[str, Values]()
    # each rank writes the mesh of the blocks
    folder = Path(path).parent / f"pushed-{comm.size}-{comm.rank}"
    folder.mkdir()
    for scheme in ("backward-euler", "quasi-static"):
        scene, state = make_scene(**driven_block(folder, 2, scheme=scheme))
        gather = scene.domain.input_numbering.gather_nodes
        while state.t < 0.3 * (1 - 1e-12):
            march(scene, state, 1)
            arrays[f"{scheme} {state.t:.3g}"] = gather(state.u.reshape(-1, 2))
        X, monitor = positions(scene), IntersectionMonitor(self_contact(scene))
        for depth in (0.02, 0.3, 0.1):
            u = np.where(X[: scene.domain.node_count, :1] > 1.01, [[-0.05 - depth, 0.0]], 0.0).reshape(-1)
            scene.balance.evaluate_at(0.0, u, 0 * u, dt=1e-3)
            monitor.record_frame(depth)
        (seen,) = monitor.first_seen.values()
        arrays[f"{scheme} overlap"] = np.array([seen["time"], *seen["place"], seen["pairs"]])
    if comm.rank == 0:
        np.savez(path, **arrays)  # type: ignore[arg-type]


if __name__ == "__main__":
    main(sys.argv[1])
