"""Crack tips that share a disc, such as those of a branched crack (2D; `crack_speed` has the criterion of branching).

    g = G a,   a = sum_k q(x_k) t_k      of tips x_k in the disc that advance along t_k and release G each

The force of a disc with several tips is that of all of them, so that it is divided by the advance of all. Each of two
short branches releases 0.52 of the energy of the single crack straight ahead.

The force does not give the direction of one tip. Until branches have left each other's discs they advance side by side
and straight, at the angle at which short branches open without sliding. If there is enough energy for both, a branch
advances without the other, which has stopped and would never catch up.

Equations: docs/theory.md#crack-speed-and-branching.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from .configurational_force import plateau
from .neighbour_search import NeighbourPairs
from .tip_parameters import TIP

Flags = npt.NDArray[np.bool_]
Values = npt.NDArray[np.float64]


def unit_or_zero(vectors: Values) -> Values:
    """Return vectors (n, d) of length 1; vectors of no length stay 0."""
    length = np.linalg.norm(vectors, axis=1)[:, None]
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0)


def rotate(vectors: Values, angle: float | Values) -> Values:
    """Return vectors (n, 2) rotated anti-clockwise by an angle or angles (n,), rad."""
    c, s = np.cos(angle), np.sin(angle)
    return np.column_stack([c * vectors[:, 0] - s * vectors[:, 1], s * vectors[:, 0] + c * vectors[:, 1]])


def shared_advance(pairs: NeighbourPairs, directions: Values, radius: Values) -> Values:
    """Return the advance a (n, 2) of all tips in each disc, of radius (n,), m.

    `pairs` are those of points and the tips in their discs, the tip at the point included, which advance along
    `directions` (pairs, 2).
    """
    return pairs.sum(plateau(pairs.distance, radius[pairs.first])[:, None] * unit_or_zero(directions))


def release_rate(force: Values, advance: Values, tangent: Values) -> Values:
    """Return G (n,), J/m^2, of tips with forces (n, 2), shared advances (n, 2) and unit tangents (n, 2).

    G = g . a / |a|^2, or g . t where the other tips of the disc approach the tip.
    """
    square = np.einsum("ni,ni->n", advance, advance)
    approach = (square < 1) | (np.einsum("ni,ni->n", advance, tangent) < 1)
    shared = np.einsum("ni,ni->n", force, advance) / np.where(approach, 1.0, square)
    return np.where(approach, np.einsum("ni,ni->n", force, tangent), shared)


def branch_directions(
    pairs: NeighbourPairs, directions: Values, other_directions: Values, radius: Values
) -> tuple[Values, Flags]:
    """Return directions (n, 2) of tips that advance side by side with another, 0 elsewhere, and which of them wait.

    A tip takes the branching angle to the mean direction of both, away from the nearest other tip.

    Args:
        pairs: pairs of tips (`place`) and the tips around them (`other`).
        directions: (pairs, 2) direction of the tip, of any length.
        other_directions: (pairs, 2) direction of the other tip.
        radius: (n,) R, m.
    """
    mean, disc = unit_or_zero(directions + other_directions), radius[pairs.first]
    left = -np.einsum("ni,ni->n", pairs.apart, rotate(mean, np.pi / 2))
    lead = -np.einsum("ni,ni->n", pairs.apart, mean)
    side_by_side = (pairs.distance < disc) & (np.abs(lead) <= TIP.side_by_side * disc)
    side_by_side &= (np.einsum("ni,ni->n", directions, other_directions) > 0) & (left != 0)
    rows = np.flatnonzero(side_by_side)
    rows = rows[np.lexsort([pairs.distance[rows], pairs.first[rows]])]
    tip, first = np.unique(pairs.first[rows], return_index=True)
    rows = rows[first]
    result, is_inactive = np.zeros((pairs.count, 2)), np.zeros(pairs.count, bool)
    result[tip] = rotate(mean[rows], np.sign(left[rows]) * TIP.branching_angle)
    is_inactive[tip] = lead[rows] > TIP.max_lead * disc[rows]
    return result, is_inactive
