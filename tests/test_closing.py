"""Cracks that close (`unilateral`): pressure across them, no tension, no energy made; both approaches."""

from __future__ import annotations

from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from fracsim.forms.crack_closure import spring_modulus
from fracsim.forms.energies import lame
from fracsim.mesh.simplices import local_edges
from fracsim.scene import Scene
from fracsim.timestepping.stable_time_step import projected_frequencies, spring_frequencies
from fracsim.timestepping.state import State
from support.reference import gradients, stiffness
from support.scenes import deform, each_step, make_scene, march

Values = npt.NDArray[np.float64]
KINDS = [("chi", "linear"), ("chi", "corotated"), ("chi", "stvk"), ("chi", "neo-hookean"), ("edge", "linear")]
SOFT = {"young": 1.0, "poisson": 0.0, "density": 1.0}


def cut(scene: Scene, at: float) -> None:
    """Break every edge that crosses x = at."""
    graph = scene.fracture.graph
    side = scene.domain.nodes[graph.edge_nodes][:, :, 0] > at
    graph.break_edges(side[:, 0] != side[:, 1])
    if scene.balance.stress.chi is not None:
        scene.balance.stress.chi.x.array[: scene.domain.cell_count][graph.split] = 0.0
    scene.fracture.degradation.update_from_graph()


def bar(approach: str, energy: str, *, unilateral: bool = True, **tables: Any) -> tuple[Scene, State]:
    """A bar of length 1 and section 0.25 (Y = 1, nu = 0: c0 = 1), cut across in the middle; never breaks by itself."""
    plain: dict[str, Any] = {
        "mesh": {"builder": "box", "size": [1.0, 0.25], "h": 0.125},
        "material": SOFT | {"energy": energy},
        "fracture": {"strength": float("inf"), "approach": approach, "unilateral": unilateral},
    }
    scene, state = make_scene(**plain | tables)
    cut(scene, 0.45)
    return scene, state


@pytest.mark.parametrize(("approach", "energy"), KINDS)
@pytest.mark.parametrize("sign", (-1, 1))
def test_closed_cracks_carry_pressure_and_open_ones_do_not(approach: str, energy: str, sign: int) -> None:
    """Pushed by a strain e << 1 the bar answers as dense matrices do, to O(e), about as stiff as a whole one; pulled,
    it does not answer.

    The matrices: linear elasticity of the whole cells, and for the broken edges of a split cell V k |d|^-2 n x n
    between their ends, k = (lambda + 2 mu) / (3 x 3/8). Quasi-static cells keep 1e-8 of their stiffness.
    """
    e, section = 1e-4, 0.25
    boundary = [{"on": "left", "fix": "xy"}, {"on": "right", "displacement": [sign * e, 0.0]}]
    time = {"scheme": "quasi-static", "step": 1.0, "end": 1.0}
    scene, state = bar(approach, energy, boundary=boundary, time=time, probe=[{"name": "grip", "on": "right"}])
    march(scene, state)
    if sign > 0:
        assert abs(scene.probes()[0]) < 1e-7 * e
        return
    expected = dense_push(scene, e)
    assert scene.probes()[0] == pytest.approx(expected, rel=5 * e)
    assert expected == pytest.approx(-e * section, rel=0.05)


def test_a_crack_between_quadratic_cells_is_as_soft_as_a_layer_of_h() -> None:
    """Corners press on each other and the middles of sides do not: Y A / F = L + a h with the same a on both meshes,
    about 1. Pulled, it does not answer."""
    e, soft = 1e-4, []
    time = {"scheme": "quasi-static", "step": 1.0, "end": 1.0}
    for h, sign in ((0.125, -1), (0.0625, -1), (0.125, 1)):
        boundary = [{"on": "left", "fix": "xy"}, {"on": "right", "displacement": [sign * e, 0.0]}]
        mesh = {"builder": "box", "size": [1.0, 0.25], "h": h, "order": 2}
        scene, state = bar("chi", "linear", boundary=boundary, time=time, mesh=mesh,
                           probe=[{"name": "grip", "on": "right"}])  # fmt: skip
        march(scene, state)
        force = scene.probes()[0]
        soft.append((0.25 * sign * e / force - 1) / h if sign < 0 else force)
    assert soft[0] == pytest.approx(soft[1], rel=0.1) and 0.8 < soft[1] < 1.25
    assert abs(soft[2]) < 1e-7 * e


def dense_push(scene: Scene, e: float) -> float:
    """Force on the right end of the bar with its split column closed, N."""
    X, cells, graph = scene.domain.nodes, scene.domain.cell_nodes, scene.fracture.graph
    K = stiffness(X, cells, *lame(1.0, 0.0), chi=np.where(graph.split, 0.0, 1.0))
    for nodes, intact in zip(cells[graph.split], graph.intact(np.flatnonzero(graph.split)), strict=True):
        V = gradients(X[nodes][None])[1][0]
        for i, j in nodes[local_edges(2)[~intact]]:
            d = X[j] - X[i]
            row = np.zeros(X.size)
            row[2 * j : 2 * j + 2], row[2 * i : 2 * i + 2] = d, -d
            K += V * (1 / (3 * 3 / 8)) * np.outer(row, row) / (d @ d) ** 2
    u = np.zeros(X.size)
    right = np.flatnonzero(X[:, 0] > 1 - 1e-9)
    u[2 * right] = -e
    free = np.repeat((X[:, 0] > 1e-9) & (X[:, 0] < 1 - 1e-9), 2)
    u[free] = np.linalg.solve(K[np.ix_(free, free)], -K[np.ix_(free, ~free)] @ u[~free])
    return float((K @ u)[2 * right].sum())


@pytest.mark.parametrize("dim", (2, 3))
def test_springs_in_all_directions_are_hookes_law(dim: int) -> None:
    """Over all directions <(n.e.n)^2> = (2 e:e + (tr e)^2) / (d (d + 2)): the modulus of uniaxial strain is kept, and
    where lambda = mu the whole of Hooke's law, by quadrature over the circle or the sphere."""
    moduli = lame(1.0, 0.25 if dim == 3 else 1 / 4)
    mu, lmbda = moduli
    edges = 3 if dim == 2 else 6
    rng = np.random.default_rng(1)
    n = rng.normal(size=(400_000, dim))
    n /= np.linalg.norm(n, axis=1)[:, None]
    uniaxial = np.zeros((dim, dim))
    uniaxial[0, 0] = 1.0
    k = spring_modulus(SimpleNamespace(mu=mu, lmbda=lmbda), dim, edges)
    along = np.einsum("ki,ij,kj->k", n, uniaxial, n)
    assert edges * k / 2 * np.mean(along**2) == pytest.approx((lmbda + 2 * mu) / 2, rel=5e-3)
    if dim == 3:
        strain = -np.eye(3) + 0.2 * (uniaxial - np.roll(uniaxial, 1, axis=(0, 1)))
        along = np.einsum("ki,ij,kj->k", n, strain, n)
        whole = mu * np.sum(strain**2) + lmbda / 2 * np.trace(strain) ** 2
        assert edges * k / 2 * np.mean(along**2) == pytest.approx(whole, rel=5e-3)


def test_an_unclosed_bar_lets_its_halves_pass() -> None:
    """Without `unilateral` the same push meets nothing."""
    time = {"scheme": "quasi-static", "step": 1.0, "end": 1.0}
    boundary = [{"on": "left", "fix": "xy"}, {"on": "right", "displacement": [-1e-4, 0.0]}]
    probe = [{"name": "grip", "on": "right"}]
    scene, state = bar("chi", "linear", unilateral=False, boundary=boundary, time=time, probe=probe)
    march(scene, state)
    assert abs(scene.probes()[0]) < 1e-11


@pytest.mark.parametrize(("approach", "energy"), KINDS)
def test_equal_bars_exchange_their_velocities(approach: str, energy: str) -> None:
    """A bar that runs into an equal one at rest stops and sends it off at its own speed (d'Alembert), after 2 L / c0.

    Halves of 0.4375 and 0.5 would not be equal: the cut is in the middle of a mesh of 17 nodes, as masses go. The law
    is elastic: energy is what it was, to the error of the steps. Nothing of it is in the crack before or afterwards.
    """
    mesh = {"builder": "box", "size": [1.0, 0.0625], "h": 1 / 15.0}
    speed = 1e-3
    scene, state = bar(
        approach, energy, mesh=mesh, time={"scheme": "newmark", "step": 0.01, "end": 1.6}, boundary=[],
    )  # fmt: skip
    x = scene.domain.nodes[: scene.domain.node_count, 0]
    left = x < 0.5
    scene.fracture.graph.broken[:] = False
    scene.fracture.graph.set_integrity(np.ones(len(scene.fracture.graph.integrity)))
    if scene.balance.stress.chi is not None:
        scene.balance.stress.chi.x.array[:] = 1.0
    cut(scene, 0.5)
    state.v.reshape(-1, 2)[left, 0] = speed
    state.settle()
    energies = [report.kinetic + report.elastic for report in each_step(scene, state)]
    mass = scene.balance.mass.lumped.reshape(-1, 2)[:, 0]
    v = state.v.reshape(-1, 2)[:, 0]
    before = 0.5 * float(mass[left] @ np.full(left.sum(), speed) ** 2)
    means = [float(mass[part] @ v[part] / mass[part].sum()) for part in (left, ~left)]
    assert means == pytest.approx([0.0, speed], abs=0.06 * speed)
    assert np.abs(np.array(energies) / before - 1).max() < 2e-3


@pytest.mark.parametrize("energy", ("corotated", "stvk", "neo-hookean"))
def test_turning_a_closed_body_costs_nothing(energy: str) -> None:
    """psi(Q F) = psi(F), with open and shortened edges in every cell."""
    scene, _ = bar("chi", energy)
    rng = np.random.default_rng(3)
    X = scene.domain.nodes[: scene.domain.node_count]
    u = rng.uniform(-0.03, 0.03, X.shape)
    Q = np.array([[np.cos(1.1), -np.sin(1.1)], [np.sin(1.1), np.cos(1.1)]])
    energies = []
    for x in (X + u, (X + u) @ Q.T):
        scene.balance.set_displacement((x - X).reshape(-1))
        energies.append(scene.balance.stress.stored_energy())
    assert energies[1] == pytest.approx(energies[0], rel=1e-12)


@pytest.mark.parametrize("dim", (2, 3))
@pytest.mark.parametrize(
    ("approach", "energy", "order"),
    [("chi", "linear", 1), ("chi", "neo-hookean", 1), ("edge", "linear", 1), ("chi", "linear", 2), ("chi", "stvk", 2)],
)
def test_energy_against_dense_matrices(dim: int, approach: str, energy: str, order: int) -> None:
    """Cell by cell, and forces that are its slope. Springs are between corners: where displacement is quadratic they
    do not feel where the middles of edges are, which nothing holds here."""
    material = {"energy": energy, "young": 1.0, "poisson": 0.3, "density": 1.0}
    mesh = {"builder": "box", "size": [1.0] * dim, "h": 0.5, "pattern": "unstructured", "order": order}
    fracture = {"strength": 1.0, "approach": approach, "unilateral": True}
    scene, _ = make_scene(mesh=mesh, material=material, fracture=fracture, time={"step": 0.1, "end": 1.0})
    balance, rng = scene.balance, np.random.default_rng(7)
    whole = rng.uniform(size=(scene.domain.cell_count, len(local_edges(dim)))) < 0.4
    balance.stress.integrity.x.array[:] = whole.reshape(-1)  # type: ignore[union-attr]
    if balance.stress.chi is not None:
        balance.stress.chi.x.array[:] = 0.0
    X = scene.domain.nodes
    u = rng.uniform(-0.05, 0.05, X.size)

    def dense(u: Values) -> float:
        x, sum_ = X + u.reshape(X.shape), 0.0
        for c, nodes in enumerate(scene.domain.cell_nodes):
            sum_ += cell_energy(X[nodes], x[nodes], whole[c], approach, energy)
        return sum_

    balance.set_displacement(u)
    assert balance.stress.stored_energy() == pytest.approx(dense(u), rel=1e-12)
    direction = rng.uniform(-1, 1, X.size)
    h = 1e-6
    slope = (dense(u + h * direction) - dense(u - h * direction)) / (2 * h)
    assert balance.stress.assemble_forces() @ direction == pytest.approx(slope, rel=1e-5)
    free = np.setdiff1d(np.arange(len(X)), scene.domain.cell_nodes)
    assert (len(free) > 0) == (order == 2)
    assert np.abs(balance.stress.assemble_forces().reshape(X.shape)[free]).max(initial=0) < 1e-14


def cell_energy(X: Values, x: Values, whole: npt.NDArray[np.bool_], approach: str, energy: str) -> float:
    """Energy of one cell, J: springs of broken edges, and Hooke's law of T^-1 times the strains of intact ones."""
    dim = X.shape[1]
    i, j = local_edges(dim).T
    D, n = X[j] - X[i], (X[j] - X[i]) / np.linalg.norm(X[j] - X[i], axis=1)[:, None]
    if energy == "linear":
        strain = np.einsum("ki,ki->k", n, (x - X)[j] - (x - X)[i]) / np.linalg.norm(D, axis=1)
    else:
        strain = (np.sum((x[j] - x[i]) ** 2, axis=1) / np.sum(D**2, axis=1) - 1) / 2
    mu, lmbda = lame(1.0, 0.3)
    k = (lmbda + 2 * mu) / (len(i) * {2: 3 / 8, 3: 1 / 5}[dim])
    density = k / 2 * float(np.sum(np.where(whole, 0.0, np.minimum(strain, 0.0)) ** 2))
    if approach == "edge":
        T = np.array([np.outer(m, m)[np.triu_indices(dim)] * (2 - np.eye(dim))[np.triu_indices(dim)] for m in n])
        tensor = np.zeros((dim, dim))
        tensor[np.triu_indices(dim)] = np.linalg.solve(T, np.where(whole, strain, 0.0))
        tensor = tensor + tensor.T - np.diag(np.diag(tensor))
        density += mu * np.sum(tensor**2) + lmbda / 2 * np.trace(tensor) ** 2
    return float(density * gradients(X[None])[1][0])


@pytest.mark.parametrize("energy", ("linear", "neo-hookean"))
def test_without_damage_it_changes_nothing(energy: str) -> None:
    """Force and energy of the plain body to round-off."""
    forces = []
    for unilateral in (False, True):
        scene, _ = make_scene(material=SOFT | {"energy": energy}, fracture={"strength": 1.0, "unilateral": unilateral})
        deform(scene, np.array([[0.9, 0.1], [0.0, 1.1]]))
        forces.append(np.append(scene.balance.stress.assemble_forces(), scene.balance.stress.stored_energy()))
    np.testing.assert_allclose(forces[1], forces[0], atol=1e-14)


@pytest.mark.parametrize("dim", (2, 3))
def test_no_cell_is_faster_than_its_edges_let_it(dim: int) -> None:
    """Dense frequencies of single cells with every set of edges: of the projection exactly, of springs from above."""
    mesh = {"builder": "box", "size": [1.0] * dim, "h": 0.4, "pattern": "unstructured"}
    scene, _ = make_scene(
        mesh=mesh, material={"energy": "linear", "young": 1.0, "poisson": 0.3, "density": 1.0},
        fracture={"strength": 1.0, "approach": "edge"}, time={"scheme": "explicit", "step": 1.0, "end": 1.0},
    )  # fmt: skip
    X, cells = scene.domain.nodes, scene.domain.cell_nodes[:12]
    edges, chosen = local_edges(dim), np.arange(len(cells))
    mu, lmbda = lame(1.0, 0.3)
    k = (lmbda + 2 * mu) / (len(edges) * {2: 3 / 8, 3: 1 / 5}[dim])
    for flags in product((False, True), repeat=len(edges)):
        if not any(flags):
            continue
        acting = np.tile(flags, (len(cells), 1))
        exact = projected_frequencies(scene.balance.stress, chosen, acting)
        bounds = spring_frequencies(scene.balance.stress, chosen, acting)
        for nodes, projected, bound in zip(cells, exact, bounds, strict=True):
            dyads, along = edge_strains(X[nodes], edges[list(flags)])
            eps = np.einsum("ea,eij->aij", along, dyads)
            K = 2 * mu * np.einsum("aij,bij->ab", eps, eps) + lmbda * np.einsum("aii,bjj->ab", eps, eps)
            assert projected == pytest.approx((dim + 1) * np.linalg.eigvalsh(K)[-1], rel=1e-9, abs=1e-6)
            lengths = np.array([np.sum((X[nodes[j]] - X[nodes[i]]) ** 2) for i, j in edges[list(flags)]])
            springs = along / lengths[:, None]
            fastest = (dim + 1) * np.linalg.eigvalsh(k * springs.T @ springs)[-1]
            assert fastest <= bound * (1 + 1e-12)
            assert bound <= 12 * fastest


@pytest.mark.parametrize("dim", (2, 3))
def test_springs_of_quadratic_cells_are_faster_as_their_corners_weigh_less(dim: int) -> None:
    """By the corners' shares of the mass: int N_i^2 of a corner is 1/30 (1/70) of a triangle (tetrahedron), of a middle
    8/45 (8/105)."""
    corner, middle = {2: (1 / 30, 8 / 45), 3: (1 / 70, 8 / 105)}[dim]
    edges = len(local_edges(dim))
    share = corner / ((dim + 1) * corner + edges * middle)
    found = []
    for order in (1, 2):
        mesh = {"builder": "box", "size": [1.0] * dim, "h": 0.5, "pattern": "unstructured", "order": order}
        scene, _ = make_scene(mesh=mesh, material=SOFT, fracture={"strength": 1.0, "unilateral": True})
        cells = np.argsort(scene.domain.input_numbering.cells)
        found.append(spring_frequencies(scene.balance.stress, cells, np.ones((len(cells), edges), bool)))
    np.testing.assert_allclose(found[1], found[0] / share / (dim + 1), rtol=1e-12)


def edge_strains(X: Values, edges: npt.NDArray[np.integer]) -> tuple[Values, Values]:
    """(k, d, d) tensors -sym(g_i x g_j) and (k, dofs) d . grad(u) . d of edges, of one cell."""
    dim = X.shape[1]
    G = gradients(X[None])[0][0]
    dyads = np.array([-(np.outer(G[i], G[j]) + np.outer(G[j], G[i])) / 2 for i, j in edges]).reshape(-1, dim, dim)
    along = np.zeros((len(edges), dim + 1, dim))
    for row, (i, j) in enumerate(edges):
        along[row, j], along[row, i] = X[j] - X[i], X[i] - X[j]
    return dyads, along.reshape(len(edges), (dim + 1) * dim)


@pytest.mark.parametrize(
    ("approach", "unilateral", "order"), [("edge", False, 1), ("edge", True, 1), ("chi", True, 1), ("chi", True, 2)]
)
def test_explicit_steps_stay_stable_with_damage(approach: str, unilateral: bool, order: int) -> None:
    """A body with two fifths of its edges broken vibrates for 500 steps without gaining energy, which too long
    a step would let grow like a power."""
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.5], "h": 0.125, "pattern": "unstructured", "order": order},
        material=SOFT | {"energy": "linear", "poisson": 0.3},
        fracture={"strength": float("inf"), "approach": approach, "unilateral": unilateral},
        time={"scheme": "explicit", "step": 1.0, "end": 1e6},
    )  # fmt: skip
    graph, rng = scene.fracture.graph, np.random.default_rng(5)
    graph.break_edges(rng.uniform(size=len(graph.broken)) < 0.4)
    if scene.balance.stress.chi is not None:
        scene.balance.stress.chi.x.array[: scene.domain.cell_count][graph.damaged] = 0.5
        scene.balance.stress.chi.x.array[: scene.domain.cell_count][graph.split] = 0.0
    scene.fracture.degradation.update_from_graph()
    state.v[:] = rng.uniform(-1e-3, 1e-3, len(state.v))
    state.settle()
    energies = [report.kinetic + report.elastic for report in march(scene, state, 500)]
    assert max(energies) < 1.5 * energies[0]


def test_shortened_edges_let_no_tension_through() -> None:
    """A cell torn along y whose edges along x are shortened: they push their ends apart, and nothing else acts.

    With the shortened edges counted as intact in chi the cell would carry tension along y once more.
    """
    scene, _ = make_scene(
        mesh={"builder": "box", "size": [1.0, 1.0], "h": 1.0},
        material=SOFT | {"energy": "neo-hookean"}, fracture={"strength": float("inf"), "unilateral": True},
        time={"step": 0.1, "end": 1.0},
    )  # fmt: skip
    balance = scene.balance
    balance.stress.chi.x.array[:] = 0.0  # type: ignore[union-attr]
    balance.stress.integrity.x.array[:] = 0.0  # type: ignore[union-attr]
    deform(scene, np.diag([0.95, 2.0]))
    force = balance.stress.assemble_forces().reshape(-1, 2)
    assert np.abs(force[:, 1]).max() < 1e-14
    outward = np.where(scene.domain.nodes[:, 0] > 0.5, 1, -1)
    assert np.all(outward * force[:, 0] < -1e-3)  # the body would burst along x


def test_the_force_does_not_jump_as_edges_close() -> None:
    """Through a state in which edges close one after another the force of a broken body is Lipschitz: halving the
    step halves the largest change. (Projected strains, with closed edges counted as intact, jump.)"""
    scene, _ = bar("edge", "linear")
    rng = np.random.default_rng(2)
    scene.balance.stress.integrity.x.array[:] = 0.0  # type: ignore[union-attr]
    X = scene.domain.nodes
    start, way = rng.uniform(-0.02, 0.02, X.size), rng.uniform(-0.02, 0.02, X.size)
    largest = []
    for steps in (200, 400):
        forces = []
        for s in np.linspace(-1, 1, steps + 1):
            scene.balance.set_displacement(start + s * way)
            forces.append(scene.balance.stress.assemble_forces())
        largest.append(np.abs(np.diff(forces, axis=0)).max())
    assert largest[1] == pytest.approx(largest[0] / 2, rel=0.05)


@pytest.mark.parametrize("order", (1, 2))
def test_a_body_that_flows_closes_too(order: int) -> None:
    """Far below yield the pushed, cut bar is that of the elastic material, springs and all."""
    forces = []
    for plasticity in ({}, {"plasticity": {"yield_stress": 10.0}}):
        boundary = [{"on": "left", "fix": "xy"}, {"on": "right", "displacement": [-1e-3, 0.0]}]
        scene, state = bar(
            "chi", "neo-hookean", boundary=boundary, time={"scheme": "quasi-static", "step": 1.0, "end": 1.0},
            probe=[{"name": "grip", "on": "right"}],
            mesh={"builder": "box", "size": [1.0, 0.25], "h": 0.125, "order": order}, **plasticity,
        )  # fmt: skip
        march(scene, state)
        forces.append(float(scene.probes()[0]))
    assert forces[1] == pytest.approx(forces[0], rel=1e-8)
    assert forces[0] < -1e-4
