"""A hollow glass ball with a short neck, a Christmas ornament."""

from __future__ import annotations

from dataclasses import dataclass
from math import asin, cos, pi
from typing import ClassVar

import numpy as np

from ..data import Indices, MeshData, Points
from ..parameters import require, require_affordable, require_positive
from ..shell import extrude_shell


@dataclass(frozen=True)
class Ornament:
    """A spherical shell around the origin with an open neck along z.

    Points lie on rings around z; triangles by Delaunay's rule on the sphere.

    Attributes:
        radius: of the middle surface [m].
        neck: radius of the opening [m]; 0: a whole sphere.
        height: of the neck above the opening [m].
        thickness: of the wall [m].
        h: size of the triangles [m].

    Groups: inner, outer, and rim where there is a neck.

    Raises:
        MeshError: a parameter is out of range, or it is too thick for its folds.
    """

    name: ClassVar[str] = "ornament"
    regions: ClassVar[tuple[str, ...]] = ()

    radius: float = 0.04
    neck: float = 0.012
    height: float = 0.012
    thickness: float = 0.001
    h: float = 0.006

    def __post_init__(self) -> None:
        require_positive("ornament", radius=self.radius, thickness=self.thickness, h=self.h, height=self.height)
        require(0 <= self.neck < 0.9 * self.radius, f"ornament: neck = {self.neck!r} must be from 0 to 0.9 radius.")
        require(
            self.thickness < 0.5 * self.radius, f"ornament: thickness = {self.thickness!r} must be below radius / 2."
        )
        require(self.h < self.radius, f"ornament: h = {self.h!r} must be below radius = {self.radius!r}.")
        require_affordable("ornament", self.h, self.cells_estimate())

    @property
    def groups(self) -> tuple[str, ...]:
        """Names of the facet groups."""
        return ("inner", "outer", "rim") if self.neck else ("inner", "outer")

    @property
    def _opening(self) -> float:
        """Polar angle of the rim of the opening [rad]."""
        return asin(self.neck / self.radius)

    def area(self) -> float:
        """Area of the middle surface [m^2]."""
        return 2 * pi * self.radius**2 * (1 + cos(self._opening)) + (2 * pi * self.neck * self.height)

    def bounds(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Lower and upper corner of the bounding box [m]."""
        outer = self.radius + self.thickness / 2
        top = self.radius * cos(self._opening) + self.height if self.neck else outer
        return (-outer, -outer, -outer), (outer, outer, max(top, outer) if top > outer else top)

    def cells_estimate(self) -> int:
        """Approximate number of cells."""
        return int(3 * self.area() / (0.433 * self.h**2))

    def build(self) -> MeshData:
        """The mesh."""
        points, triangles = self._surface()
        return extrude_shell(points, triangles, self.thickness, "ornament")

    def _surface(self) -> tuple[Points, Indices]:
        """Points and triangles of the middle surface: the sphere below the opening, and the neck."""
        from scipy.spatial import ConvexHull

        points = _rings(self.h / self.radius, self._opening if self.neck else 0.0)
        hull = ConvexHull(points)
        triangles = hull.simplices.astype(np.int64)
        spans = points[triangles[:, 1:]] - points[triangles[:, :1]]
        outwards = np.einsum("ni,ni->n", np.cross(spans[:, 0], spans[:, 1]), points[triangles].mean(axis=1)) > 0
        triangles = np.where(outwards[:, None], triangles, triangles[:, ::-1])
        points = self.radius * points
        if not self.neck:
            return points, triangles
        ring = np.flatnonzero(points[:, 2] > self.radius * cos(self._opening) * (1 - 1e-9))
        lid = np.isin(triangles, ring).all(axis=1)
        return _with_neck(points, triangles[~lid], ring, self.height, self.h)


def _rings(step: float, opening: float) -> Points:
    """(n, 3) points of the unit sphere on rings around z, from the opening [rad] down to the pole.

    `step`: distance of neighbours on a ring, over the radius.
    """
    count = max(round((pi - opening) / (step * 0.87)), 3)  # rings are a height of equilateral triangles apart
    angles = opening + (pi - opening) * np.arange(count + 1) / count
    rings = []
    for number, angle in enumerate(angles):
        segments = max(round(2 * pi * np.sin(angle) / step), 1)
        if number == 0 and opening:
            segments = max(segments, 8)
        turn = 2 * pi * (np.arange(segments) + 0.618 * number) / segments  # golden ratio: no two rings in phase
        ring = np.stack(
            [np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.full(segments, np.cos(angle))], 1
        )
        rings.append(ring if segments > 1 else np.array([[0.0, 0.0, np.cos(angle)]]))
    return np.concatenate(rings)


def _with_neck(points: Points, triangles: Indices, ring: Indices, height: float, h: float) -> tuple[Points, Indices]:
    """Points and triangles with a tube [m] of triangles of size h added upwards from a ring of points about z."""
    ring = ring[np.argsort(np.arctan2(points[ring, 1], points[ring, 0]))]
    layers, count, first = max(round(height / h), 1), len(ring), len(points)
    above = [points[ring] + [0.0, 0.0, height * (k + 1) / layers] for k in range(layers)]
    rows = np.concatenate([ring[None], first + np.arange(layers * count).reshape(layers, count)])
    a, b, c, d = rows[:-1], np.roll(rows[:-1], -1, axis=1), np.roll(rows[1:], -1, axis=1), rows[1:]
    tube = np.concatenate([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)]).reshape(-1, 3)
    return np.concatenate([points, *above]), np.concatenate([triangles, tube])
