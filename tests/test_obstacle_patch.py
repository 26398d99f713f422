"""Contact of few nodes with obstacles, against that of the whole body; nodes that come to rest before an obstacle."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from fracsim.contact.obstacle_term import ObstacleTerm
from fracsim.contact.pose import min_distance
from fracsim.scene import Scene
from fracsim.solvers import nonlinear_elimination, nonlinear_solver
from support.pushed_nodes import DISTANCE, STUDIES, make_patch, nodes_in_contact, pressed
from support.ranks import run_on_ranks
from support.scenes import Values, break_across, each_step, make_scene
from support.solver_policy import record_relaxations, set_policy

RANDOM = np.random.default_rng(7)


def displaced(scene: Scene, u: Values, nodes: npt.NDArray[np.int64], w: Values) -> None:
    """Displace nodes (k,) of a body on one rank by w (k, d), m, from u (n, d), m."""
    moved = u.copy()
    moved[nodes] += w
    scene.balance.set_displacement(moved.reshape(-1))


def least_gap(contact: ObstacleTerm) -> float:
    """Least gap of a point, or of a facet before the ball, at the current displacement, m."""
    x, posed = contact.surface.positions(contact.end_displacement), contact.group.posed
    facets = contact.surface.facet_gaps(posed, contact.surface.facets, x)
    return min(float(min_distance(posed, x).min()), float(facets.min()))


@pytest.mark.parametrize("name", STUDIES)
def test_a_patch_has_the_potential_of_the_body(name: str) -> None:
    """Changes of potential and forces, in any scheme, with friction; second derivatives against differences of forces;
    also where points move by distances of the barrier."""
    scene, contact, u = pressed(name)
    nodes = nodes_in_contact(scene, contact, 6)
    patch, shape = make_patch(scene, nodes), (6, u.shape[1])
    assert len(patch._start) < len(contact.positions)

    def of_body(w: Values) -> tuple[float, Values]:
        displaced(scene, u, nodes, w)
        forces = scene.balance.level.contact_weight * contact.contact_forces().reshape(u.shape)[nodes]
        return contact.potential(), -forces

    direction = RANDOM.normal(size=shape)
    step = DISTANCE / np.linalg.norm(direction)
    at_start, start = patch.evaluate(np.zeros(shape)), of_body(np.zeros(shape))
    np.testing.assert_allclose(at_start.forces, start[1], rtol=1e-9, atol=1e-12 * np.abs(start[1]).max())
    assert np.abs(start[1]).max() > 0
    for length in (1e-3, -1e-2, 0.05, -3.0):
        w = length * step * direction
        w *= patch.free_fraction(np.zeros(shape), w)
        value, body = patch.evaluate(w), of_body(w)
        scale = max(abs(body[0]), abs(start[0]))
        assert value.potential - at_start.potential == pytest.approx(body[0] - start[0], rel=1e-6, abs=1e-11 * scale)
        np.testing.assert_allclose(value.forces, body[1], rtol=1e-7, atol=1e-9 * np.abs(body[1]).max())
    difference = 1e-6 * step * direction
    ends = [of_body(sign * difference)[1] for sign in (1, -1)]
    product = at_start.stiffness @ (2 * difference).reshape(-1)
    np.testing.assert_allclose(product, (ends[0] - ends[1]).reshape(-1), atol=1e-5 * np.abs(product).max())


@pytest.mark.parametrize("name", ["2d", "3d"])
def test_steps_of_a_patch_end_before_obstacles(name: str) -> None:
    """Straight ways into obstacles leave gaps open, and short ways that are free are left as they are."""
    scene, contact, u = pressed(name)
    nodes = nodes_in_contact(scene, contact, 6)
    patch, shortened = make_patch(scene, nodes), 0
    for _ in range(20):
        step = 0.3 * RANDOM.normal(size=(6, u.shape[1]))
        fraction = patch.free_fraction(np.zeros_like(step), step)
        displaced(scene, u, nodes, fraction * step)
        assert least_gap(contact) > 0
        shortened += fraction < 1
        displaced(scene, u, nodes, 0 * step)
    assert shortened
    assert patch.free_fraction(np.zeros_like(step), 1e-6 * step) == 1


@pytest.mark.parametrize("name", ["2d", "3d", "free"])
def test_nodes_in_contact_come_to_rest(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """Nodes that are displaced before an obstacle: their potential falls, their forces are next to nothing, other nodes
    and the obstacle stay, and gaps are open."""
    policy = set_policy(monkeypatch, max_relaxed_nodes=0.5)
    scene, contact, u = pressed(name)
    balance = scene.balance
    nodes = nodes_in_contact(scene, contact, 2)
    displaced(scene, u, nodes, 0.05 * DISTANCE * np.cos(np.arange(u.shape[1])))
    start = balance.u.x.array.reshape(u.shape).copy()
    before, high = balance.update_forces().copy().reshape(u.shape), balance.energies.incremental_potential()[0]
    few = nonlinear_elimination.create_elimination(balance, policy)
    assert few is not None and few.relax_nodes(0.0)
    moved = np.flatnonzero(np.abs(balance.u.x.array.reshape(u.shape) - start).max(axis=1))
    assert set(nodes) & set(moved) and len(moved) < len(u)
    dofs = np.intersect1d(
        (u.shape[1] * moved[:, None] + np.arange(u.shape[1])).reshape(-1), balance.motion.free_dofs.nonzero()[0]
    )
    after = balance.update_forces().reshape(-1)
    assert np.linalg.norm(after[dofs]) < policy.patch_rtol * np.linalg.norm(before.reshape(-1)[dofs])
    assert balance.energies.incremental_potential()[0] < high
    assert least_gap(contact) > 0


@pytest.mark.fast_solver_only("nonlinear elimination")
def test_steps_end_as_without_and_take_fewer_tangents(monkeypatch: pytest.MonkeyPatch) -> None:
    """A torn block under a ball, with nodes that are relaxed separately and without: the same motion."""
    set_policy(monkeypatch, max_relaxed_nodes=0.1)
    relaxed = record_relaxations(monkeypatch)
    motions, iterations = [], []
    for _ in range(2):
        scene, state = make_scene(**STUDIES["2d"] | {"time": {"scheme": "backward-euler", "step": 0.02, "end": 0.2}})
        break_across(scene, [1.0, 0.1], 0.52)
        break_across(scene, [0.1, 1.0], 0.3)
        state.remember()
        scene.solver.edges_broke(1)
        iterations.append(sum(report.solve.newton_iterations for report in each_step(scene, state)))
        motions.append(state.u.copy())
        if not relaxed.count(True):
            break
        monkeypatch.setattr(nonlinear_solver.NonlinearSolver, "edges_broke", lambda *_: None)
    assert relaxed.count(True) > 0
    np.testing.assert_allclose(motions[0], motions[1], atol=1e-6 * np.abs(motions[1]).max())
    assert iterations[0] < iterations[1]


@pytest.mark.ranks
@pytest.mark.parametrize("ranks", (2, 3))
def test_patches_on_any_number_of_ranks(ranks: int, tmp_path: Path) -> None:
    """The same forces, and the same nodes come to rest at the same places."""
    one, several = (run_on_ranks("support.pushed_nodes", count, tmp_path) for count in (1, ranks))
    for name, values in one.items():
        np.testing.assert_allclose(several[name], values, rtol=1e-7, atol=1e-7 * np.abs(values).max(), err_msg=name)
        assert np.abs(values).max() > 0
