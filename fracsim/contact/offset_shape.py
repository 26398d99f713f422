"""A shape whose reference point is elsewhere: one that hangs on a hinge turns about that."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from .shape_base import Shape, Values
from .tessellation import Tessellation


@dataclass(frozen=True, eq=False)
class TranslatedShape:
    """A shape centred at `offset` (d,) from the reference point, m."""

    kind: ClassVar[str] = "shape on a hinge"
    shape: Shape
    offset: Values

    @property
    def dim(self) -> int:
        """2 or 3."""
        return self.shape.dim

    @property
    def convex(self) -> bool:
        """As the shape is."""
        return self.shape.convex

    @property
    def rotation_invariant(self) -> bool:
        """Not about a point elsewhere."""
        return False

    @property
    def min_radius(self) -> float:
        """That of the shape."""
        return self.shape.min_radius

    @property
    def volume(self) -> float:
        """That of the shape."""
        return self.shape.volume

    def distance(self, x: Values) -> Values:
        """(n,) m."""
        return self.shape.distance(x - self.offset)

    def normal(self, x: Values) -> Values:
        """(n, d)."""
        return self.shape.normal(x - self.offset)

    def curvature(self, x: Values) -> Values:
        """(n, d, d) 1/m."""
        return self.shape.curvature(x - self.offset)

    def tessellate(self) -> Tessellation:
        """That of the shape, moved."""
        points, elements = self.shape.tessellate()
        return points + self.offset, elements

    def inertia(self, density: float) -> Values:
        """About the reference point: I + m (|o|^2 1 - o o^T) (Huygens and Steiner)."""
        mass, o = density * self.volume, self.offset
        own = self.shape.inertia(density)
        if self.dim == 2:
            return np.asarray(own + mass * (o @ o))
        return np.asarray(own + mass * ((o @ o) * np.eye(3) - np.outer(o, o)))
