"""Corrections that would throw few nodes far: what is held back of them, and what of a whole part."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from fracsim.scene import Scene
from fracsim.solvers import line_search
from support.ranks import OnRanks, Results, starting
from support.scenes import make_scene, positions

Values = npt.NDArray[np.float64]


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A body of 1,331 nodes."""
    return make_scene(
        mesh={"builder": "box", "size": [1.0, 1.0, 1.0], "h": 0.1},
        material={"energy": "linear", "young": 1.0, "poisson": 0.3, "density": 1.0},
        time={"scheme": "backward-euler", "step": 0.01, "end": 1.0},
    )[0]


def held(scene: Scene, moves: Values, forces: Values) -> Values:
    """(n, d) what is left of moves (n, d), in mean edges, where `forces` (n, d) act."""
    y, r = scene.balance.work_vector.duplicate(), scene.balance.work_vector.duplicate()
    y.array_w[:], r.array_w[:] = scene.domain.mean_edge_length * moves.reshape(-1), forces.reshape(-1)
    line_search.clip_correction(scene.domain, y, r)
    return np.asarray(y.array_r.reshape(moves.shape) / scene.domain.mean_edge_length)


def some_moves(scene: Scene) -> Values:
    """(n, d), each 0.5 edges long."""
    moves = np.random.default_rng(3).normal(size=positions(scene).shape)
    return np.asarray(0.5 * moves / np.linalg.norm(moves, axis=1, keepdims=True))


def test_few_nodes_go_an_edge_in_their_direction(scene: Scene) -> None:
    """All others go their whole way."""
    moves = some_moves(scene)
    thrown = moves.copy()
    thrown[:30] *= 1e3
    np.testing.assert_allclose(held(scene, thrown, thrown), np.concatenate([2 * moves[:30], moves[30:]]), rtol=1e-12)


def test_what_many_do_is_their_motion(scene: Scene) -> None:
    """Half the body moves by 50 edges, and does; ten nodes that would go a thousand go little further."""
    moves = some_moves(scene)
    moves[positions(scene)[:, 0] > 0.5] += [50.0, 0.0, 0.0]
    thrown = moves.copy()
    thrown[:10] *= 1e3 / np.linalg.norm(thrown[:10], axis=1, keepdims=True)
    left = held(scene, thrown, thrown)
    np.testing.assert_allclose(left[10:], thrown[10:], rtol=1e-12)
    lengths = np.linalg.norm(left[:10], axis=1)
    assert np.all((lengths > 50.5) & (lengths < 102))


def test_nothing_is_held_back_that_would_lead_upwards(scene: Scene) -> None:
    """Down it goes by what few nodes do alone."""
    moves = some_moves(scene)
    forces = -moves
    moves[:30] *= 1e3
    forces[:30] = moves[:30]
    assert np.sum(moves * forces) > 0
    less = moves.copy()
    less[:30] /= 500
    forces[30:] *= 2 * np.sum(less[:30] * forces[:30]) / abs(np.sum(less[30:] * forces[30:]))
    assert np.sum(moves * forces) > 0 > np.sum(less * forces)
    np.testing.assert_allclose(held(scene, moves, forces), moves, rtol=1e-12)


@pytest.fixture(scope="module")
def results(on_ranks: OnRanks) -> Results:
    """Arrays of a rank count."""
    return starting("thrown-", on_ranks)


@pytest.mark.ranks
@pytest.mark.parametrize("ranks", (2, 3))
def test_on_any_number_of_ranks(results: Results, ranks: int) -> None:
    """The same nodes are held back."""
    found, serial = results(ranks)["held"], results(1)["held"]
    np.testing.assert_allclose(found, serial, atol=1e-12)
    assert serial.max() == pytest.approx(1.0, abs=1e-9)
