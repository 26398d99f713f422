"""Flat profiles of straight lines and arcs, meshed as they are (2D) or given a thickness (3D)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..data import Indices, Points
from ..gmsh_session import meshed
from ..sizing import Sizing
from ..topology import boundary_facets, facets_except, oriented, plane_groups

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


def mesh_profile(profile: Profile, thickness: float, sizing: Sizing) -> tuple[Points, Indices]:
    """Points and positive cells of the profile in x-y (thickness 0), or of the solid with its thickness along y."""
    dim = 3 if thickness > 0 else 2
    points, cells = meshed(lambda gmsh: profile.draw(gmsh, thickness), dim, sizing)
    if dim == 3:
        points = np.ascontiguousarray(points[:, [0, 2, 1]])
        cells, _ = oriented(points, cells)
    return points, cells


def rectangle_groups(points: Points, cells: Indices, size: tuple[float, float, float], rest: str) -> dict[str, Indices]:
    """Groups of a body cut from the rectangle or box of `size` (length, height, thickness) [m] at the origin.

    Left, right (x), bottom, top (the last axis), in 3D front, back (y), and every other boundary facet under `rest`.
    """
    length, height, thickness = size
    up = points.shape[1] - 1
    planes = {"left": (0, 0.0), "right": (0, length), "bottom": (up, 0.0), "top": (up, height)}
    if up == 2:
        planes |= {"front": (1, 0.0), "back": (1, thickness)}
    boundary = boundary_facets(cells)
    groups = plane_groups(points, boundary, planes)
    return groups | {rest: facets_except(boundary, *groups.values())}


def rectangle_bounds(size: tuple[float, float, float]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Bounds of the same body: 2D where the thickness is zero."""
    length, height, thickness = size
    high = (length, thickness, height) if thickness > 0 else (length, height)
    return (0.0,) * len(high), high
