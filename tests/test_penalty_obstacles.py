"""Contact with obstacles in explicit steps, against closed forms, dense matrices and conservation laws."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from pydantic import ValidationError

from fracsim.contact.contact_surface import ContactSurface
from fracsim.contact.penalty_law import NodalMassShare, Slips
from fracsim.contact.penalty_obstacles import PenaltyObstacleTerm
from fracsim.mesh.edge_graph import EdgeGraph
from fracsim.scene import Scene
from support.resumed import assert_alike, going_stopped_resumed
from support.scenes import each_step, make_scene, make_study, march, positions
from support.torn import RUNS

Values = npt.NDArray[np.float64]

RUBBER = {"energy": "neo-hookean", "young": 1e6, "poisson": 0.3, "density": 1000.0}
SPEED_OF_SOUND = 31.6  # m/s, sqrt(E / rho)
G = 10.0


def floor(dim: int, height: float, **more: Any) -> dict[str, Any]:
    """A plane below the body, the last axis upwards."""
    normal = [0.0] * (dim - 1) + [1.0]
    return {"name": "floor", "shape": "plane", "at": [height * each for each in normal], "normal": normal} | more


def masses(scene: Scene) -> Values:
    """(nodes, 1) kg."""
    return scene.balance.mass.lumped.reshape(-1, scene.domain.dim)[:, :1]


def test_springs_at_points_are_no_faster_than_said() -> None:
    """Of a torn body, whose points follow several nodes: omega^2 of M^-1 sum k_p w_p w_p^T (dense) is at most the
    bound, for any k_p; and at most 1, but not much less, for what points carry of the nodes' masses."""
    mesh = {"builder": "box", "size": [1.0, 0.6], "h": 0.2, "pattern": "unstructured"}
    scene, _ = make_scene(mesh=mesh)
    surface, graph = ContactSurface(scene.domain, 0.01), EdgeGraph(scene.domain)
    graph.break_edges(np.random.default_rng(1).random(len(graph.broken)) < 0.4)
    surface.update_damage(graph.pattern)
    W, m = surface.point_map.weights.toarray(), masses(scene)[surface.columns, 0]
    carried = NodalMassShare(surface.point_map.weights, m)

    def fastest(k: Values) -> float:
        return float(np.linalg.eigvalsh((W.T * k) @ W / np.sqrt(m[:, None] * m)).max())

    assert len(surface.point_map.copies) > 30
    own = carried.point_masses(surface.area)
    assert 0.3 < fastest(own) <= 1 + 1e-12
    for seed in range(5):
        k = np.random.default_rng(seed).exponential(size=len(own)) ** 3
        assert fastest(k) <= carried.node_rates(k).max() * (1 + 1e-12)


@pytest.mark.parametrize("dim", (2, 3))
def test_a_block_bounces_off_a_plane(dim: int) -> None:
    """At 5 m/s, a sixth of the speed of sound: m v = sum of dt f, energy to 2 % all through, friction never above mu N,
    and no point deeper than half an edge times v / c."""
    h = 0.25
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0] * dim, "h": h, "pattern": "unstructured"}, material=RUBBER,
        obstacle=[floor(dim, -0.05, friction=0.3)], initial={"velocity": [2.0] + [0.0] * (dim - 2) + [-5.0]},
        time={"scheme": "explicit", "step": 0.02, "end": 0.12},
    )  # fmt: skip
    m, v = masses(scene), state.v.reshape(-1, dim)
    began, energy = (m * v).sum(axis=0), 0.5 * float((m * v**2).sum())
    impulse, before, depth = np.zeros(dim), np.zeros(dim), 0.0
    for report in each_step(scene, state):
        force = -scene.probes()[:dim]
        impulse += report.dt * (force + before) / 2
        before = force
        assert np.linalg.norm(force[:-1]) <= 0.3 * force[-1] * (1 + 1e-9)
        x = positions(scene) + state.u.reshape(-1, dim)
        depth = max(depth, -0.05 - x[:, -1].min())
        assert report.kinetic + report.elastic + state.dissipated == pytest.approx(energy, rel=0.02)
    ended = (m * state.v.reshape(-1, dim)).sum(axis=0)
    np.testing.assert_allclose(ended - began, impulse, atol=1e-9 * abs(began[-1]))
    assert ended[-1] > 0.5 * 1000 and not before.any()  # it has left
    assert 0 < depth < 0.5 * h * 5.0 / SPEED_OF_SOUND
    assert state.dissipated > 0.01 * energy


@pytest.mark.parametrize(("share", "sticks"), [(1.1, True), (0.9, False)])
def test_a_block_on_a_slope(share: float, sticks: bool) -> None:
    """tan(theta) = 0.5 and mu = `share` of it: it stays where it is, or slides with g (sin - mu cos); the floor carries
    m g cos. Gravity is turned, not the slope. (Without damping it rocks, and comes down in hops.)"""
    slope = 0.5
    along, down = np.array([slope, -1.0]) / np.hypot(1, slope) * G
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.5], "h": 0.25}, material=RUBBER,
        load={"gravity": [along, down]}, damping={"mass": 20.0 * sticks, "stiffness": 1e-3},
        obstacle=[floor(2, -0.0125 + 1e-3, friction=share * slope)], contact={"itself": False, "distance": 0.0125},
        time={"scheme": "explicit", "step": 0.01, "end": 1.2},
    )  # fmt: skip
    m, moved = masses(scene)[:, 0], []
    for _ in each_step(scene, state):
        x, y = scene.probes()[:2]
        moved.append((state.t, float(m @ state.u.reshape(-1, 2)[:, 0]) / m.sum(), -x / y if y else 0.0))
    t, way, ratio = np.array(moved[1:]).T
    assert ratio.max() <= share * slope * (1 + 1e-9)
    if sticks:
        assert abs(way[-1] - way[len(way) // 2]) < 1e-5
        np.testing.assert_allclose(scene.probes()[:2], [500 * along, 500 * down], rtol=1e-3)
    else:
        late = t > 0.4
        assert 2 * np.polyfit(t[late], way[late], 2)[0] == pytest.approx(along + share * slope * down, rel=0.05)
        assert ratio[late].mean() == pytest.approx(share * slope, rel=0.02)


def test_the_work_of_a_driven_obstacle_is_in_the_books() -> None:
    """A rubbing platen comes down on a block: what it does is stored, moves, or is lost to friction; that to 1 %."""
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.5], "h": 0.25}, material=RUBBER,
        boundary=[{"on": "bottom", "fix": "xy"}],
        obstacle=[{"name": "platen", "shape": "plane", "at": [0.0, 0.52], "normal": [0.0, -1.0],
                   "velocity": [2.0, -1.0], "friction": 0.3}],
        time={"scheme": "explicit", "step": 0.02, "end": 0.08},
    )  # fmt: skip
    (*_, report) = march(scene, state)
    assert state.dissipated > 0.1 * state.work > 0
    assert state.work == pytest.approx(report.kinetic + report.elastic + state.dissipated, rel=0.01)
    assert scene.probes()[0] == pytest.approx(-0.3 * scene.probes()[1], rel=0.05)  # it slides everywhere, nearly


@pytest.mark.parametrize("mass", (1.0, 100.0))
def test_a_ball_that_strikes_a_block(mass: float) -> None:
    """It spins, rubs and flies off again: linear and angular momentum of the pair to round-off, and what friction takes
    is in the books; the energy of a ball of a thousandth of the block is kept less well."""
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0] * 3, "h": 0.5, "pattern": "unstructured"}, material=RUBBER,
        obstacle=[{"name": "ball", "shape": "sphere", "radius": 0.25, "at": [0.4, 0.5, 1.26], "mass": mass,
                   "velocity": [1.0, 0.0, -5.0], "spin": [3.0, 2.0, 1.0], "friction": 0.3}],
        time={"scheme": "explicit", "step": 0.02, "end": 0.1},
    )  # fmt: skip
    (contact,) = [term for term in scene.balance.terms if isinstance(term, PenaltyObstacleTerm)]
    X, m = positions(scene), masses(scene)

    def momentum() -> Values:
        flight, p = contact.group.bodies.free[0].motion, m * state.v.reshape(-1, 3)
        spun = np.cross(flight.pose.centre, flight.momentum[:3]) + flight.momentum[3:]
        turning = np.cross(X + state.u.reshape(-1, 3), p).sum(axis=0) + spun
        return np.concatenate([p.sum(axis=0) + flight.momentum[:3], turning])

    began, energies = momentum(), []
    for report in each_step(scene, state):
        energies.append(report.kinetic + report.elastic + state.dissipated - state.work)
    figures = dict(zip(scene.probes.columns, scene.probes(), strict=True))
    assert figures["contact_ball_z"] == 0 and figures["velocity_ball_z"] > 0  # it has left
    np.testing.assert_allclose(momentum(), began, atol=1e-12 * abs(began).max())
    np.testing.assert_allclose(energies, energies[0], rtol=0.02 if mass > 10 else 0.1)
    assert state.dissipated > 0 and abs(state.work) < 1e-12


@pytest.mark.parametrize(("radius", "friction"), [(0.1, 0.0), (0.2, 0.4)])
def test_a_ball_smaller_than_an_edge_does_not_pass_a_facet(radius: float, friction: float) -> None:
    """Of the body's density, thrown at the middle of a facet at a thirtieth of the speed of sound: it comes off again;
    energy to 2 %, momenta to round-off, and no facet deeper in the ball than a twentieth of an edge (trimesh)."""
    trimesh = pytest.importorskip("trimesh", reason="an environment made without a network")
    mass, h = 1000 * 4 / 3 * np.pi * radius**3, 0.5
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0] * 3, "h": h}, material=RUBBER,
        obstacle=[{"name": "ball", "shape": "sphere", "radius": radius, "at": [0.32, 0.16, 1.02 + radius], "mass": mass,
                   "velocity": [0.2, 0.1, -1.0], "spin": [0.0, 1.0, 0.0], "friction": friction}],
        time={"scheme": "explicit", "step": 0.02, "end": 0.12},
    )  # fmt: skip
    (contact,) = [term for term in scene.balance.terms if isinstance(term, PenaltyObstacleTerm)]
    corners, X, m = contact.surface.facets.corners, positions(scene), masses(scene)

    def momentum() -> Values:
        flight, p = contact.group.bodies.free[0].motion, m * state.v.reshape(-1, 3)
        spun = np.cross(flight.pose.centre, flight.momentum[:3]) + flight.momentum[3:]
        turning = np.cross(X + state.u.reshape(-1, 3), p).sum(axis=0) + spun
        return np.concatenate([p.sum(axis=0) + flight.momentum[:3], turning])

    before, energies, gap = momentum(), [], np.inf
    for report in each_step(scene, state):
        energies.append(report.kinetic + report.elastic + state.dissipated - state.work)
        centre = contact.group.bodies.free[0].motion.pose.centre
        triangles = contact.surface.positions(state.u)[corners]
        nearest = trimesh.triangles.closest_point(triangles, np.repeat(centre[None], len(triangles), axis=0))
        gap = min(gap, float(np.linalg.norm(nearest - centre, axis=1).min()) - radius)
        columns = dict(zip(scene.probes.columns, scene.probes(), strict=True))
    assert columns["contact_ball_z"] == 0 and columns["velocity_ball_z"] > 0.2
    assert -0.05 * h < gap < 0.025
    np.testing.assert_allclose(momentum(), before, atol=1e-12 * abs(before).max())
    np.testing.assert_allclose(energies, energies[0], rtol=0.02)
    assert (state.dissipated > 0) == (friction > 0)


def test_facets_leave_most_of_the_step() -> None:
    """Near a round obstacle at least 0.75 of the stable step is left."""
    steps = []
    for height in (5.0, 1.23):
        scene, state = make_scene(
            mesh={"builder": "box", "size": [1.0] * 3, "h": 0.5}, material=RUBBER,
            obstacle=[{"name": "ball", "shape": "sphere", "radius": 0.2, "at": [0.4, 0.4, height]}],
            time={"scheme": "explicit", "step": 1.0, "end": 10.0}, initial={"velocity": [0.0, 0.0, 1.0]},
        )  # fmt: skip
        steps.append(min(report.dt for report in march(scene, state, 8)))
    assert 0.75 * steps[0] < steps[1] < steps[0]


def test_a_weight_dropped_on_a_rail() -> None:
    """It has received m v + m g t from the block, and what gravity has done moves or is stored."""
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.5], "h": 0.25}, material=RUBBER, load={"gravity": [0.0, -G]},
        boundary=[{"on": "bottom", "fix": "xy"}],
        obstacle=[{"name": "weight", "shape": "box", "size": [0.5, 0.2], "at": [0.5, 0.62], "mass": 500.0,
                   "guide": "y"}],
        time={"scheme": "explicit", "step": 0.02, "end": 0.15},
    )  # fmt: skip
    impulse, before = 0.0, 0.0
    for report in each_step(scene, state):
        figures = dict(zip(scene.probes.columns, scene.probes(), strict=True))
        impulse += report.dt * (figures["contact_weight_y"] + before) / 2
        before = figures["contact_weight_y"]
    assert impulse > 100 and abs(figures["velocity_weight_x"]) == 0
    assert impulse == pytest.approx(500 * (figures["velocity_weight_y"] + G * state.t), rel=1e-9)
    assert state.work == pytest.approx(report.kinetic + report.elastic, rel=0.03)


def test_a_stiff_penalty_takes_a_shorter_step() -> None:
    """A user's stiffness is not reduced, but the step is; the default leaves at least 0.8 of it."""
    steps = []
    for contact in (None, {"itself": False}, {"itself": False, "stiffness": 1e7}):
        scene, state = make_scene(
            mesh={"builder": "box", "size": [1.0, 0.5], "h": 0.25, "pattern": "unstructured"}, material=RUBBER,
            time={"scheme": "explicit", "step": 0.02, "end": 0.06}, initial={"velocity": [0.0, -2.0]},
            **({} if contact is None else {"obstacle": [floor(2, -0.02)], "contact": contact}),
        )  # fmt: skip
        began = march(scene, state, 1)[0]
        steps.append(began.dt)
        (*_, report) = march(scene, state)
        assert report.kinetic + report.elastic == pytest.approx(began.kinetic + began.elastic, rel=0.02)
    assert 0.06 / steps[1] - 1 < 0.06 / steps[0] / 0.8  # equal steps to the end: rounding adds one at most
    assert steps[1] < steps[0]
    assert steps[2] < 0.4 * steps[0]


def test_what_breaks_in_touch_gains_nothing() -> None:
    """Edges at a floor that carries the body break: the penalty stores no more than before, no force is larger, and
    springs of points that are still there go on."""
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.5], "h": 0.125, "pattern": "unstructured"}, material=RUBBER,
        load={"gravity": [2.0, -G]}, fracture={"strength": 1e9}, obstacle=[floor(2, -0.002, friction=0.5)],
        time={"scheme": "explicit", "step": 0.02, "end": 1.0},
    )  # fmt: skip
    (contact,) = [term for term in scene.balance.terms if isinstance(term, PenaltyObstacleTerm)]
    while len(contact._step_end.slips[0].keys) <= 3:
        march(scene, state, 5)
    before, held, graph = contact.stored_energy(), contact._step_end.slips[0], scene.fracture.graph
    assert before > 0
    pushed = contact.contact_forces()
    graph.break_edges(np.random.default_rng(2).random(len(graph.broken)) < 0.4)
    scene.fracture.mark_changed()
    scene.balance.edges_broke(graph.pattern)
    assert abs(contact.contact_forces()).sum() < 1.01 * abs(pushed).sum()
    springs = contact._touching[0][0].contacts
    assert (springs.start_stiffness > 0).sum() == len(held.keys)
    np.testing.assert_array_equal(np.sort(springs.slip[springs.start_stiffness > 0, 0]), np.sort(held.slip[:, 0]))
    assert 0.3 * before < contact.stored_energy() <= before * (1 + 1e-9)


def test_springs_of_points_that_are_gone_are_not_in_a_checkpoint() -> None:
    """As an edge breaks, a face gets other points. A run that ended just then was refused as damaged."""
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.5], "h": 0.25}, material=RUBBER, load={"gravity": [2.0, -G]},
        obstacle=[floor(2, -0.002, friction=0.5)], time={"scheme": "explicit", "step": 0.02, "end": 1.0},
    )  # fmt: skip
    (contact,) = [term for term in scene.balance.terms if isinstance(term, PenaltyObstacleTerm)]
    while not len(contact._step_end.slips[0].keys):
        march(scene, state, 5)
    end = contact._step_end
    held = end.slips[0]
    with_gone = Slips(np.append(held.keys, 1), np.append(held.slip, [[0.1, 0.0]], axis=0))
    contact.restore(replace(end, slips=[with_gone]))
    contact.from_checkpoint(contact.to_checkpoint())
    kept = contact._step_end.slips[0]
    np.testing.assert_array_equal(kept.keys, np.sort(held.keys))
    np.testing.assert_array_equal(kept.slip, held.slip[np.argsort(held.keys)])


def test_a_restart_goes_on_as_the_run_would_have(tmp_path: Path) -> None:
    """A plate under a driven, rubbing disk that breaks it: stopped in touch and resumed, the same but for round-off."""
    time = {"scheme": "explicit", "step": 0.05, "end": 1.0}
    tables = RUNS["rapped"] | {"output": {"picture": False, "interval": 1.0}, "time": time}
    going, broken, again = going_stopped_resumed(tables, tmp_path, 17, 4)
    assert broken > 0
    assert_alike(again, going, 1e-9)


AXE = str(Path(__file__).parent / "support" / "axe.obj")


@pytest.mark.parametrize(
    "obstacle",
    [
        {"shape": "sphere", "radius": 0.12, "at": [0.41, 0.45, 1.13]},
        {"shape": "box", "size": [0.4, 0.3, 0.3], "rounding": 0.02, "at": [0.41, 0.45, 1.17]},
        {"shape": "mesh", "file": AXE, "at": [0.4, 0.5, 1.02]},
    ],
    ids=("ball", "box", "file"),
)
def test_a_restart_takes_the_same_steps(obstacle: dict[str, Any], tmp_path: Path) -> None:
    """A driven obstacle deep in a body: the next steps, whose size depends on what is near it, are the same bit by bit.
    The axe is 3 m wide: its points are not in the body, but its triangles are."""
    tables = {
        "mesh": {"builder": "box", "size": [1.0, 1.0, 1.0], "h": 0.34, "pattern": "unstructured"},
        "material": RUBBER, "boundary": [{"on": "bottom", "fix": "xyz"}],
        "contact": {"itself": False, "distance": 0.01},
        "obstacle": [{"name": "it", "velocity": [0.3, 0.1, -6.0], "friction": 0.3} | obstacle],
        "time": {"scheme": "explicit", "step": 0.05, "end": 1.0}, "output": {"picture": False, "interval": 1.0},
    }  # fmt: skip
    going, _, again = going_stopped_resumed(tables, tmp_path, 12, 3)
    assert abs(going.scene.probes()[:3]).max() > 1.0
    assert again.state.t == going.state.t
    np.testing.assert_array_equal(again.state.u, going.state.u)
    np.testing.assert_array_equal(again.scene.probes(), going.scene.probes())


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"contact": {"itself": False, "creep": 1e-3}}, "creep is for implicit schemes.*remove it"),
    ],
)  # fmt: skip
def test_what_explicit_steps_have_not_is_refused(tables: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        make_study(**{"time": {"scheme": "explicit", "step": 0.1, "end": 1.0}, "obstacle": [floor(2, -1.0)]} | tables)
