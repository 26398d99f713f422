"""Inset points of analytic obstacles: a shape is all within a radius of them.

They are the centre of a sphere, points on the segment of a capsule, and points on the edges of a box or a cylinder
without their rounding. Where two convex bodies are nearest to each other one of these points is nearest to the other
body: exactly in 2D, and in 3D except for two edges that cross.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from ..array_types import Values
from .pose import Pose, PosedShape
from .shape_base import Shape, frame_about, measures
from .shapes import RevolvedBody, RoundedBox, TranslatedShape
from .triangle_mesh_shape import TriangleMeshShape


@dataclass(frozen=True)
class InsetPolicy:
    """Numbers of sampled points.

    Attributes:
        edge_points: points on an edge or a segment, and circles on a cylinder.
        circle_points: points on a circle.
        touching_share: share of a surface that touches at once in a penalty, as one face of a box.
    """

    edge_points: int = 9
    circle_points: int = 24
    touching_share: float = 0.25


SAMPLES = InsetPolicy()


@dataclass(frozen=True, eq=False)
class InsetPoints:
    """Points such that a shape is all within a radius of them.

    Attributes:
        points: (n, d) in the frame of the shape, m; of a cylinder circle by circle.
        radius: m.
        area: share of each point in the surface of the shape, m^2 (2D: m).
        axis: (3,) unit axis of a cylinder, whose circles are turned about it; None: points stay.
    """

    points: Values
    radius: float
    area: float = 0.0
    axis: Values | None = None

    @property
    def areas(self) -> Values:
        """(n,) shares of all points, m^2."""
        return np.full(len(self.points), self.area)

    def posed(self, pose: Pose, target: PosedShape) -> Values:
        """(n, d) points in space before another shape, m.

        Circles of a cylinder are turned such that their first point is on the side of the other shape: on a plane the
        lowest one. By symmetry the forces then have no moment about the axis, however a cylinder spins.
        """
        if self.axis is None:
            return pose.points_to_space(self.points)
        circles, axis = self.points.reshape(-1, SAMPLES.circle_points, 3), self.axis
        centres = circles.mean(axis=1)
        towards = -target.normal(pose.points_to_space(centres)) @ pose.rotation
        arms = circles - centres[:, None]
        first, across = arms[:, 0], np.cross(axis, arms[:, 0])
        angle = np.arctan2(np.einsum("ci,ci->c", towards, across), np.einsum("ci,ci->c", towards, first))
        cosine, sine = np.cos(angle)[:, None, None], np.sin(angle)[:, None, None]
        turned = centres[:, None] + cosine * arms + sine * np.cross(axis, arms)
        return pose.points_to_space(turned.reshape(-1, 3))

    def spin_direction(self, pose: Pose) -> Values | None:
        """(6,) increment of the pose that turns a cylinder about its axis by 1 rad; None: no such axis."""
        return None if self.axis is None else np.concatenate([np.zeros(3), pose.vectors_to_space(self.axis)])


def inset_points(shape: Shape) -> InsetPoints:
    """Inset points of a shape; none of half spaces and hollow shapes."""
    if isinstance(shape, TranslatedShape):
        original = inset_points(shape.shape)
        return replace(original, points=original.points + shape.offset)
    points: Values = np.empty((0, shape.dim))
    radius, axis = 0.0, None
    if isinstance(shape, TriangleMeshShape):
        points = shape.points
    elif isinstance(shape, RoundedBox) and shape.convex:
        points, radius = _edge_points(shape.core), shape.fillet
    elif isinstance(shape, RevolvedBody) and shape.convex:
        direction, core_radius, half = shape.core
        points, radius = _circle_points(direction, core_radius, half), shape.fillet
        axis = direction if core_radius else None
    return InsetPoints(points, radius, float(measures(*shape.tessellate()).sum()) / max(len(points), 1), axis)


def _edge_points(half: Values) -> Values:
    """Points on the edges of a box of half sizes (d,), m; in 2D its corners."""
    d = len(half)
    if d == 2:
        return np.array(list(product((-1.0, 1.0), repeat=2))) * half
    along = np.linspace(-1.0, 1.0, SAMPLES.edge_points)
    lines = [np.insert(np.array(ends), axis, t) for axis in range(d) for ends in product((-1.0, 1.0), repeat=2)
             for t in along]  # fmt: skip
    return np.unique(np.array(lines), axis=0) * half


def _circle_points(axis: Values, radius: float, half: float) -> Values:
    """Points on circles over the side of a cylinder of half length `half`, m; without a radius on its axis."""
    heights = np.linspace(-half, half, SAMPLES.edge_points) if half else np.zeros(1)
    if not radius:
        return heights[:, None] * axis
    angle = np.arange(SAMPLES.circle_points) * (2 * np.pi / SAMPLES.circle_points)
    circle = radius * np.column_stack([np.cos(angle), np.sin(angle)])
    rings = [np.column_stack([circle, np.full(SAMPLES.circle_points, height)]) for height in heights]
    return np.concatenate(rings) @ frame_about(axis).T
