"""What is left of a shape without its rounding: points, all within a radius of which are in it.

A ball or capsule is all within its radius of a point or segment; corners and edges of boxes and cylinders are all
within the radius of their rounding. Where two convex bodies are nearest to each other one of these points is nearest
to the other body: exactly in 2D, and in 3D but for two edges that cross, which are taken at SAMPLES points each.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from .offset_shape import TranslatedShape
from .shape_base import ConvexBody, Shape, Values, frame_about, unit_vector
from .shapes import Capsule, RoundedBox, RoundedCylinder, Sphere
from .triangle_mesh_shape import TriangleMeshShape

SAMPLES = 9  # of an edge or a side
ROUND = 24  # of a circle


@dataclass(frozen=True, eq=False)
class InsetPoints:
    """Points (n, d) in the frame of a shape, m, the radius about them, m, and the share of each in the surface, m^2."""

    points: Values
    radius: float
    area: float = 0.0


@dataclass(frozen=True, eq=False)
class OffsetShape:
    """A shape and all within `by` of it, m: the distance less that."""

    shape: Shape
    offset: float

    @property
    def convex(self) -> bool:
        """As the shape is."""
        return self.shape.convex

    @property
    def rotation_invariant(self) -> bool:
        """As the shape is."""
        return self.shape.rotation_invariant

    def distance(self, x: Values) -> Values:
        """(n,) m."""
        return self.shape.distance(x) - self.offset

    def normal(self, x: Values) -> Values:
        """(n, d)."""
        return self.shape.normal(x)

    def curvature(self, x: Values) -> Values:
        """(n, d, d) 1/m."""
        return self.shape.curvature(x)


def inset_points(shape: Shape) -> InsetPoints:
    """Of a shape; without points where it is without end or hollow."""
    if isinstance(shape, TranslatedShape):
        inner = inset_points(shape.shape)
        return InsetPoints(inner.points + shape.offset, inner.radius, inner.area)
    if isinstance(shape, TriangleMeshShape):
        return InsetPoints(shape.points, 0.0, surface_measure(shape) / len(shape.points))
    points, radius = _bones(shape)
    return InsetPoints(points, radius, surface_measure(shape) / max(len(points), 1))


def _bones(shape: Shape) -> tuple[Values, float]:
    if isinstance(shape, ConvexBody) and not shape.hollow:
        if isinstance(shape, Sphere):
            return np.zeros((1, shape.dim)), shape.radius
        if isinstance(shape, Capsule):
            along = np.linspace(-0.5, 0.5, SAMPLES) * shape.length
            return along[:, None] * unit_vector(shape.axis), shape.radius
        if isinstance(shape, RoundedBox):
            return _edges(np.array(shape.size) / 2 - shape.fillet), shape.fillet
        if isinstance(shape, RoundedCylinder):
            return _rings(shape), shape.fillet
    return np.empty((0, shape.dim)), 0.0


def surface_measure(shape: Shape) -> float:
    """Measure of its outline, m^2 (2D: m)."""
    points, elements = shape.tessellate()
    side = points[elements[:, 1:]] - points[elements[:, :1]]
    if shape.dim == 2:
        return float(np.linalg.norm(side[:, 0], axis=1).sum())
    return float(np.linalg.norm(np.cross(side[:, 0], side[:, 1]), axis=1).sum() / 2)


def _edges(half: Values) -> Values:
    """Points on the edges of a box, in 2D its corners."""
    d = len(half)
    if d == 2:
        return np.array(list(product((-1.0, 1.0), repeat=2))) * half
    along = np.linspace(-1.0, 1.0, SAMPLES)
    lines = [np.insert(np.array(ends), axis, t) for axis in range(d) for ends in product((-1.0, 1.0), repeat=2)
             for t in along]  # fmt: skip
    return np.unique(np.array(lines), axis=0) * half


def _rings(shape: RoundedCylinder) -> Values:
    """Points on circles over the side of a cylinder."""
    turn = np.arange(ROUND) * (2 * np.pi / ROUND)
    radius, half = shape.radius - shape.fillet, shape.length / 2 - shape.fillet
    circle = radius * np.column_stack([np.cos(turn), np.sin(turn)])
    rings = [np.column_stack([circle, np.full(ROUND, height)]) for height in np.linspace(-half, half, SAMPLES)]
    return np.concatenate(rings) @ frame_about(unit_vector(shape.axis)).T
