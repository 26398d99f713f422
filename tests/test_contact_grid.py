"""The grid of contact: each kind of obstacle, motion and scheme, in 2D and 3D; what has no meaning is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fracsim.errors import InputError
from support.ranks import run_on_ranks
from support.scenes import displacement, each_step, positions
from support.touching import CELLS, MOTIONS, SCHEMES, momentum, scene_of, two_bodies

pytest.importorskip("ipctk", reason="an environment made without a network")


def refusal(kind: str, motion: str, scheme: str, dim: int) -> str:
    """What a study of a cell is told; empty if it runs."""
    if motion in ("free", "hinge") and scheme == "quasi-static":
        return "inertia"
    if kind == "mesh" and dim == 2:
        return "a 2D mesh has none"
    return ""


@pytest.mark.parametrize("dim", (2, 3))
@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("kind", ("analytic", "mesh"))
def test_a_body_and_an_obstacle(kind: str, motion: str, scheme: str, dim: int, tmp_path: Path) -> None:
    """They meet: no node of the body comes into the obstacle, which is tested without the code of contact; a free
    obstacle and the body keep their momentum."""
    if why := refusal(kind, motion, scheme, dim):
        with pytest.raises((InputError, ValueError), match=why):
            scene_of(kind, motion, scheme, dim, tmp_path)
        return
    scene, state = scene_of(kind, motion, scheme, dim, tmp_path)
    (bodies,) = [term for term in scene.balance.terms if term.name == "rigid"]
    start, least, touched = momentum(scene, state), np.inf, 0.0
    for _ in each_step(scene, state):
        pose = bodies.posed_at(state.t)[0].pose
        heights = pose.to_body(positions(scene) + displacement(scene, state))[:, -1]
        least = min(least, float(heights.min()) - 0.2)
        told = dict(zip(scene.probes.columns, scene.probes(), strict=True))
        touched = max(touched, abs(told[f"contact_it_{'xyz'[dim - 1]}"]))
        if motion == "free":
            np.testing.assert_allclose(momentum(scene, state), start, atol=1e-9 * 200)
    assert touched > 1.0
    # a penalty is penetrated by less than half an edge times v / sqrt(E / rho)
    assert least > (-0.25 * 1.0 / 10.0 if scheme == "explicit" else 0.0)


@pytest.mark.parametrize("dim", (2, 3))
@pytest.mark.parametrize("scheme", SCHEMES)
def test_two_bodies_of_one_mesh(scheme: str, dim: int, tmp_path: Path) -> None:
    """The upper one falls, or is pressed, on the lower one, and stays above it."""
    scene, state = two_bodies(scheme, dim, tmp_path)
    upper, least = positions(scene)[:, -1] > 1.02, np.inf
    for _ in each_step(scene, state):
        x = (positions(scene) + displacement(scene, state))[:, -1]
        least = min(least, float(x[upper].min() - x[~upper].max()))
    assert least > (-0.05 if scheme == "explicit" else -0.01)  # corners of different columns
    assert least < 0.03


@pytest.mark.ranks
@pytest.mark.parametrize("ranks", (2, 3))
def test_cells_are_equal_on_any_number_of_ranks(ranks: int, tmp_path: Path) -> None:
    alone, together = (run_on_ranks("support.touching", count, tmp_path, 200) for count in (1, ranks))
    assert len(alone) == len(CELLS)
    for name, values in alone.items():
        np.testing.assert_allclose(together[name], values, rtol=1e-5, atol=1e-6 * abs(values).max(), err_msg=name)
