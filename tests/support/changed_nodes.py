"""What test_changed_nodes compares: a bar of which some cells get stiffer, with multigrid of the bar before."""

from __future__ import annotations

import sys

import numpy as np

from support.scenes import make_scene
from support.solver_policy import other_policy


def main(path: str) -> None:
    """Iterations of CG with and without exact solutions, and after a new set-up; changed nodes and stiff cells."""
    fixed = [{"on": "left", "fix": "xyz"}, {"on": "right", "velocity": [1.0, 0.0, 0.0]}]
    # multigrid stays that of the bar before
    with other_policy(min_block_dofs=0, vcycle_setup_cost=10**6, vcycle_refresh_cost=10**6, max_changed_share=1.0):
        scene, walk = make_scene(
            mesh={"builder": "box", "size": [0.6, 0.2, 0.2], "h": 0.025}, fracture={"strength": 1e12}, boundary=fixed,
            material={"energy": "neo-hookean", "young": 1e6, "poisson": 0.3, "density": 1.0},
            time={"scheme": "backward-euler", "step": 1.0, "end": 10.0}, solver={"ksp_rtol": 1e-8},
        )  # fmt: skip
    domain, balance, linear = scene.domain, scene.balance, scene.stepper.solver.linear
    preconditioner, chi = linear.preconditioner, balance.stress.chi
    assert chi is not None
    scene.stepper.inelastic.begin_step(walk.state, 1.0)
    force = np.sin(1e3 * domain.nodes[: domain.node_count]).reshape(-1) * balance.motion.free_dofs

    def iterations() -> int:
        balance.work_vector.array_w[:] = force
        assert linear.solve()
        return int(linear.ksp.its)

    found = {"before": iterations()}
    x = domain.nodes[domain.cell_nodes][:, :, 0].mean(axis=1)
    is_stiff = (abs(x - 0.3) < 0.08) & (np.cos(1e3 * domain.input_numbering.cells) > 0.5)
    chi.x.array[: domain.cell_count][is_stiff] = 100.0
    chi.x.scatter_forward()
    balance.damage_changed()
    found["stale"] = iterations()
    preconditioner.edges_broke(0)
    found["exact"] = iterations()
    changed = np.zeros(domain.node_count)
    changed[preconditioner.changed_nodes] = 1.0
    gathered = {
        "changed": domain.input_numbering.gather_nodes(changed[:, None]),
        "stiff": domain.input_numbering.gather_cells(is_stiff.astype(float)),
        "cells": domain.input_numbering.gather_cells(domain.input_numbering.nodes[domain.cell_nodes]),
    }
    preconditioner.solve_failed()  # so that it is set up again
    found["new"] = iterations()
    found["left"] = 0 if preconditioner.changed_nodes is None else len(preconditioner.changed_nodes)
    if domain.comm.rank == 0:
        np.savez(path, **found, **gathered)


if __name__ == "__main__":
    main(sys.argv[1])
