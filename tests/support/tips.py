"""Crack tips of a scene on one rank: where they are, the force on them, and how fast they run."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fracsim.fracture.energy.tip_criterion import CrackTips
from fracsim.fracture.energy.tip_fields import Seen
from fracsim.scene import Scene

Values = npt.NDArray[np.float64]


def criterion_of(scene: Scene) -> CrackTips:
    criterion = scene.fracture.criterion
    assert isinstance(criterion, CrackTips)
    return criterion


def tips(scene: Scene) -> Values:
    """(n, d) m."""
    return criterion_of(scene).tips().point


def seen(scene: Scene) -> Seen:
    """The body around the tips of now, which there are."""
    criterion = criterion_of(scene)
    criterion.tips()
    return criterion.sight.look(*scene.fracture.evaluate())


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
