"""Cases of fracture, contact and impact in the report: their references, their scenes, and each on a coarse mesh."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from fracsim.studies.evidence import cohesive_beam, fracture_specimens, precision
from fracsim.studies.evidence.fracture_specimens import Course
from fracsim.studies.evidence.precision import (
    bouncing_block,
    fracture_case,
    fracture_script,
    peak_loads,
    rigid_blow,
    spalled_bar,
    sphere_contact,
    torn_strip,
    wave_loaded_crack,
)
from fracsim.study.check import check_study
from fracsim.study.reader import validate

CASES = {case.name: case for case in precision.FRACTURE_CASES}


# --- references ------------------------------------------------------------------------------------------------------


def test_the_polynomial_of_the_handbook() -> None:
    """ASTM E399, table: f(0.45) = 8.34, f(0.5) = 9.66, f(0.55) = 11.36 of the compact specimen."""
    a = fracture_specimens.COMPACT_CRACK
    W, B = fracture_specimens.COMPACT_WIDTH, fracture_specimens.COMPACT_THICKNESS
    toughness = np.sqrt(210e9 * 2700.0 / (1 - 0.3**2))
    assert a == 0.5
    assert fracture_specimens.compact_tension_load() == pytest.approx(toughness * B * np.sqrt(W) / 9.66, rel=1e-3)


def test_freunds_crack_against_its_equation_of_motion() -> None:
    """dl / dt = c_R (1 - tau / t) from l(tau) = 0, and K_I(tau) = K_c with K_I of a suddenly loaded crack."""
    tau, speed = wave_loaded_crack.start_time(), wave_loaded_crack.rayleigh_speed()
    times = np.linspace(tau, wave_loaded_crack.WINDOW, 20)
    solved = solve_ivp(lambda t, _: [speed * (1 - tau / t)], (tau, times[-1]), [0.0], t_eval=times, rtol=1e-9,
                       atol=1e-12)  # fmt: skip
    np.testing.assert_allclose(wave_loaded_crack.advance(times), solved.y[0], atol=1e-9)
    assert wave_loaded_crack.advance(np.array([0.5 * tau]))[0] == 0.0
    nu, stress = wave_loaded_crack.POISSON, 2 * wave_loaded_crack.TRACTION
    K = 2 * stress * np.sqrt(wave_loaded_crack.DILATATIONAL * tau * (1 - 2 * nu) / np.pi) / (1 - nu)
    assert K**2 * (1 - nu**2) / wave_loaded_crack.YOUNG == pytest.approx(wave_loaded_crack.ENERGY, rel=1e-9)
    # Viktorov's approximation
    assert speed / wave_loaded_crack.SHEAR == pytest.approx((0.862 + 1.14 * nu) / (1 + nu), rel=0.003)


def test_springs_converge() -> None:
    """To half a percent between 24 and 48 rows, near 1236 to 1247 N of another solution."""
    coarse, fine = cohesive_beam.springs_peak(24), cohesive_beam.springs_peak(48)
    assert coarse == pytest.approx(fine, rel=5e-3)
    assert 1225 < fine < 1250


def test_the_bar_falls_freely() -> None:
    """The integral of v = v_0 + g t up to the blow is the clearance."""
    fallen = quad(lambda t: rigid_blow.SPEED + rigid_blow.GRAVITY * t, 0, rigid_blow.blow_time())[0]
    assert fallen == pytest.approx(rigid_blow.CLEARANCE, rel=1e-12)


# --- trials ----------------------------------------------------------------------------------------------------------


def test_settings_are_read_as_they_are_written() -> None:
    settings: fracture_case.Settings = {"h": 1e-05, "order": 2, "mesh": "random"}
    read = fracture_case.parse_settings([f"{key}={value}" for key, value in settings.items()])
    assert read == settings and isinstance(read["order"], int)


def test_each_trial_names_a_case_of_its_script() -> None:
    for case in CASES.values():
        for trial in case.trials():
            if "elements" not in trial.settings:
                assert trial.script[1] == case.name
                assert fracture_case.parse_settings(list(trial.script[2:])) == trial.settings
            assert set(trial.settings) <= {*case.accuracy_case().columns, "elements"}


@pytest.mark.parametrize("case", [case for case in CASES.values() if isinstance(case.measure, peak_loads.PeakLoad)],
                         ids=lambda case: case.name)  # fmt: skip
@pytest.mark.usefixtures("little_built")
def test_specimens_are_valid(case: fracture_case.FractureCase, tmp_path: Path) -> None:
    assert isinstance(case.measure, peak_loads.PeakLoad)
    for settings in case.short:
        assert check_study(validate(case.measure.study(settings, 1, tmp_path), case.name))


def test_a_course_leads_to_its_end() -> None:
    course = Course(2e-4, 0.4, 0.01)
    assert course.displacement("free", -1.0)["value"] == [["free", 0.0], ["free", -2e-4]]
    assert course.time_table["step"] == {"time": [0.0, 0.4], "value": [0.4, 0.01]}


def test_the_worst_mesh_counts() -> None:
    runs = [{"e": 0.1, "seconds": 3.0}, {"e": 0.3, "seconds": 1.0}, {"e": 0.2, "seconds": 2.0}]
    assert fracture_case.worst_of(runs, ("e",)) == {"e": 0.3, "seconds": 2.0}


def test_a_table_has_the_figures_of_its_runs() -> None:
    case = CASES["bounce"]
    figures = {"height of the return": 0.1, "share": 0.9, "seconds": 2.0}
    record = {"case": "bounce", "name": "a", "settings": {"scheme": "newmark", "dt": 0.1}, "ranks": 1, "wall": [1.0],
              "cpu": [], "outcome": "done", "figures": figures}  # fmt: skip
    section = precision.section(case.accuracy_case(), [record])
    row = dict(zip(section.tables[0].columns, section.tables[0].rows[0], strict=True))
    assert (row["error of height of the return"], row["share"], row["core-seconds"], row["dt"]) == (0.1, 0.9, 2.0, 0.1)


# --- measures, on meshes coarser than those of the report ------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "settings", "error"),
    [
        ("notched-tension", {"h": 5e-5, "order": 1, "step": 0.02, "mesh": "lattice"}, 0.08),
        ("notched-shear", {"h": 5e-5, "order": 1, "step": 0.02, "mesh": "lattice"}, 0.15),
        ("notched-held-shear", {"h": 5e-5, "order": 1, "step": 0.02, "mesh": "lattice"}, 0.15),
        ("notched-beam", {"h": 1.5e-4, "order": 1, "step": 0.01}, 0.25),
        ("compact-tension", {"h": 2.5e-3, "order": 1, "step": 0.01}, 0.1),
        ("concrete-beam", {"cells": 4.0, "step": 0.02}, 0.15),
    ],
)
def test_peak_loads_on_coarse_meshes(
    name: str, settings: fracture_case.Settings, error: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(peak_loads, "SEEDS", (1,))
    figures = CASES[name].measure(settings, tmp_path)
    assert 0 < figures["peak load"] < error and figures["seconds"] > 0
    assert figures["least"] <= figures["peak"] <= figures["largest"]


def test_a_crack_under_a_wave_on_a_coarse_mesh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It starts late or early by less than the wave takes through four cells, and gets as far to three quarters.

    Cells are 4 mm long; with 0.5 mm it gets as far to 1 %.
    """
    monkeypatch.setattr(wave_loaded_crack, "SEEDS", (1,))
    figures = wave_loaded_crack.measure({"h": 4e-3, "order": 1, "scheme": "explicit", "law": "griffith"}, tmp_path)
    assert figures["start"] * wave_loaded_crack.start_time() < 4 * 4e-3 / wave_loaded_crack.DILATATIONAL
    assert 0.5 < figures["last advance over exact"] < 1.75 and figures["position"] < 0.5


def test_the_crack_of_a_coarse_strip(tmp_path: Path) -> None:
    figures = torn_strip.measure({"n": 6, "order": 1, "scheme": "explicit"}, tmp_path)
    assert figures["speed over c_R"] == pytest.approx(torn_strip.LIMIT, rel=0.15) and figures["tips"] == 1


def test_a_bar_spalls_on_a_coarse_mesh(tmp_path: Path) -> None:
    figures = spalled_bar.measure({"h": 2e-3, "order": 1, "mesh": "lattice"}, tmp_path)
    assert figures["pieces"] > 1 and figures["speed of the piece"] < 0.2


def test_a_sphere_on_a_coarse_block(tmp_path: Path) -> None:
    """Stiffer than Hertz's half space with linear cells; within 5 % with quadratic ones as large."""
    forces = [
        sphere_contact.measure({"n": 6, "order": order, "steps": 1}, tmp_path)["force, signed"] for order in (1, 2)
    ]
    assert forces[0] > 0.2 and abs(forces[1]) < 0.05


def test_a_block_returns_to_less_than_its_height(tmp_path: Path) -> None:
    figures = bouncing_block.measure({"scheme": "newmark", "dt": 4e-3}, tmp_path)
    assert 0.8 < figures["share"] < 1.0 and figures["height of the return"] == pytest.approx(1 - figures["share"])


def test_a_rigid_bar_is_struck_within_a_step(tmp_path: Path) -> None:
    pytest.importorskip("mujoco", reason="an environment made without a network")
    figures = rigid_blow.measure({"dt": 1e-3, "h": 0.25}, tmp_path)
    assert figures["time of the blow"] * rigid_blow.blow_time() <= 1e-3 and figures["crack"] < 0.01
    assert figures["fragments"] > 1


def test_the_script_writes_the_figures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "figures.json"
    monkeypatch.setattr("sys.argv", ["script", "bounce", "scheme=newmark", "dt=0.004", "-o", str(out)])
    fracture_script.main()
    assert 0.1 < json.loads(out.read_text())["height of the return"] < 0.2
