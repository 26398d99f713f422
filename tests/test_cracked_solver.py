"""The linear solver on a cracked body."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from cases import BAR, study
from fracsim.scene import Scene, build_scene
from fracsim.studies.evidence.growth import random_planes
from support.scenes import Walk


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
    state = Walk(scene)
    before = [state.advance().solve.krylov for _ in range(3)][-1]
    cut(scene, [(np.array([1.0, 0.0, 0.0]), np.array([0.31, 0.0, 0.0]))])
    after = [state.advance().solve.krylov for _ in range(3)][-1]
    assert scene.fracture.graph.split.any()
    assert after <= 1.25 * before + 2, f"{before} iterations before the crack, {after} after"


def test_multigrid_of_another_kind_takes_over_where_a_body_is_in_pieces() -> None:
    """Ten planes through a bar: CG takes a fifth less in the end than with the aggregates of the whole body, which a
    user who asks for them keeps."""
    krylov = []
    for given in ({}, {"pc_gamg_agg_nsmooths": 1}):
        data = study(
            BAR,
            mesh={"size": [0.6, 0.2, 0.2], "h": 0.016},
            material={"energy": "neo-hookean"},
            fracture={"strength": 1e12},
            time={"end": 1.0, "scheme": "backward-euler"},
            solver={"snes_type": "ksponly", "ksp_rtol": 1e-6, **given},
        )
        scene = build_scene(MPI.COMM_SELF, data)
        state = Walk(scene)
        state.advance()
        cut(scene, random_planes(10, scene.domain.lower, scene.domain.upper))
        krylov.append([state.advance().solve.krylov for _ in range(12)][-1])
    assert krylov[0] < 0.85 * krylov[1], krylov


def cut(scene: Scene, planes: list[Any]) -> None:
    """Break all edges across the planes, and the cells that they come apart."""
    graph = scene.fracture.graph
    ends = scene.domain.nodes[graph.edge_nodes]
    for normal, point in planes:
        side = (ends - point) @ normal >= 0
        graph.break_edges(side[:, 0] != side[:, 1])
    graph.break_idle()
    assert scene.balance.stress.chi is not None and scene.solver is not None
    scene.balance.stress.chi.x.array[: scene.domain.cell_count][graph.split] = 0.0
    scene.solver.damage_changed()
