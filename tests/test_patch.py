"""Patch test: a linear displacement on the whole boundary of an unstructured mesh is reproduced inside, with uniform
stress.

It is an exact solution of every energy, because a uniform P balances itself; P1 contains it; so what is left is the
round-off of the linear solve, eps times the condition number of K: some (size / h)^2, here 50, times a shape factor of
the cells of 10 or so.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fracsim.forms.energies import ENERGIES
from fracsim.meshes.topology import boundary_facets
from fracsim.output.frame_files import FieldEvaluator
from fracsim.scene import Scene
from fracsim.timestepping.state import State
from support.laws import law_of
from support.scenes import Values, at_nodes, each_step, make_scene, march, mesh_of, positions

EPS = np.finfo(float).eps
YOUNG, POISSON = 2.0, 0.3
MU, LAMBDA = YOUNG / 2.6, YOUNG * 0.3 / (1.3 * 0.4)
TOLERANCE = 1e3 * EPS
MESHES: dict[int, dict[str, Any]] = {
    2: {"builder": "box", "size": [1.0, 0.8], "h": 0.16, "pattern": "unstructured"},
    3: {"builder": "box", "size": [1.0, 0.8, 0.9], "h": 0.35, "pattern": "unstructured"},
}
# Stretch, shear and a turn of 6 degrees
GRADIENT = {2: np.array([[0.05, 0.08], [-0.12, -0.03]]), 3: np.array([[5, 8, -2], [-12, -3, 4], [1, 6, 7]]) / 100}


def boundary_nodes(dim: int) -> tuple[Values, Values]:
    """(points on the boundary, all points) of the patch."""
    scene, _ = make_scene(mesh=MESHES[dim])
    mesh = mesh_of(scene)
    return mesh.points[np.unique(boundary_facets(mesh.cells))], mesh.points


def patch(dim: int, energy: str, scheme: str, steps: int, plane: str = "strain") -> tuple[Scene, State]:
    """A patch whose boundary moves linearly in time to u = GRADIENT X within `steps` steps of 0.1 s."""
    boundary, every = boundary_nodes(dim)
    assert len(boundary) < len(every)  # there are nodes inside
    end = 0.1 * steps
    entries = at_nodes(boundary, boundary @ GRADIENT[dim].T)
    for entry in entries:
        entry["displacement"] = {"time": [0.0, end], "value": [[0.0] * dim, entry["displacement"]]}
    return make_scene(
        mesh=MESHES[dim],
        material={"energy": energy, "plane": plane, "young": YOUNG, "poisson": POISSON, "density": 1.0},
        boundary=entries,
        time={"scheme": scheme, "step": 0.1, "end": end},
    )


def stress_of(scene: Scene, state: State) -> Values:
    """(cells, 6) Cauchy stress as it is written: xx, xy, xz, yy, yz, zz."""
    return FieldEvaluator(scene.balance.stress, ["stress"])(state, None)[1].values


def expected_stress(energy: str, dim: int, F: Values) -> Values:
    """The same of the homogeneous deformation; in plane strain that of the embedded F."""
    solid = np.eye(3)
    solid[:dim, :dim] = F
    stress = law_of(ENERGIES[energy](MU, LAMBDA), 3).cauchy(solid)
    return np.array([stress[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))])


@pytest.mark.parametrize("dim", (2, 3))
@pytest.mark.parametrize("energy", ENERGIES)
def test_static_patch(energy: str, dim: int) -> None:
    """One load step to u = A X: the inside follows, the stress is uniform and that of F = I + A."""
    scene, state = patch(dim, energy, "quasi-static", 1)
    march(scene, state)
    X = positions(scene)
    np.testing.assert_allclose(state.u.reshape(X.shape), X @ GRADIENT[dim].T, atol=TOLERANCE)
    stress = stress_of(scene, state)
    expected = expected_stress(energy, dim, np.eye(dim) + GRADIENT[dim])
    np.testing.assert_allclose(stress, np.tile(expected, (len(stress), 1)), atol=TOLERANCE * YOUNG)


def test_static_patch_in_plane_stress() -> None:
    """The same for the reduced StVK energy, whose stress across the plane is zero."""
    scene, state = patch(2, "stvk", "quasi-static", 1, plane="stress")
    march(scene, state)
    X = positions(scene)
    np.testing.assert_allclose(state.u.reshape(X.shape), X @ GRADIENT[2].T, atol=TOLERANCE)
    stress = stress_of(scene, state)
    np.testing.assert_allclose(stress, np.tile(stress[0], (len(stress), 1)), atol=TOLERANCE * YOUNG)
    assert not stress[:, [2, 4, 5]].any()  # zz, yz, xz


@pytest.mark.parametrize("dim", (2, 3))
@pytest.mark.parametrize("scheme", ("backward-euler", "newmark"))
@pytest.mark.parametrize("energy", ("linear", "neo-hookean"))
def test_dynamic_patch(energy: str, scheme: str, dim: int) -> None:
    """u = t A X has no acceleration: both schemes follow it exactly from v = A X, through finite strains too."""
    steps = 4
    scene, state = patch(dim, energy, scheme, steps)
    X = positions(scene)
    velocity = X @ GRADIENT[dim].T / (0.1 * steps)
    state.v = velocity.reshape(-1).copy()
    for report in each_step(scene, state):
        assert report.kinetic == pytest.approx(
            0.5 * scene.balance.mass.lumped @ velocity.reshape(-1) ** 2, rel=TOLERANCE
        )
        np.testing.assert_allclose(state.u.reshape(X.shape), state.t * velocity, atol=TOLERANCE)
        np.testing.assert_allclose(state.v.reshape(X.shape), velocity, atol=TOLERANCE / 0.1)


@pytest.mark.parametrize("dim", (2, 3))
@pytest.mark.parametrize("scheme", ("backward-euler", "newmark"))
@pytest.mark.parametrize("energy", ENERGIES)
def test_uniform_velocity_goes_on(energy: str, scheme: str, dim: int) -> None:
    """A free body in flight: u = t v, no stress, no loss of kinetic energy."""
    v = [3.0, -2.0, 1.0][:dim]
    scene, state = make_scene(
        mesh=MESHES[dim],
        material={"energy": energy, "young": YOUNG, "poisson": POISSON, "density": 1.0},
        initial={"velocity": v},
        time={"scheme": scheme, "step": 0.1, "end": 0.5},
    )
    reports = march(scene, state)
    X = positions(scene)
    np.testing.assert_allclose(state.u.reshape(X.shape), np.tile(v, (len(X), 1)) * state.t, atol=TOLERANCE)
    np.testing.assert_allclose(state.v.reshape(X.shape), np.tile(v, (len(X), 1)), atol=TOLERANCE / 0.1)
    assert reports[-1].elastic == pytest.approx(0, abs=TOLERANCE)


@pytest.mark.parametrize("dim", (2, 3))
def test_reactions_carry_the_stress(dim: int) -> None:
    """In the patch the reactions on a face add up to P N A, and all of them to zero."""
    scene, state = patch(dim, "neo-hookean", "quasi-static", 1)
    march(scene, state)
    X, forces = positions(scene), scene.balance.reactions.reshape(-1, dim)
    np.testing.assert_allclose(forces.sum(axis=0), 0, atol=TOLERANCE * YOUNG)
    # virtual work of the reactions: sum f x X^T = V P for every virtual gradient
    P = law_of(ENERGIES["neo-hookean"](MU, LAMBDA), dim).P(np.eye(dim) + GRADIENT[dim])
    volume = scene.domain.volumes.sum()
    np.testing.assert_allclose(forces.T @ X, volume * P, atol=TOLERANCE * YOUNG)
