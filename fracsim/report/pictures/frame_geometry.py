"""A frame as what is drawn: skin and inside apart, so that light does not run round the edge between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
LINE = 3  # VTK's number of a segment
SHARP = 35.0  # degrees between facets that light does not run over


@dataclass(frozen=True)
class FrameParts:
    """Parts of a frame.

    Attributes:
        boundary, crack: surfaces of what was the boundary, and of cracks; None where there is none of it.
        outline: lines around a body in 2D, None in 3D or of a mesh.
    """

    boundary: Any
    crack: Any
    outline: Any

    @property
    def surfaces(self) -> list[Any]:
        """The parts that are there."""
        return [each for each in (self.boundary, self.crack) if each is not None]


def frame_parts(grid: Any) -> FrameParts:
    """The surface as it is; of a mesh, the surface of the cells that hold together, which opens the crack."""
    if "origin" not in grid.cell_data:
        if "damage" in grid.cell_data:
            kept = np.flatnonzero(grid.cell_data["damage"] < 0.5)
            grid = grid.extract_cells(kept) if len(kept) else grid
        return FrameParts(grid.extract_surface(), None, None)
    line = np.asarray(grid.celltypes) == LINE
    crack = is_crack(grid)
    if line.any():
        return FrameParts(_part(grid, ~line), None, grid.extract_cells(np.flatnonzero(line)))
    return FrameParts(_part(grid, ~crack), _part(grid, crack), None)


def is_crack(grid: Any) -> Flags:
    """(elements,) of a split surface that a crack laid open."""
    names = list(grid.field_data["origins"]) if "origins" in grid.field_data else []
    return np.asarray(grid.cell_data["origin"]) == (names.index("crack") if "crack" in names else -1)


def _part(grid: Any, which: Flags) -> Any:
    """The triangles `which` as a surface with the data that they have; None: there are none."""
    import pyvista

    if not which.any():
        return None
    corners = np.asarray(grid.cell_connectivity)
    offset = np.asarray(grid.offset)[:-1][which]
    used, numbered = np.unique(corners[offset[:, None] + np.arange(3)], return_inverse=True)
    made = pyvista.PolyData.from_regular_faces(np.asarray(grid.points)[used], numbered.reshape(-1, 3))
    for name, data in grid.point_data.items():
        made.point_data[name] = np.asarray(data)[used]
    for name, data in grid.cell_data.items():
        made.cell_data[name] = np.asarray(data)[which]
    return made


def with_normals(surface: Any) -> Any:
    """With a normal at each point, and edges sharper than SHARP kept."""
    made = surface.compute_normals(
        cell_normals=False,
        split_vertices=True,
        feature_angle=SHARP,
        consistent_normals=False,
        auto_orient_normals=False,
    )
    return made if made.n_points else surface


def without_single_nodes(grid: Any) -> Any:
    """The elements of pieces that have more than a node."""
    if "dust" not in grid.cell_data or not np.any(grid.cell_data["dust"]):
        return grid
    made = grid.extract_cells(np.flatnonzero(np.asarray(grid.cell_data["dust"]) == 0))
    made.field_data["origins"] = list(grid.field_data["origins"])
    return made


def displace(grid: Any, explode: float, magnify: float) -> Any:
    """The grid with displacements `magnify` times as large and pieces apart by the share `explode`; "rest" of its
    points is where they were before all, m."""
    if "displacement" in grid.point_data:
        grid.point_data["rest"] = np.asarray(grid.points, float) - np.asarray(grid.point_data["displacement"])
    if magnify != 1.0 and "displacement" in grid.point_data:
        grid.points = np.asarray(grid.points, float) + (magnify - 1) * np.asarray(grid.point_data["displacement"])
    if explode and "piece" in grid.point_data:
        grid.points = explode_fragments(np.asarray(grid.points, float), grid.point_data["piece"], explode)
    return grid


def explode_fragments(points: Values, piece: npt.NDArray[np.integer], share: float) -> Values:
    """(n, 3) points with each piece moved away from the middle by `share` of its distance from it."""
    numbers, of_point = np.unique(piece, return_inverse=True)
    counts = np.bincount(of_point)[:, None]
    centres = np.stack([np.bincount(of_point, column) for column in points.T], axis=1) / counts
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    return np.asarray(points + share * (centres - middle)[of_point]) if len(numbers) > 1 else points
