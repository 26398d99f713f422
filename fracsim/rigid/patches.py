"""Forces on circles of contact, with Hertz's pressure (K. L. Johnson, Contact Mechanics, 1985, eq. 3.39).

    p(r) = 3 F / (2 pi a^2) sqrt(1 - r^2 / a^2)

as points of equal force, in the plane across it: a share q of the force acts within r = a sqrt(1 - (1 - q)^(2/3)). They
lie on a spiral of golden angles, each with its mirror image, so that the force keeps its moment.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]

FINE = 0.05  # mean edges: a smaller circle is a point
DENSE = 12.0  # points to a square edge
FEWEST, MOST = 8, 256  # pairs of points to a circle
GOLDEN = np.pi * (3 - np.sqrt(5))


def patches(points: Values, force: Values, radius: Values, edge: float) -> tuple[Values, Values]:
    """(n, 3) points and (n, 3) forces on circles of radii (k,) about points (k, 3), m, from forces (k, 3), N; `edge`:
    of the cells that they fall on, m."""
    wide = np.flatnonzero(radius > FINE * edge)
    if not len(wide):
        return points, force
    narrow = np.setdiff1d(np.arange(len(radius)), wide)
    pairs = np.clip(np.pi * DENSE / 2 * (radius[wide] / edge) ** 2, FEWEST, MOST).astype(np.int64)
    of = np.repeat(np.arange(len(wide)), pairs)
    number = np.arange(len(of)) - np.repeat(np.cumsum(pairs) - pairs, pairs)
    share = (number + 0.5) / pairs[of]
    r, angle = radius[wide][of] * np.sqrt(1 - (1 - share) ** (2 / 3)), GOLDEN * number
    first, second = _across(force[wide])
    arm = (r * np.cos(angle))[:, None] * first[of] + (r * np.sin(angle))[:, None] * second[of]
    middle, each = points[wide][of], (force[wide] / (2 * pairs[:, None]))[of]
    return (
        np.concatenate([points[narrow], middle + arm, middle - arm]),
        np.concatenate([force[narrow], each, each]),
    )


def _across(way: Values) -> tuple[Values, Values]:
    """Two (k, 3) unit vectors across directions (k, 3) of any length but none."""
    least = np.eye(3)[np.abs(way).argmin(axis=1)]
    first = np.cross(way, least)
    first /= np.linalg.norm(first, axis=1)[:, None]
    second = np.cross(way, first)
    return first, second / np.linalg.norm(second, axis=1)[:, None]
