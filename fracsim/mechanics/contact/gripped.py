"""Friction on facets: what presses on them between their corners counts at these, as much as each bears of it.

The force on a corner is that at the point itself and its share of those of the facets around it; its size and direction
are the normal force and the normal that friction of the step is lagged with. So all that presses rubs, with the moment
of what presses. What slides under a corner is the obstacle where it presses: the mean of these places, by their forces.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from .facets import Between
from .touch import Grip

Values = npt.NDArray[np.float64]


def gripped_between(held: Grip, inner: Between, x: Values) -> Grip:
    """`held`: points alone, of the start of a step at x (n, d), m; with what acts on facets then."""
    corners, d = inner.corners.reshape(-1), x.shape[1]
    points = np.union1d(held.points, corners)
    if len(points) == 0:
        return held
    at, of = np.searchsorted(points, held.points), np.searchsorted(points, corners)
    force, weight, under = np.zeros((len(points), d)), np.zeros(len(points)), np.zeros((len(points), d))
    force[at], weight[at] = held.force[:, None] * held.normal, held.force
    under[at] = held.force[:, None] * held.start
    np.add.at(force, of, inner.forces.reshape(-1, d))
    pressed = np.linalg.norm(inner.forces, axis=2)
    np.add.at(weight, of, pressed.reshape(-1))
    np.add.at(under, of, (pressed[:, :, None] * inner.at.place[:, None, :]).reshape(-1, d))
    size = np.linalg.norm(force, axis=1)
    kept = np.flatnonzero(size > 0)
    points, size, start = points[kept], size[kept], x[points[kept]]
    return Grip(points, size, force[kept] / size[:, None], start, under[kept] / weight[kept, None])
