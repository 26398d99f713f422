"""Whether the body and the obstacles of a study overlap at the start. No DOLFINx here.

A body lies in an obstacle where a node of its mesh has a negative distance to it. An obstacle lies in the body where a
point of its outline is in a cell of the mesh, even if all nodes are outside the obstacle.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ..contact.initial_overlap import find_overlaps, free_pairs
from ..contact.pose import Pose, PosedShape
from ..contact.shapes import SHAPES, Shape
from ..errors import InputError
from ..meshes.data import MeshData
from ..meshes.text import format_point
from ..meshes.topology import boundary_facets, edges_of
from .conditions import ObstaclePlacement, obstacle_placements
from .mesh_source import read_obstacle_surface

if TYPE_CHECKING:
    from ..rigid.instance_placement import Place
    from . import Study

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

ROUND_OFF = 1e-9  # of the body's size: what overlaps an obstacle by less touches it, and may
WITHIN = 1e-6  # least barycentric coordinate of what lies in a cell: bodies may touch
DEEP = 0.05  # of the mean edge: rigid bodies may lie in an obstacle by so much, as convex parts of them may in a run
PAIRS = 1 << 21  # of cells and points that are compared at a time


def build_shape(entry: ObstaclePlacement, number: int) -> Shape:
    """The shape of an entry of [[obstacle]] that is not read from a file. InputError where there is no such shape."""
    try:
        return SHAPES[entry.shape](**entry.geometry)
    except InputError as error:
        raise InputError(f"obstacle.{number}: {error}") from None


def body_placements(study: Study) -> list[Place]:
    """All copies of all entries of [[body]]; one body where the mesh has it without any."""
    from ..rigid.instance_placement import Place

    if not study.body:
        return [Place(*np.zeros((4, 3)))]
    places = []
    for entry in study.body:
        grid = np.indices(entry.copies).reshape(3, -1).T * np.array(entry.spacing or [0.0, 0.0, 0.0])
        others = [np.array(each) for each in (entry.rotation, entry.velocity, entry.spin)]
        places += [Place(np.array(entry.position) + shift, *others) for shift in grid]
    return places


def find_near_obstacles(study: Study, lower: Values, upper: Values) -> list[str]:
    """Names of obstacles that may overlap a body in the box between two corners (d,), m, at the start.

    InputError where an entry is no shape, or a free obstacle overlaps another one.
    """
    corners = _corners(lower, upper)
    entries = obstacle_placements(study, len(lower))
    placed = [None if each.shape == "mesh" else _placed(each, number) for number, each in enumerate(entries)]
    if study.time.scheme == "rigid":
        bodies = _of_copies(study, corners)
    else:
        _check_free(entries, placed)
        bodies = corners[None]
    every = zip(entries, placed, strict=True)
    return [each.name for each, at in every if at is None or any(at.distance_bound(body) <= 0 for body in bodies)]


def check_initial_overlap(study: Study, mesh: MeshData) -> None:
    """InputError where the body lies in an obstacle at the start, or an obstacle in the body."""
    entries = obstacle_placements(study, mesh.dim)
    if not entries:
        return
    if study.time.scheme == "rigid":
        _check_rigid(study, mesh, entries)
        return
    for number, entry in enumerate(entries):
        if entry.shape == "mesh":
            _check_solid(entry, number, mesh)
        else:
            _check_shape(entry, number, mesh)


def _placed(entry: ObstaclePlacement, number: int) -> PosedShape:
    """An obstacle where it is at the start."""
    return PosedShape(build_shape(entry, number), Pose.at_point(_reference(entry)))


def _reference(entry: ObstaclePlacement) -> Values:
    """(d,) the reference point at the start, m."""
    return (
        entry.reference_point
        if entry.displacement is None
        else np.asarray(entry.reference_point + entry.displacement(0.0))
    )


def _corners(lower: Values, upper: Values) -> Values:
    """(2^d, d) corners of a box."""
    ends = np.stack([lower, upper])
    choice = np.indices((2,) * len(lower)).reshape(len(lower), -1).T
    return np.asarray(np.take_along_axis(ends, choice, axis=0), float)


def _check_free(entries: list[ObstaclePlacement], placed: list[PosedShape | None]) -> None:
    """InputError where an obstacle that moves freely overlaps another one; those from files are left to the run."""
    shapes = [(number, each, at) for number, (each, at) in enumerate(zip(entries, placed, strict=True)) if at]
    every = free_pairs([_Named(each.name, each.free_motion is not None) for _, each, _ in shapes])  # type: ignore[misc]
    boxes = {a: _corners(*_box(shapes[a][2])) for a, _ in every}
    among = [(a, b) for a, b in every if not shapes[b][2].distance_bound(boxes[a]) > 0]
    for a, b, deep in find_overlaps([at for _, _, at in shapes], among):
        raise InputError(
            f"obstacle.{shapes[a][0]}: {shapes[a][1].name} moves freely and overlaps {shapes[b][1].name} at the start, "
            f"by {max(0.0, deep):.4g} m; move it away or make it smaller"
        )


def _box(placed: PosedShape) -> tuple[Values, Values]:
    """Corners (d,) of a box around an obstacle, m."""
    points = placed.pose.points_to_space(placed.shape.tessellate()[0])
    return points.min(axis=0), points.max(axis=0)


class _Named:
    """What `pairs` asks of an obstacle."""

    def __init__(self, name: str, free: bool) -> None:
        self.name, self.free = name, free


def _check_shape(entry: ObstaclePlacement, number: int, mesh: MeshData) -> None:
    placed = _placed(entry, number)
    if placed.distance_bound(mesh.points) > 0:
        return
    least = float(placed.distance(mesh.points).min())
    if least < -ROUND_OFF * float(np.linalg.norm(np.ptp(mesh.points, axis=0))):
        raise InputError(
            f"obstacle.{number}: {entry.name} overlaps the body at the start, by {-least:.4g} m; "
            "move it away or make it smaller"
        )
    if not placed.shape.convex or not np.isfinite(placed.shape.volume):
        return  # all corners of the body are in a convex room, so the body is
    points = placed.pose.points_to_space(placed.shape.tessellate()[0])
    inside = containment_depth(np.concatenate([points, placed.pose.centre[None]]), mesh) > WITHIN
    if inside.any():
        where = format_point(np.concatenate([points, placed.pose.centre[None]])[np.flatnonzero(inside)[0]])
        raise InputError(
            f"obstacle.{number}: {entry.name} lies in the body at the start: {where} is inside both; "
            "move it out of the body or make it smaller"
        )


def containment_depth(x: Values, mesh: MeshData) -> Values:
    """(n,) of points x (n, d): the greatest, over cells around a point, of its least barycentric coordinate.

    Not below 0 where a point lies in the mesh; -1 where it does not.
    """
    result = np.full(len(x), -1.0)
    order = np.argsort(x[:, 0], kind="stable")
    x = x[order]
    corners = mesh.points[mesh.cells]
    lower, upper = corners.min(axis=1), corners.max(axis=1)
    cells = np.flatnonzero(((lower <= x.max(axis=0)) & (upper >= x.min(axis=0))).all(axis=1))
    first = np.searchsorted(x[:, 0], lower[cells, 0], "left")
    count = np.searchsorted(x[:, 0], upper[cells, 0], "right") - first
    for part in np.array_split(np.arange(len(cells)), 1 + int(count.sum()) // PAIRS):
        n = count[part]
        cell = np.repeat(cells[part], n)
        point = np.arange(n.sum()) - np.repeat(np.cumsum(n) - n, n) + np.repeat(first[part], n)
        close = ((x[point] >= lower[cell]) & (x[point] <= upper[cell])).all(axis=1)
        point, at = point[close], corners[cell[close]]
        basis = (at[:, 1:] - at[:, :1]).transpose(0, 2, 1)
        inner = np.linalg.solve(basis, (x[point] - at[:, 0])[:, :, None])[:, :, 0]
        np.maximum.at(result, order[point], np.minimum(inner.min(axis=1, initial=1.0), 1 - inner.sum(axis=1)))
    return np.maximum(result, -1.0)


def _check_solid(entry: ObstaclePlacement, number: int, mesh: MeshData) -> None:
    """The same of an obstacle that is read from a file."""
    from ..contact.triangle_mesh_shape import penetration_depth, surfaces_intersect

    given: dict[str, Any] = entry.geometry
    solid = read_obstacle_surface(given["file"], given.get("scale", 1.0), f"obstacle.{number}")
    points = solid.points + _reference(entry)
    if np.any(points.min(axis=0) > mesh.points.max(axis=0)) or np.any(points.max(axis=0) < mesh.points.min(axis=0)):
        return
    body, other = (mesh.points, boundary_facets(mesh.cells)), (points, np.asarray(solid.triangles, np.int64))
    cut = surfaces_intersect(body, other)
    deep = penetration_depth(body, other, cut=cut)
    if cut or deep is not None:
        how = "cuts" if deep is None else "overlaps"
        by = "" if deep is None else f", by {deep:.4g} m"
        raise InputError(
            f"obstacle.{number}: {entry.name} {how} the body at the start{by}; move it away or make it smaller"
        )


def _of_copies(study: Study, x: Values) -> Values:
    """(copies, n, 3) points x (n, 3) of the mesh where copies have them at the start, m."""
    from ..rigid.instance_placement import Poses

    poses = Poses.of(body_placements(study))
    return np.asarray(np.einsum("kij,nj->kni", poses.turn, x) + poses.place[:, None])


def _check_rigid(study: Study, mesh: MeshData, entries: list[ObstaclePlacement]) -> None:
    """The same of all copies of the mesh; obstacles from files, and bodies among themselves, are left to the run."""
    from ..rigid.instance_placement import Poses

    places = body_placements(study)
    poses, edge = Poses.of(places), edges_of(mesh.cells)
    deep = DEEP * float(np.linalg.norm(np.diff(mesh.points[edge], axis=1)[:, 0], axis=1).mean())
    middle = (mesh.points.min(axis=0) + mesh.points.max(axis=0)) / 2
    reach = float(np.linalg.norm(mesh.points - middle, axis=1).max())
    centres = poses.place + poses.turn @ middle
    for number, entry in enumerate(entries):
        if entry.shape == "mesh" or entry.geometry.get("hollow"):  # the run refuses hollow ones
            continue
        placed = _placed(entry, number)
        for copy in np.flatnonzero(placed.distance(centres) < reach):
            x = mesh.points @ poses.turn[copy].T + poses.place[copy]
            least = float(placed.distance(x).min())
            if least < -deep:
                raise InputError(
                    f"body {copy} around {format_point(centres[copy])} lies in obstacle {entry.name} at the start, by "
                    f"{-least:.3g} m: move them apart (body.N.position, spacing, or `at` of the obstacle)"
                )
