"""Free bodies under load: inertia relief, the complement of the rigid modes, and the stress that is left."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from fracsim.fracture.principal_stress import symmetric_tensors
from fracsim.mesh.domain import Domain
from fracsim.meshes.data import MeshData
from fracsim.rigid.free_body_analysis import SolidBody
from fracsim.studies.rigid_trials import pin_constraints, solve_pinned
from support.rigid import DENSITY, section_mean, stiffness_of, whole_body
from support.scenes import make_scene, march
from support.solids import lattice

Values = npt.NDArray[np.float64]
G = 9.81


def turn(dim: int) -> Values:
    """A rotation about no axis of the mesh."""
    R: Values = Rotation.from_rotvec([0.4, -0.7, 1.1]).as_matrix()
    if dim == 2:
        return np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
    return R


def some_load(domain: Domain, seed: int = 0) -> Values:
    """(nodes, d) forces at a few nodes, in no balance, by the numbers of the mesh."""
    of_mesh = np.zeros_like(domain.nodes)
    rng = np.random.default_rng(seed)
    of_mesh[rng.choice(len(of_mesh), 4, replace=False)] = rng.normal(size=(4, domain.dim))
    return of_mesh[domain.input_numbering.nodes]


@pytest.mark.parametrize("numbers", [(3, 5), (2, 2, 3)])
def test_forces_and_accelerations_balance_everywhere(numbers: tuple[int, ...]) -> None:
    """K u = f - M a at every node, and a is Newton's: sum f = m a, sum r x f = sum r x m a."""
    _, body, domain = whole_body(lattice(*numbers, size=0.5))
    force = some_load(domain)
    left = body.inertia_relief(force)
    residual = body.matrix.createVecLeft()
    u = body.matrix.createVecRight()
    u.array_w[:] = body(force).reshape(-1)
    body.matrix.mult(u, residual)
    assert np.abs(residual.array_r.reshape(left.shape) - left).max() < 1e-10 * np.abs(left).max()
    a = (force - left) / body.inertia_relief.mass[:, None]
    assert np.allclose(a, rigid(domain.nodes, a), atol=1e-12 * np.abs(a).max())
    assert np.allclose(left.sum(axis=0), 0.0, atol=1e-13)
    assert np.allclose(moment(domain.nodes, left), 0.0, atol=1e-13)


def rigid(X: Values, a: Values) -> Values:
    """The rigid field nearest to a (n, d), by least squares over a + w x X written out."""
    n, d = X.shape
    columns = [np.tile(axis, (n, 1)) for axis in np.eye(d)]
    for i, j in [(0, 1), (1, 2), (2, 0)][: 1 if d == 2 else 3]:
        column = np.zeros((n, d))
        column[:, i], column[:, j] = -X[:, j], X[:, i]
        columns.append(column)
    A = np.stack([each.reshape(-1) for each in columns], axis=1)
    return np.asarray(A @ np.linalg.lstsq(A, a.reshape(-1), rcond=None)[0]).reshape(n, d)


def moment(X: Values, f: Values) -> Values:
    """Sum of r x f."""
    if X.shape[1] == 2:
        return np.asarray((X[:, 0] * f[:, 1] - X[:, 1] * f[:, 0]).sum())
    return np.asarray(np.cross(X, f).sum(axis=0))


@pytest.mark.parametrize("numbers", [(3, 4), (2, 2, 3)])
def test_stress_does_not_depend_on_the_frame(numbers: tuple[int, ...]) -> None:
    """Turned and carried away, with its load: sigma' = Q sigma Q^T."""
    mesh, Q = lattice(*numbers, size=0.5), turn(len(numbers))
    there = MeshData(mesh.points @ Q.T + 100.0, mesh.cells)
    found = []
    for each, R in ((mesh, np.eye(mesh.dim)), (there, Q)):
        stiffness, body, domain = whole_body(each)
        u = body(some_load(domain) @ R.T)
        sigma = symmetric_tensors(stiffness.cell_stress(u, body.cell_fractions), mesh.dim)
        found.append((R.T @ sigma @ R)[np.argsort(domain.input_numbering.cells)])
    assert np.allclose(*found, atol=1e-9 * np.abs(found[0]).max())


@pytest.mark.parametrize("numbers", [(4, 8), (3, 3, 6)])
def test_a_block_at_rest_carries_its_weight(numbers: tuple[int, ...]) -> None:
    """Lifted by its floor with m g: sigma = - rho g (H - z), from nothing at its top to rho g H at its foot."""
    size = 0.5
    stiffness, body, domain = whole_body(lattice(*numbers, size=size))
    axis, height = domain.dim - 1, size * numbers[-1]
    force, foot = np.zeros_like(domain.nodes), domain.nodes[:, -1] == 0
    area = np.bincount(domain.cell_nodes.ravel(), np.repeat(domain.volumes, domain.dim + 1))
    force[foot, axis] = area[foot]  # as a floor under each cell of the first layer shares it out
    force *= G * body.inertia_relief.mass.sum() / force.sum()
    sigma = stiffness.cell_stress(body(force), body.cell_fractions)[:, axis]
    for layer in range(numbers[-1]):
        low, high = layer * size, (layer + 1) * size
        expected = -DENSITY * G * (height - (low + high) / 2)
        assert section_mean(domain, sigma, axis, low, high) == pytest.approx(expected, rel=0.02)


def test_pins_strain_a_body_where_they_hold_it_and_relief_does_not() -> None:
    """A load in balance leaves the pins without a force, so that both ways give one stress; factors and CG share
    nothing. A load out of balance is handed to the three points (B07)."""
    stiffness, body, domain = whole_body(lattice(3, 3, 3, size=0.5))
    force = np.zeros_like(domain.nodes)
    force[domain.nodes[:, 2] == 0, 2] = 1.0
    relieved = solve_pinned(body.matrix, domain.nodes, body.inertia_relief(force))
    free, same, held = (
        stiffness.cell_stress(u, body.cell_fractions)
        for u in (body(force), relieved, solve_pinned(body.matrix, domain.nodes, force))
    )
    assert np.allclose(free, same, atol=1e-8 * np.abs(free).max())
    assert np.abs(held).max() > 2 * np.abs(free).max()


@pytest.mark.parametrize("dim", [2, 3])
def test_pins_hold_all_that_is_rigid(dim: int) -> None:
    """No rigid motion but none leaves every pin where it is: the rows on the modes are regular."""
    places = np.random.default_rng(1).random((9, dim))
    modes = np.zeros((3 if dim == 2 else 6, 9, dim))
    modes[:dim] = np.eye(dim)[:, None]
    for row, (i, j) in enumerate([(0, 1), (1, 2), (2, 0)][: len(modes) - dim], dim):
        modes[row, :, i], modes[row, :, j] = -places[:, j], places[:, i]
    held = pin_constraints(places)
    assert held.shape == (len(modes), places.size)
    assert np.linalg.cond(held @ modes.reshape(len(modes), -1).T) < 100


def test_a_slow_push_gives_the_mean_stress_of_the_motion() -> None:
    """A free strip under a traction that grows over thirty of its periods, by Newmark's rule with inertia: the mean
    stress of the way is that of the mean load. (2D, pushed in the middle of its end.)"""
    on = {"box": [[0.99, 0.2], [1.01, 0.8]]}
    end = 30.0
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 1.0], "h": 0.25},
        material={"energy": "linear", "young": 1.0, "poisson": 0.2, "density": 1.0},
        boundary=[{"on": on, "traction": {"time": [0.0, end], "value": [[0.0, 0.0], [-2e-3, 0.0]]}}],
        time={"scheme": "newmark", "step": 0.25, "end": end},
    )
    (load,) = [term for term in scene.balance.terms if term.name == "dead loads"]
    domain, rows, loads = scene.domain, [], []
    stiffness = stiffness_of(scene.domain.input_mesh, young=1.0)  # type: ignore[arg-type]
    for _ in range(120):
        march(scene, state, 1)
        rows.append(stiffness.cell_stress(state.u.reshape(-1, 2), np.ones(domain.cell_count)))
        loads.append(load.applied_forces().reshape(-1, 2).copy())  # type: ignore[union-attr]
    body = SolidBody(stiffness, np.ones(domain.cell_count))
    expected = stiffness.cell_stress(body(np.mean(loads, axis=0)), body.cell_fractions)
    assert np.linalg.norm(np.mean(rows, axis=0) - expected) < 0.05 * np.linalg.norm(expected)


def test_a_piece_is_solved_for_alone() -> None:
    """Half of a block, cut through the middle of a layer of cells: these have half their mass and stiffness, their
    nodes beyond the cut go along, and nothing else moves. Lifted, it carries what is above."""
    stiffness = stiffness_of(lattice(2, 2, 5, size=0.5))
    domain = stiffness.stress.domain
    mine = domain.nodes[:, 2] < 1.3
    share = mine[domain.cell_nodes].mean(axis=1)
    body = SolidBody(stiffness, share, {"ksp_rtol": 1e-12})
    force = np.zeros_like(domain.nodes)
    force[domain.nodes[:, 2] == 0, 2] = 1.0
    u = body(force)
    assert body.inertia_relief.mass.sum() == pytest.approx(DENSITY * 1.25)
    assert not u[domain.nodes[:, 2] > 1.6].any()
    assert u[(domain.nodes[:, 2] > 1.4) & (domain.nodes[:, 2] < 1.6)].any(axis=1).all()
    sigma = stiffness.cell_stress(u, share)[:, 2]
    # a = F / m: 9 N lift 2500 kg; what is above z = 1 m, without the half of the layer that is cut, is a tenth of it
    assert section_mean(domain, sigma, 2, 0.5, 1.0) == pytest.approx(-9.0 * (1 - 0.75 / 1.25), rel=0.05)
