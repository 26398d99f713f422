"""Contact of a body with obstacles, against closed forms and conservation laws."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from mpi4py import MPI

from fracsim.contact.contact_surface import ContactSurface
from fracsim.contact.obstacle_term import ObstacleTerm
from fracsim.deformable_run import Run
from fracsim.errors import InputError
from fracsim.mesh.edge_graph import EdgeGraph
from fracsim.scene import Scene, build_scene
from support.resumed import assert_alike, going_stopped_resumed
from support.scenes import Walk, each_step, make_scene, make_study, march, positions
from support.torn import RUNS

Values = npt.NDArray[np.float64]

FINE = {"snes_rtol": 1e-9, "ksp_rtol": 1e-9}
SOFT = {"energy": "neo-hookean", "young": 1e4, "poisson": 0.3, "density": 100.0}
G = 10.0


def floor(height: float, **more: Any) -> dict[str, Any]:
    """A plane below the body, y upwards."""
    return {"name": "floor", "shape": "plane", "at": [0.0, height], "normal": [0.0, 1.0]} | more


def places(scene: Scene, state: Walk) -> Values:
    """(nodes, d) where the nodes are, m."""
    return positions(scene) + state.u.reshape(-1, scene.domain.dim)


def mass(scene: Scene) -> Values:
    """(nodes, 1) kg."""
    return scene.balance.mass.lumped.reshape(-1, scene.domain.dim)[:, :1]


# --- the surface that touches ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", (1, 2))
@pytest.mark.parametrize("dim", (2, 3))
def test_points_follow_affine_motions_and_hand_down_forces_and_moments(dim: int, order: int) -> None:
    """With a third of the body torn: x = A X + b at every point, and sum f, sum X f^T of forces are those at the
    points. The area grows by that of the walls."""
    mesh = {"builder": "box", "size": [1.0] * dim, "h": 0.25, "pattern": "unstructured", "order": order}
    scene, _ = make_scene(mesh=mesh)
    domain = scene.domain
    surface, graph = ContactSurface(domain, 0.01), EdgeGraph(domain)
    assert surface.area.sum() == pytest.approx(2 * dim)
    ends = domain.nodes[graph.edge_nodes][:, :, 0]
    graph.break_edges((ends.min(axis=1) < 0.5) & (ends.max(axis=1) > 0.5))
    surface.update_damage(graph.pattern)
    assert surface.area.sum() > 2 * dim + 1.5
    X = positions(scene)
    A, b = np.random.default_rng(dim).normal(size=(dim, dim)), np.arange(dim) + 1.0
    x = surface.interpolate((X @ A.T + b).reshape(-1))
    np.testing.assert_allclose(x, surface.point_map.rest @ A.T + b, atol=1e-13)
    f = np.sin(100 * surface.point_map.rest) * surface.area[:, None]
    nodal = surface.nodal_forces(f).reshape(-1, dim)
    np.testing.assert_allclose(nodal.sum(axis=0), f.sum(axis=0), atol=1e-13)
    np.testing.assert_allclose(X.T @ nodal, surface.point_map.rest.T @ f, atol=1e-13)
    some = np.flatnonzero(np.arange(len(f)) % 3 == 0)
    f[np.arange(len(f)) % 3 != 0] = 0.0
    both = surface.nodal_forces_of(some, np.stack([f[some], 2 * f[some]], axis=2))
    np.testing.assert_allclose(both[:, 0], surface.nodal_forces(f), atol=1e-14)
    np.testing.assert_allclose(both[:, 1], 2 * both[:, 0], atol=1e-14)


# --- impulse, rest, pressure ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", ("backward-euler", "newmark", "generalized-alpha"))
def test_the_impulse_of_contact_is_what_balances_momentum(scheme: str) -> None:
    """M (v - v_n) = dt f for every step, so that m v = sum of dt f - m g t through a whole bounce; the floor is never
    passed, though the body is as soft as jelly and falls 0.2 m, and no energy comes from nothing."""
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 1.0], "h": 0.5}, material=SOFT, load={"gravity": [0.0, -G]},
        obstacle=[floor(-0.2, friction=0.3)], solver=FINE,
        time={"scheme": scheme, "step": 0.01, "end": 0.4},
    )  # fmt: skip
    impulse, touched, before = np.zeros(2), 0, 0.0
    for report in each_step(scene, state):
        force = -scene.probes()[:2]
        impulse += force * report.dt
        touched += force[1] > 0
        assert places(scene, state)[:, 1].min() > -0.2
        if scheme == "backward-euler":  # others read the mean of a step
            assert abs(force[0]) <= 0.3 * before * (1 + 1e-9)  # lagged: of the normal force at the start of the step
        assert report.kinetic + report.elastic + state.dissipated < state.work + 1e-6 * 200
        before = force[1]
    momentum = (mass(scene) * state.v.reshape(-1, 2)).sum(axis=0)
    np.testing.assert_allclose(momentum, impulse - np.array([0.0, 100 * G * state.t]), atol=1e-4)
    assert touched > 15 and np.ptp(impulse) > 450


def test_an_obstacle_that_touches_nothing_changes_nothing() -> None:
    """The body stretches under a load as it does without, and its energy is not summed for the line search: that is
    done once it is near."""
    ends, asked = [], []
    for obstacle in ([], [floor(-5.0)], [floor(-1e-3)]):
        scene, state = make_scene(
            mesh={"builder": "box", "size": [1.0, 1.0], "h": 0.5}, material=SOFT, load={"gravity": [0.0, -G]},
            boundary=[{"on": "top", "fix": "xy"}], solver=FINE,
            time={"scheme": "backward-euler", "step": 0.02, "end": 0.2},
            **({"obstacle": obstacle} if obstacle else {}),
        )  # fmt: skip
        potential, calls = scene.balance.energies.incremental_potential, []
        scene.balance.energies.incremental_potential = lambda p=potential, c=calls: (c.append(1), p())[1]
        march(scene, state)
        ends.append(state.u.copy())
        asked.append(len(calls))
    np.testing.assert_allclose(ends[1], ends[0], atol=1e-12)
    assert asked[:2] == [0, 0] and asked[2] > 0 and np.abs(ends[2] - ends[0]).max() > 1e-3


def test_a_body_at_rest_is_carried() -> None:
    """Laid on the floor, damped to rest: the load cell reads m g."""
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.5], "h": 0.25}, material=SOFT | {"young": 1e5},
        load={"gravity": [0.0, -G]}, damping={"mass": 20.0}, obstacle=[floor(-1e-3)], solver=FINE,
        time={"scheme": "backward-euler", "step": 0.02, "end": 1.0},
    )  # fmt: skip
    march(scene, state)
    assert scene.probes()[:2] == pytest.approx([0.0, -50 * G], rel=1e-4, abs=1e-3)
    assert state.work == pytest.approx(
        -G * (mass(scene) * state.u.reshape(-1, 2))[:, 1].sum(), rel=1e-6
    )  # a floor that is held does no work


@pytest.mark.parametrize("rotate", (False, True))
def test_a_press_reads_hookes_law(rotate: bool) -> None:
    """A platen comes down to 0.98 m on a block of 1 m, E = 1e4 Pa, nu = 0: force = E int strain dA, the strain that of
    the top, a gap below the platen; what the base carries is the same, and its work is stored in block and barrier."""
    axes = [1, 0] if rotate else [0, 1]
    turn = lambda values: [values[axis] for axis in axes]  # noqa: E731
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 1.0], "h": 0.25},
        material={"energy": "linear", "young": 1e4, "poisson": 0.0, "density": 1.0},
        boundary=[{"on": "left" if rotate else "bottom", "fix": "xy"}],
        obstacle=[{"name": "platen", "shape": "plane", "at": turn([0.0, 1.015]), "normal": turn([0.0, -1.0]),
                   "displacement": {"time": [0.0, 1.0], "value": [[0.0, 0.0], turn([0.0, -0.035])]}}],
        probe=[{"name": "base", "on": "left" if rotate else "bottom"}], solver=FINE,
        time={"scheme": "quasi-static", "step": 0.04, "end": 1.0},
    )  # fmt: skip
    (*_, report) = march(scene, state)
    x, X = places(scene, state)[:, axes], positions(scene)[:, axes]
    top = np.flatnonzero(X[:, 1] > 1 - 1e-9)
    top = top[np.argsort(X[top, 0])]
    strain, height = 1 - np.trapezoid(x[top, 1], X[top, 0]), x[:, 1].max()
    pushed = scene.probes()[:4].reshape(2, 2)[:, axes]
    assert 0.98 - 0.05 * 0.25 < height < 0.98
    assert pushed[1] == pytest.approx([0.0, 1e4 * strain], rel=1e-6, abs=1e-6)
    assert pushed[0] == pytest.approx(pushed[1], rel=1e-6, abs=1e-6)
    assert report.elastic > 0.5 * 1e4 * strain**2
    assert state.work == pytest.approx(report.elastic, rel=2e-2)  # trapezia in a barrier
    assert abs(state.dissipated) < 1e-6 * report.elastic


@pytest.mark.parametrize("scheme", ("newmark", "generalized-alpha"))
def test_a_step_that_balances_inside_books_what_its_obstacle_did(scheme: str) -> None:
    """A rubbing platen presses a block: its work is stored in the block but for 2 %, what the blow as they meet and the
    scheme take, and never less than what is stored; the force that it reads has friction in it, whatever level of the
    step forces balance at."""
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.5], "h": 0.25}, material=SOFT, boundary=[{"on": "bottom", "fix": "xy"}],
        obstacle=[floor(0.53, normal=[0.0, -1.0], velocity=[0.05, -0.2], friction=0.3)], solver=FINE,
        time={"scheme": scheme, "step": 0.02, "end": 0.4},
    )  # fmt: skip
    (*_, report) = march(scene, state)
    assert 0 < state.work - (report.elastic + report.kinetic + state.dissipated) < 2e-2 * state.work
    along, down = scene.probes()[:2]
    assert down > 1e3 and 1 < abs(along) < 0.3 * down


def test_gaps_and_work_are_those_of_the_nodes_and_of_the_force(tmp_path: Path) -> None:
    """A disk pressed into a block and out again, and a plane far away: gaps are those of the nearest place; work is the
    force that is read over the way that the study gives, by trapezia, and no less in a run that is resumed."""
    way = [0.0, -0.1, 0.0]
    tables: dict[str, Any] = {
        "mesh": {"builder": "box", "size": [1.0, 0.5], "h": 0.125}, "material": SOFT, "solver": FINE,
        "boundary": [{"on": "bottom", "fix": "xy"}], "output": {"picture": False},
        "obstacle": [{"name": "disk", "shape": "sphere", "radius": 0.2, "at": [0.5, 0.72],
                      "displacement": {"time": [0.0, 0.5, 1.0], "value": [[0.0, each] for each in way]}},
                     {"name": "far", "shape": "plane", "at": [3.0, 0.0], "normal": [-1.0, 0.0]}],
        "time": {"scheme": "quasi-static", "step": 0.1, "end": 1.0},
    }  # fmt: skip
    run = Run(build_scene(MPI.COMM_SELF, make_study(**tables)), tmp_path)
    X, gaps, force, heights = positions(run.scene), [], [0.0], [0.72]
    for step in range(10):
        if step == 5:
            run.checkpoint()
            run = Run(build_scene(MPI.COMM_SELF, make_study(**tables)), tmp_path, restart=True)
        run.step()
        x = X + run.state.u.reshape(-1, 2)
        heights.append(0.72 + np.interp(run.state.t, [0.0, 0.5, 1.0], way))
        top = x[abs(X[:, 1] - 0.5) < 1e-9]
        top = top[np.argsort(top[:, 0])]
        drawn = [np.interp(np.linspace(0, len(top) - 1, 8001), np.arange(len(top)), each) for each in top.T]
        gaps.append([np.hypot(drawn[0] - 0.5, drawn[1] - heights[-1]).min() - 0.2, 3.0 - x[:, 0].max()])
        force.append(run.scene.probes()[1])
    with (tmp_path / "history.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    found = {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
    soft = 0.1 * 0.05 * 0.125 / 4  # of the deepest place, at most
    np.testing.assert_allclose(found["gap_disk"], np.array(gaps)[:, 0], rtol=1e-4, atol=soft)
    np.testing.assert_allclose(found["gap_far"], np.array(gaps)[:, 1], rtol=1e-9)
    assert found["gap_disk"].min() < 0.05 * 0.125
    work = -np.cumsum(np.diff(heights) * (np.array(force[1:]) + force[:-1]) / 2)
    np.testing.assert_allclose(found["work_disk"], work, rtol=1e-9, atol=1e-9 * work.max())
    np.testing.assert_allclose(found["external_work"], work, rtol=1e-9, atol=1e-9 * work.max())
    assert work.max() > 1 and not found["work_far"].any()


# --- friction -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("facets", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize(("share", "sticks"), [(1.1, True), (0.9, False)])
def test_a_block_on_a_slope(share: float, sticks: bool, facets: bool) -> None:
    """tan(theta) = 0.5 and mu = `share` of it: it stays, or slides with g (sin - mu cos); gravity is turned, not the
    slope. It is laid on without a drop, and left to settle a little before anything is measured. The slope is a plane,
    or the side of a box that facets feel, too."""
    box = {"shape": "box", "size": [2.0, 0.5], "at": [0.75, -0.2595], "rounding": 0.02, "normal": None}
    slope, steps = 0.5, 40
    down = np.array([slope, -1.0]) / np.hypot(1, slope) * G
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.5], "h": 0.25}, material=SOFT | {"young": 1e6},
        load={"gravity": down.tolist()}, damping={"stiffness": 0.01},
        obstacle=[floor(-0.0095, friction=share * slope) | (box if facets else {})],
        contact={"distance": 0.01, "creep": 1e-3}, solver=FINE,
        time={"scheme": "backward-euler", "step": 0.01, "end": steps * 0.01},
    )  # fmt: skip
    march(scene, state, steps // 2)
    before = (mass(scene) * state.v.reshape(-1, 2)).sum(axis=0)[0] / 50
    march(scene, state)
    after = (mass(scene) * state.v.reshape(-1, 2)).sum(axis=0)[0] / 50
    if sticks:
        assert abs(after) < 1.5e-3
    else:
        assert (after - before) / (steps / 2 * 0.01) == pytest.approx(down[0] + share * slope * down[1], rel=0.05)


@pytest.mark.parametrize("end", [0.1, 3600.0])
def test_a_slow_test_has_the_friction_of_a_fast_one(end: float) -> None:
    """A plate is drawn along a block within `end` seconds, under mu times the normal force."""
    way = {"time": [0.0, end / 10, end], "value": [[0.0, 0.0], [0.0, 0.02], [0.4, 0.02]]}
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.5], "h": 0.25}, material=SOFT, solver=FINE,
        boundary=[{"on": "top", "fix": "xy"}], obstacle=[floor(-0.001, friction=0.3) | {"displacement": way}],
        time={"scheme": "quasi-static", "step": end / 20, "end": end},
    )  # fmt: skip
    march(scene, state)
    tangential, normal = np.abs(scene.balance.reactions.reshape(-1, 2).sum(axis=0))
    assert tangential == pytest.approx(0.3 * normal, rel=1e-3)


@pytest.mark.parametrize("dim", [2, 3])
def test_friction_acts_between_corners(dim: int) -> None:
    """A ball of a tenth of a facet pressed into the middle of one and dragged over it: what it is held back by is mu
    times what it presses with (8 %: as it ploughs on what it presses is not quite upright)."""
    way = [[0.0] * dim, [*[0.0] * (dim - 1), -0.04], [0.1, *[0.0] * (dim - 2), -0.04]]
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0] * dim, "h": 0.5}, material=SOFT | {"poisson": 0.0}, solver=FINE,
        boundary=[{"on": "bottom", "fix": "xyz"[:dim]}], contact={"itself": False, "creep": 1e-4},
        obstacle=[{"name": "it", "shape": "sphere", "radius": 0.05, "at": [*[0.33, 0.17][3 - dim :], 1.06],
                   "displacement": {"time": [0.0, 0.1, 0.6], "value": way}, "friction": 0.3}],
        time={"scheme": "backward-euler", "step": 0.05, "end": 0.35},
    )  # fmt: skip
    march(scene, state)
    told = dict(zip(scene.probes.columns, scene.probes(), strict=True))
    *across, pressed = (told[f"contact_it_{axis}"] for axis in "xyz"[:dim])
    assert pressed > 50 and across[0] < 0 and np.linalg.norm(across) == pytest.approx(0.3 * pressed, rel=0.08)


def test_a_ball_that_spins_is_driven_off_by_what_it_presses() -> None:
    """A free disk that is smaller than a facet dropped on its middle, spinning so fast that it slides all along: mu
    times the momentum that stops it drives it aside (2 %) and slows its spin, and that of both stays what it was."""
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 1.0], "h": 0.5}, material=SOFT | {"poisson": 0.0}, solver=FINE,
        obstacle=[{"name": "it", "shape": "sphere", "radius": 0.05, "at": [0.25, 1.08], "mass": 0.5, "friction": 0.2,
                   "velocity": [0.0, -1.0], "spin": [60.0]}],
        time={"scheme": "backward-euler", "step": 4e-3, "end": 0.044},
    )  # fmt: skip
    march(scene, state)
    told = dict(zip(scene.probes.columns, scene.probes(), strict=True))
    given = 0.5 * (told["velocity_it_y"] + 1.0)
    assert given > 0.5 and 0.5 * told["velocity_it_x"] == pytest.approx(-0.2 * given, rel=0.02)
    both = (mass(scene) * state.v.reshape(-1, 2)).sum(axis=0)
    both += 0.5 * np.array([told["velocity_it_x"], told["velocity_it_y"]])
    np.testing.assert_allclose(both, [0.0, -0.5], atol=1e-8)
    arm = 0.5 * 0.5 * 0.05**2 * (60.0 - told["spin_it_z"]) / (0.2 * given)
    assert 0.05 < arm < 0.05 + 0.025  # friction acts a gap away from it


# --- speed, geometry, refusals --------------------------------------------------------------------------------------


@pytest.mark.parametrize("radius", [5.0, 0.1])
def test_a_striker_faster_than_its_step_does_not_tunnel(radius: float) -> None:
    """A disk at 100 m/s crosses the thin bar five times over in a step: it pushes it along instead."""
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.1], "h": 0.1}, material=SOFT | {"young": 1e6, "density": 1.0},
        obstacle=[{"name": "striker", "shape": "sphere", "radius": radius, "at": [0.5, 0.2 + radius],
                   "velocity": [0.0, -100.0]}],
        time={"scheme": "backward-euler", "step": 5e-3, "end": 1e-2},
    )  # fmt: skip
    struck = 0.0
    for _ in each_step(scene, state):
        struck = max(struck, scene.probes()[1])
        centre = np.array([0.5, 0.2 + radius - 100 * state.t])
        x = places(scene, state)
        assert np.linalg.norm(x - centre, axis=1).min() > radius
        assert (x[abs(x[:, 0] - 0.5) < 0.1, 1] < centre[1]).all()  # what is in its way, though a bar may slide round it
    assert state.v.reshape(-1, 2)[:, 1].mean() < -50
    assert struck > 0


def test_a_body_in_a_bowl_stays_there() -> None:
    """A block thrown into a hollow disk: every node is inside it after every step, and the wall takes its speed."""
    scene, state = make_scene(
        mesh={"builder": "box", "size": [0.4, 0.4], "h": 0.1, "pattern": "unstructured", "origin": [-0.2, -0.2]},
        material=SOFT, initial={"velocity": [3.0, 1.0], "spin": [4.0]},
        obstacle=[{"name": "bowl", "shape": "sphere", "radius": 0.5, "at": [0.0, 0.0], "hollow": True}],
        time={"scheme": "backward-euler", "step": 0.01, "end": 0.3},
    )  # fmt: skip
    for _ in each_step(scene, state):
        assert np.linalg.norm(places(scene, state), axis=1).max() < 0.5
    assert np.linalg.norm((mass(scene) * state.v.reshape(-1, 2)).sum(axis=0)) < 0.7 * 16 * np.hypot(3, 1)


def test_a_cracked_body_touches_with_its_walls() -> None:
    """A strip that has come apart is pushed from the crack's side: the platen meets points that were inside it."""
    scene, _ = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.5], "h": 0.125, "pattern": "unstructured"},
        material=SOFT, fracture={"strength": 1e9}, solver=FINE,
        obstacle=[floor(-1e-2)], time={"scheme": "backward-euler", "step": 0.01, "end": 1.0},
    )  # fmt: skip
    graph, domain = scene.fracture.graph, scene.domain
    y = domain.nodes[graph.edge_nodes][:, :, 1]
    graph.break_edges((y.min(axis=1) < 0.25) & (y.max(axis=1) > 0.25))
    scene.fracture.mark_changed()
    scene.balance.edges_broke(graph.pattern)
    (contact,) = [term for term in scene.balance.terms if isinstance(term, ObstacleTerm)]
    X = contact.surface.rest_positions
    inside = (X[:, 0] > 0.05) & (X[:, 0] < 0.95) & (X[:, 1] > 0.05) & (X[:, 1] < 0.45)
    assert inside.sum() > 10 and contact.surface.area[inside].min() > 0


def test_crack_faces_are_released_once_a_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not again as edges break in the step and it is solved anew: they have room at the last solution alone."""
    released: list[Any] = []
    release = ContactSurface.release

    def recorded(surface: ContactSurface, u: Values, posed: Any) -> None:
        released.append(u.copy())
        release(surface, u, posed)

    monkeypatch.setattr(ContactSurface, "release", recorded)
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 1.0], "h": 0.25, "pattern": "unstructured"},
        material={"young": 1e4, "poisson": 0.2, "density": 1.0}, fracture={"strength": 300.0, "passes": 5},
        time={"scheme": "backward-euler", "step": 5e-3, "end": 0.1}, boundary=[{"on": "bottom", "fix": "xy"}],
        obstacle=[{"name": "press", "shape": "sphere", "radius": 0.3, "at": [0.5, 1.31], "velocity": [0.0, -2.0]}],
    )  # fmt: skip
    solves = [report.solve.newton_iterations for report in each_step(scene, state) if report.broken]
    assert solves
    assert len(released) == len({u.tobytes() for u in released})


def test_crack_faces_far_from_obstacles_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk is driven along a crack and parts its walls: as with a surface of all crack faces, of which it needs only
    those near the disk."""
    ends, points = [], []
    for shows_all in (False, True):
        monkeypatch.setattr(ObstacleTerm, "shows_all_cells", shows_all)
        disk = {"name": "wedge", "shape": "sphere", "at": [1.06, 0.26], "radius": 0.05, "velocity": [-1.0, 0.0]}
        scene, state = make_scene(
            mesh={"builder": "box", "size": [1.0, 0.5], "h": 0.08, "pattern": "unstructured"},
            boundary=[{"on": "left", "fix": "xy"}], material=SOFT, fracture={"strength": 1e9}, solver=FINE,
            crack=[{"segment": [[0.2, 0.26], [1.0, 0.26]]}], obstacle=[disk],
            time={"scheme": "backward-euler", "step": 0.02, "end": 0.24},
        )  # fmt: skip
        (contact,) = [term for term in scene.balance.terms if isinstance(term, ObstacleTerm)]
        points.append([])
        for _ in each_step(scene, state):
            points[-1].append(len(contact.surface.area))
        ends.append(state.u.copy())
    limited, whole = points
    assert limited[0] < limited[-1] < whole[-1] == whole[0]
    assert np.abs(ends[1]).max() > 0.02
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-7)


def test_an_obstacle_inside_the_body_is_refused() -> None:
    with pytest.raises(InputError, match=r"obstacle\.0: floor overlaps the body at the start, by 0\.05 m"):
        make_scene(obstacle=[floor(0.05)])


def test_a_restart_goes_on_as_the_run_would_have(tmp_path: Path) -> None:
    """A plate under a driven, rubbing disk that breaks it: stopped half-way and resumed, the same energies, cracks and
    forces."""
    tables = RUNS["struck"] | {
        "time": {"scheme": "backward-euler", "step": 0.05, "end": 1.0},
        "solver": FINE,
        "output": {"picture": False},
    }
    going, broken, again = going_stopped_resumed(tables, tmp_path, 2, 1)
    assert 0 < broken < going.breaks.counts[0]
    assert_alike(again, going, 1e-6)
