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
from .shape_base import Shape, frame_about, unit_vector
from .shapes import Capsule, RoundedBox, RoundedCylinder, Sphere, TranslatedShape
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
    if isinstance(shape, TriangleMeshShape):
        return InsetPoints(shape.points, 0.0, surface_measure(shape) / len(shape.points))
    points, radius = _points_and_radius(shape)
    axis = unit_vector(shape.axis) if isinstance(shape, RoundedCylinder) and len(points) else None
    return InsetPoints(points, radius, surface_measure(shape) / max(len(points), 1), axis)


def _points_and_radius(shape: Shape) -> tuple[Values, float]:
    if isinstance(shape, Sphere) and shape.convex:
        return np.zeros((1, shape.dim)), shape.radius
    if isinstance(shape, Capsule) and shape.convex:
        along = np.linspace(-0.5, 0.5, SAMPLES.edge_points) * shape.length
        return along[:, None] * unit_vector(shape.axis), shape.radius
    if isinstance(shape, RoundedBox) and shape.convex:
        return _edge_points(np.array(shape.size) / 2 - shape.fillet), shape.fillet
    if isinstance(shape, RoundedCylinder) and shape.convex:
        return _circle_points(shape), shape.fillet
    return np.empty((0, shape.dim)), 0.0


def surface_measure(shape: Shape) -> float:
    """Area of the tessellation of a shape, m^2 (2D: length, m)."""
    points, elements = shape.tessellate()
    side = points[elements[:, 1:]] - points[elements[:, :1]]
    if shape.dim == 2:
        return float(np.linalg.norm(side[:, 0], axis=1).sum())
    return float(np.linalg.norm(np.cross(side[:, 0], side[:, 1]), axis=1).sum() / 2)


def _edge_points(half: Values) -> Values:
    """Points on the edges of a box of half sizes (d,), m; in 2D its corners."""
    d = len(half)
    if d == 2:
        return np.array(list(product((-1.0, 1.0), repeat=2))) * half
    along = np.linspace(-1.0, 1.0, SAMPLES.edge_points)
    lines = [np.insert(np.array(ends), axis, t) for axis in range(d) for ends in product((-1.0, 1.0), repeat=2)
             for t in along]  # fmt: skip
    return np.unique(np.array(lines), axis=0) * half


def _circle_points(shape: RoundedCylinder) -> Values:
    """Points on circles over the side of a cylinder."""
    angle = np.arange(SAMPLES.circle_points) * (2 * np.pi / SAMPLES.circle_points)
    radius, half = shape.radius - shape.fillet, shape.length / 2 - shape.fillet
    circle = radius * np.column_stack([np.cos(angle), np.sin(angle)])
    heights = np.linspace(-half, half, SAMPLES.edge_points)
    rings = [np.column_stack([circle, np.full(SAMPLES.circle_points, height)]) for height in heights]
    return np.concatenate(rings) @ frame_about(unit_vector(shape.axis)).T
