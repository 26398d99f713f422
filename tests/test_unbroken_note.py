"""The note at the end of a run in which no edge broke: how far the body was from its strength."""

from __future__ import annotations

from typing import Any

import pytest

from fracsim.output.result_checks import unbroken_note
from support.scenes import make_scene, march

YOUNG, STRENGTH = 1e5, 3e4


def note_of_bar(strain: float, strength: float = STRENGTH) -> str:
    """The note after a bar without contraction has been strained along x: sigma = Y strain in every cell."""
    way: dict[str, Any] = {"time": [0.0, 1.0], "value": [[0.0, 0.0], [0.4 * strain, 0.0]]}
    scene, state = make_scene(
        mesh={"builder": "box", "size": [0.4, 0.1], "h": 0.05},
        material={"energy": "linear", "young": YOUNG, "poisson": 0.0, "density": 1.0},
        fracture={"strength": strength},
        boundary=[{"on": "left", "fix": "xy"}, {"on": "right", "displacement": way}],
        time={"scheme": "quasi-static", "step": 1.0, "end": 1.0},
    )
    for _ in march(scene, state):
        pass
    return unbroken_note(scene.fracture)


@pytest.mark.parametrize(("strain", "share"), [(0.1, "0.33"), (0.27, "0.9")])
def test_share_of_the_strength(strain: float, share: str) -> None:
    note = note_of_bar(strain)
    assert f"is {YOUNG * strain:.3g} Pa, {share} of the strength, at (" in note


def test_a_body_that_broke_has_no_note() -> None:
    assert note_of_bar(0.31) == ""


@pytest.mark.parametrize("strength", [1e14, float("inf")])
def test_a_strength_far_above_all_stresses(strength: float) -> None:
    """A strength in a wrong unit, or none: the body is in tension."""
    note = note_of_bar(0.1, strength)
    assert f"is {YOUNG * 0.1:.3g} Pa, {YOUNG * 0.1 / strength:.2g} of the strength, at (" in note


def test_a_body_in_compression() -> None:
    assert note_of_bar(-0.1) == "nothing broke, and no cell is in tension at the end"
