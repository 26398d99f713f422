"""Overlap of the body and the obstacles of a study at the start. No DOLFINx here.

The body overlaps an obstacle if a node of its mesh has a negative distance to it. An obstacle inside the body is found
by a point of its outline in a cell of the mesh, also if all nodes are outside the obstacle.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ..contact.obstacle import check_free_obstacles
from ..contact.pose import Pose, PosedShape
from ..contact.shapes import SHAPES, Shape
from ..errors import InputError
from ..meshes.data import MeshData, format_point
from ..meshes.topology import boundary_facets, edges_of
from .check_limits import LIMITS
from .conditions import ObstaclePlacement, obstacle_placements
from .mesh_source import read_obstacle_surface

if TYPE_CHECKING:
    from ..rigid.instance_placement import InstancePlacement
    from . import Study

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


def build_shape(entry: ObstaclePlacement, number: int) -> Shape:
    """Returns the analytic shape of an obstacle.

    Raises:
        InputError: if its geometry is invalid.
    """
    try:
        return SHAPES[entry.shape](**entry.geometry)
    except InputError as error:
        raise InputError(f"obstacle.{number}: {error}") from None


def body_placements(study: Study) -> list[InstancePlacement]:
    """Returns position, rotation vector, velocity and spin of all copies of all entries of [[body]].

    Without an entry there is one body at the position of the mesh.
    """
    from ..rigid.instance_placement import InstancePlacement

    if not study.body:
        return [InstancePlacement(*np.zeros((4, 3)))]
    placements = []
    for entry in study.body:
        grid = np.indices(entry.copies).reshape(3, -1).T * np.array(entry.spacing or [0.0, 0.0, 0.0])
        motion = [np.array(vector) for vector in (entry.rotation, entry.velocity, entry.spin)]
        placements += [InstancePlacement(np.array(entry.position) + shift, *motion) for shift in grid]
    return placements


def find_near_obstacles(study: Study, lower: Values, upper: Values) -> list[str]:
    """Returns names of obstacles that may overlap a body in the box between two corners (d,), m, at the start.

    Raises:
        InputError: if a shape is invalid, or a free obstacle overlaps another obstacle.
    """
    corners = _corners(lower, upper)
    entries = obstacle_placements(study, len(lower))
    shapes = [None if entry.shape == "mesh" else _placed(entry, number) for number, entry in enumerate(entries)]
    if study.time.scheme == "rigid":
        bodies = _copies_in_space(study, corners)
    else:
        # the run checks those from files
        items = enumerate(zip(entries, shapes, strict=True))
        named = {n: (entry.name, entry.free_motion is not None, shape) for n, (entry, shape) in items if shape}
        check_free_obstacles(named)
        bodies = corners[None]
    return [
        entry.name
        for entry, shape in zip(entries, shapes, strict=True)
        if shape is None or any(shape.distance_bound(body) <= 0 for body in bodies)
    ]


def check_initial_overlap(study: Study, mesh: MeshData) -> None:
    """Raises InputError if the body and an obstacle overlap at the start."""
    entries = obstacle_placements(study, mesh.dim)
    if not entries:
        return
    if study.time.scheme == "rigid":
        _check_rigid_bodies(study, mesh, entries)
        return
    for number, entry in enumerate(entries):
        if entry.shape == "mesh":
            _check_mesh_obstacle(entry, number, mesh)
        else:
            _check_shape(entry, number, mesh)


def _placed(entry: ObstaclePlacement, number: int) -> PosedShape:
    """The shape of an obstacle at its pose at the start."""
    return PosedShape(build_shape(entry, number), Pose.at_point(_reference(entry)))


def _reference(entry: ObstaclePlacement) -> Values:
    """The reference point of an obstacle at the start, (d,) in m."""
    if entry.displacement is None:
        return entry.reference_point
    return np.asarray(entry.reference_point + entry.displacement(0.0))


def _corners(lower: Values, upper: Values) -> Values:
    """The corners of a box, (2^d, d)."""
    bounds = np.stack([lower, upper])
    choice = np.indices((2,) * len(lower)).reshape(len(lower), -1).T
    return np.asarray(np.take_along_axis(bounds, choice, axis=0), float)


def _check_shape(entry: ObstaclePlacement, number: int, mesh: MeshData) -> None:
    """Raises InputError if an analytic obstacle overlaps the body."""
    placed = _placed(entry, number)
    if placed.distance_bound(mesh.points) > 0:
        return
    gap = float(placed.distance(mesh.points).min())
    if gap < -LIMITS.overlap_round_off * float(np.linalg.norm(np.ptp(mesh.points, axis=0))):
        raise InputError(
            f"obstacle.{number}: {entry.name} overlaps the body at the start, by {-gap:.4g} m; "
            "move it away or make it smaller"
        )
    if not placed.shape.convex or not np.isfinite(placed.shape.volume):
        # all corners of the body are inside a convex space, and so is the body
        return
    points = placed.pose.points_to_space(placed.shape.tessellate()[0])
    inside = containment_depth(np.concatenate([points, placed.pose.centre[None]]), mesh) > LIMITS.min_inside_coordinate
    if inside.any():
        where = format_point(np.concatenate([points, placed.pose.centre[None]])[np.flatnonzero(inside)[0]])
        raise InputError(
            f"obstacle.{number}: {entry.name} lies in the body at the start: {where} is inside both; "
            "move it out of the body or make it smaller"
        )


def containment_depth(x: Values, mesh: MeshData) -> Values:
    """Returns the least barycentric coordinate of points x (n, d) in their cell, (n,); -1 outside the mesh.

    If several cells contain a point, the greatest value counts. Points in the mesh have values of 0 or more.
    """
    result = np.full(len(x), -1.0)
    order = np.argsort(x[:, 0], kind="stable")
    x = x[order]
    corners = mesh.points[mesh.cells]
    lower, upper = corners.min(axis=1), corners.max(axis=1)
    cells = np.flatnonzero(((lower <= x.max(axis=0)) & (upper >= x.min(axis=0))).all(axis=1))
    first = np.searchsorted(x[:, 0], lower[cells, 0], "left")
    count = np.searchsorted(x[:, 0], upper[cells, 0], "right") - first
    # cells and points of overlapping ranges in x are compared, a limited number of pairs at a time
    for part in np.array_split(np.arange(len(cells)), 1 + int(count.sum()) // LIMITS.max_overlap_pairs):
        n = count[part]
        cell = np.repeat(cells[part], n)
        point = np.arange(n.sum()) - np.repeat(np.cumsum(n) - n, n) + np.repeat(first[part], n)
        close = ((x[point] >= lower[cell]) & (x[point] <= upper[cell])).all(axis=1)
        point, x_corners = point[close], corners[cell[close]]
        basis = (x_corners[:, 1:] - x_corners[:, :1]).transpose(0, 2, 1)
        inner = np.linalg.solve(basis, (x[point] - x_corners[:, 0])[:, :, None])[:, :, 0]
        np.maximum.at(result, order[point], np.minimum(inner.min(axis=1, initial=1.0), 1 - inner.sum(axis=1)))
    return np.maximum(result, -1.0)


def _check_mesh_obstacle(entry: ObstaclePlacement, number: int, mesh: MeshData) -> None:
    """Raises InputError if an obstacle from a file overlaps the body."""
    from ..contact.triangle_mesh_shape import refuse_overlap, surfaces_intersect

    geometry: dict[str, Any] = entry.geometry
    surface = read_obstacle_surface(geometry["file"], geometry.get("scale", 1.0), f"obstacle.{number}")
    points = surface.points + _reference(entry)
    if np.any(points.min(axis=0) > mesh.points.max(axis=0)) or np.any(points.max(axis=0) < mesh.points.min(axis=0)):
        return
    body = mesh.points, boundary_facets(mesh.cells)
    obstacle = points, np.asarray(surface.triangles, np.int64)
    refuse_overlap(f"obstacle.{number}: {entry.name}", body, obstacle, cut=surfaces_intersect(body, obstacle))


def _copies_in_space(study: Study, x: Values) -> Values:
    """Points x (n, 3) of the mesh at their positions in all copies at the start, (copies, n, 3) in m."""
    from ..rigid.instance_placement import InstancePoses

    poses = InstancePoses.from_placements(body_placements(study))
    return np.asarray(np.einsum("kij,nj->kni", poses.rotation, x) + poses.position[:, None])


def _check_rigid_bodies(study: Study, mesh: MeshData, entries: list[ObstaclePlacement]) -> None:
    """Raises InputError if a copy of the mesh overlaps an obstacle.

    The run checks obstacles from files, and rigid bodies against each other.
    """
    from ..rigid.instance_placement import InstancePoses

    poses, edges = InstancePoses.from_placements(body_placements(study)), edges_of(mesh.cells)
    mean_edge = float(np.linalg.norm(np.diff(mesh.points[edges], axis=1)[:, 0], axis=1).mean())
    max_depth = LIMITS.max_rigid_overlap * mean_edge
    centre = (mesh.points.min(axis=0) + mesh.points.max(axis=0)) / 2
    radius = float(np.linalg.norm(mesh.points - centre, axis=1).max())
    centres = poses.position + poses.rotation @ centre
    for number, entry in enumerate(entries):
        if entry.shape == "mesh":
            continue
        placed = _placed(entry, number)
        for copy in np.flatnonzero(placed.distance(centres) < radius):
            x = mesh.points @ poses.rotation[copy].T + poses.position[copy]
            gap = float(placed.distance(x).min())
            if gap < -max_depth:
                raise InputError(
                    f"body {copy} around {format_point(centres[copy])} lies in obstacle {entry.name} at the start, by "
                    f"{-gap:.3g} m: move them apart (body.N.position, spacing, or `at` of the obstacle)"
                )
