"""The whole stepper on a small body: modes of the discrete system move as oscillators, energies are accounted for."""

from __future__ import annotations

import json
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from fracsim.deformable_run import run_study
from fracsim.forms.schemes import BackwardEuler, Newmark
from fracsim.output.step_size_checks import MissedPeakMonitor
from fracsim.scene import Scene, make_scheme
from fracsim.study.conditions import tabulated_conditions
from fracsim.timestepping.state import State
from support.oscillator import exact, run, slopes
from support.reference import lumped_mass, modes, stiffness
from support.scenes import DIRECT, Values, each_step, make_scene, make_study, march, positions

EPS = np.finfo(float).eps
MATERIAL = {"energy": "linear", "young": 2.0, "poisson": 0.3, "density": 3.0}
MU, LAMBDA = 2.0 / 2.6, 2.0 * 0.3 / (1.3 * 0.4)
MESH = {"builder": "box", "size": [1.0, 0.5], "h": 0.25}
CLAMP = [{"on": "left", "fix": "xy"}]
SCHEMES = {"backward-euler": 1, "newmark": 2, "generalized-alpha": 2}
# Newton on a linear body leaves rounding errors only: 1e-13 of the forces a step
SOLVED = 1e-10


@dataclass
class Vibration:
    """A body started in one of its modes."""

    scene: Scene
    state: State
    w: float
    shape: Values

    def amplitude(self) -> float:
        """Modal coordinate phi . M u."""
        return float(self.shape @ (self.scene.balance.mass.lumped * self.state.u))


def discrete_modes(boundary: list[dict[str, Any]]) -> tuple[Values, Values]:
    """Frequencies and shapes of the dense matrices, held dofs left out."""
    scene, _ = make_scene(mesh=MESH, material=MATERIAL, boundary=boundary)
    X, cells = positions(scene), scene.domain.cell_nodes
    free = np.ones(X.size, bool)
    free[scene.balance.motion.owned_dofs] = False
    return modes(stiffness(X, cells, MU, LAMBDA), lumped_mass(X, cells, 3.0), free)


def vibrate(scheme: str, steps: int, periods: float = 1.0, number: int = 0, **tables: Any) -> Vibration:
    """A clamped body with unit modal velocity in mode `number`, to be moved by `steps` steps."""
    w, shapes = discrete_modes(CLAMP)
    end = periods * 2 * np.pi / w[number]
    scene, state = make_scene(
        mesh=MESH,
        material=MATERIAL,
        boundary=CLAMP,
        time={"scheme": scheme, "step": end / steps, "end": end},
        **tables,
    )
    state.v = shapes[:, number].copy()
    state.settle()
    return Vibration(scene, state, float(w[number]), shapes[:, number])


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("number", (0, 3))
def test_a_mode_moves_as_an_oscillator(scheme: str, number: int) -> None:
    """Step by step the modal coordinate is that of the scheme's own recursion, and the other modes stay at rest."""
    steps = 25
    body = vibrate(scheme, steps, number=number)
    rows = run(make_scheme(body.scene.study.time), body.w, body.scene.study.time.step, steps, (0.0, 1.0))
    for expected in rows[1:]:
        march(body.scene, body.state, 1)
        np.testing.assert_allclose(body.state.u, expected[0] * body.shape, atol=SOLVED)
        np.testing.assert_allclose(body.state.v, expected[1] * body.shape, atol=SOLVED * body.w)


@pytest.mark.parametrize(("scheme", "order"), SCHEMES.items())
def test_order_of_the_stepper(scheme: str, order: int) -> None:
    """The error against the exact motion of the mode falls with the order of the scheme."""
    errors = []
    for steps in (40, 80):
        body = vibrate(scheme, steps, periods=0.6)
        march(body.scene, body.state)
        errors.append(abs(body.amplitude() - float(exact(body.w, body.state.t, (0.0, 1.0)))))
    np.testing.assert_allclose(slopes(errors)[-1], order, atol=0.1)


@pytest.mark.parametrize(
    ("damping", "number"),
    (({"mass": 0.2}, 0), ({"stiffness": 0.1}, 0), ({"mass": 0.1, "stiffness": 0.05}, 1)),
    ids=("mass", "stiffness", "both"),
)
def test_rayleigh_damping_of_a_mode(damping: dict[str, float], number: int) -> None:
    """zeta = a / (2 w) + b w / 2: the mode decays like exp(-zeta w t), the error being that of the trapezoidal rule.

    Its frequency error is (w dt)^2 / 12, so that after a phase w t the motion is off by w t (w dt)^2 / 12 at most.
    """
    steps, periods = 200, 2.0
    body = vibrate("newmark", steps, periods, number, damping=damping)
    zeta = damping.get("mass", 0.0) / (2 * body.w) + damping.get("stiffness", 0.0) * body.w / 2
    assert 0.02 < zeta < 0.5
    phase = body.w * body.scene.study.time.step
    for _ in range(10):
        march(body.scene, body.state, steps // 10)
        tolerance = body.w * body.state.t * phase**2 / 12 / body.w
        assert body.amplitude() == pytest.approx(
            float(exact(body.w, body.state.t, (0.0, 1.0), zeta)), abs=2 * tolerance
        )


@pytest.mark.parametrize("damping", ({"mass": 0.2}, {"stiffness": 0.1}), ids=("mass", "stiffness"))
@pytest.mark.parametrize("scheme", SCHEMES)
def test_damped_modes_follow_the_recursion(scheme: str, damping: dict[str, float]) -> None:
    """With damping too every step is that of the scheme, started from the acceleration -w^2 u - (a + b w^2) v."""
    steps = 10
    body = vibrate(scheme, steps, number=1, damping=damping)
    a, b = damping.get("mass", 0.0), damping.get("stiffness", 0.0)
    timing = body.scene.study.time
    rows = run(make_scheme(timing), body.w, timing.step, steps, (0.0, 1.0), a, b)
    for expected in rows[1:]:
        march(body.scene, body.state, 1)
        assert body.amplitude() == pytest.approx(expected[0], abs=SOLVED)


def test_trapezoidal_rule_conserves_energy() -> None:
    """Free vibration of a linear body: kinetic + elastic is constant over 300 steps of a mixed motion."""
    w, shapes = discrete_modes(CLAMP)
    scene, state = make_scene(
        mesh=MESH, material=MATERIAL, boundary=CLAMP, time={"scheme": "newmark", "step": 1 / w[0], "end": 300 / w[0]}
    )
    state.v = shapes.sum(axis=1)
    start = 0.5 * len(w)  # each mode has 1/2
    totals = [report.kinetic + report.elastic for report in march(scene, state)]
    np.testing.assert_allclose(totals, start, rtol=SOLVED)


def test_backward_euler_loses_energy_monotonically() -> None:
    """Every mode loses 1 / (1 + w^2 dt^2) a step, so the sum of all falls in every step."""
    w, shapes = discrete_modes(CLAMP)
    dt = 0.1 / w[0]
    scene, state = make_scene(
        mesh=MESH, material=MATERIAL, boundary=CLAMP, time={"scheme": "backward-euler", "step": dt, "end": 50 * dt}
    )
    state.v = shapes.sum(axis=1)
    totals = np.array([report.kinetic + report.elastic for report in march(scene, state)])
    expected = [0.5 * np.sum((1 + (w * dt) ** 2) ** -float(n)) for n in range(1, 51)]
    np.testing.assert_allclose(totals, expected, rtol=SOLVED)
    assert np.all(np.diff(totals) < 0)


LOADED: dict[str, dict[str, Any]] = {
    "traction": {
        "boundary": [*CLAMP, {"on": "right", "traction": {"time": [0.0, 2.0], "value": [[0.0, 0.0], [0.1, 0.05]]}}]
    },
    "gravity": {"boundary": CLAMP, "load": {"gravity": [0.0, -0.1]}},
    "pulled": {"boundary": [*CLAMP, {"on": "right", "velocity": [0.1, 0.0]}]},
    "damped": {
        "boundary": [*CLAMP, {"on": "right", "velocity": [0.1, 0.0]}],
        "damping": {"mass": 0.3, "stiffness": 0.05},
    },
    "spinning": {"boundary": [], "initial": {"velocity": [0.2, 0.1], "spin": [0.1]}, "damping": {"mass": 0.3}},
}


@pytest.mark.parametrize("case", LOADED.values(), ids=LOADED)
def test_work_is_energy_plus_dissipation(case: dict[str, Any]) -> None:
    """Trapezoidal rule and work by trapezia: work = change of energy + viscous loss, identically for a linear body.

    d(1/2 v M v) = du . M (a0 + a1) / 2, d(elastic) = du . (f0 + f1) / 2, and M a + f + drag = load at both ends.
    """
    scene, state = make_scene(mesh=MESH, material=MATERIAL, time={"scheme": "newmark", "step": 0.1, "end": 4.0}, **case)
    start = scene.balance.energies.kinetic_energy(state.v)
    for report in each_step(scene, state):
        balance = start + state.work - report.kinetic - report.elastic - state.dissipated
        assert balance == pytest.approx(0, abs=SOLVED)
    assert (state.dissipated > 0) == ("damping" in case)


def test_energy_balance_of_finite_strain_is_second_order() -> None:
    """For a nonlinear energy the trapezoidal work is not exact: the gap falls with dt^2."""
    gaps = []
    for steps in (20, 40, 80):
        scene, state = make_scene(
            mesh=MESH,
            material=MATERIAL | {"energy": "neo-hookean"},
            boundary=[*CLAMP, {"on": "right", "traction": [0.3, 0.2]}],
            time={"scheme": "newmark", "step": 1.0 / steps, "end": 1.0},
        )
        report = march(scene, state)[-1]
        gaps.append(abs(state.work - report.kinetic - report.elastic))
    assert slopes(gaps)[-1] == pytest.approx(2, abs=0.3)
    assert gaps[-1] < 1e-3 * state.work


def test_work_is_that_of_the_forces_in_balance() -> None:
    """A nearly incompressible bar pulled at once in steps of 100 times what a pressure wave takes through a cell.

    Where generalized-alpha balances forces, between 69 kPa of pressure and 191 kPa of tension; at the end of the first
    step, extrapolated, J is off by |grad du|^2 and the pressure 779 kPa. Work of the reactions there is -8 J where the
    body holds 30 J. What is left is the scheme's own loss.
    """
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.25, 0.25], "h": 0.125},
        material={"energy": "neo-hookean", "young": 1e6, "poisson": 0.4999, "density": 1e3},
        boundary=[{"on": "left", "fix": "xyz"}, {"on": "right", "velocity": [1.0, 0.0, 0.0]}],
        time={"scheme": "generalized-alpha", "step": 1e-2, "end": 0.1},
    )
    for report in each_step(scene, state):
        assert report.kinetic + report.elastic == pytest.approx(state.work, rel=0.04)


@pytest.mark.parametrize("scheme", ("backward-euler", "newmark", "quasi-static"))
def test_prescribed_motion_is_met_exactly(scheme: str) -> None:
    """Held nodes are at their tabulated place at the end of every step."""
    table = {"time": [0.0, 0.25, 1.0], "value": [[0.0, "free"], [0.02, "free"], [-0.01, "free"]]}
    scene, state = make_scene(
        mesh=MESH,
        material=MATERIAL,
        boundary=[*CLAMP, {"on": "right", "displacement": table}],
        time={"scheme": scheme, "step": 0.1, "end": 1.0},
    )
    right = np.isclose(positions(scene)[:, 0], 1.0)
    for _ in range(10):
        march(scene, state, 1)
        u = state.u.reshape(-1, 2)[right]
        np.testing.assert_array_equal(u[:, 0], np.interp(state.t, table["time"], [row[0] for row in table["value"]]))
        assert np.any(u[:, 1] != 0)  # Poisson's contraction: y is free


def test_gravity_on_a_free_body_is_free_fall() -> None:
    """u = g t^2 / 2 for every node, by the trapezoidal rule exactly; backward Euler is at g t (t + dt) / 2."""
    for scheme, late in (("newmark", 0.0), ("backward-euler", 0.1)):
        scene, state = make_scene(
            mesh=MESH,
            material=MATERIAL,
            load={"gravity": [0.0, -9.81]},
            time={"scheme": scheme, "step": 0.1, "end": 1.0},
        )
        march(scene, state)
        expected = np.tile([0.0, -9.81 * (1.0 + late) / 2], len(positions(scene)))
        np.testing.assert_allclose(state.u, expected, atol=SOLVED)


@pytest.mark.parametrize("scheme", ("newmark", "generalized-alpha", "backward-euler"))
def test_damping_does_not_hold_a_rigid_spin_back(scheme: str) -> None:
    """Stiffness damping of a nonlinear body sees strain rates only: a rigidly turning body loses nothing to it.

    The strain rate is taken with a predicted F. With F of the start of the step 1 to 4 % were lost in 100 steps.
    """
    losses, stiff = [], 2e5
    for steps in (25, 50, 100):
        scene, state = make_scene(
            mesh=MESH,
            material=MATERIAL | {"energy": "neo-hookean", "young": stiff},
            initial={"spin": [1.0]},
            damping={"stiffness": 1e-4},
            time={"scheme": scheme, "step": 1.0 / steps, "end": 1.0},
        )
        kinetic = scene.balance.energies.kinetic_energy(state.v)
        march(scene, state)
        losses.append(abs(state.dissipated) / kinetic)
    assert losses[-1] < 1e-4 and min(slopes(losses)) > 2.5


def test_step_halving_reaches_the_same_end() -> None:
    """Where a step is refused it is halved, and the run still ends exactly at `end`."""
    scene, state = make_scene(
        mesh=MESH,
        material=MATERIAL | {"energy": "neo-hookean"},
        boundary=[*CLAMP, {"on": "right", "displacement": {"time": [0.0, 1.0], "value": [[0.0, 0.0], [1.5, 0.8]]}}],
        time={"scheme": "quasi-static", "step": 1.0, "end": 1.0},
        solver=DIRECT | {"snes_max_it": 3, "snes_rtol": 1e-8},
    )
    reports = march(scene, state)
    assert len(reports) > 1
    assert state.t == pytest.approx(1.0, rel=10 * EPS)
    assert sum(report.dt for report in reports) == pytest.approx(1.0, rel=10 * EPS)


def test_make_scheme_passes_the_parameters() -> None:
    """[time] beta and gamma reach the scheme."""
    scene, _ = make_scene(time={"scheme": "newmark", "step": 0.1, "end": 1.0, "beta": 0.3025, "gamma": 0.6})
    assert make_scheme(scene.study.time) == Newmark(0.3025, 0.6)
    assert make_scheme(scene.study.time.model_copy(update={"scheme": "backward-euler"})) == BackwardEuler()


@pytest.mark.parametrize("scheme", ("backward-euler", "newmark", "generalized-alpha", "explicit"))
def test_a_grip_that_starts_at_once_moves_as_it_is_told(scheme: str) -> None:
    """A strip whose end is driven at 0.3 m/s from the first step on: that end has this velocity in every step, and
    work = elastic + kinetic to first order of the step, but for what backward Euler damps."""
    gaps = []
    for dt in (0.02, 0.01):
        scene, state = make_scene(
            mesh={"builder": "box", "size": [1.0, 0.5], "h": 0.25},
            boundary=[{"on": "left", "fix": "xy"}, {"on": "right", "velocity": [0.3, 0.0]}],
            time={"scheme": scheme, "step": dt, "end": 1.0},
        )
        grip = scene.domain.nodes[: scene.domain.node_count, 0] > 1 - 1e-9
        for report in each_step(scene, state):
            np.testing.assert_allclose(state.v.reshape(-1, 2)[grip], [[0.3, 0.0]] * grip.sum(), atol=1e-12)
            gap = abs(state.work - report.elastic - report.kinetic) / state.work
        gaps.append(gap)
    assert gaps[1] < 0.6 * gaps[0] or gaps[1] < 1e-9
    assert gaps[1] < (0.2 if scheme == "backward-euler" else 5e-3)


# --- peaks of tables within a step ---


def missed(entry: dict[str, Any], ends: list[float]) -> MissedPeakMonitor:
    """A monitor that has recorded steps with these ends, of a study with an entry of [[boundary]] on the right."""
    study = make_study(boundary=[*CLAMP, {"on": "right"} | entry])
    monitor = MissedPeakMonitor(tabulated_conditions(study, 2), 1.0)
    for before, t in pairwise([0.0, *ends]):
        monitor.record_step(t, t - before)
    return monitor


PULSE = {"time": [0.4, 0.45, 0.5], "value": [0.0, 2.0, 0.0]}


def test_a_pulse_within_a_step_is_told() -> None:
    """By 2 Pa of pressure of 2 Pa; where a step ends on the flank, at 1.2 Pa, by 0.8 Pa."""
    monitor = missed({"pressure": PULSE}, [0.2, 0.4, 0.6, 0.8, 1.0])
    (note,) = monitor.notes()
    assert note.startswith(
        "boundary.1.pressure has a peak at t = 0.45 s within a step of 0.2 s, and 100% of its largest"
    )
    again = missed({"pressure": PULSE}, [])
    again.from_checkpoint(json.loads(json.dumps(monitor.to_checkpoint())))
    assert again.notes() == [note]
    assert "and 40% of its largest" in missed({"pressure": PULSE}, [0.2, 0.43, 0.6]).notes()[0]
    there_and_back = {"time": [0.4, 0.5, 0.6], "value": [["free", 0.0], ["free", -1.0], ["free", 0.0]]}
    assert missed({"displacement": there_and_back}, [0.4, 0.6]).notes()


def test_what_steps_see_is_not_told() -> None:
    """A pulse whose peak is the end of a step, a jump within a step, and a pulse of velocity, whose way is exact."""
    assert missed({"pressure": PULSE}, [0.2, 0.45, 0.7]).notes() == []
    jump = {"time": [0.0, 0.5, 0.51], "value": [0.0, 0.0, 2.0]}
    assert missed({"pressure": jump}, [0.3, 0.6, 1.0]).notes() == []
    blow = {"time": [0.4, 0.45, 0.5], "value": [[0.0, 0.0], [2.0, 0.0], [0.0, 0.0]]}
    assert missed({"velocity": blow}, [0.2, 0.6]).notes() == []


def test_a_run_tells_of_a_pulse_that_no_step_saw(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    study = make_study(
        boundary=[*CLAMP, {"on": "right", "pressure": PULSE}],
        time={"scheme": "quasi-static", "step": 0.2, "end": 1.0},
        output={"picture": False},
    )
    run_study(MPI.COMM_WORLD, study, tmp_path / "out")
    assert "boundary.1.pressure has a peak at t = 0.45 s within a step of 0.2 s" in capfd.readouterr().err
