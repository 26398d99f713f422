"""Nodes that hold Newton's method up: what they are solved for with, and that steps end where they would without."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import fracsim.mechanics.balance as balance_module
from fracsim.mechanics.cell_stiffness import CellStiffness
from fracsim.scene import Scene
from fracsim.stepping import newton, stragglers
from support.ranks import OnRanks, Results, starting
from support.reference import dense_tangent
from support.scenes import make_scene, positions
from support.thrown import thrown

RANDOM = np.random.default_rng(5)


def summed(scene: Scene) -> np.ndarray:
    """The stiffness of all cells as a dense matrix."""
    domain = scene.domain
    blocks, d = CellStiffness(scene.balance.stress)(np.arange(domain.cell_count, dtype=np.int32)), domain.dim
    n = domain.node_count
    K = np.zeros((n, n, d, d))
    for corners, block in zip(domain.cell_nodes, blocks, strict=True):
        K[np.ix_(corners, corners)] += block
    return K.transpose(0, 2, 1, 3).reshape(n * d, n * d)


@pytest.mark.parametrize("energy", ["neo-hookean", "stvk"])
@pytest.mark.parametrize("dim", [2, 3])
def test_cells_add_up_to_the_tangent(energy: str, dim: int) -> None:
    """To DOLFINx's own where moduli are positive; where a body is crumpled, to more than that, and to something
    positive."""
    scene, _ = make_scene(
        mesh={"builder": "box", "size": [1.0] * dim, "h": 0.5},
        material={"energy": energy, "young": 1.0, "poisson": 0.3, "density": 1.0},
    )
    X, balance = positions(scene), scene.balance
    balance.displace((0.05 * X + RANDOM.normal(scale=1e-3, size=X.shape)).reshape(-1))
    np.testing.assert_allclose(summed(scene), dense_tangent(scene), atol=1e-12)
    balance.displace((-0.2 * X + RANDOM.normal(scale=0.05, size=X.shape)).reshape(-1))
    K, made = dense_tangent(scene), summed(scene)
    assert np.linalg.eigvalsh(K)[0] < -1e-3
    assert np.linalg.eigvalsh(made)[0] > -1e-12
    assert np.linalg.eigvalsh(made - K)[0] > -1e-12


def test_a_small_system_is_solved_for() -> None:
    """Three nodes of two cells and one beside them, against a dense solve; what is held stays where it is."""
    names, mass, free = np.array([3, 5, 9]), RANDOM.uniform(1, 2, (3, 2)), np.ones((3, 2))
    free[1, 0] = 0.0
    corners = np.array([[3, 5, 9], [9, 3, 7]])
    roots = RANDOM.normal(size=(2, 6, 6))
    blocks = (roots @ roots.transpose(0, 2, 1)).reshape(2, 3, 2, 3, 2).transpose(0, 1, 3, 2, 4)
    K = np.diag(mass.reshape(-1))
    for row, block in zip(corners, blocks, strict=True):
        for a, b in np.ndindex(3, 3):
            if row[a] != 7 and row[b] != 7:
                i, j = (int(np.flatnonzero(names == row[k])[0]) for k in (a, b))
                K[2 * i : 2 * i + 2, 2 * j : 2 * j + 2] += block[a, b]
    held = np.flatnonzero(free.reshape(-1) == 0)
    K[held], K[:, held] = 0.0, 0.0
    K[held, held] = 1.0
    matrix = stragglers._matrix(corners, blocks, names, mass, free)
    np.testing.assert_allclose(matrix.toarray(), K, atol=1e-13)
    b = RANDOM.normal(size=(3, 2)) * free
    x = stragglers._conjugate_gradients(matrix, b)
    assert x[1, 0] == 0
    assert np.linalg.norm(K @ x.reshape(-1) - b.reshape(-1)) < np.linalg.norm(b)


def test_a_thrown_corner_is_solved_for_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    """A block of which a corner flies off at once, through the cell behind it: steps end as without, to the tolerance
    of Newton's method, with fewer tangents; without damage nothing of it is made."""
    made: list[int] = []
    assemble = balance_module.Balance._assemble_body
    monkeypatch.setattr(
        balance_module.Balance, "_assemble_body", lambda self, *given: made.append(1) or assemble(self, *given)
    )
    monkeypatch.setattr(stragglers, "FEW", 0.2)

    def flown() -> tuple[np.ndarray, int, Any]:
        made.clear()
        scene, state = thrown()
        return state.u.copy(), len(made), scene

    u, tangents, scene = flown()
    assert scene.solver._stragglers is not None
    monkeypatch.setattr(newton, "_waits", lambda *_: False)
    alone, more, scene = flown()
    assert scene.solver._stragglers is None
    np.testing.assert_allclose(u, alone, atol=1e-7 * np.abs(alone).max())
    assert tangents < more


def test_nodes_elsewhere_stay_where_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is solved for is found, it ends with less of a residual, and nothing else moves."""
    monkeypatch.setattr(stragglers, "FEW", 0.2)
    scene, _ = thrown(steps=0)
    balance = scene.balance
    balance.begin(0.01, 0.01, *(np.zeros(balance.owned) for _ in range(3)))
    X, u = positions(scene), np.zeros((balance.owned // 3, 3))
    corner = X.sum(axis=1).argmax()
    u[corner] = -0.3
    balance.displace(u.reshape(-1))
    before = balance.forces().copy()
    found = stragglers.Stragglers(balance)
    assert found.look()
    found.solve(0.0)
    assert not found.look()  # before anything else has moved
    moved = np.abs(balance.u.x.array.reshape(-1, 3) - u).max(axis=1) > 0
    assert 0 < moved.sum() < 0.7 * len(u)
    far = np.linalg.norm(X - X[corner], axis=1)
    assert far[moved].max() < far[~moved].max()
    assert np.linalg.norm(balance.forces()) < 0.3 * np.linalg.norm(before)


@pytest.fixture(scope="module")
def results(on_ranks: OnRanks) -> Results:
    """Arrays of a rank count."""
    return starting("thrown-", on_ranks)


@pytest.mark.ranks
@pytest.mark.parametrize("ranks", (2, 3))
def test_on_any_number_of_ranks(results: Results, ranks: int) -> None:
    """The same motion, and some nodes were solved for."""
    found, serial = results(ranks), results(1)
    assert found["solved"] > 0 and serial["solved"] > 0
    np.testing.assert_allclose(found["u"], serial["u"], atol=1e-7 * np.abs(serial["u"]).max())
