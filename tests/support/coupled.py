"""What test_block_matrix compares: a block between obstacles, with contact beside a tangent in blocks, on any ranks."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from mpi4py import MPI

from fracsim.mechanics.tangent import Tangent
from fracsim.scene import Scene, build_scene
from fracsim.study.reader import validate

from .solver_policy import set_policy

Values = npt.NDArray[np.float64]
STUDY: dict[str, Any] = {
    "title": "pressed",
    "mesh": {"builder": "box", "size": [1.0, 1.0, 1.0], "h": 0.25, "pattern": "unstructured"},
    "material": {"energy": "neo-hookean", "young": 1e7, "poisson": 0.35, "density": 1000.0},
    "boundary": [{"on": "bottom", "fix": "xyz"}],
    "obstacle": [
        {"name": "ball", "shape": "sphere", "radius": 0.4, "at": [0.4, 0.6, 1.41], "velocity": [0.1, 0.0, -2.0],
         "friction": 0.3},
        {"name": "free", "shape": "sphere", "radius": 0.2, "at": [1.21, 0.5, 0.5], "density": 3000.0,
         "velocity": [-3.0, 0.0, 0.0]},
    ],
    "solver": {"snes_rtol": 1e-9, "ksp_rtol": 1e-9},
    "time": {"scheme": "backward-euler", "step": 2e-3, "end": 1.0},
}  # fmt: skip


def pressed(steps: int) -> tuple[Scene, Values]:
    """The scene after some steps, and (owned dofs,) displacement, m (collective)."""
    scene = build_scene(MPI.COMM_WORLD, validate(STUDY, "pressed"))
    state = scene.start()
    for _ in range(steps):
        state, report = scene.stepper.advance(state)
        assert report.solve.converged
    return scene, state.u


def main(path: str) -> None:
    comm = MPI.COMM_WORLD
    with pytest.MonkeyPatch.context() as patch:
        set_policy(patch, min_block_dofs=0)
        scene, u = pressed(8)
        patch.setattr(Tangent, "switch_to_blocks", lambda _: None)
        _, u_entries = pressed(8)
    tangent = scene.balance.tangent
    tangent.assemble()
    blocks, entries = tangent._assembler.blocks, tangent.matrix
    assert blocks is not None
    x, y = entries.createVecs()
    expected = y.duplicate()
    x.array_w[:] = np.sin(np.arange(*x.getOwnershipRange()))
    blocks.mult(x, y)
    entries.mult(x, expected)
    nodes = np.concatenate([coupling.nodes for coupling in blocks.couplings])[:5]
    rows = tangent.owned_rows(nodes)
    all_x = np.concatenate(comm.allgather(x.array_r))
    d = scene.domain.dim
    diagonal_error = 0.0
    body = blocks.matrix.to_dense() if comm.size == 1 else None
    for coupling in blocks.couplings if body is not None else ():
        size = np.abs(coupling.diagonal_blocks).max()
        for node, block in zip(coupling.nodes, coupling.diagonal_blocks, strict=True):
            part = slice(d * node, d * node + d)
            dofs = np.arange(part.start, part.stop, dtype=np.int32)
            diagonal_error = max(
                diagonal_error,
                np.abs(entries.getValues(dofs, dofs) - body[part, part] - block).max() / size,
            )

    def relative(difference: Values, values: Values) -> float:
        norms = comm.allreduce(np.array([np.sum(difference**2), np.sum(values**2)]))
        return float(np.sqrt(norms[0] / norms[1]))

    # PETSc's multigrid smooths by the entries of its last update
    size = entries.norm()
    tangent.assemble(blocks_only=True)
    product = expected.array_r.reshape(-1, d)[nodes].reshape(-1)
    found = {
        "coupled": comm.allreduce(sum(len(coupling.nodes) for coupling in blocks.couplings)),
        "product": relative(y.array_r - expected.array_r, expected.array_r),
        "rows": relative(rows @ all_x - product, product),
        "diagonal": comm.allreduce(diagonal_error, op=MPI.MAX),
        "entries": abs(entries.norm() / size - 1),
        "displacement": relative(u - u_entries, u),
    }
    if comm.rank == 0:
        np.savez(path, **found)


if __name__ == "__main__":
    main(sys.argv[1])
