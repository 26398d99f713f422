"""Tessellation of obstacles for output: made once in their own frame, and moved with their poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
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


@dataclass(frozen=True)
class SlabPolicy:
    """Slab that stands for a half space in output.

    Attributes:
        patch_size: its edge, in diagonals of the body's bounding box.
        thickness: in its edge, so that it is seen from the side.
    """

    patch_size: float = 2.0
    thickness: float = 0.01


SLAB = SlabPolicy()


class ObstacleTessellation:
    """Tessellation of a shape in its own frame, in 2D with its area; of a half space a slab near the body."""

    def __init__(self, posed: PosedShape, lower: Values, upper: Values) -> None:
        """`posed`: the shape at the start; `lower`, `upper`: (d,) corners of the body's bounding box then, m."""
        if isinstance(posed.shape, HalfSpace):
            middle = posed.pose.to_body((lower + upper)[None] / 2)[0]
            side = SLAB.patch_size * float(np.linalg.norm(upper - lower))
            self._points, elements = slab(unit_vector(posed.shape.direction), middle, side)
        else:
            self._points, elements = posed.shape.tessellate()
        empty = np.empty((0, 2), np.int32)
        is_flat = self._points.shape[1] == 2
        self._segments = elements if is_flat else empty
        self._triangles = _fan(posed.shape, len(self._points)) if is_flat else elements

    def __call__(self, posed: PosedShape) -> SurfaceData:
        """Tessellation at the pose of `posed`."""
        return SurfaceData(posed.pose.points_to_space(self._points), self._triangles, self._segments)


class ObstacleTessellations:
    """Tessellations of several obstacles, made when they are first needed."""

    def __init__(self, obstacles: Sequence[RigidObstacle], lower: Values, upper: Values) -> None:
        """`lower`, `upper`: (d,) corners of the body's bounding box at the start, m."""
        self._obstacles, self._box = obstacles, (lower, upper)

    @cached_property
    def _tessellations(self) -> list[ObstacleTessellation]:
        return [ObstacleTessellation(obstacle.posed_at(0.0), *self._box) for obstacle in self._obstacles]

    def __call__(self, posed: Sequence[PosedShape]) -> dict[str, SurfaceData]:
        """Tessellations by the names of obstacles, at the poses of `posed`."""
        items = zip(self._obstacles, self._tessellations, posed, strict=True)
        return {obstacle.name: tessellation(shape) for obstacle, tessellation, shape in items}


def slab(normal: Values, middle: Values, side: float) -> tuple[Values, Ints]:
    """Tessellation of a slab behind the plane n . x = 0.

    Args:
        normal: (d,) n.
        middle: (d,) point over the middle of the slab, m.
        side: edge of the slab, m.
    """
    d = len(normal)
    ranges = [*[[-0.5, 0.5]] * (d - 1), [-SLAB.thickness, 0.0]]
    corners = np.stack(np.meshgrid(*ranges, indexing="ij"), axis=-1).reshape(-1, d)
    foot = middle - (middle @ normal) * normal
    points = foot + side * corners @ frame_about(normal).T
    if d == 2:
        order = np.array([0, 2, 3, 1])  # counterclockwise
        return points[order], np.array([[0, 1], [1, 2], [2, 3], [3, 0]], np.int32)
    # the number of a corner is the sum of these for its upper coordinates
    x, y, z = 4, 2, 1
    squares = [[0, y, x + y, x], [z, x + z, x + y + z, y + z], [0, x, x + z, z], [y, y + z, x + y + z, x + y],
               [0, z, y + z, y], [x, x + y, x + y + z, x + z]]  # fmt: skip
    a, b, c, e = np.array(squares, np.int32).T
    return points, np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, e])])


def _fan(shape: Shape, count: int) -> Ints:
    """(k, 3) fan of triangles over a convex polygon of `count` points; empty for a hollow shape."""
    if not shape.convex:
        return np.empty((0, 3), np.int32)
    second = np.arange(1, count - 1, dtype=np.int32)
    return np.column_stack([np.zeros_like(second), second, second + 1])
