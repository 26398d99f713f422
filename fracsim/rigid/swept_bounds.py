"""How far things come in a step: what tells which of them may meet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from .bodies import Bodies
from .mujoco_model import Model, Rules

Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

FARTHER = 1.5  # times as far as was thought: what such a body meets is looked for again


@dataclass(frozen=True)
class Course:
    """No point of a body comes farther than a `reach` (n,) beside what moves with a `common` velocity (3,), and than
    another (n,) beside what stands, m; that goes at `rates` (stands, 3), m/s."""

    rates: Values
    common: Values
    reach: Sequence[Values]

    def slide(self, step: float) -> list[Values]:
        """(stands,) how far what stands comes in a step, s, beside the common velocity and as it is, m."""
        return [step * np.linalg.norm(self.rates - of, axis=1) for of in (self.common, 0.0)]

    def farther(self, now: Course) -> Flags:
        """(n,) what comes much farther than this as it goes `now`."""
        return np.any([mine > FARTHER * then for mine, then in zip(now.reach, self.reach, strict=True)], axis=0)

    def widened(self, far: Flags, now: Course) -> Course:
        """With reaches that hold as well for bodies (n,) that come `far`ther as they go now."""
        most = [np.where(far, np.maximum(*both), both[0]) for both in zip(self.reach, now.reach, strict=True)]
        return replace(self, reach=most)


def still(stands: int, count: int) -> Course:
    """Nothing moves: neither what stands nor bodies."""
    return Course(np.zeros((stands, 3)), np.zeros(3), 2 * [np.zeros(count)])


def course_of(model: Model, rules: Rules, bodies: Bodies, rates: Values, common: Values | None = None) -> Course:
    """Of bodies that move so, beside what stands and goes at `rates` (stands, 3); `common`: (3,) m/s (None: what most
    do)."""
    if common is None:
        common = np.median(np.concatenate([bodies.velocity, rates]), axis=0)
    return Course(rates, common, [_reach(model, rules, bodies, of) for of in (common, 0.0)])


def _reach(model: Model, rules: Rules, bodies: Bodies, common: Values | float) -> Values:
    """(n,) how far any point of a body comes in a step beside what moves with a `common` velocity, m/s: two things
    come together by no more than the sum of theirs."""
    turning = model.extent * np.linalg.norm(bodies.spin, axis=1)
    speed = np.linalg.norm(bodies.velocity - common, axis=1) + turning
    return np.asarray(rules.step * (speed + rules.fast))
