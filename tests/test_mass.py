"""Lumped and consistent mass against closed forms."""

from __future__ import annotations

from math import factorial

import numpy as np
import numpy.typing as npt
import pytest
from scipy.linalg import eigh

from fracsim.forms.energies import lame
from support.reference import gradients, stiffness
from support.scenes import make_scene, march
from support.torn import weaken

Values = npt.NDArray[np.float64]
DENSITY = 3.0
MATERIAL = {"energy": "linear", "young": 1.0, "poisson": 0.0, "density": DENSITY}


def consistent_mass(nodes: Values, cells: npt.NDArray[np.integer]) -> Values:
    """(nodes, nodes) of int rho N_a N_b: on a simplex rho V (1 + delta_ab) d! / (d + 2)!."""
    d = nodes.shape[1]
    V = gradients(nodes[cells])[1]
    local = DENSITY * V[:, None, None] * (np.ones((d + 1, d + 1)) + np.eye(d + 1)) * factorial(d) / factorial(d + 2)
    M = np.zeros((len(nodes), len(nodes)))
    np.add.at(M, (cells[:, :, None], cells[:, None, :]), local)
    return M


@pytest.mark.parametrize("dim", (2, 3))
def test_consistent_mass_is_the_integral(dim: int) -> None:
    """M a of every component equals the dense integral, and its row sums are the lumped mass."""
    mesh = {"builder": "box", "size": [1.0] * dim, "h": 0.4, "pattern": "unstructured"}
    scene, _ = make_scene(mesh=mesh, material=MATERIAL, time={"step": 0.1, "end": 1.0, "mass": "consistent"})
    domain, inertia = scene.domain, scene.balance.mass
    M = consistent_mass(domain.nodes, domain.cell_nodes)
    a = np.random.default_rng(2).uniform(-1, 1, domain.nodes.shape)
    np.testing.assert_allclose(inertia.multiply(a.reshape(-1)).reshape(a.shape), M @ a, atol=1e-14)
    np.testing.assert_allclose(inertia.lumped.reshape(a.shape)[:, 0], M.sum(axis=1), atol=1e-14)
    free = np.random.default_rng(3).uniform(size=a.size) < 2  # nothing is held
    np.testing.assert_allclose(inertia.solve((M @ a).reshape(-1), free), a.reshape(-1), atol=1e-10)


@pytest.mark.fast_solver_only("blocks of a node")
@pytest.mark.parametrize("dim", (2, 3))
def test_a_tangent_in_blocks_has_it(dim: int) -> None:
    """K + c_a M of cells a third of which carry nothing, and were left out before there were blocks: dense, of free
    dofs; prescribed ones stand alone. Twice, as what M adds is kept."""
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0] * dim, "h": 0.4, "pattern": "unstructured"},
        material=MATERIAL,
        fracture={"strength": 1e9},
        time={"scheme": "newmark", "step": 0.1, "end": 1.0, "mass": "consistent"},
        boundary=[{"on": "left", "fix": "xyz"[:dim]}],
    )
    domain, balance = scene.domain, scene.balance
    weaken(scene)
    balance.damage_changed()
    products, chi = balance.tangent.switch_to_blocks(), balance.stress.chi
    assert products is not None and chi is not None
    for step in (0.1, 0.05):
        balance.begin_step(step, step, state.u, state.v, state.a)
        balance.tangent.assemble(blocks_only=True)
        M = np.kron(consistent_mass(domain.nodes, domain.cell_nodes), np.eye(dim))
        K = stiffness(domain.nodes, domain.cell_nodes, *lame(1.0, 0.0), chi.x.array[: domain.cell_count])
        expected = K + balance.c_a * M
        held = balance.motion.owned_dofs
        expected[held] = expected[:, held] = 0.0
        expected[held, held] = 1.0
        found = products.matrix.to_dense()
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13 * np.abs(expected).max())


def test_a_mode_of_the_consistent_mass_vibrates_at_its_frequency() -> None:
    """The trapezoidal rule turns a mode's phase by 2 atan(w dt / 2) a step; w from K phi = w^2 M phi, dense."""
    steps, dt = 30, 0.2
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 1.0], "h": 0.4, "pattern": "unstructured"},
        material=MATERIAL,
        time={"scheme": "newmark", "step": dt, "end": 1e3, "mass": "consistent"},
        boundary=[{"on": "left", "fix": "xy"}],
    )
    X, cells = scene.domain.nodes, scene.domain.cell_nodes
    free = np.setdiff1d(np.arange(X.size), scene.balance.motion.owned_dofs)
    M = np.kron(consistent_mass(X, cells), np.eye(2))[np.ix_(free, free)]
    squares, vectors = eigh(stiffness(X, cells, *lame(1.0, 0.0))[np.ix_(free, free)], M)
    state.v[free] = vectors[:, 2]
    state.settle()
    march(scene, state, steps)
    phase = 2 * np.arctan(np.sqrt(squares[2]) * dt / 2) * steps
    np.testing.assert_allclose(state.v[free], np.cos(phase) * vectors[:, 2], atol=1e-9)
