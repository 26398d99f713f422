"""A shape that is a closed surface of triangles."""

from __future__ import annotations

from dataclasses import dataclass, replace

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
    round: bool = False
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

    @property
    def centre(self) -> Values:
        """(3,) of its mass, from the reference point, m."""
        each, middle = self._tetrahedra()
        return np.asarray(each @ middle / each.sum())

    def inertia(self, density: float) -> Values:
        """(3, 3) rho (tr S 1 - S) about the reference point, S = int x x^T dV: of the tetrahedron between it and a
        triangle, with corners a, b, c and sum s, V / 20 (a a^T + b b^T + c c^T + s s^T)."""
        each, _ = self._tetrahedra()
        corners = self.points[self.triangles]
        whole = corners.sum(axis=1)
        S = (np.einsum("k,kci,kcj->ij", each, corners, corners) + np.einsum("k,ki,kj->ij", each, whole, whole)) / 20
        return np.asarray(density * (np.trace(S) * np.eye(3) - S))

    def shifted(self, offset: Values) -> Solid:
        """The same with its reference point elsewhere: all points by `offset` (3,), m."""
        return replace(self, points=self.points + offset)

    def _tetrahedra(self) -> tuple[Values, Values]:
        """(k,) signed volumes of those between triangles and the reference point, m^3, and (k, 3) their middles, m."""
        corners = self.points[self.triangles]
        return np.linalg.det(corners) / 6, corners.sum(axis=1) / 4
