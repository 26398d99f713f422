"""Other programs beside this one: what is handed to them, and what the page says where they are missing.

With AKANTU_PYTHON (studies/evidence/peers/akantu.py) the comparison itself runs, small.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from fracsim.scene import build_scene
from fracsim.studies.evidence import peers
from fracsim.studies.evidence.peers import akantu, akantu_statics, linear_step, phase_field, start_up
from fracsim.studies.evidence.precision import brazilian_disk, linear_statics, precision_trials
from fracsim.study.reader import validate

without = pytest.mark.skipif(akantu.akantu_python() is None, reason=akantu.ABSENT)


@pytest.fixture
def absent(monkeypatch: pytest.MonkeyPatch) -> Any:
    """A Python that cannot import Akantu: this one."""
    monkeypatch.setenv(akantu.VARIABLE, sys.executable)
    akantu.akantu_python.cache_clear()
    monkeypatch.delenv(phase_field.VARIABLE, raising=False)
    phase_field.phasefieldx_python.cache_clear()
    yield
    akantu.akantu_python.cache_clear()


def problem(study: dict[str, Any]) -> dict[str, Any]:
    return akantu.problem_arrays(build_scene(MPI.COMM_SELF, validate(study, "peers")), 0.0)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("case, volume", [("cantilever", 0.01), ("plate", 0.05**2 - np.pi * 0.01**2 / 4)])
def test_cells_are_handed_over_with_positive_volume_and_middles_in_place(case: str, volume: float, order: int) -> None:
    h = {"cantilever": 0.1, "plate": 0.008}[case]
    found = problem(linear_statics.STUDIES[case](h, order=order))
    X, size = found["points"][found["cells"]], found["points"].shape[1]
    corners = X[:, : size + 1]
    volumes = np.linalg.det(corners[:, 1:] - corners[:, :1]) / [2, 6][size - 2]
    assert volumes.min() > 0
    assert volumes.sum() == pytest.approx(volume, rel=1e-12 if size == 3 else 2e-2), "chords of the hole"
    ends = np.stack([corners[:, edge].mean(axis=1) for edge in akantu.MIDPOINT_CORNERS[size]], axis=1)
    middles = X[:, size + 1 :]
    assert middles.shape[1] == (0 if order == 1 else len(akantu.MIDPOINT_CORNERS[size]))
    if order == 2:  # on a round side a middle is off its chord, by less than a tenth of an edge
        assert np.abs(middles - ends).max() < (1e-12 if size == 3 else h / 10)


def test_the_force_is_that_of_the_load_and_what_is_held_has_none() -> None:
    found = problem(linear_statics.cantilever(0.05))
    assert found["force"].sum(axis=0) == pytest.approx(
        [0.0, 0.0, -linear_statics.TRACTION * linear_statics.DEPTH**2], abs=1e-9
    )
    np.testing.assert_array_equal(found["held"].all(axis=1), found["points"][:, 0] < 1e-12)
    assert not found["force"][found["held"]].any()


def test_stress_of_a_displacement_that_is_linear_is_that_of_hooke() -> None:
    """sigma_xx = E / (1 - nu^2) (e_xx + nu e_yy), sigma_xy = E / (1 + nu) e_xy."""
    found = problem(linear_statics.plate(0.012))
    x, y = found["points"].T
    u = np.stack([2e-6 * x + 1e-6 * y, 3e-6 * x - 4e-6 * y], axis=1)
    E, nu = linear_statics.YOUNG, linear_statics.POISSON
    xx, yy = (E / (1 - nu**2) * value for value in (2e-6 - nu * 4e-6, nu * 2e-6 - 4e-6))
    xy = E / (1 + nu) * 2e-6
    stress = akantu_statics.plane_stress(found, u)
    np.testing.assert_allclose(stress, np.broadcast_to([xx, xy, xy, yy], stress.shape), rtol=1e-9)


def test_where_akantu_is_missing_nothing_runs_and_the_page_says_so(
    absent: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert [trial.case for trial in peers.trials()] == ["start-up"], "which measures this program by itself, too"
    assert precision_trials.akantu_trials("plate", 0.01, 1) == []
    assert [section.text for section in peers.sections([])] == [akantu.ABSENT]
    with pytest.raises(RuntimeError, match="AKANTU_PYTHON"):
        akantu.AkantuProcess({}, None)  # type: ignore[arg-type]
    monkeypatch.setenv(akantu.VARIABLE, "/nowhere")
    akantu.akantu_python.cache_clear()
    assert akantu.akantu_python() is None


def figures(cpu: float, apart: float) -> dict[str, Any]:
    ours = {way: {"wall": cpu, "cpu": cpu, "first": 1.0} for way in linear_step.SCHEMES}
    return {"cells": 24000, "apart": apart, "akantu": {"wall": 1.0, "cpu": 1.0, "first": 9.0}, "ours": ours}


@pytest.mark.parametrize("cpu, apart, holds", [(0.79, 1e-9, [True, True]), (0.81, 1e-3, [False, False])])
def test_a_step_is_judged_by_time_and_by_answer(cpu: float, apart: float, holds: list[bool]) -> None:
    record = {"case": "linear-step", "figures": figures(cpu, apart), "message": ""}
    (section,) = linear_step.sections([record])
    assert [claim.holds for claim in section.claims] == holds
    assert section.tables[0].rows[0][1:4] == ("Akantu", 1.0, 1.0)


@pytest.mark.parametrize("worst, holds", [(0.69, True), (0.71, False)])
def test_start_up_is_judged_by_the_worst_job(worst: float, holds: bool) -> None:
    seconds = dict.fromkeys(start_up.JOBS, 0.5) | {"neo-hookean": worst}
    (section,) = start_up.sections([{"case": "start-up", "figures": seconds}])
    assert section.claims[0].holds is holds and akantu.ABSENT in section.text


@without
def test_akantu_comes_to_the_same_displacement() -> None:
    found = linear_step.compare(2)
    assert found["apart"] < 1e-6 and found["akantu"]["cpu"] > 0


@without
@pytest.mark.parametrize("order", [1, 2])
def test_akantu_stresses_a_disk_as_the_closed_form_does(order: int, tmp_path: Any) -> None:
    found = problem(brazilian_disk.pressed_disk(8, order))
    theirs = akantu.AkantuProcess(found, tmp_path)
    theirs.step(1.0)
    assert akantu_statics.case_figures("disk", found, theirs.end())["centre"] < {1: 0.02, 2: 0.001}[order]
