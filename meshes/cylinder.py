"""A round bar, and a disk in 2D."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import Any, ClassVar, Literal

import numpy as np

from .data import MeshData
from .gmsh_session import meshed
from .parameters import affordable, one_of, positive
from .sizing import Sizing, cells_for
from .topology import boundary_facets, facets_except, plane_groups


@dataclass(frozen=True)
class Cylinder:
    """A solid circular cylinder that starts at the origin and runs along an axis.

    Attributes:
        radius: [m].
        length: [m].
        h: cell size [m]. The round side is a polygon with its nodes on the circle: the volume is less by about
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
        positive("cylinder", radius=self.radius, length=self.length, h=self.h)
        one_of("cylinder", "axis", self.axis, ("x", "y", "z"))
        affordable("cylinder", self.h, self.cells_estimate())

    def bounds(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        along = "xyz".index(self.axis)
        low, high = [-self.radius] * 3, [self.radius] * 3
        low[along], high[along] = 0.0, self.length
        return tuple(low), tuple(high)

    def cells_estimate(self) -> int:
        return cells_for(Sizing(self.h), *self.bounds(), filled=pi / 4)

    def build(self) -> MeshData:
        points, cells = meshed(self._draw, 3, Sizing(self.h))
        along = "xyz".index(self.axis)
        # Drawn along z; turning the axes in a circle keeps every cell's orientation.
        points = np.roll(points, along - 2, axis=1)
        boundary = boundary_facets(cells)
        ends = plane_groups(points, boundary, {"bottom": (along, 0.0), "top": (along, self.length)})
        return MeshData(points, cells, ends | {"side": facets_except(boundary, *ends.values())})

    def _draw(self, gmsh: Any) -> None:
        gmsh.model.occ.addCylinder(0.0, 0.0, 0.0, 0.0, 0.0, self.length, self.radius)


@dataclass(frozen=True)
class Disk:
    """A flat disk around the origin, in triangles.

    Attributes:
        radius: [m].
        h: cell size [m].

    Groups: rim.

    Raises:
        MeshError: a parameter is out of range.
    """

    name: ClassVar[str] = "disk"
    groups: ClassVar[tuple[str, ...]] = ("rim",)
    regions: ClassVar[tuple[str, ...]] = ()

    radius: float = 0.05
    h: float = 0.005

    def __post_init__(self) -> None:
        positive("disk", radius=self.radius, h=self.h)
        affordable("disk", self.h, self.cells_estimate())

    def bounds(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        return (-self.radius,) * 2, (self.radius,) * 2

    def cells_estimate(self) -> int:
        return cells_for(Sizing(self.h), *self.bounds(), filled=pi / 4)

    def build(self) -> MeshData:
        points, cells = meshed(self._draw, 2, Sizing(self.h))
        return MeshData(points, cells, {"rim": boundary_facets(cells)})

    def _draw(self, gmsh: Any) -> None:
        gmsh.model.occ.addDisk(0.0, 0.0, 0.0, self.radius, self.radius)
