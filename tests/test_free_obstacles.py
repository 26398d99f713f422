"""Obstacles that move freely, with the body: momentum, energy, closed forms."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from pydantic import ValidationError

from fracsim.contact.obstacle_term import ObstacleTerm
from fracsim.contact.penalty_obstacle_pairs import VerletRigidObstacles
from fracsim.contact.rigid_pose import FreeRigidObstacles
from fracsim.errors import InputError
from fracsim.output.contact_checks import ObstacleOverlapMonitor
from fracsim.scene import Scene
from fracsim.study.check import check_study
from support.resumed import going_stopped_resumed
from support.scenes import Walk, each_step, make_scene, make_study, march, positions

Values = npt.NDArray[np.float64]

FINE = {"snes_rtol": 1e-9, "ksp_rtol": 1e-9}
SOFT = {"energy": "neo-hookean", "young": 1e5, "poisson": 0.3, "density": 100.0}
SCHEMES = ("backward-euler", "newmark", "generalized-alpha")
G = 10.0


def ball(**more: Any) -> dict[str, Any]:
    """A disk above a body that ends at y = 0.3."""
    return {"name": "it", "shape": "sphere", "radius": 0.1, "at": [0.5, 0.42], "mass": 5.0} | more


def contact_of(scene: Scene) -> FreeRigidObstacles:
    (found,) = [term for term in scene.balance.terms if isinstance(term, FreeRigidObstacles)]
    return found


def told(scene: Scene) -> dict[str, float]:
    """The columns of history.csv."""
    return dict(zip(scene.probes.columns, scene.probes(), strict=True))


def momenta(scene: Scene, state: Walk) -> tuple[Values, Values]:
    """(d,) linear and (1,) or (3,) angular momentum about the origin of body and obstacle."""
    d, (flight,) = scene.domain.dim, [each.motion for each in contact_of(scene).free.values()]
    mass = scene.balance.mass.lumped.reshape(-1, d)[:, :1]
    x, v = positions(scene) + state.u.reshape(-1, d), state.v.reshape(-1, d)
    rows = [(x, mass * v), (flight.pose.centre[None], flight.momentum[None, :d])]
    linear = sum((p.sum(axis=0) for _, p in rows), np.zeros(d))
    angular = sum((_cross(x, p).sum(axis=0) for x, p in rows), flight.momentum[d:])
    return linear, angular


def _cross(x: Values, p: Values) -> Values:
    return np.cross(x, p) if x.shape[1] == 3 else (x[:, 0] * p[:, 1] - x[:, 1] * p[:, 0])[:, None]


def carried(scene: Scene, state: Walk) -> float:
    """int rho u_y dV of the body, kg m."""
    return float((scene.balance.mass.lumped * state.u).reshape(-1, scene.domain.dim)[:, 1].sum())


# --- by itself ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", SCHEMES)
def test_free_flight_is_the_parabola_of_the_scheme(scheme: str) -> None:
    """y = v t - g t^2 / 2, of backward Euler v t - g t (t + dt) / 2; motion gains the work of gravity, less
    m (g dt)^2 / 2 a step of backward Euler."""
    scene, state = make_scene(
        obstacle=[ball(at=[3.0, 5.0], velocity=[1.0, 2.0], spin=[3.0])], load={"gravity": [0.0, -G]},
        material=SOFT, boundary=[{"on": "bottom", "fix": "xy"}], time={"scheme": scheme, "step": 0.02, "end": 0.2},
    )  # fmt: skip
    started = 0.5 * 5.0 * 5.0 + 0.5 * 0.5 * 5.0 * 0.1**2 * 9.0
    march(scene, state)
    row, t = told(scene), state.t
    late = 0.02 if scheme == "backward-euler" else 0.0
    assert row["position_it_x"] == pytest.approx(3 + t, abs=1e-12)
    assert row["position_it_y"] == pytest.approx(5 + 2 * t - G * t * (t + late) / 2, abs=1e-12)
    assert [row["velocity_it_y"], row["turn_it_z"], row["spin_it_z"]] == pytest.approx([2 - G * t, 3 * t, 3.0])
    assert state.work == pytest.approx(-5.0 * G * (row["position_it_y"] - 5) - G * carried(scene, state))
    assert row["kinetic_it"] - started == pytest.approx(-5.0 * G * (row["position_it_y"] - 5) - 2.5 * G**2 * late * t)


@pytest.mark.parametrize("dim", (2, 3))
def test_a_pendulum_swings_in_its_period(dim: int) -> None:
    """T = 2 pi sqrt(I / (m g l)) at 0.1 rad, which lengthens it by 0.06 %: zero crossings of the turn, 1 % of T."""
    tail = [0.3] * (dim - 2)
    hinge = {"point": [3.0, 5.0, *tail]} | ({"axis": [0.0, 0.0, 2.0]} if dim == 3 else {})
    inertia = (0.5 if dim == 2 else 0.4) * 0.1**2 + 0.4**2
    period = 2 * np.pi * np.sqrt(inertia / (G * 0.4))
    at = [3 + 0.4 * np.sin(0.1), 5 - 0.4 * np.cos(0.1), *tail]
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0] * dim, "h": 1.0}, load={"gravity": [0.0, -G, 0.0][:dim]},
        material={"energy": "linear", "young": 1e5, "poisson": 0.0, "density": 1.0},
        boundary=[{"on": "bottom", "fix": "xyz"[:dim]}], obstacle=[ball(at=at, hinge=hinge)],
        time={"scheme": "newmark", "step": period / 28, "end": 1.29 * period},
    )  # fmt: skip
    turns, times = [0.0], [0.0]
    for _ in each_step(scene, state):
        turns.append(told(scene)["turn_it_z"])
        times.append(state.t)
    swing, t = np.array(turns) + 0.1, np.array(times)
    down = np.flatnonzero((swing[:-1] > 0) & (swing[1:] <= 0))
    crossing = t[down] + swing[down] / (swing[down] - swing[down + 1]) * np.diff(t)[down]
    assert np.diff(crossing) == pytest.approx([period], rel=1e-2)
    assert swing.min() == pytest.approx(-0.1, rel=1e-2)


# --- with the body --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", SCHEMES)
def test_an_isolated_pair_keeps_its_momentum(scheme: str) -> None:
    """A spinning, rubbing box thrown on a block that nothing holds: m v of both together stays to the solver's
    tolerance while it is turned round; friction and the scheme take energy, and none gives any."""
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.3], "h": 0.15}, material=SOFT, solver=FINE,
        obstacle=[{"name": "it", "shape": "box", "size": [0.3, 0.1], "at": [0.7, 0.36], "velocity": [1.0, -2.0],
                   "spin": [3.0], "mass": 5.0, "friction": 0.3}],
        time={"scheme": scheme, "step": 4e-3, "end": 0.04},
    )  # fmt: skip
    before, _ = momenta(scene, state)
    given = 0.0
    for report in each_step(scene, state):
        np.testing.assert_allclose(momenta(scene, state)[0], before, atol=1e-8 * 10)
        assert report.kinetic + report.elastic + state.dissipated < 12.69 * (1 + 1e-9)
        given += told(scene)["work_it"]
    row = told(scene)
    assert row["velocity_it_y"] > -0.5 and state.dissipated > 0.5  # of -2; how far it is round depends on the mesh
    if scheme == "newmark":
        assert given == pytest.approx(
            12.69 - row["kinetic_it"], rel=4e-2
        )  # its work on the body: trapezia, friction in full
    assert row["gap_it"] > 0


def test_angular_momentum_is_kept_to_the_order_of_the_scheme() -> None:
    """Backward Euler loses dt sum m v_n+1 x v_n of it a step, as of the body's: less than a third at a quarter of the
    step, in 3D, with all of an obstacle's freedoms at work."""
    lost = []
    for step in (8e-3, 2e-3):
        scene, state = make_scene(
            mesh={"builder": "box", "size": [1.0, 0.3, 0.5], "h": 0.5}, material=SOFT, solver=FINE,
            obstacle=[{"name": "it", "shape": "box", "size": [0.3, 0.1, 0.2], "at": [0.7, 0.37, 0.3], "mass": 5.0,
                       "velocity": [1.0, -2.0, 0.5], "spin": [3.0, -8.0, 2.0], "friction": 0.3}],
            time={"scheme": "backward-euler", "step": step, "end": 0.032},
        )  # fmt: skip
        linear, angular = momenta(scene, state)
        march(scene, state)
        after = momenta(scene, state)
        np.testing.assert_allclose(after[0], linear, atol=1e-8 * 10)
        lost.append(np.abs(after[1] - angular).max())
    assert np.linalg.norm(linear - contact_of(scene).free[0].motion.momentum[:3]) > 5  # most of it has changed hands
    assert lost[1] < lost[0] / 3 and lost[1] < 5e-3 * np.linalg.norm(angular)


@pytest.mark.parametrize("mass", (5e3, 0.1, 1e-5))
def test_a_free_striker_faster_than_its_step_does_not_tunnel(mass: float) -> None:
    """A disk at 100 m/s would cross a bar of 0.1 kg five times over in a step: it never enters it, whatever its mass;
    both have the momentum that it brought, and they part no faster than a twentieth of what they met with."""
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.1], "h": 0.05}, solver=FINE,
        material={"energy": "neo-hookean", "young": 1e6, "poisson": 0.3, "density": 1.0},
        obstacle=[ball(at=[0.5, 0.3], velocity=[0.0, -100.0], mass=mass)],
        time={"scheme": "backward-euler", "step": 5e-3, "end": 1e-2},
    )  # fmt: skip
    for _ in each_step(scene, state):
        row, x = told(scene), positions(scene) + state.u.reshape(-1, 2)
        centre = np.array([row["position_it_x"], row["position_it_y"]])
        assert np.linalg.norm(x - centre, axis=1).min() > 0.1
        assert x[:, 1].mean() < centre[1]
        np.testing.assert_allclose(momenta(scene, state)[0], [0.0, -100.0 * mass], atol=1e-7 * max(100 * mass, 1.0))
    assert -105 < state.v.reshape(-1, 2)[:, 1].mean() < -mass / (mass + 0.1) * 95


def test_a_ball_much_heavier_than_the_body_needs_no_shorter_steps() -> None:
    """10,000 times the mass of a bar, by a barrier's distance a step: before a bar that has not given way yet it would
    stop a hair's breadth away, and Newton's method would creep. It comes on as the bar lets it."""
    mass = 1e4 * 1100 * 0.25
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.25], "h": 0.125}, solver={},
        contact={"itself": False, "distance": 1e-3},
        material={"energy": "neo-hookean", "young": 1e7, "poisson": 0.3, "density": 1100.0},
        obstacle=[ball(radius=0.25, at=[0.47, 0.5015], velocity=[0.0, -10.0], mass=mass)],
        time={"scheme": "backward-euler", "step": 1e-4, "end": 5e-4},
    )  # fmt: skip
    for report in each_step(scene, state):
        assert report.dt == pytest.approx(1e-4)
        assert report.solve.newton_iterations <= 20
        assert told(scene)["gap_it"] > 0
        np.testing.assert_allclose(momenta(scene, state)[0], [0.0, -10 * mass], atol=1e-9 * mass)
    assert -20 < state.v.reshape(-1, 2)[:, 1].min() < -9  # what is below goes with it, or bounces off, at 2 v at most


def test_a_weight_dropped_on_a_block_comes_to_rest() -> None:
    """Guided, on a damped block that is held: contact has given it m v + m g t in all, and carries m g in the end; what
    gravity did is stored, or gone."""
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.3], "h": 0.3}, material=SOFT, solver=FINE, damping={"stiffness": 0.02},
        boundary=[{"on": "bottom", "fix": "xy"}], load={"gravity": [0.0, -G]},
        obstacle=[{"name": "it", "shape": "box", "size": [0.6, 0.2], "at": [0.5, 0.42], "density": 400.0, "guide": "y",
                   "velocity": [0.0, -1.0]}],
        time={"scheme": "backward-euler", "step": 0.02, "end": 1.0},
    )  # fmt: skip
    mass, impulse = contact_of(scene).free[0].body.mass, 0.0
    assert mass == pytest.approx(400 * 0.12, rel=1e-2)
    for report in each_step(scene, state):
        impulse += told(scene)["contact_it_y"] * report.dt
    row = told(scene)
    assert impulse == pytest.approx(mass * 1.0 + mass * G * state.t, rel=1e-3)
    assert abs(row["velocity_it_y"]) < 1e-3 and row["position_it_x"] == 0.5
    assert row["contact_it_y"] == pytest.approx(mass * G, rel=1e-3)


@pytest.mark.parametrize(("scheme", "width"), [("backward-euler", 1.2), ("generalized-alpha", 1.2),
                                               ("generalized-alpha", 0.04)])  # fmt: skip
def test_the_condensed_tangent_is_the_derivative_of_the_force(scheme: str, width: float) -> None:
    """Flat on flat along a guide, where nothing of a tangent is left out: K less its part of low rank times a change of
    u, against differences of r, each with the obstacle where it then belongs; r against those of the potential. A wide
    one is felt at points, a narrow one by one facet between them."""
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.3], "h": 0.1}, material=SOFT, solver=FINE,
        obstacle=[{"name": "it", "shape": "box", "size": [width, 0.1], "at": [0.5 if width > 1 else 0.45, 0.358],
                   "mass": 0.5, "guide": "y",
                   "velocity": [0.0, -1.0]}],
        time={"scheme": scheme, "step": 5e-3, "end": 1.0},
    )  # fmt: skip
    balance, n = scene.balance, scene.balance.owned_dof_count
    balance.begin_step(5e-3, 5e-3, state.u, state.v, state.a)
    u = balance.feasible_guess(1e-4 * np.sin(1e3 * positions(scene)).reshape(-1))

    def move(u: Values) -> None:
        """The obstacle goes where it then belongs."""
        balance.set_displacement(u)
        balance.eliminated.solve()

    move(u)
    K, x, y = balance.tangent.matrix, balance.work_vector.duplicate(), balance.work_vector.duplicate()
    balance.tangent.assemble()
    change, h = 1 + np.cos(np.arange(n)), 1e-8
    x.array_w[:] = change
    K.mult(x, y)
    ((U, C),) = balance.tangent.low_rank_updates
    found = y.array_r - U @ (C @ (U.T @ change))
    sides = []
    for sign in (1, -1):
        move(u + sign * h * change)
        sides.append((balance.update_forces().copy(), balance.energies.incremental_potential()[0]))
    slope = (sides[0][0] - sides[1][0]) / (2 * h)
    np.testing.assert_allclose(found, slope, atol=1e-5 * np.abs(slope).max())
    assert np.abs(U @ (C @ (U.T @ change))).max() > 0.01 * np.abs(slope).max()
    move(u)
    assert balance.update_forces() @ change == pytest.approx((sides[0][1] - sides[1][1]) / (2 * h), rel=1e-5)


@pytest.mark.parametrize(("dim", "scheme"), [(2, "newmark"), (3, "backward-euler")])
def test_a_free_ball_smaller_than_a_facet_is_felt_between_its_corners(dim: int, scheme: str) -> None:
    """Shot at the middle of a facet ten times its size: no place of it is ever inside the ball, by dense sampling; it
    comes back, with the momentum of both as it was, and the block has what it lost."""
    over = [0.33, 0.17] if dim == 3 else [0.22]
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0] * dim, "h": 0.5}, material=SOFT | {"poisson": 0.0}, solver=FINE,
        obstacle=[{"name": "it", "shape": "sphere", "radius": 0.05, "at": [*over, 1.08], "mass": 0.5,
                   "velocity": [*[0.3] * (dim - 1), -4.0]}],
        time={"scheme": scheme, "step": 4e-3, "end": 0.048},
    )  # fmt: skip
    assert scene.domain.input_mesh is not None
    top = scene.domain.input_mesh.facet_groups["top"]
    shares = np.stack(np.meshgrid(*[np.arange(31)] * dim, indexing="ij"), axis=-1).reshape(-1, dim) / 30
    shares = shares[abs(shares.sum(axis=1) - 1) < 1e-9]
    before, least, energy = momenta(scene, state)[0], np.inf, 0.5 * 0.5 * (16 + 0.09 * (dim - 1))
    for report in each_step(scene, state):
        u = scene.domain.input_numbering.gather_nodes(state.u.reshape(-1, dim))
        assert u is not None
        x, centre = (scene.domain.input_mesh.points + u)[top], contact_of(scene).free[0].motion.pose.centre
        least = min(least, np.linalg.norm(np.einsum("sc,kcd->ksd", shares, x) - centre, axis=2).min() - 0.05)
        assert np.linalg.norm(x - centre, axis=2).min() > 0.1  # no corner is near
        np.testing.assert_allclose(momenta(scene, state)[0], before, atol=1e-9 * 2)
        assert report.kinetic + report.elastic < energy * (1 + 1e-6)
    assert 0 < least < next(term for term in scene.balance.terms if isinstance(term, ObstacleTerm)).group.barrier_width
    moved = contact_of(scene).free[0].motion.momentum[dim - 1] / 0.5
    assert 0.1 < moved < 4.0


def test_a_light_ball_on_a_heavy_block_halves_no_step() -> None:
    """A ten-thousandth of the block's mass: potentials differ by less than their round-off, and steps stay whole."""
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.5], "h": 0.25}, material=SOFT | {"young": 1e4}, solver=FINE,
        obstacle=[ball(at=[0.55, 0.63], velocity=[0.0, -2.0], mass=5e-3)],
        time={"scheme": "backward-euler", "step": 5e-3, "end": 0.05},
    )  # fmt: skip
    before, _ = momenta(scene, state)
    march(scene, state)
    assert scene.stepper.failures.steps_failed == 0
    np.testing.assert_allclose(momenta(scene, state)[0], before, atol=1e-8 * 0.01)
    assert told(scene)["velocity_it_y"] > -0.6


# --- states, restarts, refusals -------------------------------------------------------------------------------------

STRUCK: dict[str, Any] = {
    "mesh": {"builder": "box", "size": [1.0, 0.3], "h": 0.1}, "material": SOFT, "solver": FINE,
    "obstacle": [ball(at=[0.45, 0.405], velocity=[0.5, -2.0], friction=0.3)],
    "time": {"scheme": "generalized-alpha", "step": 2e-3, "end": 0.03}, "output": {"picture": False},
}  # fmt: skip


def test_a_step_from_an_earlier_state_is_the_same_step() -> None:
    """Obstacles are part of the state: taken again from three steps before, all numbers are the same but for
    what the solver leaves."""
    scene, state = make_scene(**STRUCK)
    march(scene, state, 2)
    earlier = state.state
    march(scene, state, 3)
    first, velocity = told(scene), state.v
    state.state = earlier
    march(scene, state, 3)
    assert told(scene) == pytest.approx(first, rel=1e-7, abs=1e-9)
    np.testing.assert_allclose(state.v, velocity, atol=1e-8)
    assert first["contact_it_y"] != 0 and first["spin_it_z"] != 0


DOOR = ball(name="door", at=[3.0, 0.4], hinge={"point": [2.8, 0.4]}, spin=[2.0])
LIFT = ball(name="lift", at=[5.0, 0.5], guide="y", velocity=[0.0, 1.0])


@pytest.mark.parametrize("others", [[], [DOOR, LIFT]], ids=["alone", "beside a door and a lift"])
def test_a_restart_goes_on_as_the_run_would_have(others: list[dict[str, Any]], tmp_path: Path) -> None:
    """Stopped in the middle of the blow: the same columns of history.csv, but for what the solver leaves."""
    study = STRUCK | {"obstacle": [*STRUCK["obstacle"], *others]}
    going, _, again = going_stopped_resumed(study, tmp_path, 3, 2)
    assert told(again.scene) == pytest.approx(told(going.scene), rel=1e-9, abs=1e-9)
    assert again.state.dissipated == pytest.approx(going.state.dissipated, rel=1e-9)
    assert told(going.scene)["contact_it_y"] != 0


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"displacement": [0.0, 1.0]}, "driven by displacement and, with a mass, free"),
        ({"velocity": {"time": [0.0], "value": [[0.0, 1.0]]}}, "the one it starts with"),
        ({"density": 3.0}, "mass or density, not both"),
        ({"hollow": True}, "walls without thickness"),
        ({"shape": "plane", "normal": [0.0, 1.0], "radius": None}, "without end, so it cannot move freely"),
        ({"mass": None, "spin": [1.0]}, "spin is for an obstacle that moves freely"),
        ({"hinge": {"point": [0.0, 1.0]}, "guide": "y"}, "hinge or guide, not both"),
        ({"hinge": {"point": [0.0, 1.0]}, "velocity": [0.0, 1.0]}, "follows from the spin"),
        ({"guide": "y", "spin": [1.0]}, "does not turn"),
    ],
)
def test_what_makes_no_sense_is_refused(changes: dict[str, Any], words: str) -> None:
    entry = {key: value for key, value in (ball() | changes).items() if value is not None}
    with pytest.raises(ValidationError, match=words):
        make_study(obstacle=[entry])


def test_without_inertia_nothing_is_free() -> None:
    with pytest.raises(ValidationError, match=r"obstacle\.0 has a mass .* a quasi-static study has none"):
        make_study(obstacle=[ball()], time={"scheme": "quasi-static", "step": 0.1, "end": 1.0})


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"guide": "z"}, "a 2D mesh has no z"),
        ({"guide": "y", "velocity": [1.0, 0.0]}, "it moves along y alone"),
        ({"hinge": {"point": [0.0, 1.0], "axis": [0.0, 1.0]}}, "in 2D bodies turn in the plane"),
        ({"spin": [1.0, 2.0, 3.0]}, "needs 1 number"),
    ],
)
def test_what_does_not_fit_the_mesh_is_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        check_study(make_study(obstacle=[ball(at=[0.5, 1.2]) | changes]))


def test_a_free_obstacle_that_lies_in_another_is_refused() -> None:
    """A disk of 0.1 m with its centre 0.07 m above a floor; two disks 0.15 m apart. One just on a floor is not."""
    floor = {"name": "floor", "shape": "plane", "at": [0.0, -1.0], "normal": [0.0, 1.0]}
    for other, words in (
        (floor, r"obstacle\.1: it moves freely and overlaps floor at the start, by 0\.03 m"),
        (
            ball(name="other", at=[0.65, -0.93]),
            r"obstacle\.0: other moves freely and overlaps it .*, by 0\.05 m",
        ),
    ):
        with pytest.raises(InputError, match=words):
            make_scene(obstacle=[other, ball(at=[0.5, -0.93])])
    make_scene(obstacle=[floor, ball(at=[0.5, -0.9])])


def test_obstacles_that_have_run_into_one_another_are_told_of() -> None:
    """In explicit steps, cubes of 0.2 and 0.6 m, one put into the other: a note of the deepest frame."""
    scene, _ = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.3, 0.3], "h": 0.3}, material=SOFT,
        obstacle=[{"name": "it", "shape": "box", "size": [0.2] * 3, "at": [3.0, 0.5, 0.0], "mass": 1.0},
                  {"name": "other", "shape": "box", "size": [0.6] * 3, "at": [3.7, 0.5, 0.0]}],
        time={"scheme": "explicit", "step": 0.1, "end": 0.4},
    )  # fmt: skip
    (bodies,) = [term for term in scene.balance.terms if isinstance(term, VerletRigidObstacles)]
    monitor, motion = ObstacleOverlapMonitor(bodies), bodies.free[0].motion
    for t, way, notes in ((0.0, 0.0, 0), (0.1, 0.315, 0), (0.2, 0.4, 1), (0.3, 0.35, 1)):
        bodies.free[0].motion = replace(motion, pose=motion.pose.incremented(np.array([way, 0, 0, 0, 0, 0])))
        monitor.record_frame(t)
        assert len(monitor.notes()) == notes
    assert monitor.notes()[0].startswith(
        "it ran into other, by 0.1 m at t = 0.2 s: they met faster than explicit steps"
    )


def test_check_says_what_is_free() -> None:
    other = {"name": "other", "shape": "sphere", "radius": 0.1, "at": [0.5, 2.0], "density": 7e3, "guide": "y"}
    mesh = {"builder": "box", "size": [1.0, 0.3], "h": 0.1}
    lines = check_study(make_study(mesh=mesh, obstacle=[ball(), other]))
    assert not any("pass through" in line for line in lines)
    quick = make_study(mesh=mesh, obstacle=[ball(), other], time={"scheme": "explicit", "step": 1e-3, "end": 1.0})
    assert not any("pass through" in line for line in check_study(quick))
    assert "obstacles   it (free, 5 kg, sphere), other (free along y, 7000 kg/m^3, sphere)" in lines
