"""Moduli made positive: against dense eigenvalues, and a step that exact tangents do not get through."""

from __future__ import annotations

import numpy as np
import pytest

from fracsim.mechanics.positive import least_pivots
from support.reference import dense_tangent
from support.scenes import displacement, make_scene, positions

RANDOM = np.random.default_rng(3)


def test_pivots_tell_what_is_positive() -> None:
    """Their least is negative where an eigenvalue is (numpy's), also beside a matrix of zeros."""
    roots = RANDOM.normal(size=(200, 9, 9))
    A = roots @ roots.transpose(0, 2, 1) + RANDOM.uniform(-3.0, 1.0, 200)[:, None, None] * np.eye(9)
    negative = np.linalg.eigvalsh(A)[:, 0] < 0
    assert 0 < negative.sum() < 200
    np.testing.assert_array_equal(least_pivots(A) < 0, negative)
    assert not (least_pivots(np.zeros((1, 4, 4))) < 0).any()


@pytest.mark.parametrize("energy", ["neo-hookean", "stvk"])
@pytest.mark.parametrize("dim", [2, 3])
def test_a_crumpled_body_is_made_positive(energy: str, dim: int) -> None:
    """K+ has no negative eigenvalue where K has, nor has K+ - K; and what is positive stays as it is, to round-off."""
    scene, _ = make_scene(
        mesh={"builder": "box", "size": [1.0] * dim, "h": 0.5},
        material={"energy": energy, "young": 1.0, "poisson": 0.3, "density": 1.0},
    )
    X, balance = positions(scene), scene.balance
    balance.displace((0.05 * X + RANDOM.normal(scale=1e-3, size=X.shape)).reshape(-1))
    K = dense_tangent(scene)
    np.testing.assert_allclose(dense_tangent(scene, small=0.0), K, atol=1e-12)
    balance.displace((-0.2 * X + RANDOM.normal(scale=0.05, size=X.shape)).reshape(-1))
    K, made = dense_tangent(scene), dense_tangent(scene, small=0.0)
    assert np.linalg.eigvalsh(K)[0] < -1e-3
    assert np.linalg.eigvalsh(made)[0] > -1e-12
    assert np.linalg.eigvalsh(made - K)[0] > -1e-12


def test_a_step_that_exact_tangents_do_not_get_through_is_taken() -> None:
    """A slender column pressed together by 0.3 of its length in one step ends bent and in balance, with much less than
    the 45 J of the straight one, Y A L 0.3^2 / 2, which stands far beyond Euler's 0.03."""
    scene, walk = make_scene(
        mesh={"builder": "box", "size": [0.1, 1.0], "h": 0.05, "pattern": "structured"},
        material={"energy": "neo-hookean", "young": 1e4, "poisson": 0.3, "density": 1.0},
        load={"gravity": [1.0, 0.0]},
        boundary=[{"on": "bottom", "fix": "xy"}, {"on": "top", "displacement": [0.0, -0.3]}],
        time={"scheme": "quasi-static", "step": 1.0, "end": 1.0, "adapt": False},
        solver={"snes_rtol": 1e-9},
    )
    assert walk.advance().solve.converged
    balance = scene.balance
    free = np.setdiff1d(np.arange(balance.owned), balance.motion.owned)
    assert np.linalg.norm(balance.forces()[free]) < 1e-6 * np.linalg.norm(balance.reactions[balance.motion.owned])
    assert abs(displacement(scene, walk)[:, 0]).max() > 0.2
    assert balance.stress.stored() < 20.0
    assert scene.solver is not None and scene.solver._downhill is not None


def test_a_first_guess_that_is_inside_out_gives_way_to_the_start_of_the_step() -> None:
    """A block whose nodes fly at random by a fifth of its size in a step, with a pressure of nothing on it, which takes
    its potential away: the step is taken whole, momentum is kept, and no cell ends inside out."""
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 1.0, 1.0], "h": 0.34}, solver={},
        material={"energy": "neo-hookean", "young": 1e4, "poisson": 0.3, "density": 1.0},
        boundary=[{"on": "right", "pressure": 0.0}], time={"scheme": "backward-euler", "step": 0.1, "end": 0.2},
    )  # fmt: skip
    assert not scene.balance.conservative
    v = 2.0 * np.random.default_rng(0).standard_normal(positions(scene).shape)
    state.v = v.reshape(-1)
    state.settle()
    x, mass = positions(scene), scene.balance.mass.lumped.reshape(-1, 3)
    cells = scene.domain.cell_nodes
    volumes = [np.linalg.det(np.diff(at[cells], axis=1)) for at in (x, x + 0.1 * v)]
    assert (volumes[0] * volumes[1] < 0).any()  # where it would go by itself
    state.advance()
    assert scene.stepper.troubles()["steps_failed"] == 0
    ends = np.linalg.det(np.diff((x + state.u.reshape(-1, 3))[cells], axis=1))
    assert (volumes[0] * ends > 0).all()
    np.testing.assert_allclose((mass * state.v.reshape(-1, 3)).sum(axis=0), (mass * v).sum(axis=0), atol=1e-6)


def test_what_crawls_goes_on_down_the_potential(monkeypatch: pytest.MonkeyPatch) -> None:
    """A step of a block that is swung, by the norm of its residual and, from the first iteration on, down its
    potential: to the same place, which no norm has to be halved for."""
    found = []
    for crawl in (5, 0):
        monkeypatch.setattr("fracsim.stepping.newton.CRAWL", crawl)
        scene, state = make_scene(
            mesh={"builder": "box", "size": [1.0, 1.0, 1.0], "h": 0.34}, solver={"snes_rtol": 1e-10},
            material={"energy": "neo-hookean", "young": 1e4, "poisson": 0.3, "density": 1.0},
            boundary=[{"on": "left", "fix": "xyz"}], time={"scheme": "backward-euler", "step": 0.05, "end": 0.05},
        )  # fmt: skip
        state.v = np.where(state.u == 0, 3.0 * positions(scene)[:, [1, 2, 0]].reshape(-1), 0.0)
        state.settle()
        state.advance()
        assert scene.solver is not None and (scene.solver._downhill is not None) == (crawl == 0)
        found.append(state.u.copy())
    np.testing.assert_allclose(found[1], found[0], atol=1e-7 * np.abs(found[0]).max())
