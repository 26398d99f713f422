"""Nodes that hold Newton's method up: what they come to rest by, and that steps end where they would without."""

from __future__ import annotations

import numpy as np
import pytest

from fracsim.mechanics.cell_energy import CellEnergy
from fracsim.mechanics.tangent import Tangent
from fracsim.solvers import nonlinear_elimination, nonlinear_solver
from support.ranks import OnRanks, Results, starting
from support.reference import dense_tangent
from support.scenes import make_scene, positions
from support.solver_policy import set_policy
from support.thrown import thrown
from test_joining import tied

RANDOM = np.random.default_rng(5)


@pytest.mark.parametrize("energy", ["neo-hookean", "stvk", "corotated"])
@pytest.mark.parametrize("dim", [2, 3])
def test_cells_add_up_to_the_body(energy: str, dim: int) -> None:
    """Energies, forces and stiffness of cells, to what DOLFINx assembles of a crumpled body."""
    scene, _ = make_scene(
        mesh={"builder": "box", "size": [1.0] * dim, "h": 0.5},
        material={"energy": energy, "young": 1.0, "poisson": 0.3, "density": 1.0},
    )
    X, balance, domain = positions(scene), scene.balance, scene.domain
    balance.set_displacement((-0.2 * X + RANDOM.normal(scale=0.05, size=X.shape)).reshape(-1))
    of_cells = CellEnergy(balance.stress)(np.arange(domain.cell_count, dtype=np.int32))
    assert np.isclose(of_cells.energy.sum(), balance.stress.stored_energy(), rtol=1e-12)
    forces, n = np.zeros_like(X), domain.node_count
    np.add.at(forces, domain.cell_nodes, of_cells.forces)
    np.testing.assert_allclose(forces.reshape(-1), balance.stress.assemble_forces(), atol=1e-13)
    K = np.zeros((n, n, dim, dim))
    for corners, block in zip(domain.cell_nodes, of_cells.stiffness, strict=True):
        K[np.ix_(corners, corners)] += block
    np.testing.assert_allclose(K.transpose(0, 2, 1, 3).reshape(n * dim, -1), dense_tangent(scene), atol=1e-12)


@pytest.mark.fast_solver_only("nonlinear elimination")
def test_a_thrown_corner_comes_to_rest_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    """A block of which a corner flies off at once, through the cell behind it: steps end as without, to the tolerance
    of Newton's method, with fewer tangents; without damage nothing of it is made."""
    made: list[int] = []
    assemble = Tangent._assemble_body
    monkeypatch.setattr(
        Tangent,
        "_assemble_body",
        lambda self, *given: (made.append(1), assemble(self, *given))[1],
    )
    set_policy(monkeypatch, max_relaxed_nodes=0.2)
    scene, state = thrown()
    u, tangents = state.u.copy(), len(made)
    assert scene.solver is not None and scene.solver._newton._convergence._elimination is not None
    made.clear()
    monkeypatch.setattr(nonlinear_solver.NonlinearSolver, "edges_broke", lambda *_: None)
    scene, state = thrown()
    assert scene.solver is not None and scene.solver._newton._convergence._elimination is None
    np.testing.assert_allclose(u, state.u, atol=1e-7 * np.abs(state.u).max())
    assert tangents < len(made)


def test_nodes_elsewhere_stay_where_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """A corner that is pushed through its cell: it and its neighbours lower the potential, their forces are next to
    nothing, nothing else moves, and there K is positive."""
    policy = set_policy(monkeypatch, max_relaxed_nodes=0.2)
    scene, _ = thrown(steps=0)
    balance = scene.balance
    balance.begin_step(0.01, 0.01, *(np.zeros(balance.owned_dof_count) for _ in range(3)))
    X, u = positions(scene), np.zeros((balance.owned_dof_count // 3, 3))
    corner = X.sum(axis=1).argmax()
    u[corner] = -0.3
    balance.set_displacement(u.reshape(-1))
    before, high = balance.update_forces().copy().reshape(-1, 3), balance.energies.incremental_potential()[0]
    few = nonlinear_elimination.create_elimination(balance, policy)
    assert few is not None and few.relax_nodes(0.0)
    moved = np.flatnonzero(np.abs(balance.u.x.array.reshape(-1, 3) - u).max(axis=1))
    touched = np.unique(scene.domain.cell_nodes[(scene.domain.cell_nodes == corner).any(axis=1)])
    assert set(touched) <= set(moved) and len(moved) < 0.7 * len(u)
    after = balance.update_forces().reshape(-1, 3)
    assert np.linalg.norm(after[moved]) < policy.patch_rtol * np.linalg.norm(before)
    assert balance.energies.incremental_potential()[0] < high
    dofs = (3 * moved[:, None] + np.arange(3)).reshape(-1)
    K = dense_tangent(scene) + balance.c_a * np.diag(balance.mass.lumped)
    assert np.linalg.eigvalsh(K[np.ix_(dofs, dofs)])[0] > 0


@pytest.mark.parametrize("dim", [2, 3])
def test_what_is_tied_comes_to_rest_with_its_ties(monkeypatch: pytest.MonkeyPatch, dim: int) -> None:
    """A node without cells that is pulled away from where it is tied goes back: the potential, with what ties store, is
    lower, and the forces of all nodes that moved, which ties are part of, are next to nothing."""
    policy = set_policy(monkeypatch, max_relaxed_nodes=0.5)
    scene, state, tethers = tied(dim, time={"scheme": "backward-euler", "step": 10.0, "end": 100.0})
    balance = scene.balance
    balance.begin_step(10.0, 10.0, state.u, np.zeros(balance.owned_dof_count), np.zeros(balance.owned_dof_count))
    u = state.u.reshape(-1, dim).copy()
    node = int(np.flatnonzero(scene.domain.input_numbering.nodes == tethers.ties.nodes[0, 0])[0])
    u[node] += 2.0
    balance.set_displacement(u.reshape(-1))
    before, high, stored = (
        balance.update_forces().copy(),
        balance.energies.incremental_potential()[0],
        tethers.stored_energy(),
    )
    few = nonlinear_elimination.create_elimination(balance, policy)
    assert few is not None and few.relax_nodes(0.0)
    moved = np.flatnonzero(np.abs(balance.u.x.array.reshape(-1, dim) - u).max(axis=1))
    assert node in moved
    assert np.linalg.norm(balance.update_forces().reshape(-1, dim)[moved]) < policy.patch_rtol * np.linalg.norm(before)
    assert balance.energies.incremental_potential()[0] < high - 0.9 * stored


@pytest.fixture(scope="module")
def results(on_ranks: OnRanks) -> Results:
    """Arrays of a rank count."""
    return starting("thrown-", on_ranks)


@pytest.mark.ranks
@pytest.mark.parametrize("ranks", (2, 3))
def test_on_any_number_of_ranks(results: Results, ranks: int) -> None:
    """The same motion."""
    found, serial = results(ranks), results(1)
    np.testing.assert_allclose(found["u"], serial["u"], atol=1e-7 * np.abs(serial["u"]).max())


@pytest.mark.fast_solver_only("nonlinear elimination")
@pytest.mark.ranks
@pytest.mark.parametrize("ranks", (1, 2, 3))
def test_some_nodes_come_to_rest_by_themselves(results: Results, ranks: int) -> None:
    assert results(ranks)["rested"] > 0
