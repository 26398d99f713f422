"""A body that touches itself in explicit steps: against differences, dense matrices and conservation laws."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import meshio
import numpy as np
import numpy.typing as npt
import pytest
from scipy.sparse import eye

from fracsim.contact.ipc_pairs import IpcPairs
from fracsim.contact.penalty_contact import PenaltyContact
from fracsim.contact.penalty_law import ContactStiffness, NodalMassShare, penalty_stiffness
from fracsim.contact.penalty_pairs import PenaltyPairs
from fracsim.contact.penalty_surface import PenaltyPart, PenaltyState
from fracsim.contact.retractable_surface import RetractableSurface
from fracsim.meshes.builders.box import Box
from fracsim.scene import Scene
from support.resumed import assert_alike, going_stopped_resumed
from support.scenes import break_across, each_step, make_scene, march, positions
from support.torn import RUNS
from test_self_contact import SOFT, two_blocks

Values = npt.NDArray[np.float64]


def contact_of(scene: Scene) -> tuple[PenaltyContact, RetractableSurface[PenaltyPart]]:
    (found,) = [term for term in scene.balance.terms if isinstance(term, PenaltyContact)]
    return found, found.surface.current


def pushed(dim: int) -> tuple[PenaltyPairs, Values]:
    """A rough sheet over another one, turned outwards, some points of it through: nearer than 0.1 or 0.05 deep."""
    rng, n = np.random.default_rng(3), 5
    grid = np.stack(np.meshgrid(*[np.arange(n) / (n - 1)] * (dim - 1), indexing="ij"), axis=-1).reshape(-1, dim - 1)
    rise = 0.03 * rng.normal(size=(2, len(grid)))
    low, high = np.c_[grid, rise[0]], np.c_[0.9 * grid + 0.03, rise[1]]
    number = np.arange(len(grid)).reshape((n,) * (dim - 1))
    if dim == 2:
        up = np.stack([number[1:], number[:-1]], axis=1)
    else:
        a, b, c, d = (each.ravel() for each in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]))
        up = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    elements = np.concatenate([up, up[:, ::-1] + len(grid)])
    x, offset = np.concatenate([low, high]), np.zeros(dim)
    offset[-1] = 0.09
    stiffness = ContactStiffness.of_one_body(rng.uniform(1.0, 2.0, size=len(x)))
    pairs = PenaltyPairs(x, elements, stiffness, distance=0.12)
    x[len(grid) :] += offset
    pairs.end_step(x)
    x[len(grid) :] -= 0.06 / 0.09 * offset
    pairs.end_step(x)
    return pairs, x


@pytest.mark.parametrize("dim", [2, 3])
def test_forces_are_a_derivative_and_sum_to_nothing(dim: int) -> None:
    """Of points before facets and of some that are through: against differences; force and moment vanish."""
    pairs, x = pushed(dim)
    met, gradient, h = pairs.contacts(x), pairs.gradient(x), 1e-7
    assert (met.gap < 0).sum() > 1 and (met.gap > 0).sum() > 3
    assert (np.sum(met.weights < 0, axis=1) == dim).any()
    way = np.random.default_rng(1).normal(size=(6, *x.shape))
    for each in way:
        slope = (pairs.energy(x + h * each) - pairs.energy(x - h * each)) / (2 * h)
        assert np.vdot(gradient, each) == pytest.approx(slope, abs=1e-5 * np.linalg.norm(gradient))
    size = np.linalg.norm(gradient)
    np.testing.assert_allclose(gradient.sum(axis=0), 0.0, atol=1e-13 * size)
    moment = np.cross(x, gradient) if dim == 3 else x[:, 0] * gradient[:, 1] - x[:, 1] * gradient[:, 0]
    np.testing.assert_allclose(moment.sum(axis=0), 0.0, atol=1e-13 * size)


@pytest.mark.parametrize("dim", [2, 3])
def test_it_is_no_faster_than_said(dim: int) -> None:
    """omega^2 of M^-1 times the stiffness along the normals, dense; and with k_p that bodies of the same mesh on both
    sides have, no more than was asked for."""
    pairs, x = pushed(dim)
    n, mass, met = len(x), np.random.default_rng(2).uniform(0.5, 1.0, size=len(x)), pairs.contacts(x)
    K = np.zeros((n * dim, n * dim))
    for points, weights, normal, rate in zip(met.points, met.weights, met.normal, met.stiffness, strict=True):
        row = np.zeros((n, dim))
        row[points] = weights[:, None] * normal
        K += rate * np.outer(row.reshape(-1), row.reshape(-1))
    m = np.repeat(mass, dim)
    fastest = float(np.linalg.eigvalsh(K / np.sqrt(m[:, None] * m)).max())
    bound = float((pairs.near_contacts(x).added_load(eye(n, format="csr")) / mass).max())
    assert 0.3 * bound < fastest <= bound
    own = penalty_stiffness(NodalMassShare(eye(n, format="csr"), mass), np.ones(n), np.inf, 1.0)
    np.testing.assert_allclose(own, mass, rtol=1e-12)


@pytest.mark.parametrize("dim", [2, 3])
def test_two_bodies_collide(tmp_path: Path, dim: int) -> None:
    """Thrown at each other at a twentieth of the speed of sound: momentum to round-off, energy to 2 %; nodes are within
    each other by less than a thirtieth of an edge, and steps are 0.75 of what they were before they met."""
    scene, state = make_scene(
        mesh={"file": two_blocks(tmp_path, dim, 0.03)}, material=SOFT, contact={},
        time={"scheme": "explicit", "step": 0.02, "end": 0.32},
    )  # fmt: skip
    contact, surface = contact_of(scene)
    X, m = positions(scene), scene.balance.mass.lumped.reshape(-1, dim)
    v = np.zeros_like(X)
    v[X[:, 0] < 1.01, 0] = 0.5
    state.v = v.reshape(-1)
    state.settle()
    before, touched, steps = (m * v).sum(axis=0), 0, []
    for report in each_step(scene, state):
        steps.append(report.dt)
        assert report.kinetic + report.elastic == pytest.approx(0.25 * before[0], rel=0.02)
        after = (m * state.v.reshape(-1, dim)).sum(axis=0)
        np.testing.assert_allclose(after, before, atol=1e-12 * before[0])
        x = contact._end_positions()
        assert x is not None
        touched += contact.stored_energy() > 0
        assert surface.parts[0].pairs.contacts(x).gap.min(initial=1.0) > -0.01
    right = X[:, 0] > 1.01
    assert touched > 5 and (m * state.v.reshape(-1, dim))[right, 0].sum() > 0.7 * before[0]
    assert min(steps) > 0.75 * max(steps)


def test_a_cracked_column_carries_its_upper_half() -> None:
    """Cut through, then pressed: the base reads what the top is pressed with, through the crack; without contact it
    reads nothing. So it is with contact between pieces alone, whose flat walls are less apart."""
    carried = []
    for contact in ({"contact": {}}, {}, {"contact": {"itself": "pieces"}}):
        scene, state = make_scene(
            mesh={"builder": "box", "size": [0.5, 1.0], "h": 0.25}, material=SOFT, fracture={"strength": 1e9},
            boundary=[{"on": "bottom", "fix": "xy"},
                      {"on": "top", "displacement": {"time": [0.0, 0.5], "value": [[0.0, 0.0], [0.0, -0.08]]}}],
            probe=[{"name": "base", "on": "bottom"}], damping={"mass": 20.0},
            time={"scheme": "explicit", "step": 0.02, "end": 1.0}, **contact,
        )  # fmt: skip
        break_across(scene, [0.0, 1.0], 0.45)
        if contact:
            assert contact_of(scene)[0].stored_energy() == 0
        state.remember()
        march(scene, state)
        carried.append(scene.probes()[1])
    # 0.08 m less the gap of the crack over a column of 1 m: E A strain, about
    assert 0.3 * 1e4 * 0.5 * 0.08 < carried[0] < 1.2 * 1e4 * 0.5 * 0.08 / (1 - 0.3**2)
    assert abs(carried[1]) < 1e-2 * carried[0]
    assert carried[0] < carried[2] < 1.2 * carried[0]


def test_what_breaks_in_touch_gains_nothing(tmp_path: Path) -> None:
    """Edges of two blocks that press each other break: no more is stored than before, and points that were pushed are
    pushed on."""
    scene, state = make_scene(
        mesh={"file": two_blocks(tmp_path, 2, 0.03)}, material=SOFT, contact={}, fracture={"strength": 1e9},
        time={"scheme": "explicit", "step": 0.02, "end": 1.0},
    )  # fmt: skip
    contact, surface = contact_of(scene)
    v = np.zeros_like(X := positions(scene))
    v[X[:, 0] < 1.01, 0] = 0.5
    state.v = v.reshape(-1)
    state.settle()
    while contact.stored_energy() < 0.5:
        march(scene, state, 1)
    before, graph = contact.stored_energy(), scene.fracture.graph
    pushed_keys = surface.parts[0].pairs.history.points[:, 0]
    graph.break_edges(np.random.default_rng(2).random(len(graph.broken)) < 0.5)
    scene.fracture.mark_changed()
    scene.balance.edges_broke(graph.pattern)
    _, again = contact_of(scene)
    assert again is not surface and len(again.rest_positions) > len(surface.rest_positions)
    assert np.isin(again.parts[0].pairs.history.points[:, 0], pushed_keys).any()
    assert 0.1 * before < contact.stored_energy() <= before * (1 + 1e-6)


def test_crack_faces_are_extended_once_nodes_have_moved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A broken body in flight, whose faces stay retracted: each half width of the penalty they are tried again."""
    scene, state = make_scene(
        mesh={"file": two_blocks(tmp_path, 2, 0.03)}, material=SOFT, contact={}, fracture={"strength": 1e9},
        time={"scheme": "explicit", "step": 0.002, "end": 10.0},
    )  # fmt: skip
    contact, _ = contact_of(scene)
    scene.fracture.graph.break_edges(np.ones(len(scene.fracture.graph.broken), bool))
    scene.fracture.mark_changed()
    scene.balance.edges_broke(scene.fracture.graph.pattern)
    state.v = np.full(positions(scene).size, 0.1 / np.sqrt(2))
    state.settle()
    times: list[float] = []
    monkeypatch.setattr(contact.surface, "extend_faces", lambda u: times.append(state.t))
    for retracted, expected in ((True, 8), (False, 0)):
        times.clear()
        contact.surface.has_retracted = retracted
        # 0.1 m/s for the time of 8.5 half widths
        start, motion = state.t, 8.5 * 0.5 * contact.surface.law.distance
        while state.t < start + motion / 0.1:
            march(scene, state, 1)
        assert abs(len(times) - expected) <= (1 if expected else 0)


@pytest.mark.parametrize("scheme", ["explicit", "backward-euler"])
def test_a_body_of_single_nodes_has_no_fragments_to_touch(scheme: str) -> None:
    """All edges break, so that contact between fragments is left without a surface: nodes fly on in free fall."""
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 1.0], "h": 0.5}, material=SOFT, contact={"itself": "pieces"},
        fracture={"strength": 1e9}, load={"gravity": [0.0, -1.0]}, time={"scheme": scheme, "step": 0.02, "end": 0.1},
    )  # fmt: skip
    graph = scene.fracture.graph
    graph.break_edges(np.ones(len(graph.broken), bool))
    scene.fracture.damage_restored()
    scene.balance.damage_changed()
    scene.balance.edges_broke(graph.pattern)
    state.remember()
    march(scene, state)
    np.testing.assert_allclose(state.v.reshape(-1, 2), np.tile([0.0, -0.1], (9, 1)), atol=1e-9)


@pytest.mark.slow
def test_a_restart_goes_on_as_the_run_would_have(tmp_path: Path) -> None:
    """A plate that is crushed and breaks, its pieces in touch and rubbing: stopped and resumed, the same but for
    round-off."""
    time = {"scheme": "explicit", "step": 0.05, "end": 1.0}
    tables: dict[str, Any] = RUNS["rammed"] | {"output": {"picture": False, "interval": 1.0}, "time": time}
    going, stopped, again = going_stopped_resumed(tables, tmp_path, 20, 4)
    assert stopped > 0
    assert_alike(again, going, 1e-9)


def test_nothing_is_looked_for_where_nothing_is_near(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two blocks that fly at each other, and meet: few steps before look for anything, and all numbers are those of a
    run that looks in every step."""
    ends, looks = [], []
    for always in (False, True):
        if always:
            monkeypatch.setattr(PenaltyState, "measure_clearance", lambda self, x: None)
        scene, state = make_scene(
            mesh={"file": two_blocks(tmp_path, 2, 0.1)}, material=SOFT, contact={},
            time={"scheme": "explicit", "step": 0.02, "end": 0.6},
        )  # fmt: skip
        contact, _ = contact_of(scene)
        X, gathered, m = positions(scene), contact.surface.nodal_values, scene.balance.mass.lumped.reshape(-1, 2)
        v = np.zeros_like(X)
        v[X[:, 0] < 1.01, 0] = 0.2
        state.v = v.reshape(-1)
        state.settle()
        count = [0]

        def counted(u: Values, gathered: Any = gathered, count: list[int] = count) -> Values | None:
            count[0] += 1
            return gathered(u)

        monkeypatch.setattr(contact.surface, "nodal_values", counted)
        march(scene, state, 10)
        looks.append(count[0])
        march(scene, state)
        ends.append(np.concatenate([state.u, state.v]))
        assert (m * state.v.reshape(-1, 2))[X[:, 0] > 1.01, 0].sum() > 0.02  # they have met
    np.testing.assert_array_equal(*ends)
    assert abs(ends[0][: len(ends[0]) // 2]).max() > 0.1 and looks[0] < looks[1] / 2


# --- friction ---


def slab_and_block(path: Path, gap: float) -> str:
    """A file with a slab of 3 x 0.25 m and a block of 1 x 0.5 m over it, `gap` apart, their meshes not alike."""
    low = Box(size=(3.0, 0.25), h=0.21).build()
    high = Box(size=(1.0, 0.5), h=0.25, origin=(0.52, 0.25 + gap)).build()
    points = np.pad(np.concatenate([low.points, high.points]), ((0, 0), (0, 1)))
    cells = np.concatenate([low.cells, high.cells + len(low.points)])
    meshio.Mesh(points, [("triangle", cells)]).write(path / "slab.vtu")
    return str(path / "slab.vtu")


@pytest.mark.parametrize(("share", "sticks"), [(1.2, True), (0.8, False)])
def test_a_block_on_a_slope(tmp_path: Path, share: float, sticks: bool) -> None:
    """tan(theta) = 0.5 and mu = `share` of it: the block stays on the slab, or slides with g (sin - mu cos)."""
    slope, distance = 0.5, 0.0125
    along, down = np.array([slope, -1.0]) / np.hypot(1, slope) * 9.81
    scene, state = make_scene(
        mesh={"file": slab_and_block(tmp_path, distance)}, material=SOFT | {"young": 1e6, "density": 1000.0},
        contact={"distance": distance, "friction": share * slope}, load={"gravity": [along, down]},
        boundary=[{"on": {"box": [[-1.0, -1.0], [4.0, 0.25]]}, "fix": "xy"}],
        damping={"mass": 20.0 * sticks, "stiffness": 1e-3}, time={"scheme": "explicit", "step": 0.01, "end": 0.5},
    )  # fmt: skip
    high = positions(scene)[:, 1] > 0.255
    m, moved = scene.balance.mass.lumped[::2] * high, []
    for _ in each_step(scene, state):
        moved.append((state.t, float(m @ state.u[::2]) / m.sum()))
    t, way = np.array(moved[1:]).T
    if sticks:
        assert abs(way[-1] - way[len(way) // 2]) < 1e-4 and way[-1] < 0.01
    else:
        late = t > 0.2
        assert 2 * np.polyfit(t[late], way[late], 2)[0] == pytest.approx(along + share * slope * down, rel=0.05)


def test_rubbing_is_in_the_books(tmp_path: Path) -> None:
    """Blocks that meet askew: momentum to round-off, friction mu times what presses at most and against the sliding;
    what it takes is what is missing, and is more than nothing."""
    scene, state = make_scene(
        mesh={"file": two_blocks(tmp_path, 2, 0.03)}, material=SOFT, contact={"friction": 0.3},
        time={"scheme": "explicit", "step": 0.02, "end": 0.32},
    )  # fmt: skip
    contact, surface = contact_of(scene)
    X, m = positions(scene), scene.balance.mass.lumped.reshape(-1, 2)
    v = np.zeros_like(X)
    v[X[:, 0] < 1.01] = [0.5, 0.5]
    state.v = v.reshape(-1)
    state.settle()
    before, slid = (m * v).sum(axis=0), 0.0
    began = 0.5 * float((m * v * v).sum())
    for report in each_step(scene, state):
        after = (m * state.v.reshape(-1, 2)).sum(axis=0)
        np.testing.assert_allclose(after, before, atol=1e-12 * before[0])
        assert report.kinetic + report.elastic + state.dissipated == pytest.approx(began, rel=0.02)
        x = contact._end_positions()
        assert x is not None
        pairs = surface.parts[0].pairs
        met = pairs.contacts(x)
        pull = met.spring_stiffness * np.linalg.norm(met.slip, axis=1)
        assert (pull <= 0.3 * met.spring_stiffness * (pairs.width - met.gap) * (1 + 1e-12)).all()
        slid = max(slid, float(pull.sum()))
    right = X[:, 0] > 1.01
    assert slid > 0 and state.dissipated > 0.005 * began
    given = (m * state.v.reshape(-1, 2))[right].sum(axis=0)
    assert 0 < given[1] <= 0.3 * given[0] * (1 + 1e-9)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_surface_without_elements_touches_nothing(dim: int) -> None:
    """As where all cells are split and fragments alone are in contact: no energy, forces, gaps or candidates."""
    x = np.random.default_rng(1).random((4, dim))
    none, stiffness = np.empty((0, dim), np.int64), ContactStiffness.of_one_body(np.ones(4))
    barrier = IpcPairs(x, none, distance=0.1, stiffness=1.0)
    assert barrier.free_fraction(x, x + 1.0) == 1.0 and not barrier.hessian(x).nnz
    for pairs in (barrier, PenaltyPairs(x, none, stiffness, distance=0.1)):
        assert pairs.energy(x) == 0.0 and not pairs.gradient(x).any() and pairs.min_gap(x) == np.inf
        assert not len(pairs.intersections(x))


@pytest.mark.parametrize("tilt", [-0.1, 0.0, 1e-9, 0.1])
def test_a_point_is_not_behind_the_side_of_its_body(tilt: float) -> None:
    """At the end of a slit: the point is before the upper face, and the edge of a side facet is as near. The point lies
    in the plane of that facet, or nearly: this tells nothing."""
    height, D = 0.019, 0.02
    point, above = [0.0, 0.0, 0.0], [0.0, 0.0, height]
    x = np.array([point, above, [-1.0, 0.0, 0.0], [-1.0, tilt, 1.0], [1.0, 1.0, height], [1.0, 0.0, height]])
    elements = np.array([[2, 0, 1], [2, 1, 3], [1, 4, 5]])  # its own facet, the side facet, the upper face
    pairs = PenaltyPairs(x, elements, ContactStiffness.of_one_body(np.ones(len(x))), distance=D)
    pairs.end_step(x)
    assert 0 in pairs.history.points[:, 0]
    assert pairs.min_gap(x) == pytest.approx(height, rel=1e-3)
    assert pairs.energy(x) < 10 * 0.5 * (D - height) ** 2


@pytest.mark.parametrize("dim", (2, 3))
def test_forces_do_not_depend_on_the_order_of_facets(dim: int) -> None:
    """Two lattices, one over the other, with points over edges and nodes, and masses that differ from point to point:
    of facets that share a closest point any may be found first. Their order and that of corners change nothing."""
    n, gap, width = 3, 0.02, 0.05
    grid = np.stack(np.meshgrid(*[np.arange(n + 1) / n] * (dim - 1), indexing="ij"), axis=-1).reshape(-1, dim - 1)
    if dim == 2:
        facets = np.array([[i + 1, i] for i in range(n)])
    else:
        first = np.array([i * (n + 1) + j for i in range(n) for j in range(n)])[:, None]
        facets = np.concatenate([first + np.array(corners) for corners in ((0, n + 1, n + 2), (0, n + 2, 1))])
    lower = np.column_stack([grid, np.zeros(len(grid))])
    upper = np.column_stack([grid + (0.5 / n if dim == 3 else 0.0), np.full(len(grid), gap)])
    x, count = np.concatenate([lower, upper]), len(grid)
    elements = np.concatenate([facets, facets[:, ::-1] + count])
    random = np.random.default_rng(0)
    k, reduction = random.uniform(1.0, 2.0, 2 * count), random.uniform(0.3, 1.0, 2 * count)
    patch = np.repeat(np.array([0, 1], np.int32), count)

    def forces(order: npt.NDArray[np.int64], first: int) -> Values:
        stiffness = ContactStiffness(k, 2 * k, reduction)
        pairs = PenaltyPairs(x, np.roll(elements[order], first, axis=1), stiffness, distance=width, patch=patch)
        return pairs.gradient(x)

    expected = forces(np.arange(len(elements)), 0)
    assert abs(expected).max() > 0.3 * (width - gap)
    for first in range(3) if dim == 3 else (0,):
        for _ in range(4):
            np.testing.assert_allclose(forces(random.permutation(len(elements)), first), expected, atol=1e-14)
