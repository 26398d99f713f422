"""Facets that may be near an obstacle: looked for among all only when points or the obstacle have gone far.

A distance to an obstacle changes by no more than the point moves, |t| of its reference point and ||R - R_0|| times the
radius of the obstacle about that.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from .placed import Placed

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

OUTLINE = 1.1  # an outline is drawn within its shape


@dataclass(frozen=True)
class _Look:
    """Where points (n, d) and an obstacle were, and the facets (k,) that were within a distance of it, m, but for
    `margin`."""

    x: Values
    placed: Placed
    within: float
    margin: float
    found: Ints

    def holds(self, placed: Placed, x: Values, within: float) -> bool:
        """Whether no facet within that distance, m, can be missing."""
        off = x - self.x
        moved = float(np.sqrt(np.einsum("nd,nd->n", off, off).max(initial=0.0)))
        now, then = placed.pose, self.placed.pose
        turned = float(np.linalg.norm(now.rotation - then.rotation))
        carried = float(np.linalg.norm(now.centre - then.centre)) + (turned and turned * _radius(placed))
        return within - self.within + moved + carried <= self.margin


@dataclass(frozen=True, eq=False)
class Candidates:
    """Of facets with these corners (m, c)."""

    corners: Ints
    _looks: dict[int, _Look] = field(default_factory=dict)

    def __call__(self, placed: Placed, x: Values, within: float) -> Ints:
        """(k,) all that have a place nearer than `within` m to an obstacle with points at x (n, d), and others."""
        last = self._looks.get(id(placed.shape))
        if last is None or last.placed.shape is not placed.shape or not last.holds(placed, x, within):
            last = self._looks[id(placed.shape)] = self._look(placed, x, within)
        return last.found

    def _look(self, placed: Placed, x: Values, within: float) -> _Look:
        corners = x[self.corners]
        middle = corners.mean(axis=1)
        arms = corners - middle[:, None]
        around = np.sqrt(np.einsum("kcd,kcd->kc", arms, arms).max(axis=1, initial=0.0))
        margin = max(float(around.mean()) if len(around) else 0.0, within)
        return _Look(x, placed, within, margin, np.flatnonzero(placed.distance(middle) - around < within + margin))


def _radius(placed: Placed) -> float:
    """m, of a shape about its reference point."""
    points, _ = placed.shape.outline()
    return OUTLINE * float(np.linalg.norm(points, axis=1).max())
