"""Rounds of a step in which contacts are looked for: what one finds anew changes nothing where there is nothing new."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

pytest.importorskip("mujoco", reason="an environment made without a network")

from fracsim.rigid.bodies import Bodies
from fracsim.rigid.engine import SETTINGS, Engine
from fracsim.rigid.fragment_overlap import InitialOverlaps
from fracsim.rigid.mujoco_model import ContactParameters
from support.falling import CUBE, DOWN, cubes

Values = npt.NDArray[np.float64]
STEP, SPEED = 0.02, 5.0


def struck(monkeypatch: pytest.MonkeyPatch, farther: float) -> tuple[Bodies, InitialOverlaps]:
    """Two pieces that lie in one another by 0.3 m from birth and fly on together; a third block strikes the one ahead
    half-way through the step. `farther`: times what was thought, see rigid.engine."""
    monkeypatch.setattr("fracsim.rigid.engine.SETTINGS", replace(SETTINGS, excess_reach_ratio=farther))
    bodies = cubes([[0.0, 0.0, 0.0], [0.7, 0.05, 0.0], [1.8, 0.0, 0.05]])
    velocity: Values = np.array([[SPEED, 0, 0], [SPEED, 0, 0], [-SPEED, 0, 0]])
    engine = Engine(
        bodies,
        [[CUBE]] * 3,
        [],
        ContactParameters(STEP, 0 * DOWN),
        InitialOverlaps.between_new_fragments(np.array([[0, 1]])),
    )
    return engine.advance(replace(bodies, velocity=velocity))[0], engine.initial_overlaps


def test_a_round_does_not_go_on_from_how_overlaps_stood_after_the_one_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """There one of them had flown to the blow and the other not: what they lay in one another by was less by v dt / 2,
    and in the next round they were pushed apart by what they are more."""
    (once, stands), (again, stands_again) = (struck(monkeypatch, farther) for farther in (1e9, 0.0))
    assert np.allclose(stands.depth, stands_again.depth, atol=1e-12)
    assert np.allclose(once.velocity, again.velocity, atol=1e-9) and np.allclose(
        once.position, again.position, atol=1e-11
    )
