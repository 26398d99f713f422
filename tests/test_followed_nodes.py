"""Nodes in contact stay where others are relaxed separately; all of the surface stay where these would collide."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fracsim.contact.self_contact import SelfContact
from fracsim.scene import Scene
from fracsim.solvers import nonlinear_elimination, nonlinear_solver
from support.scenes import Values, Walk, break_across, each_step, make_scene
from support.solver_policy import record_relaxations, set_policy
from support.torn import TIGHT

SOFT = {"energy": "neo-hookean", "young": 1e4, "poisson": 0.3, "density": 100.0}
PUSHED = [{"on": "left", "velocity": [2.0, 0.5]}, {"on": "right", "velocity": [-2.0, 0.0]}]
STEP = {"scheme": "backward-euler", "step": 5e-3, "end": 0.15}


def torn_block(dim: int, **tables: Any) -> tuple[Scene, Walk, SelfContact]:
    """Two halves of a block, whose crack faces touch each other."""
    mesh = {
        "builder": "box",
        "size": [2.0, *[1.0] * (dim - 1)],
        "h": 0.1 if dim == 2 else 0.2,
        "pattern": "unstructured",
    }
    given: dict[str, Any] = {
        "mesh": mesh, "material": SOFT, "fracture": {"strength": 1e9}, "contact": {"itself": "pieces"}, "solver": TIGHT,
        "time": STEP,
    }  # fmt: skip
    scene, state = make_scene(**given | tables)
    break_across(scene, [1.0] + [0.1] * (dim - 1), 1.05)
    (term,) = [term for term in scene.balance.terms if isinstance(term, SelfContact)]
    return scene, state, term


def closing(scene: Scene, term: SelfContact) -> Values:
    """(nodes, d) displacement by which the halves come into contact, m."""
    x = scene.domain.nodes[: scene.domain.node_count]
    u = 1e-3 * scene.domain.mean_edge_length * np.sin(7 * x[:, ::-1])
    u[:, 0] -= np.sign(x[:, 0] - 1.0) * 0.7 * term.surface.law.distance
    return np.asarray(u)


@pytest.mark.parametrize("dim", [2, 3])
def test_the_surface_moves_with_these_nodes_alone(dim: int) -> None:
    scene, _, term = torn_block(dim)
    u, followed = closing(scene, term), term.followed_nodes()
    x = term.surface.positions(u.reshape(-1)).copy()
    for node in range(len(u)):
        moved = u.copy()
        moved[node] += 1e-3
        assert np.array_equal(term.surface.positions(moved.reshape(-1)), x) != followed[node]
    assert 0.1 < followed.mean() < 0.95


@pytest.mark.parametrize("collides", [False, True])
@pytest.mark.parametrize("dim", [2, 3])
def test_nodes_come_to_rest_beside_contact_that_stays(
    dim: int, collides: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = set_policy(monkeypatch, max_relaxed_nodes=0.5)
    scene, state, term = torn_block(dim)
    balance, u = scene.balance, closing(scene, term)
    balance.begin_step(state.t, 5e-3, u.reshape(-1), *(0 * u.reshape(-1),) * 2)
    balance.set_displacement(u.reshape(-1))
    followed, forces = term.followed_nodes(), term.contact_forces()
    stays = followed if collides else term.nodes_in_contact()
    assert followed[stays].all()
    if collides:
        monkeypatch.setattr(term, "max_step_fraction", lambda change: 0.5)
    assert forces is not None and np.abs(forces).max() > 0
    forces = forces.copy()
    node = np.flatnonzero(~followed)[3]
    u[node] += 0.1 * scene.domain.mean_edge_length
    balance.set_displacement(u.reshape(-1))
    before = np.linalg.norm(balance.update_forces().reshape(u.shape)[node])
    few = nonlinear_elimination.create_elimination(balance, policy)
    assert few is not None and few.relax_nodes(0.0)
    after = balance.update_forces().reshape(u.shape)
    moved = np.abs(balance.u.x.array.reshape(u.shape) - u).max(axis=1) > 0
    assert moved[node] and not moved[stays].any()
    assert np.linalg.norm(after[moved]) < 0.05 * before
    assert moved[followed].any() != collides
    assert np.array_equal(term.contact_forces(), forces)


@pytest.mark.fast_solver_only("nonlinear elimination")
def test_steps_of_a_torn_body_in_contact_end_as_without(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two halves that are pushed together, with many broken edges within them."""
    set_policy(monkeypatch, max_relaxed_nodes=0.1)
    relaxed = record_relaxations(monkeypatch)
    motions, touched = [], 0.0
    for _ in range(2):
        scene, state, term = torn_block(2, boundary=PUSHED)
        graph, inside = scene.fracture.graph, np.abs(scene.domain.nodes[:, 1] - 0.5) < 0.35
        broken = np.random.default_rng(5).random(len(graph.edge_nodes)) < 0.6
        graph.break_edges(broken & inside[graph.edge_nodes].all(axis=1))
        scene.fracture.damage_restored()
        scene.balance.damage_changed()
        scene.balance.edges_broke(graph.pattern)
        state.remember()
        scene.solver.edges_broke(1)
        for _ in each_step(scene, state):
            touched = max(touched, term.stored_energy())
        motions.append(state.u.copy())
        if len(motions) == 1:
            assert relaxed.count(True) > 5
            monkeypatch.setattr(nonlinear_solver.NonlinearSolver, "edges_broke", lambda *_: None)
    assert touched > 0
    np.testing.assert_allclose(motions[0], motions[1], atol=1e-6 * np.abs(motions[1]).max())
