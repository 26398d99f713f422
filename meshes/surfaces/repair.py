"""Repair of surfaces that changes their shape: holes are filled, self-intersections removed, crossing parts united.

Holes and self-intersections of a part are repaired by MeshFix (M. Attene 2010, A lightweight approach to repairing
digitized polygon meshes, The Visual Computer 26), crossing parts united by Manifold. Gross changes of shape are
refused, and so is a surface that is open or crosses itself afterwards.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..data import Indices, MeshError, Points, format_midpoint
from ..time_limit import ProcessDiedError, call_with_time_limit
from ..topology import Mask, components, distinct_rows
from .closed import (
    ClosedSurface,
    RepairableSurfaceError,
    check_areas,
    check_edges,
    check_points,
    closed_surface,
    orient_consistently,
    read_raw_triangles,
    read_surface,
)
from .mending import MENDING, EdgeTable, find_open_edges, mend_closed_surface
from .self_intersection import crossing_triangles
from .triangle_geometry import (
    Triangulation,
    areas,
    concatenate,
    directed_edges,
    enclosed_volumes,
    probes_inside,
    without_unused_points,
)


@dataclass(frozen=True)
class RepairLimits:
    """Changes of shape that a repair may make, and bounds of its work."""

    max_change: float = 0.1  # of the volume of a part, or of a bound of its box over the longest side
    max_new_area: float = 0.25  # of a part, over its area
    reported_new_area: float = 0.1  # the same: from here on the note begins with a warning
    max_parts: int = 1000  # of a file that are mended one by one
    dust: float = 1e-3  # area over that of the surface: smaller open parts are left out
    sliver: float = 1e-5  # over the size of a union: shorter edges are collapsed
    united_volume: float = 1e-6  # relative: a union may be smaller than its largest part, or larger than all parts
    seconds: float = 60.0  # of the repair, and
    seconds_per_triangle: float = 1e-3


REPAIR = RepairLimits()
BY_HAND = "Mend it by hand there (MeshLab: Filters > Cleaning and Repairing; Blender: Mesh > Clean Up)."


def read_body(
    path: str | Path, scale: float = 1.0, *, repair: bool = False, time_limit: float | None = None
) -> ClosedSurface:
    """A closed surface from file that does not intersect itself; with `repair` it is made so, with notes.

    Args:
        path: the file.
        scale: metres per unit of length of the file.
        repair: whether the shape may be changed.
        time_limit: of the repair [s]; None: a minute and a millisecond for each triangle.

    Raises:
        RepairableSurfaceError: the surface is open or intersects itself, and `repair` is off.
        MeshError: see read_surface; a repair that changes the shape grossly, fails or takes too long.
    """
    source = f"Surface file '{path}'"
    if not repair:
        surface = read_surface(path, scale)
        _refuse_crossings(surface, source)
        return surface
    points, triangles = read_raw_triangles(Path(path), scale, source)
    check_points(points, triangles, source)
    seconds = REPAIR.seconds + REPAIR.seconds_per_triangle * len(triangles) if time_limit is None else time_limit
    try:
        points, triangles, notes = call_with_time_limit(seconds, repair_triangles, points, triangles, source)
    except TimeoutError:
        raise MeshError(
            f"{source}: the repair had not ended within {seconds:.0f} s ({len(triangles):,} triangles). Simplify the "
            "surface, or give more seconds with [mesh] time_limit."
        ) from None
    except ProcessDiedError as died:
        raise MeshError(f"{source}: the repair died ({died.how}). {BY_HAND}") from None
    after = f"{source}, repaired,"
    surface = closed_surface(points, triangles, after)
    _refuse_crossings(surface, after, closed=True)
    return replace(surface, notes=(*notes, *surface.notes))


def _refuse_crossings(surface: ClosedSurface, source: str, closed: bool = False) -> None:
    """Raise RepairableSurfaceError if triangles intersect; `closed`: see crossing_triangles."""
    pairs = crossing_triangles(surface.points, surface.triangles, closed=closed)
    if len(pairs):
        where = format_midpoint(surface.points, surface.triangles[pairs[0]].ravel())
        raise RepairableSurfaceError(
            f"{source} cuts itself: {len(np.unique(pairs))} of its {len(surface.triangles)} triangles pass through "
            f"others, the first near {where}. {BY_HAND}"
        )


def repair_triangles(points: Points, triangles: Indices, source: str) -> tuple[Points, Indices, tuple[str, ...]]:
    """Points and triangles of closed parts that do not cross, and notes of the changes.

    Raises:
        MeshError: an edge of more than two triangles, a part with one side only; a gross change; pymeshfix or
            manifold3d is not installed.
    """
    points, triangles, mended_notes = _mend(points, triangles, source)
    triangles, shell, _ = orient_consistently(triangles, EdgeTable(triangles), source)
    crossings = crossing_triangles(points, triangles, closed=True)
    crossing = np.unique(crossings[shell[crossings[:, 0]] == shell[crossings[:, 1]]])  # within one part
    at_holes = np.unique(find_open_edges(triangles) // 3)
    area = np.bincount(shell, areas(points, triangles))
    is_crossing, is_open = (np.bincount(shell[which], minlength=len(area)) > 0 for which in (crossing, at_holes))
    dust = is_open & (area < REPAIR.dust * area.sum())
    parts, notes = [], list(mended_notes)
    for number in np.flatnonzero(~dust):
        part = without_unused_points(points, triangles[shell == number])
        if is_crossing[number] or is_open[number]:
            part, note = _repair_part(*part, int(np.count_nonzero(shell[crossing] == number)), source)
            notes.append(note)
        parts.append(part)
    if dust.any():
        first = format_midpoint(points, triangles[shell == np.argmax(dust)].ravel())
        notes.append(
            f"Repair: {int(dust.sum())} open parts of the surface were left out, {area[dust].sum() / area.sum():.2g} "
            f"of its area, the first near {first}."
        )
    parts, unions = _unite_crossing_parts(parts, source)
    if not (dust.any() or is_crossing.any() or is_open.any() or unions):
        notes.append("[mesh] repair = true: the surface is closed and does not cut itself; its shape is as it was.")
    return *concatenate(parts), (*notes, *unions)


def _mend(points: Points, triangles: Indices, source: str) -> tuple[Points, Indices, tuple[str, ...]]:
    """The surface mended as a whole, or part by part if edges belong to more than two triangles otherwise."""
    # parts that touch may have points at the same place, such as two boxes with a common face
    original = points, triangles
    points, triangles, notes, *_ = mend_closed_surface(*original)
    if _is_non_manifold(triangles):
        _, part = components(np.concatenate([original[1][:, :2], original[1][:, 1:]]), len(original[0]))
        of_triangle = part[original[1][:, 0]]
        numbers = np.unique(of_triangle)
        if 1 < len(numbers) <= REPAIR.max_parts:
            parts = [
                mend_closed_surface(*without_unused_points(original[0], original[1][of_triangle == number]))
                for number in numbers
            ]
            apart = concatenate([(part.points, part.triangles) for part in parts])
            # STL does not tell which triangles are connected: each would be an open part
            if not _is_non_manifold(apart[1]) and len(find_open_edges(apart[1])) <= len(find_open_edges(triangles)):
                points, triangles = apart
                notes = tuple(note for part in parts for note in part.notes)
    check_areas(points, triangles, source)
    check_edges(points, EdgeTable(triangles), source, (2,))
    return points, triangles, notes


def _is_non_manifold(triangles: Indices) -> bool:
    """Whether an edge belongs to more than two triangles."""
    return bool((EdgeTable(triangles).counts > 2).any())


# --- holes and self-intersections of one part -----------------------------------------------------------------------


@dataclass(frozen=True)
class _Holes:
    """Loops of open edges of a part.

    Attributes:
        count: of loops.
        longest: the longest open edge [m].
        where: the centroid of the first loop, as text.
        lids: (k, 3, 3) triangles from the centroid of each loop to its edges, oriented like the part.
    """

    count: int
    longest: float
    where: str
    lids: Points

    @classmethod
    def of(cls, points: Points, triangles: Indices) -> _Holes:
        """The holes of a part."""
        edges = directed_edges(triangles)[find_open_edges(triangles)]
        if len(edges) == 0:
            return cls(0, 0.0, "", np.zeros((0, 3, 3)))
        nodes, local_edges = np.unique(edges, return_inverse=True)
        local_edges = local_edges.reshape(-1, 2)
        count, loop = components(local_edges, len(nodes))
        weight = np.bincount(loop)[:, None]
        middles = np.stack([np.bincount(loop, points[nodes, axis]) for axis in range(3)], axis=1) / weight
        of_edge = middles[loop[local_edges[:, 0]]]
        lids = np.stack([points[edges[:, 1]], points[edges[:, 0]], of_edge], axis=1)
        longest = float(np.linalg.norm(points[edges[:, 1]] - points[edges[:, 0]], axis=1).max())
        return cls(count, longest, format_midpoint(middles, np.array([0])), lids)


def _repair_part(points: Points, triangles: Indices, crossing: int, source: str) -> tuple[Triangulation, str]:
    """A part without holes and self-intersections, and a note.

    `crossing`: number of its triangles that intersect others.

    Raises:
        MeshError: the repair failed, or changes the shape grossly.
    """
    # the volume before is that of the part with each hole closed by a fan from its centroid
    holes = _Holes.of(points, triangles)
    corners = np.concatenate([points[triangles], holes.lids])
    before = _volume(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
    new_points, new = _by_meshfix(points, triangles, clean=crossing > 0)
    if crossing == 0 and len(crossing_triangles(new_points, new)):
        new_points, new = _by_meshfix(points, triangles, clean=True)
    faults = [f"{holes.count} holes (longest edge {holes.longest:.3g} m, the first near {holes.where})"]
    faults = (faults if holes.count else []) + [f"{crossing} triangles that pass through others"] * (crossing > 0)
    description = " and ".join(faults)
    if len(new) == 0 or len(find_open_edges(new)):
        raise MeshError(f"{source}: repair failed to mend {description}. {BY_HAND}")
    after, share = _volume(new_points, new), _new_area(points, triangles, new_points, new)
    size = float(np.ptp(points, axis=0).max())
    moved = max(
        float(np.abs(bound(new_points, axis=0) - bound(points, axis=0)).max()) / size for bound in (np.min, np.max)
    )
    figures = f"its volume went from {before:.4g} to {after:.4g} m^3, {share:.2g} of its area is new"
    limit = REPAIR.max_change
    if abs(after - before) > limit * before or moved > limit or share > REPAIR.max_new_area:
        shell = " An open surface may be a shell: [mesh] shell = ..., with a thickness." if holes.count else ""
        raise MeshError(
            f"{source}: repair would change the shape grossly. A part has {description}; repaired, {figures}, and its "
            f"bounding box has moved by {moved:.2g} of its size. Allowed are {limit:g} of the volume and of the box, "
            f"and {REPAIR.max_new_area:g} of the area. {BY_HAND}{shell}"
        )
    warning = "LOOK AT THE SHAPE: " if share > REPAIR.reported_new_area else ""
    closed_with = " (before: each hole closed with a lid from its middle)" if holes.count else ""
    return (new_points, new), f"{warning}Repair: a part of the surface had {description}; {figures}{closed_with}."


def _volume(points: Points, triangles: Indices) -> float:
    return abs(float(enclosed_volumes(points, triangles).sum()))


def _new_area(points: Points, triangles: Indices, new_points: Points, new: Indices) -> float:
    """Area of the triangles that were not there before, over the whole area."""
    number, same = _nearest(points, new_points)
    number = np.where(same, number, len(points) + np.arange(len(new_points)))
    _, counts, inverse = distinct_rows(np.sort(np.concatenate([triangles, number[new]]), axis=1))
    area = areas(new_points, new)
    return float(area[counts[inverse[len(triangles) :]] == 1].sum() / area.sum())


def _nearest(points: Points, new_points: Points) -> tuple[Indices, Mask]:
    """The old point nearest to each new one, and whether both are at the same place."""
    from scipy.spatial import cKDTree

    distance, number = cKDTree(points).query(new_points)
    return np.asarray(number, np.int64), distance <= MENDING.merge_distance * np.ptp(points, axis=0).max()


def _by_meshfix(points: Points, triangles: Indices, clean: bool) -> Triangulation:
    """The part of MeshFix: holes filled and, with `clean`, intersecting triangles removed and the gaps filled."""
    # MeshFix keeps the largest part of a surface only: it gets one part at a time
    fixer = _optional_module("pymeshfix").PyTMesh()
    fixer.set_quiet(True)
    low, size = points.min(axis=0), float(np.ptp(points, axis=0).max())
    fixer.load_array(np.ascontiguousarray((points - low) / size), np.ascontiguousarray(triangles, dtype=np.int32))
    fixer.fill_small_boundaries(0, False)
    if clean:
        fixer.clean(10, 3)
    scaled, new = fixer.return_arrays()
    new_points = np.array(scaled, np.float64) * size + low
    if len(new):
        number, same = _nearest(points, new_points)
        new_points[same] = points[number[same]]  # `clean` rounds to single precision
    return new_points, np.array(new, np.int64)


def _optional_module(name: str) -> Any:
    """A package that is needed for repair only; MeshError if it is not installed."""
    from importlib import import_module

    try:
        return import_module(name)
    except ImportError:
        raise MeshError(
            f"[mesh] repair = true needs {name}, which this environment lacks: pip install fracsim[repair]"
        ) from None


# --- parts that cross -----------------------------------------------------------------------------------------------


def _unite_crossing_parts(parts: list[Triangulation], source: str) -> tuple[list[Triangulation], tuple[str, ...]]:
    """Closed parts, those that cross or touch united, and a note of each union."""
    if len(parts) < 2:
        return parts, ()
    points, triangles = concatenate(parts)
    part = np.repeat(np.arange(len(parts)), [len(t) for _, t in parts])
    of_point = np.repeat(np.arange(len(parts)), [len(p) for p, _ in parts])
    crossings = np.concatenate(
        [part[crossing_triangles(points, triangles, closed=True)], of_point[_coincident_points(points)]]
    )
    crossings = np.unique(crossings[crossings[:, 0] != crossings[:, 1]], axis=0)
    count, cluster = components(crossings, len(parts))
    united, notes = [], []
    for number in range(count):
        members = np.flatnonzero(cluster == number)
        if len(members) == 1:
            united.append(parts[members[0]])
            continue
        union, note = _union([parts[i] for i in members], source)
        united.append(union)
        notes.append(note)
    return united, tuple(notes)


def _coincident_points(points: Points) -> Indices:
    """(k, 2) pairs of points at the same place."""
    from scipy.spatial import cKDTree

    distance = MENDING.merge_distance * float(np.ptp(points, axis=0).max())
    return np.asarray(cKDTree(points).query_pairs(distance, output_type="ndarray"), np.int64)


def _union(parts: list[Triangulation], source: str) -> tuple[Triangulation, str]:
    """The union of closed parts, and a note; MeshError if it fails or a part lies within another."""
    _refuse_cavities(parts, source)
    manifold3d = _optional_module("manifold3d")
    solids, volumes = [], [float(enclosed_volumes(*part).sum()) for part in parts]
    for (points, triangles), volume in zip(parts, volumes, strict=True):
        outwards = triangles if volume > 0 else triangles[:, ::-1]
        mesh = manifold3d.Mesh64(np.ascontiguousarray(points), np.ascontiguousarray(outwards, dtype=np.uint64))
        solids.append(manifold3d.Manifold(mesh))
    size = float(np.ptp(concatenate(parts)[0], axis=0).max())
    union = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add).simplify(REPAIR.sliver * size)
    mesh = union.to_mesh64()
    points, triangles = np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts, np.int64).reshape(-1, 3)
    failed = any(solid.status() != manifold3d.Error.NoError for solid in (*solids, union))
    before = np.abs(volumes)
    volume = float(enclosed_volumes(points, triangles).sum()) if len(triangles) else 0.0
    if failed or not (1 - REPAIR.united_volume) * before.max() <= volume <= (1 + REPAIR.united_volume) * before.sum():
        where = format_midpoint(parts[1][0], np.arange(len(parts[1][0])))
        raise MeshError(f"{source}: {len(parts)} parts cross near {where}, and their union failed. {BY_HAND}")
    note = (
        f"Repair: {len(parts)} closed parts of the surface that cross or touch were made one; their volumes, "
        f"{before.sum():.4g} m^3 together, became {volume:.4g} m^3. Names of the parts are not kept."
    )
    return (points, triangles), note


def _refuse_cavities(parts: list[Triangulation], source: str) -> None:
    """Raise MeshError if a part lies within another: it may be a cavity, which the union would fill."""
    for i, (points, _) in enumerate(parts):
        for j, (outer_points, triangles) in enumerate(parts):
            if i != j and probes_inside(points, outer_points[triangles]).all():
                raise MeshError(
                    f"{source}: parts that cross have another part within them, near "
                    f"{format_midpoint(points, np.arange(len(points)))}; whether it is a cavity is not known. Unite "
                    "the parts by hand (Blender: Modifier > Boolean > Union; MeshLab: Mesh Boolean: Union)."
                )
