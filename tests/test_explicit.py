"""Explicit steps: the bound on the step, the order, and the same motion as implicit ones."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.linalg import eigh

from fracsim.forms.energies import lame
from fracsim.mechanics.stability_limit import SAFETY, stable_step
from fracsim.scene import Scene
from fracsim.timestepping import stable_time_step
from fracsim.timestepping.explicit import ExplicitStepper
from fracsim.timestepping.stable_time_step import cell_frequencies, damaged_frequencies
from fracsim.timestepping.state import State
from support.reference import lumped_mass, modes, stiffness
from support.scenes import make_scene, march

MESH = {"builder": "box", "size": [1.0, 0.5], "h": 0.25, "pattern": "unstructured"}
CLAMP = [{"on": "left", "fix": "xy"}]


def scene_of(scheme: str, step: float, end: float = 1e3, **tables: Any) -> tuple[Scene, State]:
    time = {"scheme": scheme, "step": step, "end": end}
    return make_scene(mesh=MESH, boundary=CLAMP, time=time, **tables)


@pytest.mark.parametrize("dim", (2, 3))
def test_no_body_is_faster_than_its_fastest_cell(dim: int) -> None:
    """The bound covers the largest frequency of the assembled body (dense), and is within 3 of it."""
    material = {"energy": "linear", "young": 1.0, "poisson": 0.3, "density": 1.0}
    mesh = {"builder": "box", "size": [1.0] * dim, "h": 0.4, "pattern": "unstructured"}
    scene, _ = make_scene(mesh=mesh, material=material, time={"scheme": "explicit", "step": 1.0, "end": 1.0})
    X, cells = scene.domain.nodes, scene.domain.cell_nodes
    squares = eigh(stiffness(X, cells, *lame(1.0, 0.3)), np.diag(lumped_mass(X, cells, 1.0)), eigvals_only=True)
    bound = np.sqrt(cell_frequencies(scene.balance.stress).max())
    assert np.sqrt(squares[-1]) <= bound <= 3 * np.sqrt(squares[-1])


def test_order_and_energy() -> None:
    """With half the step a mode is off by a quarter; over 1000 steps its energy swings by (w dt)^2, no more."""
    scene, _ = scene_of("explicit", 1.0)
    X, cells = scene.domain.nodes, scene.domain.cell_nodes
    free = np.setdiff1d(np.arange(X.size), scene.balance.motion.owned_dofs)
    flags = np.isin(np.arange(X.size), free)
    w, shapes = modes(stiffness(X, cells, *lame(1.0, 0.0)), lumped_mass(X, cells, 1.0), flags)
    errors = []
    for dt in (0.02, 0.01):
        scene, state = scene_of("explicit", dt)
        state.v = shapes[:, 1].copy()
        state.settle()
        march(scene, state, round(1.0 / dt))
        errors.append(np.abs(state.u - shapes[:, 1] * np.sin(w[1]) / w[1]).max())
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.05)
    reports = march(scene, state, 1000)
    energies = np.array([report.kinetic + report.elastic for report in reports])
    assert np.abs(energies - 0.5).max() < (w[1] * 0.01) ** 2


def test_the_step_is_cut_to_the_stable_one() -> None:
    """A study step of 1 s is far too long for cells of 0.25 m at 1 m/s; the run stays bounded and ends in time."""
    scene, state = scene_of("explicit", 1.0, end=5.0, initial={"velocity": [0.01, 0.0]})
    assert isinstance(scene.stepper, ExplicitStepper) and scene.solver is None
    reports = march(scene, state)
    assert state.t == pytest.approx(5.0, rel=1e-12)
    assert max(report.dt for report in reports) < 0.25
    assert max(report.kinetic + report.elastic for report in reports) < 1.1 * 0.5 * 0.5 * 0.01**2


@pytest.mark.parametrize("energy", ("linear", "neo-hookean", "corotated"))
def test_explicit_and_implicit_agree(energy: str) -> None:
    """Both are of second order: with the same small step the tip of a swinging strip is at the same place."""
    tips = []
    for scheme in ("explicit", "newmark"):
        material = {"energy": energy, "young": 1.0, "poisson": 0.3, "density": 1.0}
        scene, state = scene_of(
            scheme, 0.005, 1.0, material=material, load={"gravity": [0.0, -0.05]}, damping={"mass": 0.3}
        )
        march(scene, state)
        tips.append(state.u.copy())
    assert np.abs(tips[0]).max() > 0.01
    np.testing.assert_allclose(tips[0], tips[1], atol=2e-4 * np.abs(tips[0]).max())


def test_a_torn_body_goes_on() -> None:
    """Split cells drop out of the bound, energy stays bounded, and the pieces fly on: no NaN after everything broke."""
    scene, state = make_scene(
        mesh=MESH,
        boundary=[{"on": "left", "velocity": [-0.5, 0.0]}, {"on": "right", "velocity": [0.5, 0.0]}],
        fracture={"strength": 0.2},
        time={"scheme": "explicit", "step": 0.02, "end": 2.0},
    )
    reports = march(scene, state)
    assert sum(report.broken for report in reports) > 0
    assert np.isfinite(state.u).all() and np.isfinite(reports[-1].elastic)
    assert state.work >= state.dissipated


@pytest.mark.parametrize(("approach", "unilateral"), [("edge", False), ("edge", True), ("chi", True)])
def test_the_stable_step_follows_every_break(approach: str, unilateral: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each step is that of the damage it starts from, to the last bit; what edges do to it is worked out after breaks
    alone, though chi falls in other steps too."""
    scene, state = make_scene(
        mesh=MESH | {"h": 0.3},
        boundary=[{"on": "left", "velocity": [-0.5, 0.0]}, {"on": "right", "velocity": [0.5, 0.0]}],
        fracture={"strength": 0.2, "approach": approach, "unilateral": unilateral},
        time={"scheme": "explicit", "step": 1.0, "end": 100.0},
        output={"every": 100},  # no step is shortened for a frame
    )
    evaluate, evaluations = stable_time_step.edge_frequencies, []
    monkeypatch.setattr(stable_time_step, "edge_frequencies", lambda e: evaluations.append(e) or evaluate(e))
    broke, steps = 1, []
    for _ in range(80):
        stress = scene.balance.stress
        squares = damaged_frequencies(stress, cell_frequencies(stress), evaluate(stress))
        expected, before = SAFETY * stable_step(np.sqrt(squares.max()), 0.0, 0.0), len(evaluations)
        (report,) = march(scene, state, 1)
        assert report.dt == expected
        assert len(evaluations) - before == (broke > 0)
        broke = report.broken
        steps.append(report.dt)
    assert len(set(steps)) > 1 and 2 <= len(evaluations) < 80


def test_work_moves_the_grips_as_well() -> None:
    """A grip that starts at 0.3 m/s at once: work = elastic + kinetic, to the second order of the step."""
    gaps = []
    for dt in (0.01, 0.005):
        time = {"scheme": "explicit", "step": dt, "end": 1.0}
        boundary = [*CLAMP, {"on": "right", "velocity": [0.3, 0.0]}]
        scene, state = make_scene(mesh=MESH, boundary=boundary, time=time)
        last = march(scene, state)[-1]
        gaps.append(abs(state.work - last.elastic - last.kinetic) / state.work)
    assert gaps[1] < 2e-3
    assert gaps[1] < 0.6 * gaps[0]
