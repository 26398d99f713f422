"""A circular cylinder, and a disk in 2D."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, pi, radians, sin
from typing import Any, ClassVar, Literal

import numpy as np

from ..data import MeshData
from ..gmsh_session import mesh_with_gmsh
from ..parameters import CurvedBoundary, RoundSolid, require, require_affordable, require_one_of, require_positive
from ..sizing import SizeField, estimate_cells_in_box
from ..topology import boundary_facets, exclude_facets, facet_groups_on_planes
from .profile import Profile


@dataclass(frozen=True)
class Cylinder:
    """A solid circular cylinder along an axis, one end around the origin.

    Attributes:
        radius: [m].
        length: [m].
        h: cell size [m]. The side is a polygon with its nodes on the circle, so that the volume is too small by about
            (h / radius)^2 / 6 of itself.
        axis: "x", "y" or "z".

    Groups: bottom (at coordinate 0 of the axis), top (at `length`), side.

    Raises:
        MeshError: a parameter is out of range.
    """

    name: ClassVar[str] = "cylinder"
    groups: ClassVar[tuple[str, ...]] = ("bottom", "top", "side")
    regions: ClassVar[tuple[str, ...]] = ()

    radius: float = 0.05
    length: float = 0.2
    h: float = 0.01
    axis: Literal["x", "y", "z"] = "z"

    def __post_init__(self) -> None:
        require_positive("cylinder", radius=self.radius, length=self.length, h=self.h)
        require_one_of("cylinder", "axis", self.axis, ("x", "y", "z"))
        require_affordable("cylinder", self.h, self.cells_estimate())

    def bounds(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Lower and upper corner of the bounding box [m]."""
        along = "xyz".index(self.axis)
        low, high = [-self.radius] * 3, [self.radius] * 3
        low[along], high[along] = 0.0, self.length
        return tuple(low), tuple(high)

    def cells_estimate(self) -> int:
        """Approximate number of cells."""
        return estimate_cells_in_box(SizeField(self.h), *self.bounds(), filled=pi / 4)

    @property
    def curved_boundaries(self) -> tuple[CurvedBoundary, ...]:
        """The side."""
        return (CurvedBoundary(("side",), self.radius, "xyz".index(self.axis)),)

    @property
    def round_solid(self) -> RoundSolid:
        """The cylinder."""
        along = "xyz".index(self.axis)
        x, y, z = (self.length / 2 if axis == along else 0.0 for axis in range(3))
        return RoundSolid("cylinder", (x, y, z), self.radius, self.length, along)

    def build(self) -> MeshData:
        """The mesh."""
        points, cells = mesh_with_gmsh(self._draw, 3, SizeField(self.h))
        along = "xyz".index(self.axis)
        # drawn along z; a cyclic permutation of the axes keeps the orientation of cells
        points = np.roll(points, along - 2, axis=1)
        boundary = boundary_facets(cells)
        ends = facet_groups_on_planes(points, boundary, {"bottom": (along, 0.0), "top": (along, self.length)})
        return MeshData(points, cells, ends | {"side": exclude_facets(boundary, *ends.values())})

    def _draw(self, gmsh: Any) -> None:
        gmsh.model.occ.addCylinder(0.0, 0.0, 0.0, 0.0, 0.0, self.length, self.radius)


@dataclass(frozen=True)
class Disk:
    """A flat disk around the origin, in triangles.

    Attributes:
        radius: [m].
        h: cell size [m].
        arc: angle [degrees] of two arcs of the rim that face each other on the y axis, as the platens of a Brazilian
            test touch them; 0 for none. Their ends, and the ends of both diameters along the axes, are nodes.

    Groups: rim; with arcs top, bottom, and rim for what lies between them.

    Raises:
        MeshError: a parameter is out of range.
    """

    name: ClassVar[str] = "disk"
    regions: ClassVar[tuple[str, ...]] = ()

    radius: float = 0.05
    h: float = 0.005
    arc: float = 0.0

    def __post_init__(self) -> None:
        require_positive("disk", radius=self.radius, h=self.h)
        require(0 <= self.arc < 180, f"disk: arc = {self.arc!r} must be at least 0 and less than 180 degrees.")
        require_affordable("disk", self.h, self.cells_estimate())

    @property
    def groups(self) -> tuple[str, ...]:
        """Names of the facet groups."""
        return ("top", "bottom", "rim") if self.arc else ("rim",)

    def bounds(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Lower and upper corner of the bounding box [m]."""
        return (-self.radius,) * 2, (self.radius,) * 2

    def cells_estimate(self) -> int:
        """Approximate number of cells."""
        return estimate_cells_in_box(SizeField(self.h), *self.bounds(), filled=pi / 4)

    @property
    def curved_boundaries(self) -> tuple[CurvedBoundary, ...]:
        """The rim."""
        return (CurvedBoundary(self.groups, self.radius),)

    def build(self) -> MeshData:
        """The mesh."""
        draw = self._sectors().draw if self.arc else self._draw
        points, cells = mesh_with_gmsh(lambda gmsh: draw(gmsh, 0.0), 2, SizeField(self.h))
        boundary = boundary_facets(cells)
        if not self.arc:
            return MeshData(points, cells, {"rim": boundary})
        # the ends of arcs are nodes: the midpoint of a facet tells whether it lies on an arc
        middle = points[boundary].mean(axis=1)
        near = np.abs(middle[:, 0]) < np.abs(middle[:, 1]) * np.tan(radians(self.arc / 2))
        parts = {"top": near & (middle[:, 1] > 0), "bottom": near & (middle[:, 1] < 0), "rim": ~near}
        return MeshData(points, cells, {name: boundary[part] for name, part in parts.items()})

    def _draw(self, gmsh: Any, _: float) -> None:
        gmsh.model.occ.addDisk(0.0, 0.0, 0.0, self.radius, self.radius)

    def _sectors(self) -> Profile:
        """The rim with nodes at the ends and the middle of each arc, and on the x axis."""
        half = self.arc / 2
        angles = [0.0, 90 - half, 90.0, 90 + half, 180.0, 270 - half, 270.0, 270 + half]
        corners = [(self.radius * cos(radians(angle)), self.radius * sin(radians(angle))) for angle in angles]
        return Profile(corners, dict.fromkeys(range(len(corners)), (0.0, 0.0)))
