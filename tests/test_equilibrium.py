"""Residual and tangent of the discrete equations: finite differences, a dense reference, rigid motion."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq

from fracsim.forms.energies import ENERGIES
from fracsim.scene import Scene
from support.laws import rotation
from support.reference import dense_tangent, lumped_mass, stiffness
from support.scenes import Values, deform, make_scene, march, positions

EPS = np.finfo(float).eps
YOUNG, POISSON, DENSITY = 2.0, 0.3, 3.0
MU, LAMBDA = YOUNG / 2.6, YOUNG * 0.3 / (1.3 * 0.4)
NONLINEAR = ("corotated", "stvk", "neo-hookean")


def scene_of(energy: str, dim: int, **tables: Any) -> Scene:
    """An unstructured body of a few cells, with nothing prescribed."""
    mesh = {"builder": "box", "size": [1.0, 0.7, 0.6][:dim], "h": 0.35 if dim == 2 else 0.6, "pattern": "unstructured"}
    material = {"energy": energy, "young": YOUNG, "poisson": POISSON, "density": DENSITY}
    scene, state = make_scene(mesh=mesh, material=material, **tables)
    scene.balance.begin_step(0.1, 0.1, state.u, state.v, state.a)
    return scene


def residual_at(scene: Scene, u: Values) -> Values:
    """r(u), a copy."""
    x = scene.balance.work_vector.duplicate()
    x.array_w[:] = u
    scene.balance.assemble_free_residual(x, scene.balance.work_vector)
    x.destroy()
    return scene.balance.work_vector.array_r.copy()


def randomly_deformed(scene: Scene, size: float = 0.03) -> Values:
    """A displacement that turns no cell inside out: small beside the cells."""
    return np.random.default_rng(5).uniform(-size, size, len(scene.balance.mass.lumped))


@pytest.mark.parametrize("dim", (2, 3))
@pytest.mark.parametrize("energy", ENERGIES)
def test_tangent_is_the_derivative_of_the_residual(energy: str, dim: int) -> None:
    """K h against central differences of r with step eps^(1/3) of a cell, inertia included: error O(eps^(2/3))."""
    scene = scene_of(energy, dim)
    u, h = randomly_deformed(scene), np.random.default_rng(6).uniform(-1, 1, len(scene.balance.mass.lumped))
    t = EPS ** (1 / 3)
    difference = (residual_at(scene, u + t * h) - residual_at(scene, u - t * h)) / (2 * t)
    scene.balance.set_displacement(u)
    K = dense_tangent(scene) + scene.balance.c_a * np.diag(scene.balance.mass.lumped)
    np.testing.assert_allclose(K @ h, difference, atol=1e3 * t**2 * np.abs(K).max())


@pytest.mark.parametrize("dim", (2, 3))
def test_corotated_tangent_of_a_turned_body(dim: int) -> None:
    """At u = (Q - I) X the cells' frames are Q: K = Q K_linear Q^T, symmetric, with dense NumPy for K_linear."""
    scene, Q = scene_of("corotated", dim), rotation(dim, 4)
    deform(scene, Q)
    X = positions(scene)
    turn = np.kron(np.eye(len(X)), Q)
    expected = turn @ stiffness(X, scene.domain.cell_nodes, MU, LAMBDA) @ turn.T
    found = dense_tangent(scene)
    np.testing.assert_allclose(found, expected, atol=1e4 * EPS * np.abs(expected).max())


@pytest.mark.parametrize("dim", (2, 3))
@pytest.mark.parametrize("energy", ENERGIES)
def test_tangent_at_rest_is_linear_elasticity(energy: str, dim: int) -> None:
    """Every energy tends to Hooke's law: K(0) is the dense stiffness of P1 elasticity, and M its lumped mass."""
    scene = scene_of(energy, dim)
    X, cells = positions(scene), scene.domain.cell_nodes
    deform(scene, np.eye(dim))
    expected = stiffness(X, cells, MU, LAMBDA)
    np.testing.assert_allclose(dense_tangent(scene), expected, atol=1e3 * EPS * np.abs(expected).max())
    np.testing.assert_allclose(scene.balance.mass.lumped, lumped_mass(X, cells, DENSITY), rtol=100 * EPS)


def test_plane_stress_stiffness() -> None:
    """Linear plane stress is the same stiffness with lambda* = E nu / (1 - nu^2)."""
    mesh = {"builder": "box", "size": [1.0, 1.0], "h": 0.5}
    material = {"energy": "linear", "plane": "stress", "young": YOUNG, "poisson": POISSON, "density": DENSITY}
    scene, state = make_scene(mesh=mesh, material=material)
    scene.balance.begin_step(0.1, 0.1, state.u, state.v, state.a)
    reduced = YOUNG * POISSON / (1 - POISSON**2)
    expected = stiffness(positions(scene), scene.domain.cell_nodes, MU, reduced)
    np.testing.assert_allclose(dense_tangent(scene), expected, atol=1e3 * EPS * YOUNG)


def test_chi_scales_the_stiffness_of_its_cell() -> None:
    """psi_frac = chi psi: K is the sum of the cells' matrices times their chi."""
    scene = scene_of("linear", 2, fracture={"strength": 1.0})
    chi = np.random.default_rng(8).uniform(0, 1, scene.domain.cell_count)
    assert scene.balance.stress.chi is not None
    scene.balance.stress.chi.x.array[:] = chi
    expected = stiffness(positions(scene), scene.domain.cell_nodes, MU, LAMBDA, chi)
    np.testing.assert_allclose(dense_tangent(scene), expected, atol=1e3 * EPS * YOUNG)


@pytest.mark.parametrize("dim", (2, 3))
@pytest.mark.parametrize("energy", NONLINEAR)
def test_a_finite_rotation_causes_no_force_and_stores_no_energy(energy: str, dim: int) -> None:
    """x = Q X + c: zero nodal forces to the round-off of forces Y h^(d-1), zero energy."""
    scene, Q = scene_of(energy, dim), rotation(dim, 9)
    X = positions(scene)
    scene.balance.set_displacement((X @ (Q - np.eye(dim)).T + 0.3).reshape(-1))
    np.testing.assert_allclose(scene.balance.stress.assemble_forces(), 0, atol=100 * EPS * YOUNG)
    assert scene.balance.stress.stored_energy() == pytest.approx(0, abs=100 * EPS * YOUNG)


@pytest.mark.parametrize("dim", (2, 3))
@pytest.mark.parametrize("energy", NONLINEAR)
def test_forces_turn_with_the_body(energy: str, dim: int) -> None:
    """f(Q x) = Q f(x) for a strained body: the equations are objective."""
    scene, Q = scene_of(energy, dim), rotation(dim, 9)
    X = positions(scene)
    x = X + randomly_deformed(scene).reshape(X.shape)
    scene.balance.set_displacement((x - X).reshape(-1))
    before = scene.balance.stress.assemble_forces().reshape(X.shape)
    scene.balance.set_displacement((x @ Q.T - X).reshape(-1))
    after = scene.balance.stress.assemble_forces().reshape(X.shape)
    np.testing.assert_allclose(after, before @ Q.T, atol=1e3 * EPS * YOUNG)


@pytest.mark.parametrize("dim", (2, 3))
@pytest.mark.parametrize("energy", ENERGIES)
def test_internal_forces_are_in_balance(energy: str, dim: int) -> None:
    """Without loads their sum is zero, and so is their moment about any point of the deformed body (of the
    reference body for the linear energy): the discrete laws of momentum rest on this."""
    scene = scene_of(energy, dim)
    X = positions(scene)
    u = randomly_deformed(scene).reshape(X.shape)
    scene.balance.set_displacement(u.reshape(-1))
    force, arm = scene.balance.stress.assemble_forces().reshape(X.shape), X if energy == "linear" else X + u
    np.testing.assert_allclose(force.sum(axis=0), 0, atol=1e3 * EPS * YOUNG)
    moment = np.einsum("ni,nj->ij", arm, force)
    np.testing.assert_allclose(moment - moment.T, 0, atol=1e3 * EPS * YOUNG)


def test_a_scene_without_fracture_builds_nothing_for_it() -> None:
    """No [fracture]: no chi in the forms, no graph, no pass."""
    scene = scene_of("linear", 2)
    assert scene.fracture is None
    assert scene.balance.stress.chi is None


def test_dead_loads_are_the_integrals() -> None:
    """Gravity gives each node its weight; a traction gives t times the area in all, and moves none of its moment."""
    mesh = {"builder": "box", "size": [1.0, 0.5], "h": 0.25}
    tables: dict[str, Any] = {
        "material": {"energy": "linear", "young": YOUNG, "poisson": POISSON, "density": DENSITY},
        "boundary": [{"on": "right", "traction": [2.0, -1.0]}],
        "load": {"gravity": [0.5, -9.0]},
    }
    scene, state = make_scene(mesh=mesh, **tables)
    scene.balance.begin_step(0.1, 0.1, state.u, state.v, state.a)
    X, force = positions(scene), scene.balance.energies.applied_forces().reshape(-1, 2)
    weight = scene.balance.mass.lumped.reshape(-1, 2) * [0.5, -9.0]
    right = np.isclose(X[:, 0], 1.0)
    np.testing.assert_allclose(force[~right], weight[~right], atol=100 * EPS)
    pull = (force - weight)[right]
    np.testing.assert_allclose(pull.sum(axis=0), [2.0 * 0.5, -1.0 * 0.5], atol=100 * EPS)
    assert np.sum(pull[:, 0] * X[right, 1]) == pytest.approx(2.0 * 0.5**2 / 2, abs=100 * EPS)


@pytest.mark.parametrize("energy", ("linear", "neo-hookean"))
def test_pressure_on_a_closed_body_is_in_balance(energy: str) -> None:
    """A uniform pressure all round has no resultant, and squeezes a body by p / (2 (mu + lambda)) in plane strain."""
    p, size = 1e-6 * YOUNG, [1.0, 0.5]
    sides = [{"on": name, "pressure": p} for name in ("left", "right", "bottom", "top")]
    held = [
        {"on": {"box": [[-1e-9, -1e-9], [1e-9, 1e-9]]}, "fix": "xy"},
        {"on": {"box": [[1 - 1e-9, -1e-9], [1 + 1e-9, 1e-9]]}, "fix": "y"},
    ]
    scene, state = make_scene(
        mesh={"builder": "box", "size": size, "h": 0.25},
        material={"energy": energy, "young": YOUNG, "poisson": POISSON, "density": DENSITY},
        boundary=[*sides, *held],
        time={"scheme": "quasi-static", "step": 1.0, "end": 1.0},
    )
    march(scene, state)
    X, u = positions(scene), state.u.reshape(-1, 2)
    strain = p / (2 * (MU + LAMBDA))
    relative = 0.0 if energy == "linear" else 20 * strain  # second-order terms of the nonlinear law
    np.testing.assert_allclose(u, -strain * X, atol=(1e-9 + relative) * strain)
    np.testing.assert_allclose(scene.balance.reactions[scene.balance.motion.owned_dofs], 0, atol=1e-7 * p)


def test_a_pressure_acts_on_the_thickness_that_a_stretched_sheet_has() -> None:
    """Suction 0.2 Y on an end in plane stress: S = Y E_11, and Cauchy's stress l_1 S / (l_2 l_3) is the suction.

    Across, l^2 = 1 - 2 nu E_11 in both directions.
    """
    suction = 0.2 * YOUNG

    def excess(strain: float) -> float:
        return float(np.sqrt(1 + 2 * strain) * strain / (1 - 2 * POISSON * strain) - suction / YOUNG)

    expected = np.sqrt(1 + 2 * brentq(excess, 0.0, 1.0))
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.5], "h": 0.25},
        material={"energy": "stvk", "plane": "stress", "young": YOUNG, "poisson": POISSON, "density": DENSITY},
        boundary=[
            {"on": "left", "fix": "x"},
            {"on": {"box": [[-1e-9, -1e-9], [1e-9, 1e-9]]}, "fix": "y"},
            {"on": "right", "pressure": -suction},
        ],
        time={"scheme": "quasi-static", "step": 1.0, "end": 1.0},
    )
    march(scene, state)
    X, u = positions(scene), state.u.reshape(-1, 2)
    np.testing.assert_allclose(u[:, 0], (expected - 1) * X[:, 0], atol=1e-6)


def test_tractions_on_two_groups() -> None:
    """Opposite tractions on both ends of a free bar: no resultant, sigma = t, stretch by t L / E."""
    t = 1e-6 * YOUNG
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.5], "h": 0.25},
        material={"energy": "linear", "young": YOUNG, "poisson": 0.0, "density": DENSITY},
        boundary=[
            {"on": "left", "traction": [-t, 0.0]},
            {"on": "right", "traction": [t, 0.0]},
            {"on": {"box": [[-1e-9, -1e-9], [1e-9, 1e-9]]}, "fix": "xy"},
            {"on": {"box": [[1 - 1e-9, -1e-9], [1 + 1e-9, 1e-9]]}, "fix": "y"},
        ],
        time={"scheme": "quasi-static", "step": 1.0, "end": 1.0},
    )
    march(scene, state)
    assert scene.balance.energies.applied_forces().sum() == pytest.approx(0, abs=10 * EPS * t)
    expected = positions(scene) * [t / YOUNG, 0.0]
    np.testing.assert_allclose(state.u.reshape(-1, 2), expected, atol=1e-9 * t / YOUNG)


@pytest.mark.parametrize("energy", ("linear", "neo-hookean"))
def test_reactions_from_the_cells_at_the_supports(energy: str) -> None:
    """Assembled over the few cells that touch prescribed dofs they are those of the whole residual, damping
    included."""
    scene = scene_of(
        energy,
        2,
        boundary=[{"on": "left", "fix": "xy"}, {"on": "right", "velocity": [0.1, 0.0]}, {"on": "top", "pressure": 0.1}],
        damping={"mass": 0.3, "stiffness": 0.2},
        fracture={"strength": 1.0},
    )
    balance = scene.balance
    balance.stress.chi.x.array[:] = np.random.default_rng(2).uniform(0, 1, scene.domain.cell_count)
    residual_at(scene, randomly_deformed(scene))
    whole = balance.reactions.copy()
    balance.reactions[balance.motion.owned_dofs] = np.nan
    balance.update_reactions()
    np.testing.assert_allclose(balance.reactions, whole, atol=1e3 * EPS * YOUNG / 0.1)
