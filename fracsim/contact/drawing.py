"""What is drawn of an obstacle: its outline, made once in its own frame and moved with its pose."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import numpy.typing as npt

from ..mechanics.term_protocols import SurfaceData
from .obstacle import RigidObstacle
from .pose import PosedShape
from .shape_base import Shape, frame_about, unit_vector
from .shapes import HalfSpace

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]

PATCH = 2.0  # edge of what is drawn of a plane, in diagonals of the body's box
THICK = 0.01  # of the patch: seen from the side a plane would be no more than a line


class ObstacleTessellation:
    """The outline of a shape, in 2D with what it fills; of a plane a slab behind the part of it near the body."""

    def __init__(self, placed: PosedShape, lower: Values, upper: Values) -> None:
        """`placed`: where the shape is at the start; `lower`, `upper`: corners of the body's box then, m."""
        if isinstance(placed.shape, HalfSpace):
            middle = placed.pose.to_body((lower + upper)[None] / 2)[0]
            side = PATCH * float(np.linalg.norm(upper - lower))
            self._points, elements = slab(unit_vector(placed.shape.direction), middle, side)
        else:
            self._points, elements = placed.shape.tessellate()
        none = np.empty((0, 2), np.int32)
        flat = self._points.shape[1] == 2
        self._segments = elements if flat else none
        self._triangles = _filling(placed.shape, len(self._points)) if flat else elements

    def __call__(self, placed: PosedShape) -> SurfaceData:
        """Where it is now."""
        return SurfaceData(placed.pose.points_to_space(self._points), self._triangles, self._segments)


class ObstacleTessellations:
    """Of several obstacles, made once they are asked for."""

    def __init__(self, obstacles: Sequence[RigidObstacle], lower: Values, upper: Values) -> None:
        """`lower`, `upper`: corners of the body's box at the start, m."""
        self._obstacles, self._box = obstacles, (lower, upper)

    @cached_property
    def _each(self) -> list[ObstacleTessellation]:
        return [ObstacleTessellation(each.posed_at(0.0), *self._box) for each in self._obstacles]

    def __call__(self, placed: Sequence[PosedShape]) -> dict[str, SurfaceData]:
        """Each by its name, where it is now."""
        each = zip(self._obstacles, self._each, placed, strict=True)
        return {obstacle.name: drawing(here) for obstacle, drawing, here in each}


def min_extent(shape: Shape) -> float:
    """The least side of the box around a shape, m; infinite of a plane and of a hollow one."""
    if isinstance(shape, HalfSpace) or not shape.convex:
        return float("inf")
    return float(np.ptp(shape.tessellate()[0], axis=0).min())


def slab(normal: Values, middle: Values, side: float) -> tuple[Values, Ints]:
    """Outline (triangles; in 2D segments) of a slab of that side behind the plane n . x = 0, over the point `middle`
    (d,), m."""
    d = len(normal)
    corners = np.stack(np.meshgrid(*[[-0.5, 0.5]] * (d - 1), [-THICK, 0.0], indexing="ij"), axis=-1).reshape(-1, d)
    over = middle - (middle @ normal) * normal
    points = over + side * corners @ frame_about(normal).T
    if d == 2:
        around = np.array([0, 2, 3, 1])  # counterclockwise
        return points[around], np.array([[0, 1], [1, 2], [2, 3], [3, 0]], np.int32)
    x, y, z = 4, 2, 1  # of a corner's number
    squares = [[0, y, x + y, x], [z, x + z, x + y + z, y + z], [0, x, x + z, z], [y, y + z, x + y + z, x + y],
               [0, z, y + z, y], [x, x + y, x + y + z, x + z]]  # fmt: skip
    a, b, c, e = np.array(squares, np.int32).T
    return points, np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, e])])


def _filling(shape: Shape, count: int) -> Ints:
    """(k, 3) a fan over a convex polygon of `count` points; none where the shape is what lies outside it."""
    if not shape.convex:
        return np.empty((0, 3), np.int32)
    rest = np.arange(1, count - 1, dtype=np.int32)
    return np.column_stack([np.zeros_like(rest), rest, rest + 1])
