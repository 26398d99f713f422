"""The linear solver on a cracked body."""

from __future__ import annotations

import pytest
from mpi4py import MPI

from cases import BAR, study
from fracsim.scene import build_scene


@pytest.mark.parametrize("scheme", ("backward-euler", "generalized-alpha"))
def test_a_crack_does_not_slow_the_linear_solver(scheme: str) -> None:
    """A plane of broken edges through 9k tetrahedra: CG takes about as many iterations as before, for multigrid's
    aggregates do not reach across the crack (where they did, twice as many)."""
    data = study(
        BAR,
        mesh={"size": [0.6, 0.2, 0.2], "h": 0.025},
        fracture={"strength": 1e12},
        time={"end": 1.0, "scheme": scheme},
        solver={"snes_type": "ksponly", "ksp_rtol": 1e-6},
    )
    scene = build_scene(MPI.COMM_SELF, data)
    state = scene.stepper.start(None)
    before = [scene.stepper.advance(state).outcome.krylov for _ in range(3)][-1]
    graph = scene.fracture.graph
    left = scene.domain.nodes[graph.edge_nodes][:, :, 0] < 0.31
    graph.break_edges(left[:, 0] != left[:, 1])
    assert scene.equations.chi is not None
    scene.equations.chi.x.array[: scene.domain.cell_count][graph.split] = 0.0
    assert scene.solver is not None
    scene.solver.damage_changed()
    after = [scene.stepper.advance(state).outcome.krylov for _ in range(3)][-1]
    assert graph.split.any() and after <= 1.25 * before + 2, f"{before} iterations before the crack, {after} after"
