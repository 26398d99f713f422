"""Nodes without a whole cell stay joined to the neighbour that holds them best, in the graph and in mechanics."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from fracsim.fracture.node_retention import NodeAttachment
from fracsim.mechanics.node_ties import NodeTies
from fracsim.mesh.edge_graph import EdgeGraph
from fracsim.mesh.fragments import find_fragments
from fracsim.scene import Scene
from fracsim.solvers.preconditioner import Update
from support.scenes import Walk, each_step, make_scene, march
from support.solver_policy import set_policy
from test_cycle import by_hand, dense, written_out

Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
MESHES: dict[int, dict[str, Any]] = {
    2: {"builder": "box", "size": [1.0, 1.0], "h": 0.2, "pattern": "unstructured"},
    3: {"builder": "box", "size": [1.0, 0.6, 0.6], "h": 0.25, "pattern": "unstructured"},
}


@pytest.fixture(scope="module", params=(2, 3))
def scene(request: pytest.FixtureRequest) -> Scene:
    return make_scene(mesh=MESHES[request.param])[0]


def strength(cells: npt.NDArray[np.int64], edges: npt.NDArray[np.int64]) -> Values:
    return np.ones(edges.shape)


def one_pass(scene: Scene, graph: EdgeGraph, failing: Flags, own: Values, held: Flags | None = None) -> None:
    """Edges fail, cells feel own (cells,) in all directions."""
    d = scene.domain.dim
    stress = np.concatenate([np.tile(own[:, None], d), np.zeros((len(own), d * (d - 1) // 2))], axis=1)
    held = np.zeros(len(scene.domain.nodes), bool) if held is None else held
    edges = np.flatnonzero(failing)
    fail = NodeAttachment(scene.balance.stress, graph, strength, held)(edges, stress)  # type: ignore[arg-type]
    flags = np.zeros(len(graph.broken), bool)
    flags[edges[fail]] = True
    graph.break_edges(flags)
    graph.break_unloaded_edges()


def bodies(graph: EdgeGraph, *, cells: bool) -> npt.NDArray[np.integer]:
    """(nodes,) component by SciPy, under the intact edges or under those of whole cells alone (-1: no such cell)."""
    intact = ~graph.broken
    if cells:
        intact &= np.isin(np.arange(len(intact)), graph.cell_edges[~graph.split])
    ends, n = graph.edge_nodes[intact], len(graph.domain.nodes)
    label = connected_components(coo_matrix((np.ones(len(ends)), ends.T), shape=(n, n)), directed=False)[1]
    if cells:
        label[~np.isin(np.arange(n), graph.cell_nodes[~graph.split])] = -1
    return label


def test_a_node_stays_with_the_least_loaded_of_its_edges(scene: Scene) -> None:
    """All its edges fail: one is left, that whose cells feel least, and the node is no piece."""
    graph, domain = EdgeGraph(scene.domain), scene.domain
    node = int(np.argmin(np.linalg.norm(domain.nodes - domain.nodes.mean(axis=0), axis=1)))
    own = 2.0 + np.random.default_rng(1).random(domain.cell_count)
    at = (graph.edge_nodes == node).any(axis=1)
    load = [own[(graph.cell_edges == edge).any(axis=1)].max() for edge in np.flatnonzero(at)]
    one_pass(scene, graph, at, own)
    assert np.flatnonzero(at & ~graph.broken).tolist() == [np.flatnonzero(at)[np.argmin(load)]]
    assert find_fragments(graph).count == 1


def test_random_breaks_leave_no_crumb_and_join_no_bodies(scene: Scene) -> None:
    """A third of what is left fails in each of eight passes. There is no piece of a single node, and what is joined has
    the whole cells of one body alone."""
    graph, rng = EdgeGraph(scene.domain), np.random.default_rng(5)
    seen = 0
    for _ in range(8):
        one_pass(scene, graph, rng.random(len(graph.broken)) < 0.3, 1.0 + rng.random(scene.domain.cell_count))
        joined, whole = bodies(graph, cells=False), bodies(graph, cells=True)
        assert np.bincount(joined).min() > 1
        pairs = np.unique(np.stack([joined, whole], axis=1)[whole >= 0], axis=0)
        assert len(pairs) == len(np.unique(pairs[:, 0])) == len(np.unique(pairs[:, 1]))
        seen = max(seen, np.count_nonzero(whole < 0))
    assert seen > 5 and graph.split.sum() > 0.5 * scene.domain.cell_count


def test_what_is_left_on_a_grip_is_a_piece_of_its_own(scene: Scene) -> None:
    """All edges that leave the nodes of one side, whose motion is prescribed, fail: two pieces, and with nothing
    prescribed one, whose nodes hang on the body."""
    side = scene.domain.nodes[:, 0] < 1e-9
    ends = side[EdgeGraph(scene.domain).edge_nodes]
    for held, wanted in ((side, 2), (np.zeros(len(side), bool), 1)):
        graph = EdgeGraph(scene.domain)
        one_pass(scene, graph, ends.any(axis=1) & ~ends.all(axis=1), np.full(scene.domain.cell_count, 2.0), held)
        assert find_fragments(graph).count == wanted


@pytest.mark.parametrize("dim", (2, 3))
def test_cracks_that_take_an_energy_cut_no_node_off(dim: int) -> None:
    """A plate, a block that flies apart: with crumbs most of its pieces are single nodes, without there are pieces, and
    none of a single node. A cell is cut as its crack goes, or not at all, and a restart breaks the same. The cracks are
    of half to two and a half times the size: where no node comes off, ligaments of a cell hold until their own strain
    breaks them."""
    split, crumbs = [], []
    for single in (True, False):
        scene = burst(dim, single)
        graph = scene.fracture.graph
        fragments = find_fragments(graph)
        assert fragments.count > 1
        crumbs.append(np.count_nonzero(np.bincount(fragments.node_fragment) == 1))
        split.append(np.count_nonzero(graph.split))
        assert np.isnan(scene.fracture.criterion.cut_positions[~graph.broken]).all()  # what was spared is not cut
    assert crumbs[0] > 10 and crumbs[1] == 0 and 0.5 < split[1] / split[0] < 2.5
    other = burst(dim, False, forgetful=True)
    np.testing.assert_array_equal(other.fracture.graph.broken, scene.fracture.graph.broken)


def burst(dim: int, crumbs: bool, forgetful: bool = False) -> Scene:
    """A body that has flown apart; `forgetful`: nothing is remembered from step to step but what a checkpoint has."""
    size, h, step = {2: ([1.0, 1.0], 0.04, 2.5e-3), 3: ([1.0, 1.0, 0.5], 0.2, 1e-2)}[dim]
    scene, state = make_scene(
        mesh={"builder": "box", "size": size, "h": h, "pattern": "unstructured"},
        material={"energy": "linear", "young": 1.0, "poisson": 0.3, "density": 1.0},
        fracture={"strength": 0.1, "energy": 0.002, "crumbs": crumbs},
        time={"scheme": "explicit", "step": step, "end": 1.0},
    )
    apart = scene.domain.nodes - scene.domain.nodes.mean(axis=0)
    state.v = (3.0 * apart * np.linalg.norm(apart, axis=1)[:, None]).reshape(-1)
    state.settle()
    for _ in each_step(scene, state):
        if forgetful:
            scene.fracture.criterion._tips.clear_excluded_cells()
    return scene


# --- mechanics ---


def tied(dim: int, **tables: Any) -> tuple[Scene, Walk, NodeTies]:
    """A body with some nodes near its middle that have lost all their cells, somewhat deformed as it happened."""
    plain: dict[str, Any] = {
        "mesh": MESHES[dim],
        "material": {"energy": "neo-hookean", "young": 1.0, "poisson": 0.3, "density": 1.0},
        "fracture": {"strength": 1e9, "crumbs": False},
    }
    scene, state = make_scene(**plain | tables)
    X = scene.domain.nodes
    state.u = (0.1 * np.sin(2 * X)).reshape(-1)
    scene.balance.set_displacement(state.u)
    graph = scene.fracture.graph
    rng, close = np.random.default_rng(6), np.linalg.norm(X - X.mean(axis=0), axis=1) < 0.3
    near = close[graph.edge_nodes].any(axis=1)
    for _ in range(4):
        one_pass(scene, graph, near & (rng.random(len(near)) < 0.6), 1.0 + rng.random(scene.domain.cell_count))
    scene.fracture.damage_restored()
    scene.balance.stress.chi.x.array[graph.split] = 0.0
    scene.balance.damage_changed()
    scene.balance.edges_broke(graph.pattern)
    state.remember()
    tethers = next(term for term in scene.balance.terms if isinstance(term, NodeTies))
    assert len(tethers.ties.cell) > 1
    return scene, state, tethers


def force_at(scene: Scene, tethers: NodeTies, u: Values) -> Values:
    scene.balance.set_displacement(u)
    rows = np.zeros(len(u))
    tethers.add_nodal_forces(rows)
    return rows


@pytest.mark.parametrize("dim", (2, 3))
def test_ties_are_born_at_rest_and_give_no_resultant_and_no_moment(dim: int) -> None:
    scene, state, tethers = tied(dim)
    assert np.abs(force_at(scene, tethers, state.u)).max() < 1e-14 and tethers.stored_energy() < 1e-28
    u = state.u + 0.1 * np.random.default_rng(2).standard_normal(len(state.u))
    force = force_at(scene, tethers, u).reshape(-1, dim)
    x = scene.domain.nodes + u.reshape(-1, dim)
    moment = np.einsum("ni,nj->ij", x, force)
    assert np.abs(force).max() > 1e-3
    assert np.abs(force.sum(axis=0)).max() < 1e-14 and np.abs(moment - moment.T).max() < 1e-14


@pytest.mark.parametrize("dim", (2, 3))
def test_ties_beside_blocks_are_those_among_single_entries(dim: int) -> None:
    """K x of what may move, some dofs of tied nodes being held, is that of PETSc's matrix without their rows and
    columns."""
    scene, _, tethers = tied(dim)
    rng = np.random.default_rng(4)
    free = rng.random(scene.balance.owned_dof_count) < 0.7
    beside, K = tethers.tie_matrix(free), tethers.coupling_matrix()
    assert beside is not None and K is not None
    x, y = K.createVecs()
    x.array_w[:] = np.where(free, rng.standard_normal(len(free)), 0.0)
    K.mult(x, y)
    found, whatever = np.zeros((len(free) // dim, dim)), np.where(free, x.array_r, 9.0).reshape(-1, dim)
    found[beside.nodes] = beside.multiply(whatever[beside.nodes])
    np.testing.assert_allclose(found.reshape(-1), np.where(free, y.array_r, 0.0), atol=1e-14)
    assert np.abs(found).max() > 1e-3


@pytest.mark.fast_solver_only("blocks of a node, and a V cycle of our own")
@pytest.mark.parametrize("dim", (2, 3))
def test_ties_beside_blocks_are_in_products_and_in_the_cycle(dim: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """As they are now, written out: also ties a hundred times as stiff as when multigrid was set up."""
    set_policy(monkeypatch, min_block_dofs=0)
    finer = MESHES[dim] | {"h": {2: 0.6, 3: 0.7}[dim] * MESHES[dim]["h"]}
    scene, _, tethers = tied(dim, mesh=finer, solver={"snes_type": "ksponly", "ksp_rtol": 1e-8})
    linear, stiffness = scene.solver.linear, scene.balance.tangent  # type: ignore[union-attr]
    assert linear.solve()
    made, pc = linear.preconditioner.applied.vcycle, linear.preconditioner.pc
    assert made is not None
    A = [dense(pc.getMGSmoother(level).getOperators()[1]) for level in range(pc.getMGLevels())]
    P = [dense(pc.getMGInterpolation(level)) for level in range(1, len(A))]
    for stiffer in (1.0, 100.0):
        tethers.stiffness *= stiffer
        tethers._set_ties(tethers.ties)
        linear.preconditioner._due = Update.NONE
        assert linear.solve()
        products = written_out(linear.operators.operator.mult, scene.balance.work_vector)
        stiffness.update_entries()
        before, A[-1] = A[-1], dense(stiffness.matrix)
        assert (np.abs(A[-1] - before).max() > 0.01 * np.abs(before).max()) == (stiffer > 1)
        np.testing.assert_allclose(products, A[-1], atol=1e-13 * np.abs(A[-1]).max())
        M, reference = written_out(made.pc.apply, scene.balance.work_vector), by_hand(A, P, made._levels)
        assert np.abs(M - reference).max() < 1e-5 * np.abs(reference).max()


@pytest.mark.parametrize("dim", (2, 3))
def test_their_energy_turns_with_the_body_and_gives_force_and_stiffness(dim: int) -> None:
    """f = dE/du and K = df/du by differences (E is quadratic: exact), and E(Q x) = E(x)."""
    scene, state, tethers = tied(dim)
    rng = np.random.default_rng(3)
    u, way = state.u + 0.1 * rng.standard_normal(len(state.u)), rng.standard_normal(len(state.u))
    force, stored = force_at(scene, tethers, u), tethers.stored_energy()
    moved = [(force_at(scene, tethers, u + sign * way), tethers.stored_energy()) for sign in (1, -1)]
    assert (moved[0][1] - moved[1][1]) / 2 == pytest.approx(force @ way, rel=1e-10)
    K = tethers.coupling_matrix()
    assert K is not None
    x, y = K.createVecs()
    x.array_w[:] = way
    K.mult(x, y)
    np.testing.assert_allclose(y.array_r, moved[0][0] - force, atol=1e-12)
    Q = np.linalg.qr(rng.standard_normal((dim, dim)))[0]
    X = scene.domain.nodes
    scene.balance.set_displacement(((X + u.reshape(-1, dim)) @ Q.T - X).reshape(-1))
    assert tethers.stored_energy() == pytest.approx(stored, rel=1e-10)


def test_tied_nodes_go_with_the_body_and_nothing_is_gained() -> None:
    """A free body that turns and swings keeps momentum, its moment and energy. Tied nodes stay within an edge of where
    their cells take them while it turns by a radian, where they fly off by more with nothing to hold them."""

    def turned(hold: float) -> tuple[float, Values, Values]:
        scene, state, tethers = tied(2, time={"scheme": "newmark", "step": 0.04, "end": 2.0})
        tethers.stiffness *= hold
        X, mass = scene.domain.nodes, scene.balance.mass.lumped.reshape(-1, 2)
        state.u = state.u / 10
        state.v = (np.column_stack([-X[:, 1], X[:, 0]]) * 0.5 + [0.3, 0.1]).reshape(-1)
        state.settle()

        def figures() -> Values:
            x, v = X + state.u.reshape(-1, 2), state.v.reshape(-1, 2)
            return np.array([*(mass * v).sum(axis=0), np.sum(mass[:, 0] * (x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0]))])

        before, reports = figures(), march(scene, state)
        energy = np.array([each.kinetic + each.elastic for each in reports])
        return (
            float(np.linalg.norm(tethers._elongations(), axis=1).max()),
            figures() / before - 1,
            energy / energy[0] - 1,
        )

    apart, change, gained = turned(1.0)
    assert np.abs(change[:2]).max() < 1e-9 and abs(change[2]) < 1e-2 and gained.max() < 1e-2  # Newmark's own errors
    assert 3 * apart < turned(0.0)[0]


def test_ties_come_back_with_a_state_and_from_a_checkpoint() -> None:
    """recall and restore give the same forces; with more edges broken than then the ties of now stay."""
    scene, state, tethers = tied(3)
    u = state.u + 0.05
    was, memory, saved = tethers.ties, tethers.snapshot(), tethers.to_checkpoint()
    wanted = force_at(scene, tethers, u * 1.1)
    graph = scene.fracture.graph
    cell = int(np.flatnonzero(np.isin(scene.domain.input_numbering.cells, was.cell))[0])
    more = graph.pattern.copy()
    more[cell] = (1 << graph.cell_edges.shape[1]) - 1
    tethers.edges_broke(more)
    now = tethers.ties
    assert not np.array_equal(now.cell, was.cell)
    tethers.restore(memory)
    assert tethers.ties is now
    tethers.edges_broke(graph.pattern)
    tethers.restore(memory)
    np.testing.assert_array_equal(force_at(scene, tethers, u * 1.1), wanted)
    other = tied(3)[2]
    other.from_checkpoint(saved)
    np.testing.assert_array_equal(other.ties.weights, was.weights)


def test_ties_are_in_the_tangent_once() -> None:
    """At the places that no cell couples."""
    scene, state, tethers = tied(2)
    balance = scene.balance
    balance.begin_step(0.1, 0.1, state.u, state.v, state.a)
    K = balance.tangent.matrix
    balance.tangent.assemble()
    once = K.convert("dense").getDenseArray().copy() if K.comm.size == 1 else None
    assert once is not None and not balance.tangent.couplings.has_contact
    added = tethers.coupling_matrix()
    assert added is not None
    # a node and a corner of its cell that share no cell: nothing but the tie is there
    node, *corners = (int(np.flatnonzero(scene.domain.input_numbering.nodes == n)[0]) for n in tethers.ties.nodes[0])
    apart = [c for c in corners if not (scene.domain.cell_nodes[:, :, None] == [node, c]).any(axis=1).all(axis=1).any()]
    assert apart
    for corner in apart:
        assert once[2 * node, 2 * corner] == added.getValue(2 * node, 2 * corner) != 0.0


def test_what_a_tie_stored_is_booked_as_lost_when_its_cell_comes_apart() -> None:
    scene, state, tethers = tied(2)
    scene.balance.set_displacement(state.u + 0.05 * np.random.default_rng(4).standard_normal(len(state.u)))
    stored, graph = tethers.stored_energy(), scene.fracture.graph
    more = graph.pattern.copy()
    more[np.isin(scene.domain.input_numbering.cells, tethers.ties.cell)] = 7
    tethers.edges_broke(more)
    assert stored > 1e-6
    assert (
        tethers.step_work() == (0.0, pytest.approx(stored - tethers.stored_energy())) and tethers.step_work()[1] == 0.0
    )


def test_the_bound_on_their_frequency() -> None:
    """Above the greatest eigenvalue of M^-1 K, and by no more than ten times."""
    scene, _, tethers = tied(2)
    K = tethers.coupling_matrix()
    assert K is not None
    dense = K.convert("dense").getDenseArray() / scene.balance.mass.lumped[:, None]
    highest = float(np.linalg.eigvals(dense).real.max())
    assert highest <= tethers.frequency_bound() < 10 * highest


@pytest.mark.parametrize("dim", [2, 3])
def test_multigrid_knows_of_rotations_once_nodes_are_tied(dim: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ties add entries to the matrix that multigrid is made of, by which PETSc forgets its near null space: all rigid
    motions are there once it is solved with."""
    set_policy(monkeypatch, max_plain_direct_dofs=0)
    scene, state, _ = tied(dim, time={"scheme": "backward-euler", "step": 10.0, "end": 100.0}, solver={})
    state.advance()
    assert scene.solver is not None
    found = scene.balance.tangent.matrix.getNearNullSpace()
    assert found and len(found.getVecs()) == {2: 3, 3: 6}[dim]
