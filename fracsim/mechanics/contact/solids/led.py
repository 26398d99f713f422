"""First guesses that have passed through no solid: what would is stopped before it, and taken along from there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix

from ..near import KEPT, longest
from ..pose import Pose
from .facing import Facing, Facings
from .front import Front

Values = npt.NDArray[np.float64]

ROUNDS = 5  # in which points that follow several nodes are brought back
PIECES = 50  # of a way, each of an edge's length
WEIGHT = 1e-3  # of points that are stopped, from which on a node is brought back with them


def led_past(front: Front, pairs: Facings, start: Values, end: Values, before: Sequence[Pose]) -> Values:
    """(nodes, 3) displacements at the `end` of a step, m, with points stopped where they would pass into a solid of
    `pairs`; at the `start` solids were at poses `before`; they are where they will be. The same array where none
    would."""
    at = front.at
    x = at(start)
    for _ in range(ROUNDS):
        to = at(end)
        if pairs.along(x, to, before) == 1:
            return end
        back = np.sum([brought_back(*each, x, to) for each in zip(pairs.each, before, strict=True)], axis=0)
        if not back.any():
            return end
        end = end + _of_nodes(abs(at.weights).T, back)
    return end


def _of_nodes(weights: csr_matrix, back: Values) -> Values:
    """(nodes, 3) means of what is `back` (n, 3) over the points that are stopped, by `weights` (nodes, n) >= 0."""
    weight = weights @ back.any(axis=1).astype(float)
    taken = weight > WEIGHT
    return np.where(taken[:, None], (weights @ back) / np.where(taken, weight, 1.0)[:, None], 0.0)


def brought_back(facing: Facing, before: Pose, x: Values, to: Values) -> Values:
    """(n, 3) what the ways of points from x to `to` lack of safe ones, m: seen from the solid a point stops where it
    comes as near to it as a tenth of its distance; piece by piece, each point on its own."""
    way = to - facing.solid.pose.points_to_space(before.to_body(x))  # seen from the solid
    edge = facing.edge
    count = min(max(1, int(np.ceil(longest(way) / edge))), PIECES)
    now, there = to - way, to - way  # beside the solid where it is now
    going = np.ones(len(x), bool)
    for piece in range(count):
        step = to - way * (1 - (piece + 1) / count) - there
        length = np.linalg.norm(step, axis=1)
        safe = (1 - KEPT) * facing.safe_distances(now, min(1.01 * longest(step) / (1 - KEPT), 2 * edge))
        going &= length <= safe
        now = now + np.where(going[:, None], step, 0.0)
        there = there + step
    return np.where(going[:, None], 0.0, now - to)
