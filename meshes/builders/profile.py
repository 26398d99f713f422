"""Flat profiles of straight lines and arcs, meshed as they are (2D) or given a thickness (3D)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ..data import Indices, MeshData, Points
from ..gmsh_session import mesh_with_gmsh
from ..sizing import SizeField, estimate_cells_in_box
from ..topology import boundary_facets, exclude_facets, facet_groups_on_planes, orient_cells

Point = tuple[float, float]


@dataclass(frozen=True)
class Profile:
    """A closed outline in the plane of length (x) and height (y).

    Attributes:
        corners: the outline's points [m] in order, each once.
        centres: corner number -> centre [m] of the arc (of less than half a turn) that leads from it to the next
            corner. All other corners are joined by straight lines.
    """

    corners: list[Point]
    centres: dict[int, Point]

    def draw(self, gmsh: Any, thickness: float) -> None:
        """Put the profile into gmsh's OpenCASCADE model, pulled out along its z axis where there is a thickness [m]."""
        occ = gmsh.model.occ
        corners = [occ.addPoint(x, y, 0.0) for x, y in self.corners]
        curves = []
        for i, (start, end) in enumerate(zip(corners, corners[1:] + corners[:1], strict=True)):
            if i in self.centres:
                curves.append(occ.addCircleArc(start, occ.addPoint(*self.centres[i], 0.0), end))
            else:
                curves.append(occ.addLine(start, end))
        face = occ.addPlaneSurface([occ.addCurveLoop(curves)])
        if thickness > 0:
            occ.extrude([(2, face)], 0.0, 0.0, thickness)


def mesh_profile(profile: Profile, thickness: float, sizing: SizeField) -> tuple[Points, Indices]:
    """Points and positive cells of the profile in the x-y plane (thickness 0), or of a solid with thickness along y."""
    dim = 3 if thickness > 0 else 2
    points, cells = mesh_with_gmsh(lambda gmsh: profile.draw(gmsh, thickness), dim, sizing)
    if dim == 3:
        points = np.ascontiguousarray(points[:, [0, 2, 1]])
        cells, _ = orient_cells(points, cells)
    return points, cells


class CutRectangle(ABC):
    """A rectangle or box with one corner at the origin and a cut: notch, hole or corner.

    2D: x is the length, y the height. 3D: x the length, y the thickness, z the height.
    """

    cut: ClassVar[str]  # facet group of the boundary that the cut makes

    @property
    @abstractmethod
    def _extent(self) -> tuple[float, float, float]:
        """Length, height and thickness [m]; thickness 0: 2D."""

    @property
    @abstractmethod
    def _sizing(self) -> SizeField:
        """Cell size as a function of place."""

    @abstractmethod
    def _profile(self) -> Profile:
        """The rectangle of length and height without the cut."""

    @property
    def groups(self) -> tuple[str, ...]:
        """Names of the facet groups."""
        return ("left", "right", "bottom", "top", *(("front", "back") if self._extent[2] else ()), self.cut)

    def bounds(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Lower and upper corner of the bounding box [m]."""
        length, height, thickness = self._extent
        high = (length, thickness, height) if thickness else (length, height)
        return (0.0,) * len(high), high

    def cells_estimate(self) -> int:
        """Approximate number of cells."""
        length, height, _ = self._extent
        return self._cells_within(length, height)

    def _cells_within(self, x: float, y: float) -> int:
        """Approximate number of cells in the rectangle from the origin to (x, y) [m], through the thickness."""
        thickness = self._extent[2]
        high = (x, y, thickness) if thickness else (x, y)
        return estimate_cells_in_box(self._sizing, (0.0,) * len(high), high)

    def build(self) -> MeshData:
        """The mesh."""
        points, cells = mesh_profile(self._profile(), self._extent[2], self._sizing)
        return MeshData(points, cells, self._groups(points, cells))

    def _groups(self, points: Points, cells: Indices) -> dict[str, Indices]:
        """Left, right (x), bottom, top (the last axis), in 3D front, back (y), and the rest of the boundary."""
        up = points.shape[1] - 1
        length, height, thickness = self._extent
        planes = {"left": (0, 0.0), "right": (0, length), "bottom": (up, 0.0), "top": (up, height)}
        if up == 2:
            planes |= {"front": (1, 0.0), "back": (1, thickness)}
        boundary = boundary_facets(cells)
        groups = facet_groups_on_planes(points, boundary, planes)
        return groups | {self.cut: exclude_facets(boundary, *groups.values())}
