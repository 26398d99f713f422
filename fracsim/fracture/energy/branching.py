"""How tips go that share a disc, as those of a crack that has branched do (in the plane; running says when one does).

    g = G a,   a = sum_k q(x_k) t_k      of tips x_k in the disc, along t_k, that take up G each

A disc with several tips advances them all, so that its force is over all of them, as that in space is over the crack
that an advance makes (crack_front). Each of two short branches releases 0.52 of what the one crack does straight on.

The force of a disc in which there is another tip is neither's, and does not say which is to go. Until branches have
left each other's discs they keep level, and each goes straight on, at the angle at which short branches open and do not
slide: 27 degrees (by elements of order 2, tests/test_branching.py; 0.52 from there). But nobody waits where
there is enough for both: the other has stopped, and would never be level again.

Equations: docs/theory.md#crack-speed-and-branching.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from .configurational_force import plateau
from .neighbour_search import Pairs

Flags = npt.NDArray[np.bool_]
Values = npt.NDArray[np.float64]

TIPS = 2.0  # G over G_c from which on there is enough for two
ABREAST, LEAD = 0.5, 0.2  # of R: tips no more apart along their way go abreast; and the one that is so far ahead waits
ANGLE = np.radians(27.0)  # between each branch and the crack that they come from


def unit(vectors: Values) -> Values:
    """(n, d) of length 1; 0 stays."""
    length = np.linalg.norm(vectors, axis=1)[:, None]
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0)


def rotated(vectors: Values, angle: float | Values) -> Values:
    """(n, 2) turned anti-clockwise by an angle or (n,)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.column_stack([c * vectors[:, 0] - s * vectors[:, 1], s * vectors[:, 0] + c * vectors[:, 1]])


def advance(pairs: Pairs, along: Values, radius: Values) -> Values:
    """(n, 2) a, of pairs of places and the tips in their discs, which go `along` (pairs, 2); a place is one of them."""
    return pairs.sum(plateau(pairs.distance, radius[pairs.place])[:, None] * unit(along))


def each(force: Values, advance: Values, tangent: Values) -> Values:
    """(n,) G, J/m^2: g . a / |a|^2, or along the tip's own tangent where the others in its disc come towards it."""
    square = np.einsum("ni,ni->n", advance, advance)
    towards = (square < 1) | (np.einsum("ni,ni->n", advance, tangent) < 1)
    shared = np.einsum("ni,ni->n", force, advance) / np.where(towards, 1.0, square)
    return np.where(towards, np.einsum("ni,ni->n", force, tangent), shared)


def parted(pairs: Pairs, own: Values, other: Values, radius: Values) -> tuple[Values, Flags]:
    """(n, 2) whither tips go that run abreast of another in their disc, 0 for others, and (n,) whether they wait.

    `own`, `other`: (pairs, 2) how the place and the other tip go, of any length. `radius`: (n,) R, m. Each at ANGLE to
    the way of both, away from the nearest other.
    """
    both, disc = unit(own + other), radius[pairs.place]
    left = -np.einsum("ni,ni->n", pairs.apart, rotated(both, np.pi / 2))
    lead = -np.einsum("ni,ni->n", pairs.apart, both)
    abreast = (pairs.distance < disc) & (np.abs(lead) <= ABREAST * disc)
    abreast &= (np.einsum("ni,ni->n", own, other) > 0) & (left != 0)
    rows = np.flatnonzero(abreast)
    rows = rows[np.lexsort([pairs.distance[rows], pairs.place[rows]])]
    place, first = np.unique(pairs.place[rows], return_index=True)
    rows = rows[first]
    way, waits = np.zeros((pairs.count, 2)), np.zeros(pairs.count, bool)
    way[place] = rotated(both[rows], np.sign(left[rows]) * ANGLE)
    waits[place] = lead[rows] > LEAD * disc[rows]
    return way, waits
