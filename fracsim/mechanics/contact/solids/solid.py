"""A shape that is a closed surface of triangles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ....meshes.surfaces.enclosed import enclosed_volumes
from ..outlines import Outline

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Solid:
    """What points (n, 3), m, and triangles (k, 3), their normals outwards, enclose; its reference point is the origin.

    It stands where a Shape does as far as it is placed and drawn; it is felt by its triangles (facing), not by a
    distance.
    """

    points: Values
    triangles: Ints
    dim: int = 3
    convex: bool = False
    least_radius: float = 0.0

    def outline(self) -> Outline:
        """Its triangles."""
        return self.points, self.triangles.astype(np.int32)

    @property
    def volume(self) -> float:
        """m^3."""
        return float(enclosed_volumes(self.points, self.triangles).sum())

    def distance(self, x: Values) -> Values:
        """NotImplementedError."""
        raise NotImplementedError("solids are felt by their triangles")

    def normal(self, x: Values) -> Values:
        """As `distance`."""
        return self.distance(x)

    def curvature(self, x: Values) -> Values:
        """As `distance`."""
        return self.distance(x)

    def inertia(self, density: float) -> Values:
        """NotImplementedError."""
        raise NotImplementedError("solids do not move freely")
