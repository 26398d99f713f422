"""Energy from nowhere is told, and only that."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from cases import STRIP, study
from fracsim.deformable_run import Run
from fracsim.forms.schemes import (
    BackwardEuler,
    GeneralizedAlpha,
    Newmark,
    Scheme,
    conserves_energy,
)
from fracsim.output.result_checks import EnergyBalanceMonitor, negligible_energy
from fracsim.output.summary import irregular_event_text
from fracsim.scene import build_scene
from support.scenes import deform, make_scene, make_study


def watched(rows: list[tuple[float, float, float, float]], *, at_rest: bool = True) -> EnergyBalanceMonitor:
    """A watch that has seen rows of (kinetic, elastic, dissipated, work), J."""
    watch = EnergyBalanceMonitor(at_rest=at_rest)
    for step, (kinetic, elastic, dissipated, work) in enumerate(rows, 1):
        report: Any = SimpleNamespace(kinetic=kinetic, elastic=elastic)
        state: Any = SimpleNamespace(t=0.1 * step, dissipated=dissipated, work=work)
        watch.record_step(report, state)
    return watch


def test_losses_of_damping_schemes_and_balance_are_not_told() -> None:
    assert watched([(1.0, 1.0, 0.0, 2.0), (0.5, 1.0, 0.3, 2.0), (0.2, 0.2, 0.3, 2.0)]).note("generalized-alpha") == ""
    assert watched([(3.0, 0.0, 0.0, 0.0), (2.9, 0.0, 0.1, 0.0)], at_rest=False).note("newmark", conserves=True) == ""


def test_a_loss_of_a_conserving_scheme_is_told() -> None:
    """2 J of work that is held, then 1 J of it gone; a scheme with numerical dissipation may have lost it."""
    watch = watched([(0.0, 2.0, 0.0, 2.0), (0.0, 1.0, 0.0, 2.0)])
    told = watch.note("quasi-static", conserves=True)
    assert told.startswith("1 J of the energy is neither stored nor dissipated, 50% of all")
    assert watch.note("backward-euler") == ""
    again = EnergyBalanceMonitor(at_rest=True)
    again.from_checkpoint(watch.to_checkpoint())
    assert again.note("newmark", conserves=True) == told
    balanced = watched([(0.0, 2.0, 0.0, 2.0), (0.0, 1.0, 1.0, 2.0)])
    assert balanced.note("quasi-static", conserves=True) == ""


@pytest.mark.parametrize(
    "scheme", [BackwardEuler(), Newmark(), Newmark(0.36, 0.7), GeneralizedAlpha(), GeneralizedAlpha(1.0)], ids=str
)
def test_schemes_that_conserve_energy(scheme: Scheme) -> None:
    """An oscillator u'' = -u keeps its energy in 200 long steps, or loses a tenth at least."""
    dt, u, v, a = 5.0, 1.0, 0.0, -1.0
    for _ in range(200):
        (c_a, _c_v), (u_a, _u_v) = scheme.rate_coefficients(dt), scheme.reference_displacements(dt, u, v, a)
        solution = c_a * u_a / (c_a + 1)
        u, v, a = scheme.complete_step(dt, solution, u, v, a)
    energy = u**2 + v**2
    assert energy == pytest.approx(1.0, abs=1e-9) if conserves_energy(scheme) else energy < 0.9


def test_a_gain_is_told_with_its_share() -> None:
    """2 J of work, then 3 J held: 1 J from nowhere, a third of what is at play; even after a loss of 1 J before."""
    watch = watched([(1.0, 1.0, 0.0, 2.0), (1.0, 2.0, 0.0, 2.0)])
    assert watch.note("newmark").startswith("the body gained 1 J of energy from nowhere (100% of it")
    assert "in the step to t = 0.2 s), 33% of all" in watch.note("newmark")
    assert watched([(1.0, 0.0, 0.0, 2.0), (2.0, 0.0, 0.0, 2.0)]).rise == pytest.approx(1.0)


def test_the_step_that_gained_most_is_named() -> None:
    """0.1 J a step of work that is held, then 4 J in the fifth step: what the energy of a torn bar without crumbs
    does. Where every step gains as much, no step is named. A restart goes on with what was."""
    held = [(0.1 * n, 0.0, 0.0, 0.1 * n) for n in range(1, 5)]
    told = "gained 4 J of energy from nowhere (100% of it in the step to t = 0.5 s), 89% of all"
    assert told in watched([*held, (4.5, 0.0, 0.0, 0.5)]).note("generalized-alpha")
    assert "gained 4 J of energy from nowhere, " in watched([(n, 0.0, 0.0, 0.0) for n in range(1, 5)]).note("newmark")
    first, again = watched(held), EnergyBalanceMonitor(at_rest=True)
    again.from_checkpoint(first.to_checkpoint())
    last: Any = SimpleNamespace(kinetic=4.5, elastic=0.0), SimpleNamespace(t=0.5, dissipated=0.0, work=0.5)
    again.record_step(*last)
    assert told in again.note("generalized-alpha")


def test_a_note_does_not_advise_what_is_so_already() -> None:
    """Backward Euler is named to those who do not use it, and only where there is inertia."""
    watch = watched([(1.0, 1.0, 0.0, 2.0), (1.0, 2.0, 0.0, 2.0)])
    for scheme in ("explicit", "newmark", "generalized-alpha"):
        assert 'try time.scheme = "backward-euler", or a shorter time.step' in watch.note(scheme)
    for scheme in ("backward-euler", "quasi-static"):
        assert watch.note(scheme).endswith("try a shorter time.step")


def test_round_off_is_not_told() -> None:
    """A steel block that lies there: 4e-14 J are of strains of 1e-12, and no gain."""
    scene, _ = make_scene(material={"energy": "linear", "young": 2e11, "poisson": 0.3, "density": 7800.0})
    watch = EnergyBalanceMonitor(at_rest=True, floor=negligible_energy(scene.balance.stress))
    assert watch.floor == pytest.approx(2e11 * 1.0 * 9e-16)
    watch.record_step(SimpleNamespace(kinetic=4e-14, elastic=0.0), SimpleNamespace(t=0.1, dissipated=0.0, work=0.0))  # type: ignore[arg-type]
    assert watch.rise == 4e-14 and watch.note("newmark") == ""


def test_what_a_run_went_on_in_spite_of_is_one_sentence() -> None:
    """Counts of what happened, none of what did not; a halved step that was taken in the end is no trouble."""
    assert irregular_event_text({"steps_failed": 7, "linear_failures": 0}) == ""
    words = irregular_event_text(
        {"steps_failed": 7, "unbalanced_steps": 2, "linear_failures": 0, "cells_not_finite": 5}
    )
    assert words.startswith("the run went on in spite of 2 steps that ended out of balance")
    assert "in spite of 1 step that ended" in irregular_event_text({"unbalanced_steps": 1})
    assert "; 5 cells crushed flat" in words and "linear" not in words


@pytest.mark.parametrize(
    ("energy", "method", "is_told"),
    [("neo-hookean", "ksponly", True), ("neo-hookean", "newtonls", False), ("linear", "ksponly", False)],
)
def test_a_balance_that_was_not_tested_is_told(energy: str, method: str, is_told: bool, tmp_path: Path) -> None:
    """One linear solve a step is a solution of a linear balance alone."""
    study = make_study(
        mesh={"builder": "box", "size": [1.0, 1.0], "h": 0.5},
        material={"energy": energy, "young": 1.0, "poisson": 0.3, "density": 1.0},
        time={"step": 0.1, "end": 0.1},
        solver={"snes_type": method},
    )
    scene = build_scene(MPI.COMM_SELF, study)
    monitors = Run(scene, tmp_path / "run").monitors
    assert any("was not tested" in note for note in monitors.notes(done=True)) == is_told


def test_a_resolve_that_fails_after_a_break_is_counted() -> None:
    """The weakened body has no solution: the last one stands, and the step is counted as out of balance."""
    scene, walk = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.5], "h": 0.125},
        boundary=[{"on": "left", "fix": "xy"}, {"on": "right", "velocity": [0.05, 0.0]}],
        fracture={"strength": 0.02, "passes": 3},
    )
    stepper: Any = scene.stepper
    solve = stepper.solver.solve
    while not scene.fracture.graph.broken.any():
        calls = [0]

        def once(guess: Any, calls: list[int] = calls) -> Any:
            calls[0] += 1
            result = solve(guess)
            return (
                result
                if calls[0] == 1
                else type(result)(False, result.newton_iterations, result.krylov_iterations, "no")
            )

        stepper.solver.solve = once
        walk.advance()
    assert stepper.failure_counts()["unbalanced_steps"] == 1 and stepper.failure_counts()["steps_failed"] == 0


def test_stress_that_is_no_number_is_counted() -> None:
    """A body crushed flat has J = 0 in all of its cells."""
    scene, walk = make_scene(
        mesh={"builder": "box", "size": [1.0, 1.0], "h": 0.5},
        material={"energy": "neo-hookean", "young": 1.0, "poisson": 0.3, "density": 1.0},
        fracture={"strength": 1.0},
    )
    deform(scene, np.diag([1.0, 0.0]))
    scene.fracture()
    assert scene.stepper.failure_counts()["cells_not_finite"] == scene.domain.cell_count
    assert walk.t == 0


@pytest.mark.parametrize(
    ("scheme", "step", "told"),
    [("generalized-alpha", 0.01, True), ("generalized-alpha", 1e-3, False), ("newmark", 0.01, False)],
)
@pytest.mark.parametrize("order", [1, 2])
def test_stress_from_rotation_in_a_step_is_told(
    order: int, scheme: str, step: float, told: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A bar that spins at w = 10 rad/s: rho w^2 L^2 / 8 is a tenth of its strength. With rho = 0.8 steps of 0.1 rad add
    E (20/81) 0.1^2 / 2 = 3.1 of it."""
    spinning = study(
        STRIP, mesh={"size": [0.4, 0.1], "h": 0.05, "order": order}, boundary=[], probe=[], initial={"spin": [10.0]},
        material={"young": 5e7, "poisson": 0.0}, fracture={"strength": 2e4},
        time={"scheme": scheme, "step": step, "end": 0.02}, output={"every": 1, "picture": False, "surface": False},
    )  # fmt: skip
    Run(build_scene(MPI.COMM_SELF, spinning), tmp_path)()
    heard = capsys.readouterr().err
    assert ("cells rotated by 0.1 rad in the step to t = 0.01 s" in heard) == told
    assert ("a stress of 3.1 of the strength" in heard) == told


@pytest.mark.parametrize(("step", "told"), ((0.01, True), (5e-3, False)))
def test_strain_from_rotation_is_told_without_fracture(
    step: float, told: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With rho = 0.8 steps of 0.1 rad add a strain of (20/81) 0.1^2 / 2 = 0.0012, of 0.05 rad a quarter of that."""
    spinning = make_study(
        mesh={"builder": "box", "size": [0.4, 0.1], "h": 0.05}, initial={"spin": [10.0]},
        material={"energy": "neo-hookean", "young": 5e7, "poisson": 0.0, "density": 1000.0},
        time={"scheme": "generalized-alpha", "step": step, "end": 0.02}, output={"picture": False},
    )  # fmt: skip
    Run(build_scene(MPI.COMM_SELF, spinning), tmp_path)()
    assert ("a strain of 0.0012; try" in capsys.readouterr().err) == told
