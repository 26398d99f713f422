"""The group `precision` of the evidence: closed forms against what they solve, trials, measurements, sections."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from mpi4py import MPI
from scipy.integrate import quad
from scipy.linalg import eigh

from fracsim.deformable_run import run_study
from fracsim.studies.evidence import closed_forms, precision
from fracsim.studies.evidence.precision import (
    accuracy_summary,
    averaging_error,
    bar_fracture,
    bar_wave,
    brazilian_disk,
    case_section,
    finite_strain,
    linear_statics,
    plastic_bar,
    vibrating_beam,
)
from fracsim.studies.evidence.report_section import Plot, PlotGrid, Section
from fracsim.studies.evidence.trial import Trial
from fracsim.study.check import check_study
from fracsim.study.reader import validate

Values = npt.NDArray[np.float64]
TRIALS = precision.trials()


# --- closed forms ---


def test_timoshenko_beam_against_beam_elements() -> None:
    """Deflection and first frequency against a beam of 200 cells, linear in y and psi, shear integrated at the middle.

    int E I psi'^2 + kappa G A (y' - psi)^2 and mass rho A y^2 + rho I psi^2, lumped at the nodes: error (1/200)^2.
    """
    n, L, d, E, nu, rho = 200, 1.0, 0.1, 210e9, 0.3, 7850.0
    area, inertia, dx = d**2, d**4 / 12, 1.0 / n
    shear = 10 * (1 + nu) / (12 + 11 * nu) * E / (2 * (1 + nu)) * area
    K, m = np.zeros((2 * n + 2, 2 * n + 2)), np.zeros(2 * n + 2)
    bend, slide = np.array([0, -1, 0, 1]) / dx, np.array([-1 / dx, -0.5, 1 / dx, -0.5])
    for i in range(n):
        dofs = slice(2 * i, 2 * i + 4)
        K[dofs, dofs] += dx * (E * inertia * np.outer(bend, bend) + shear * np.outer(slide, slide))
        m[dofs] += rho * dx / 2 * np.array([area, inertia, area, inertia])
    K, m = K[2:, 2:], m[2:]
    force = np.zeros(2 * n)
    force[-2] = 1000.0
    tip = np.linalg.solve(K, force)[-2]
    assert closed_forms.timoshenko_deflection(1000.0, L, d, d, E, nu) == pytest.approx(tip, rel=1e-4)
    omega = np.sqrt(eigh(K, np.diag(m), subset_by_index=[0, 0], eigvals_only=True)[0])
    assert closed_forms.timoshenko_frequency(L, d, E, nu, rho) == pytest.approx(omega / (2 * np.pi), rel=1e-4)


def test_euler_beam_is_the_slender_limit() -> None:
    """Shear and rotary inertia take away a share of the order (depth / length)^2."""
    euler, thick = (
        closed_forms.euler_frequency(1.0, 0.01, 1e9, 1000.0),
        closed_forms.timoshenko_frequency(1.0, 0.01, 1e9, 0.3, 1000.0),
    )
    assert 0 < 1 - thick / euler < 0.01**2 * 2
    assert closed_forms.euler_frequency(1.0, 0.1, 210e9, 7850.0) == pytest.approx(83.6, abs=0.1)  # BENCHMARKS.md


def test_bar_wave_solves_the_wave_equation() -> None:
    """u_tt = u_xx and u_t = v by central differences of step e (error e^2 times fourth derivatives, (8 pi / 0.6)^4 e^2
    at most); the end is pulled by u_x = p(t)."""
    x, t, e = np.linspace(0.3, 1.0, 57), 0.7, 1e-3
    u = lambda x, t: closed_forms.bar_displacement(x, t, 0.6)  # noqa: E731
    second = (u(x, t + e) - 2 * u(x, t) + u(x, t - e)) - (u(x + e, t) - 2 * u(x, t) + u(x - e, t))
    np.testing.assert_allclose(second / e**2, 0, atol=1e-6)
    rate = (u(x, t + e) - u(x, t - e)) / (2 * e)
    bound = e**2 / 6 * (4 * np.pi / 0.6) ** 2
    np.testing.assert_allclose(rate, closed_forms.bar_velocity(x, t, 0.6), atol=bound)
    for now in (0.1, 0.3, 0.5):
        slope = float((u(np.array(1 + e), now) - u(np.array(1 - e), now)) / (2 * e))
        assert slope == pytest.approx(float(closed_forms.pulse(np.array(now), 0.6)), abs=bound)


def test_stress_at_the_clamp_against_modes() -> None:
    """Body force b(t): modes sin(w x), w = (n - 1/2) pi, load 2 b / w, stress at 0 the sum of w q(t).

    For b = t the oscillators q'' + w^2 q = 2 t / w have q = 2 (t - sin(w t) / w) / w^3; the series is cut at 4000
    terms, whose tail is below sum 2 t / w^2 = 2 t / (pi^2 4000).
    """
    t = np.linspace(0.0, 7.0, 70001)
    found = closed_forms.clamp_stress(t, t)
    w = (np.arange(1, 4001) - 0.5) * np.pi
    for now in (0.5, 1.9, 3.3, 5.0, 6.7):
        series = float((2 * (now - np.sin(w * now) / w) / w**2).sum())
        assert np.interp(now, t, found) == pytest.approx(series, abs=2 * now / (np.pi**2 * 4000) + 1e-6)


def energy_density(energy: str, F: Values, young: float, poisson: float) -> float:
    """psi of docs/theory.md#elastic-energies, without constants."""
    mu, lmbda = closed_forms.lame(young, poisson)
    if energy == "stvk":
        E = (F.T @ F - np.eye(3)) / 2
        return float(mu * np.sum(E * E) + lmbda / 2 * np.trace(E) ** 2)
    m, volumetric = 4 / 3 * mu, lmbda + 5 / 6 * mu
    alpha = 1 + m / volumetric - m / (4 * volumetric)
    trace = np.sum(F * F)
    return float(m / 2 * (trace - 3) + volumetric / 2 * (np.linalg.det(F) - alpha) ** 2 - m / 2 * np.log(trace + 1))


@pytest.mark.parametrize("energy", closed_forms.STRESSES)
def test_stresses_are_derivatives_of_energies(energy: str) -> None:
    """Central differences of psi with step e: error e^2, round-off eps / e."""
    F, e = np.array([[1.2, 0.3, 0.0], [-0.1, 0.9, 0.2], [0.05, 0.0, 1.1]]), 1e-5
    found = closed_forms.STRESSES[energy](F, 1.0, 0.3)
    for i, j in np.ndindex(3, 3):
        step = np.zeros((3, 3))
        step[i, j] = e
        difference = energy_density(energy, F + step, 1.0, 0.3) - energy_density(energy, F - step, 1.0, 0.3)
        assert difference / (2 * e) == pytest.approx(found[i, j], abs=1e-9)
    np.testing.assert_allclose(closed_forms.STRESSES[energy](np.eye(3), 1.0, 0.3), 0, atol=1e-15)


def test_disk_is_free_between_its_platens_and_in_balance() -> None:
    """Traction on the rim: none outside the arcs, the pressure inside. Across a diameter: the pressure's resultant on
    one side of it, 2 p R sin a downwards and 2 p R (1 - cos a) sideways."""
    R, a, p = 2.0, np.radians(7.5), 3.0
    angle = np.radians([0.0, 20.0, 50.0, 75.0, 86.0, 88.5])
    n = np.column_stack([np.cos(angle), np.sin(angle)])
    s = closed_forms.disk_stress(*(0.998 * R * n.T), R, a, p, points=1000)
    radial = s[:, 0] * n[:, 0] ** 2 + s[:, 1] * n[:, 1] ** 2 + 2 * s[:, 2] * n[:, 0] * n[:, 1]
    np.testing.assert_allclose(radial, [0, 0, 0, 0, -p, -p], atol=0.01 * p)

    def across(x: float) -> float:
        return float(closed_forms.disk_stress(np.array([x]), np.zeros(1), R, a, p)[0, 1])

    def along(y: float) -> float:
        return float(closed_forms.hondros(np.array(y), R, a, p)[0])

    assert 2 * quad(across, 0, R)[0] == pytest.approx(-2 * p * R * np.sin(a), rel=1e-6)
    total = quad(along, 0, R * (1 - 1e-9), limit=200)[0]
    assert total == pytest.approx(-p * R * (1 - np.cos(a)), rel=1e-4)  # half of each arc pushes sideways


def test_hondros_is_the_disk_on_its_diameter() -> None:
    """And for small arcs 2 P / (pi D) and -6 P / (pi D) at the centre, P = 2 p R sin a (BENCHMARKS.md)."""
    R, a, p = 0.025, np.radians(5.0), 1.0
    r = np.array([0.0, 0.3, 0.6, 0.8]) * R
    np.testing.assert_allclose(
        np.column_stack(closed_forms.hondros(r, R, a, p)),
        closed_forms.disk_stress(0 * r, r, R, a, p)[:, :2],
        rtol=1e-10,
    )
    small = 1e-4
    load = 2 * p * R * np.sin(small)
    x, y = (float(s[0]) for s in closed_forms.hondros(np.zeros(1), R, small, p))
    assert x == pytest.approx(2 * load / (np.pi * 2 * R), rel=1e-6)
    assert y == pytest.approx(-6 * load / (np.pi * 2 * R), rel=1e-6)


@pytest.mark.parametrize("kernel", averaging_error.KERNELS)
def test_kernel_moments_are_integrals(kernel: str) -> None:
    shape = {"linear": lambda q: 1 - q, "constant": lambda q: 1.0, "gaussian": lambda q: np.exp(-4.5 * q**2)}[kernel]
    weight = lambda q: float(shape(q) * q)  # noqa: E731
    expected = quad(lambda q: q**2 * weight(q), 0, 1)[0] / quad(weight, 0, 1)[0]
    assert closed_forms.kernel_moment(kernel) == pytest.approx(expected, rel=1e-10)


def test_howland_tends_to_kirsch_and_to_the_net_section() -> None:
    """3 in an infinite plate; 2 over what is left of the section in a ligament (Peterson)."""
    assert closed_forms.howland_factor(1e-6) == pytest.approx(3.0, abs=0.01)
    assert closed_forms.howland_factor(0.999) * 0.001 == pytest.approx(2.0, rel=0.01)


def test_bilinear_curve() -> None:
    E, K, s = 200.0, 20.0, 1.0
    assert closed_forms.bilinear_stress(s / E / 2, E, s, K) == s / 2
    plastic_strain = 0.01  # s + K e_p is the stress, s + K e_p over E the elastic strain
    stress = s + K * plastic_strain
    assert closed_forms.bilinear_stress(stress / E + plastic_strain, E, s, K) == pytest.approx(stress, rel=1e-12)


def test_flow_at_a_finite_rate_against_its_equations() -> None:
    """s = E (e - e_p), e_p' = rate (s - Y - K e_p) / (3 G + K) by explicit Euler of 1e5 steps."""
    E, nu, Y, K, rate, end, n = 200.0, 0.3, 1.0, 20.0, 3.0, 0.03, 100000
    plastic_strain, shear = 0.0, E / (2 * (1 + nu))
    for strain in np.linspace(0, end, n, endpoint=False):
        excess = E * (strain - plastic_strain) - Y - K * plastic_strain
        plastic_strain += rate * max(excess, 0.0) / (3 * shear + K) / n
    found = closed_forms.flowing_stress(end, end, (E, nu), np.array([Y, K, rate]))
    assert found == pytest.approx(E * (end - plastic_strain), rel=1e-4)
    fast = closed_forms.flowing_stress(end, end, (E, nu), np.array([Y, K, 1e9]))
    assert fast == pytest.approx(closed_forms.bilinear_stress(end, E, Y, K), rel=1e-6)


# --- trials ---


@pytest.mark.usefixtures("little_built")
@pytest.mark.parametrize("trial", [t for t in TRIALS if t.study], ids=lambda t: f"{t.case}-{t.name}")
def test_studies_are_valid(trial: Trial) -> None:
    assert trial.study is not None
    assert check_study(validate(json.loads(json.dumps(trial.study)), trial.name))


def test_trials_have_places_of_their_own_and_sections() -> None:
    places = [(trial.case, trial.name) for trial in TRIALS]
    assert len(set(places)) == len(places)
    cases = precision.accuracy_cases()
    assert {trial.case for trial in TRIALS} | {"plastic"} == {case.name for case in cases}
    names = {case: {name for of, name in places if of == case} for case, _ in places}
    for case in cases:
        for order in case.orders:
            assert set(order.names) <= names.get(case.name, set(order.names)), (case.name, order)


# --- measurements ---


def run(study: dict[str, Any], folder: Path) -> Path:
    run_study(MPI.COMM_SELF, validate(study, "test"), folder)
    return folder


def test_measures_of_statics(tmp_path: Path) -> None:
    """A coarse cantilever is too stiff; a coarse plate has a stress concentration."""
    deflection = linear_statics.measure_cantilever(run(linear_statics.cantilever(0.05), tmp_path / "a"))["deflection"]
    beam_theory = closed_forms.timoshenko_deflection(
        1000.0, 1.0, 0.1, 0.1, linear_statics.YOUNG, linear_statics.POISSON
    )
    assert 0.4 * beam_theory < deflection < beam_theory
    figures = linear_statics.measure_plate(run(linear_statics.plate(0.008), tmp_path / "b"))
    assert figures["peak"] == pytest.approx(closed_forms.howland_factor(0.2), rel=0.15)
    # the whole plate without a hole: p a / E
    assert 1.0 < figures["deflection"] / (linear_statics.PULL * linear_statics.SIDE / linear_statics.YOUNG) < 1.3


def test_quadratic_elements_agree_with_fine_linear_ones(tmp_path: Path) -> None:
    """Plate: the energy of linear elements is below by O(h^2)."""
    from fracsim.studies.evidence.precision.quadratic_reference import deflection, frequency

    exact = deflection("plate", 0.004)
    found = linear_statics.measure_plate(run(linear_statics.plate(0.004), tmp_path))
    assert found["deflection"] == pytest.approx(exact["deflection"], rel=3e-3)
    thick = closed_forms.timoshenko_frequency(
        vibrating_beam.LENGTH,
        vibrating_beam.DEPTH,
        vibrating_beam.YOUNG,
        vibrating_beam.POISSON,
        vibrating_beam.DENSITY,
    )
    assert frequency(0.05)["frequency"] == pytest.approx(thick, rel=0.01)


def test_measure_of_the_beam() -> None:
    """A free swing of 83 Hz is read as such."""
    t = np.linspace(0, 0.036, 3001)
    assert vibrating_beam.swing_frequency(t, np.cos(2 * np.pi * 83 * t)) == pytest.approx(83, rel=1e-4)


def test_measures_of_waves_and_finite_strain(tmp_path: Path) -> None:
    figures = bar_wave.measure(run(bar_wave.bar_study(32, "explicit", 1 / 64, "pulse"), tmp_path / "a"))
    assert figures["displacement"] < figures["velocity"] < 0.1
    assert bar_wave.measure(run(bar_wave.bar_study(32, "explicit", 1 / 64, "step"), tmp_path / "b"))["velocity"] > 0.1
    for number, make in enumerate((finite_strain.stretched_cube, finite_strain.sheared_cube)):
        for energy in ("neo-hookean", "stvk"):
            study = make(energy, (1e-10, 1e-8))
            study["mesh"]["h"] = 0.5
            figures = finite_strain.measure(run(study, tmp_path / f"{energy}{number}"))
            assert figures["displacement"] < 1e-9


def test_measures_of_fracture(tmp_path: Path) -> None:
    """Two thirds of a step late; and the recoil of a coarse bar, with two pieces or one: its clamped nodes are a piece
    of their own only where an edge still joins them."""
    late = bar_fracture.measure_break(run(bar_fracture.pulled_bar(10), tmp_path / "a"))["break time"]
    assert late == pytest.approx(2 / 3 / (10 + 1 / 3), rel=1e-6)
    figures = bar_fracture.measure_recoil(run(bar_fracture.recoiling_bar(32, "newmark"), tmp_path / "b"))
    assert figures["velocity"] < 0.03 and figures["break time"] < 0.03


def test_measures_of_the_disk(tmp_path: Path) -> None:
    figures = brazilian_disk.measure_centre(run(brazilian_disk.pressed_disk(12), tmp_path / "a"))
    assert figures["centre"] < 0.01 and figures["stress"] < 0.1
    study = brazilian_disk.split_disk(8, 0.0)
    study["time"]["step"] = 0.1
    peak = brazilian_disk.measure_peak(run(study, tmp_path / "b"))
    assert 0.8 < peak["first break"] <= peak["crack"] <= peak["greatest"]


def test_average_errs_little() -> None:
    figures = averaging_error.measure(3)
    assert all(figures[kernel] < 0.02 for kernel in averaging_error.KERNELS)


def test_plastic_study_is_for_a_program_with_plasticity() -> None:
    from fracsim.study import Study

    assert bool(plastic_bar.trials()) == ("plasticity" in Study.model_fields)


# --- sections ---


def record(name: str, error: float, seconds: float, **settings: Any) -> dict[str, Any]:
    return {
        "group": "precision", "case": "made", "name": name, "settings": settings, "ranks": settings.pop("ranks", 1),
        "outcome": "done", "message": "", "wall": [seconds + 1.0], "stepping": [seconds], "cpu": [seconds],
        "figures": {"e": error}, "summary": {},
    }  # fmt: skip


MADE = case_section.AccuracyCase(
    "made", "Made up", lambda records: "words", ("scheme", "dt"), case_section.measured_errors("e"), ("e",),
    (case_section.ExpectedOrder("e", "dt", 1.0, ("a", "b", "c")),
     case_section.ExpectedOrder("e", "dt", 2.0, ("a", "b", "c"))),
    split="scheme", excluded=("explicit",),
)  # fmt: skip
EULER = [
    record(name, 0.2 * dt, 1 / dt, scheme="generalized-alpha", dt=dt)
    for name, dt in zip("abc", (0.4, 0.2, 0.1), strict=True)
]


def test_what_seems_cheaper_than_the_default_is_timed_three_times() -> None:
    """Once by chance: the median of three decides, of both. What is as good within noise, or explicit, is left."""
    rival = record("d", 0.04, 1.0, scheme="newmark", dt=0.4)
    assert case_section.doubtful_trials(MADE, [*EULER, rival]) == {"b", "d"}
    default = EULER[1] | {"cpu": [5.0, 1.2, 1.1]}
    rival["cpu"] += [1.1]
    runs = [EULER[0], default, EULER[2], rival]
    assert case_section.doubtful_trials(MADE, runs) == set() and case_section.section(MADE, runs).claims[2].holds
    default["cpu"] = [5.0, 1.2]
    assert case_section.doubtful_trials(MADE, runs) == {"b", "d"}
    default["cpu"], rival["cpu"] = [5.0, 4.9, 1.2], [1.1, 1.0, 4.0]
    claim = case_section.section(MADE, runs).claims[2]
    assert (
        case_section.doubtful_trials(MADE, runs) == set()
        and claim.holds is False
        and claim.measured.count("medians of 3") == 1
    )
    assert case_section.doubtful_trials(MADE, [*EULER, record("d", 0.04, 4.5, scheme="newmark", dt=0.4)]) == set()
    assert case_section.doubtful_trials(MADE, [*EULER, record("d", 0.005, 1.0, scheme="explicit", dt=0.4)]) == set()


def test_orders_are_fitted_and_judged() -> None:
    first, second = case_section.section(MADE, EULER).claims[:2]
    assert first.measured.startswith("1.00") and first.holds
    assert second.holds is False
    assert case_section.section(MADE, EULER[:2]).claims[0].holds is None
    least = replace(MADE, orders=(case_section.ExpectedOrder("e", "dt", 0.5, ("a", "b", "c"), least=True),))
    assert case_section.section(least, EULER).claims[0].holds


def test_the_default_is_recommended_where_nothing_beats_it() -> None:
    """Errors 8, 4, 2 % for 2.5, 5, 10 s: 5 % takes b, 1 % nobody; a trapezoidal run is cheaper by more than noise."""
    alone = case_section.section(MADE, EULER)
    assert alone.tables[0].marked == (1,) and "1% of e: no setting" in alone.text
    assert [claim.holds for claim in alone.claims[2:]] == [True, None]
    beaten = case_section.section(MADE, [*EULER, record("d", 0.005, 1.0, scheme="newmark", dt=0.4)])
    assert [claim.holds for claim in beaten.claims[2:]] == [False, False]
    assert beaten.tables[0].marked == (3,)
    noise = case_section.section(MADE, [*EULER, record("d", 0.04, 4.5, scheme="newmark", dt=0.4)])
    assert noise.claims[2].holds and noise.tables[0].marked == (1,)
    explicit = case_section.section(MADE, [*EULER, record("d", 0.005, 1.0, scheme="explicit", dt=0.4)])
    assert explicit.claims[2].holds and explicit.tables[0].marked == (3,)


def test_core_seconds_are_the_processors_and_failed_runs_stay_in_the_table() -> None:
    broken = record("d", 0.0, 0.0, scheme="newmark", dt=0.1) | {
        "outcome": "out of time",
        "figures": {},
        "summary": None,
    }
    two = record("e", 0.01, 3.0, scheme="newmark", dt=0.1, ranks=2)
    table = case_section.section(MADE, [*EULER, broken, two]).tables[0]
    assert len(table.rows) == 5 and table.rows[3][-1] == "out of time"
    assert table.rows[4][table.columns.index("core-seconds")] == 3.0


def test_a_section_says_that_its_reference_is_missing() -> None:
    missing = replace(MADE, compare=lambda records: {"a": {"e": case_section.trial_figure(records, "reference", "e")}})
    assert "reference has no e" in case_section.section(missing, EULER).text


def test_all_sections_can_be_made_of_nothing() -> None:
    assert len(precision.sections([])) == len(precision.accuracy_cases())


def panels_of(section: Section) -> tuple[Plot, ...]:
    """Panels of the only plot of a section."""
    (grid,) = section.plots
    assert isinstance(grid, PlotGrid)
    return grid.panels


def test_the_first_screen_has_the_cheapest_of_each_case_and_its_peers() -> None:
    """Errors 8, 4, 2 % for 2.5, 5, 10 s; another program takes 1 s for 3 %; no one gets to 1 %."""
    peer = record("p", 0.03, 1.0, elements="quadratic") | {"cpu": [], "figures": {"e": 0.03, "seconds": 1.0}}
    (found,) = accuracy_summary.summary_sections([MADE], [*EULER, peer])
    row = dict(zip(found.tables[0].columns, found.tables[0].rows[0], strict=True))
    assert found.first and row["s for 5%"] == 5.0 and row["s for 1%"] is None
    assert row["cheapest setting for 5%"] == "scheme = generalized-alpha, dt = 0.2"
    assert row["DOLFINx alone, quadratic: s for 5%"] == 1.0 and row["DOLFINx alone, quadratic: s for 1%"] is None
    (panel,) = panels_of(found)
    assert panel.caption == "Made up" and [series.label for series in panel.series] == [
        "fracsim", "DOLFINx alone, quadratic"
    ]  # fmt: skip
    assert panel.series[0].x == (2.5, 5.0, 10.0) and panel.series[1].y == (0.03,)
    exact = [
        record(f"x{cost}", error, cost, scheme="newmark", dt=cost) for error, cost in ((1e-9, 20.0), (1e-12, 40.0))
    ]
    (found,) = accuracy_summary.summary_sections([MADE], [*EULER, *exact])
    (panel,) = panels_of(found)
    assert panel.series[0].x == (2.5, 5.0, 10.0, 20.0) and panel.series[0].y[-1] == accuracy_summary.FINEST
    assert accuracy_summary.summary_sections([MADE], []) == []


def test_the_tolerances_called_default_are() -> None:
    from fracsim.solvers.linear_solver import DEFAULT_OPTIONS
    from fracsim.studies.evidence.precision import finite_strain

    assert (DEFAULT_OPTIONS["snes_rtol"], DEFAULT_OPTIONS["ksp_rtol"]) == finite_strain.DEFAULT
