"""How deep obstacles lie in one another: at the start none may, and in explicit steps they do not feel each other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np
import numpy.typing as npt

from ..errors import InputError
from .obstacle import RigidObstacle
from .pose import PosedShape

Values = npt.NDArray[np.float64]

LOOKS, SHORTER = 60, 0.8  # of the search for the deepest point, and each against the last
LEAST = 1e-6  # of the size of the free one: less is mere touch


def free_pairs(obstacles: Sequence[RigidObstacle]) -> list[tuple[int, int]]:
    """Numbers of a free obstacle and another one, each pair once."""
    both = combinations(range(len(obstacles)), 2)
    either = [(a, b) if obstacles[a].free else (b, a) for a, b in both]
    return [(a, b) for a, b in either if obstacles[a].free]


def find_overlaps(
    placed: Sequence[PosedShape], among: Sequence[tuple[int, int]], least: float = LEAST
) -> Iterator[tuple[int, int, float]]:
    """Those of the pairs that overlap by more than `least` of the size of the first, and how deep, m."""
    for a, b in among:
        size = float(np.ptp(placed[a].shape.tessellate()[0], axis=0).max())
        if (deep := overlap_depth(placed[a], placed[b])) > least * size:
            yield a, b, deep


def overlap_depth(body: PosedShape, other: PosedShape) -> float:
    """-min of the distance to the other shape over a convex body, m: by how far they overlap, or less than 0.

    From the points of its outline downhill by ever shorter ways, each brought back to the nearest point of the body.
    """
    x = body.pose.points_to_space(body.shape.tessellate()[0])
    way, least = float(np.linalg.norm(np.ptp(x, axis=0))), other.distance(x)
    for _ in range(LOOKS):
        x = x - way * other.normal(x)
        x = x - np.maximum(body.distance(x), 0.0)[:, None] * body.normal(x)
        least, way = np.minimum(least, other.distance(x)), SHORTER * way
    return -float(least.min())


def check_free_apart(obstacles: Sequence[RigidObstacle]) -> None:
    """InputError where a free obstacle overlaps or touches another one at the start."""
    for a, b, deep in find_overlaps([each.posed_at(0.0) for each in obstacles], free_pairs(obstacles), -LEAST):
        raise InputError(
            f"obstacle.{a}: {obstacles[a].name} moves freely and overlaps {obstacles[b].name} at the start, by "
            f"{max(0.0, deep):.4g} m; move it away or make it smaller"
        )
