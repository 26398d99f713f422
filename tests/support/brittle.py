"""Surfaces opened in a mesh without solving anything, and the split surface that they leave."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pyvista

from fracsim.fracture.brittle.crack_level_set import DirectionField
from fracsim.fracture.brittle.grains import SurfaceParameters
from fracsim.fracture.brittle.surface_cut import SurfaceCutMesh
from fracsim.fracture.brittle.surface_pass import OpenedSurfaces, OverloadedCells, SurfacePass
from fracsim.mesh.split_surface.closed_surface import SplitSurface, build_split_surface
from fracsim.mesh.split_surface.entity_numbering import EntityNumbering
from fracsim.meshes.data import MeshData
from fracsim.output.surface.fragment_table import enclosed_volumes
from fracsim.scene import Scene

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Broken:
    """A body after a pass."""

    opened: OpenedSurfaces
    places: Values  # (n, d) where edges are cut, m
    surface: SplitSurface
    volumes: Values  # (pieces,) m^d enclosed


def pulled_along(normals: Values) -> Values:
    """(n, d, d) uniaxial tension of 1 Pa."""
    return np.einsum("ni,nj->nij", normals, normals)


def near(body: SurfaceCutMesh, place: list[float]) -> int:
    """The cell whose centroid is nearest to a place."""
    return int(np.argmin(np.linalg.norm(body.centroids - place, axis=1)))


def open_at(
    mesh: MeshData,
    places: list[list[float]],
    normals: list[list[float]],
    settle: bool = False,
    field: Any = None,
    **table: Any,
) -> Broken:
    """Surfaces from the cells nearest to places, under tension along the normals, the first place loaded most.

    `field`: a function from places (C, d) to directions of tension in the whole body.
    """
    pattern = SurfacePass(mesh, SurfaceParameters(surfaces=len(places), **table), 1e-6, settle)
    body, dim = pattern.mesh, mesh.dim
    cells = np.array([near(body, place) for place in places])
    direction = np.array(normals, float) / np.linalg.norm(normals, axis=1)[:, None]
    order = np.argsort(cells)
    rest = np.broadcast_to(np.eye(dim), (len(body.cells), dim, dim))
    loads = 2.0 - np.arange(len(cells)) / 100
    load = OverloadedCells(cells[order], loads[order], pulled_along(direction[order]), rest[: len(cells)])
    whole = None
    if field is not None:
        whole = DirectionField.from_cells(body, pulled_along(field(body.centroids)), rest, np.ones(len(rest)))
    opened = pattern.open_surfaces(load, np.empty((0, 2), np.int64), np.empty((0, dim)), len(places), whole)
    return after(mesh, opened)


def after(mesh: MeshData, opened: OpenedSurfaces) -> Broken:
    """The body with what a pass opened."""
    skeleton = EntityNumbering(mesh)
    cut = skeleton.edge_values(opened.keys, opened.cut_positions)
    broken = ~np.isnan(cut)
    bits = 1 << np.arange(skeleton.cell_edges.shape[1])
    made = build_split_surface(skeleton, broken[skeleton.cell_edges] @ bits, cut)
    return Broken(opened, cut_points(mesh.points, opened.keys, opened.cut_positions), made, enclosed(made))


def cut_points(points: Values, keys: Ints, cut: Values) -> Values:
    """(n, d) where edges between nodes `keys` (n, 2) are cut."""
    ends = points[keys]
    return np.asarray(ends[:, 0] + cut[:, None] * (ends[:, 1] - ends[:, 0]))


def enclosed(made: SplitSurface) -> Values:
    """(pieces,) volumes inside a surface, by the divergence theorem."""
    return enclosed_volumes(made.points, made.elements, made.point_fragment[made.elements[:, 0]], made.fragment_count)


def scene_surface(scene: Scene) -> SplitSurface:
    """The split surface of a scene as it stands (serial)."""
    assert scene.domain.input_mesh is not None
    skeleton, graph = EntityNumbering(scene.domain.input_mesh), scene.fracture.graph
    own = np.flatnonzero(graph.broken)
    cut = skeleton.edge_values(graph.keys.of_edges(own), scene.fracture.criterion.cut_positions[own])
    pattern = scene.domain.input_numbering.gather_cells(graph.pattern)
    assert pattern is not None
    return build_split_surface(skeleton, pattern, cut)


def volume_above(mesh: MeshData, point: Values, normal: Values) -> float:
    """Volume of a 3D mesh on the positive side of a plane, as VTK clips it."""
    grid = pyvista.UnstructuredGrid({pyvista.CellType.TETRA: mesh.cells}, mesh.points)
    clipped = grid.clip(normal=normal, origin=point, invert=False).triangulate()
    corners = np.asarray(clipped.points, float)[clipped.cells_dict[pyvista.CellType.TETRA]]
    return float(np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])).sum()) / 6
