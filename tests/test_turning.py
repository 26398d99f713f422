"""How far pieces may turn in a study, and what `check` says of a linear energy then."""

from __future__ import annotations

import math
from typing import Any

import pytest

from fracsim.study.check import check_study
from fracsim.study.length_checks import estimated_rotation
from support.scenes import make_study

STIFF: dict[str, Any] = {
    "mesh": {"builder": "box", "size": [0.2, 0.1], "h": 0.02},
    "material": {"energy": "linear", "young": 1e10, "poisson": 0.2, "density": 2500.0},
    "fracture": {"strength": 5e6}, "time": {"scheme": "newmark", "step": 1e-5, "end": 1e-3},
}  # fmt: skip
SPEED = 5e6 / math.sqrt(1e10 * 2500.0)  # m/s, at which it breaks


def angle(**tables: Any) -> float:
    return estimated_rotation(make_study(**STIFF | tables), 2, 0.1)


def test_what_is_fastest_counts() -> None:
    """v T / L of the break, of a driven side, of an obstacle that is driven or free, of gravity, of a start; a spin."""
    assert angle() == pytest.approx(SPEED * 1e-3 / 0.1)
    ball = {"name": "ball", "shape": "sphere", "radius": 0.01, "at": [0.1, 0.2]}
    assert angle(obstacle=[ball | {"velocity": [0.0, -30.0]}]) == pytest.approx(30.0 * 1e-3 / 0.1)
    assert angle(obstacle=[ball | {"velocity": [0.0, -30.0], "mass": 1.0}]) == pytest.approx(30.0 * 1e-3 / 0.1)
    assert angle(boundary=[{"on": "left", "velocity": [3.0, 4.0]}]) == pytest.approx(5.0 * 1e-3 / 0.1)
    assert angle(load={"gravity": [0.0, -1e6]}) == pytest.approx(1e6 * 1e-6 / 2 / 0.1)
    assert angle(initial={"velocity": [0.0, 40.0]}) == pytest.approx(40.0 * 1e-3 / 0.1)
    assert angle(initial={"spin": [700.0]}) == pytest.approx(0.7)


def test_nothing_turns_that_does_not_break_or_has_no_inertia() -> None:
    held = [{"on": "left", "fix": "xy"}]
    assert angle(fracture={"strength": math.inf}, boundary=held) == 0.0
    assert angle(time={"scheme": "quasi-static", "step": 0.1, "end": 1e3}, boundary=held) == 0.0


@pytest.mark.parametrize(
    ("end", "energy", "said"), [(1e-3, "linear", False), (1.0, "linear", True), (1.0, "corotated", False)]
)
def test_check_says_so_where_it_matters(end: float, energy: str, said: bool) -> None:
    time, material = STIFF["time"] | {"end": end}, STIFF["material"] | {"energy": energy}
    lines = check_study(make_study(**STIFF | {"time": time, "material": material}))
    assert any("swell" in line for line in lines) == said
