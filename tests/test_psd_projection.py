"""Moduli made positive: against dense eigenvalues, and a step that exact tangents do not get through."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from fracsim.mechanics.psd_projection import plain_psd_correction, psd_correction
from support.reference import dense_tangent
from support.scenes import displacement, make_scene, positions
from support.solver_policy import set_policy

RANDOM = np.random.default_rng(3)


@pytest.mark.parametrize("correct", [psd_correction, plain_psd_correction])
@pytest.mark.parametrize("size", [4, 9])
@pytest.mark.parametrize(("small", "factor"), [(0.0, 1.0), (0.05, 2.0)])
def test_matrices_are_made_positive(correct: Callable[..., None], size: int, small: float, factor: float) -> None:
    """By zeros in place of negative eigenvalues (LAPACK's), or their absolute values, where one is below - small of
    their mean; one of nothing and one with equal eigenvalues are among them."""
    roots = RANDOM.normal(size=(203, size, size))
    A = roots @ roots.transpose(0, 2, 1) + RANDOM.uniform(-3.0, 1.0, 203)[:, None, None] * np.eye(size)
    A[5], A[6] = 0.0, -np.eye(size)
    values, vectors = np.linalg.eigh(A)
    lifted = values[:, 0] < -small * values.mean(axis=1)
    lifted[6] = True
    assert 0 < lifted.sum() < len(A)
    made = np.maximum(values, 0.0) if factor == 1 else abs(values)
    expected = ((vectors * made[:, None, :]) @ vectors.transpose(0, 2, 1) - A) * lifted[:, None, None]
    found, filled = np.full((len(A) + 1, size, size), 7.0), np.ones(len(A), np.uint8)
    for order in (slice(None), slice(None, None, -1)):  # once more with what the first time has left
        correct(np.ascontiguousarray(A[order]), small, factor, found[:-1], filled)
        np.testing.assert_allclose(found[:-1], expected[order], atol=1e-10)
        np.testing.assert_array_equal(filled, lifted[order])
    assert (found[-1] == 7.0).all()


@pytest.mark.parametrize("energy", ["neo-hookean", "stvk", "corotated"])
@pytest.mark.parametrize("dim", [2, 3])
def test_a_crumpled_body_is_made_positive(energy: str, dim: int) -> None:
    """K+ has no negative eigenvalue where K has, nor has K+ - K; and what is positive stays as it is, to round-off."""
    scene, _ = make_scene(
        mesh={"builder": "box", "size": [1.0] * dim, "h": 0.5},
        material={"energy": energy, "young": 1.0, "poisson": 0.3, "density": 1.0},
    )
    X, balance = positions(scene), scene.balance
    balance.set_displacement((0.05 * X + RANDOM.normal(scale=1e-3, size=X.shape)).reshape(-1))
    K = dense_tangent(scene)
    np.testing.assert_allclose(dense_tangent(scene, small=0.0), K, atol=1e-12)
    balance.set_displacement((-0.2 * X + RANDOM.normal(scale=0.05, size=X.shape)).reshape(-1))
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
    free = np.setdiff1d(np.arange(balance.owned_dof_count), balance.motion.owned_dofs)
    assert np.linalg.norm(balance.update_forces()[free]) < 1e-6 * np.linalg.norm(
        balance.reactions[balance.motion.owned_dofs]
    )
    assert abs(displacement(scene, walk)[:, 0]).max() > 0.2
    assert balance.stress.stored_energy() < 20.0
    assert scene.solver is not None and scene.solver._newton._second_modified is not None


def test_a_first_guess_that_is_inside_out_gives_way_to_the_start_of_the_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """A block whose nodes fly at random by a fifth of its size in a step, with a pressure of nothing on it, which takes
    its potential away: the step is taken whole, momentum is kept, and no cell ends inside out."""
    # Factors solve even with the tangents of such a guess: Newton's method runs out of iterations, the step is halved.
    set_policy(monkeypatch, max_plain_direct_dofs=0)
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
    assert scene.stepper.failure_counts()["steps_failed"] == 0
    ends = np.linalg.det(np.diff((x + state.u.reshape(-1, 3))[cells], axis=1))
    assert (volumes[0] * ends > 0).all()
    np.testing.assert_allclose((mass * state.v.reshape(-1, 3)).sum(axis=0), (mass * v).sum(axis=0), atol=1e-6)
