"""What an obstacle does to points, joined with what it does to the facets between them (facets).

Friction acts at the points alone. A place on a facet sticks where its corners do not, and with the slip that passes for
sticking so small Newton's method hunts for which of them do: 20 to 50 iterations a step in place of 3 to 5.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from .facets import Between
from .touch import Touch

Values = npt.NDArray[np.float64]


def joined(found: Touch, inner: Between, stored: float) -> Touch:
    """A touch with what facets feel, which store J, added to their corners, and their stiffness between these."""
    if not len(inner.area):
        return found
    points = np.union1d(found.points, inner.corners.reshape(-1))
    place, d = np.searchsorted(points, found.points), found.normal.shape[1]
    normal, rubbed = np.zeros((2, len(points), d))
    normal[place], rubbed[place] = found.normal, found.friction
    np.add.at(normal, np.searchsorted(points, inner.corners), inner.forces)

    def parts() -> tuple[Values, Values]:
        exact, stick = np.zeros((2, len(points), d, d))
        exact[place], stick[place] = found.exact, found.stick
        return exact, stick

    potential = found.potential + float(inner.energy.sum())
    return Touch(points, found.energy + stored, normal, rubbed, potential, parts, inner)
