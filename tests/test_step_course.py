"""[time] step as a table: steps are as long as it says, end at its corners, and are halved below it alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI

from fracsim.deformable_run import Run
from fracsim.errors import InputError
from fracsim.mechanics.time_functions import TabulatedFunction
from fracsim.scene import build_scene
from fracsim.study.check import check_study
from fracsim.study.reader import validate
from fracsim.timestepping.step_sizes import StepSizes
from support.scenes import make_study

TABLE = {"time": [0.0, 0.1, 0.15, 0.3, 0.301], "value": [0.02, 0.02, 0.05, 0.05, 0.01]}


def times(scheme: str, step: object, folder: Path, **options: object) -> np.ndarray:
    timing = {"scheme": scheme, "step": step, "end": 0.4} | options
    solver = {} if scheme == "explicit" else make_study().solver
    study = make_study(time=timing, solver=solver, output={"picture": False, "surface": False})
    Run(build_scene(MPI.COMM_SELF, study), folder)()
    return np.genfromtxt(folder / "history.csv", delimiter=",", names=True)["time"]


@pytest.mark.parametrize("scheme", ("newmark", "explicit"))
def test_steps_are_those_of_the_table(scheme: str, tmp_path: Path) -> None:
    """0.02 up to 0.1, then as long as at their beginning, none over a corner; 0.01 in the end."""
    t = times(scheme, TABLE, tmp_path)
    dt = np.diff(t, prepend=0.0)
    assert dt[:5] == pytest.approx(0.02) and t[-1] == pytest.approx(0.4)
    for corner in (0.1, 0.15, 0.3):
        assert np.abs(t - corner).min() < 1e-12
    allowed = np.interp(t - dt, TABLE["time"], TABLE["value"])
    assert (dt <= allowed * (1 + 1e-9)).all()
    assert dt[(t > 0.151) & (t < 0.301)] == pytest.approx(0.05)
    assert dt[-8:-1] == pytest.approx(0.01, rel=0.02)  # explicit ones are equal up to the end


def test_one_number_is_a_table_of_it(tmp_path: Path) -> None:
    """To the last bit."""
    plain = times("newmark", 0.02, tmp_path / "plain")
    table = times("newmark", {"time": [0.0], "value": [0.02]}, tmp_path / "table")
    assert np.array_equal(plain, table)


def test_a_corner_that_is_reached_but_for_round_off_makes_no_sliver() -> None:
    sizes = StepSizes(
        1.0, 9.0, 1e-3, schedule=TabulatedFunction(np.array([0.0, 0.3, 5.0]), np.array([[0.1], [0.1], [1.0]]))
    )
    assert sizes.largest_step_at(0.1 + 0.2) == pytest.approx(0.1) and sizes.largest_step_at(
        0.3 * (1 - 1e-12)
    ) == pytest.approx(0.1)
    assert sizes.largest_step_at(4.5) == pytest.approx(0.5) and sizes.largest_step_at(6.0) == 1.0


def test_what_is_wrong_with_a_table() -> None:
    data = make_study().model_dump(mode="json", exclude_none=True)
    data["mesh"] = {"builder": "box", "size": [1.0, 1.0], "h": 0.5}
    for step, message in (
        ({"time": [0.0, 0.0], "value": [0.1, 0.2]}, "time.step: times must increase"),
        ({"time": [0.0], "value": [-0.1]}, r"time.step.value.0 = -0.1"),
        ({"time": [0.0], "value": [9.0]}, "step = 9 s is longer than the run"),
    ):
        with pytest.raises(InputError, match=message):
            validate({**data, "time": {"step": step, "end": 1.0}}, "test")


def test_check_says_what_steps_are_long() -> None:
    study = make_study(time={"scheme": "newmark", "step": TABLE, "end": 0.4})
    assert any("steps of 0.01 to 0.05 s" in line for line in check_study(study))
