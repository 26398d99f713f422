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
