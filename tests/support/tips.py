"""Crack tips of a scene on one rank: where they are, the force on them, and how fast they run."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fracsim.fracture.energy.tip_criterion import TipCriterion
from fracsim.fracture.energy.tip_fields import TipFields
from fracsim.scene import Scene

Values = npt.NDArray[np.float64]


def criterion_of(scene: Scene) -> TipCriterion:
    criterion = scene.fracture.criterion
    assert isinstance(criterion, TipCriterion)
    return criterion


def tips(scene: Scene) -> Values:
    """(n, d) m."""
    return criterion_of(scene).find_tips().point


def seen(scene: Scene) -> TipFields:
    """The body around the tips of now, which there are."""
    criterion = criterion_of(scene)
    criterion.find_tips()
    return criterion.field_evaluator.evaluate_fields(*scene.fracture.evaluate_undamaged_stress())


def run_when_ready(scene: Scene, ready: float) -> tuple[Values, list[Values]]:
    """(n,) s since `ready`, and (m, d) the tips then, m, of each step in which a crack gets on, held until `ready`."""
    criterion, state = criterion_of(scene), scene.start()
    toughness, times, places = criterion.toughness, [], []
    criterion.toughness = np.inf
    while not scene.ended(state):
        state, report = scene.stepper.advance(state)
        criterion.toughness = toughness if state.t > ready else np.inf
        if report.broken and len(now := tips(scene)):
            times.append(state.t - ready)
            places.append(now)
    return np.array(times), places
