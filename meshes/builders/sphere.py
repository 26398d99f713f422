"""A solid sphere, and a capsule: a cylinder between two half spheres."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import Any, ClassVar, Literal

import numpy as np

from ..data import MeshData, Points
from ..gmsh_session import mesh_with_gmsh
from ..parameters import RoundSolid, require_affordable, require_one_of, require_positive
from ..sizing import SizeField, estimate_cells_in_box
from ..topology import boundary_facets


@dataclass(frozen=True)
class SolidSphere:
    """A solid sphere around the origin.

    Attributes:
        radius: [m].
        h: cell size [m]. The surface is a polyhedron with its nodes on the sphere, so that the volume is too small by
            about 0.36 (h / radius)^2 of itself.

    Groups: surface.

    Raises:
        MeshError: a parameter is out of range.
    """

    name: ClassVar[str] = "sphere"
    groups: ClassVar[tuple[str, ...]] = ("surface",)
    regions: ClassVar[tuple[str, ...]] = ()

    radius: float = 0.05
    h: float = 0.01

    def __post_init__(self) -> None:
        require_positive("sphere", radius=self.radius, h=self.h)
        require_affordable("sphere", self.h, self.cells_estimate())

    def bounds(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Lower and upper corner of the bounding box [m]."""
        return (-self.radius,) * 3, (self.radius,) * 3

    def cells_estimate(self) -> int:
        """Approximate number of cells."""
        return estimate_cells_in_box(SizeField(self.h), *self.bounds(), filled=pi / 6)

    @property
    def round_solid(self) -> RoundSolid:
        """The sphere."""
        return RoundSolid("sphere", (0.0, 0.0, 0.0), self.radius)

    def build(self) -> MeshData:
        """The mesh."""
        points, cells = mesh_with_gmsh(self._draw, 3, SizeField(self.h))
        return MeshData(points, cells, {"surface": boundary_facets(cells)})

    def _draw(self, gmsh: Any) -> None:
        gmsh.model.occ.addSphere(0.0, 0.0, 0.0, self.radius)


@dataclass(frozen=True)
class SolidCapsule:
    """All points within a radius of a segment, with the middle of the segment at the origin.

    Attributes:
        radius: [m].
        length: of the segment [m]; the whole length is length + 2 radius.
        h: cell size [m]. The surface is a polyhedron with its nodes on the capsule.
        axis: "x", "y" or "z".

    Groups: surface.

    Raises:
        MeshError: a parameter is out of range.
    """

    name: ClassVar[str] = "capsule"
    groups: ClassVar[tuple[str, ...]] = ("surface",)
    regions: ClassVar[tuple[str, ...]] = ()

    radius: float = 0.05
    length: float = 0.2
    h: float = 0.01
    axis: Literal["x", "y", "z"] = "z"

    def __post_init__(self) -> None:
        require_positive("capsule", radius=self.radius, length=self.length, h=self.h)
        require_one_of("capsule", "axis", self.axis, ("x", "y", "z"))
        require_affordable("capsule", self.h, self.cells_estimate())

    def bounds(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Lower and upper corner of the bounding box [m]."""
        high = [self.radius] * 3
        high["xyz".index(self.axis)] += self.length / 2
        return tuple(-x for x in high), tuple(high)

    def cells_estimate(self) -> int:
        """Approximate number of cells."""
        share = (pi * self.length + 4 / 3 * pi * self.radius) / (4 * (self.length + 2 * self.radius))
        return estimate_cells_in_box(SizeField(self.h), *self.bounds(), filled=share)

    @property
    def round_solid(self) -> RoundSolid:
        """The capsule."""
        return RoundSolid("capsule", (0.0, 0.0, 0.0), self.radius, self.length, "xyz".index(self.axis))

    def build(self) -> MeshData:
        """The mesh."""
        points, cells = mesh_with_gmsh(self._draw, 3, SizeField(self.h))
        return MeshData(self._along_axis(points), cells, {"surface": boundary_facets(cells)})

    def _along_axis(self, points: Points) -> Points:
        """Points of the capsule along z, rotated onto its axis; a cyclic permutation keeps the orientation of cells."""
        return np.roll(points, "xyz".index(self.axis) - 2, axis=1)

    def _draw(self, gmsh: Any) -> None:
        occ, half = gmsh.model.occ, self.length / 2
        side = occ.addCylinder(0.0, 0.0, -half, 0.0, 0.0, self.length, self.radius)
        ends = [occ.addSphere(0.0, 0.0, z, self.radius) for z in (-half, half)]
        occ.fuse([(3, side)], [(3, end) for end in ends])
