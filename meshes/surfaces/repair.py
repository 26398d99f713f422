"""Repair of surfaces that changes their shape: holes are filled, self-intersections removed, crossing parts united.

Holes and self-intersections of one part: MeshFix (M. Attene 2010, A lightweight approach to repairing digitized polygon
meshes, The Visual Computer 26), a part at a time, since it keeps the largest part only. Parts that cross: the union by
Manifold, to round-off. What changes the shape grossly is refused, and so is what is left open or crosses itself.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..data import Indices, MeshError, Points, format_midpoint
from ..time_limit import ProcessDiedError, within
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
from .enclosed import enclosed_volumes, winding_numbers
from .mending import JOINED, EdgeTable, areas, directed_edges, find_open_edges, mended
from .self_intersection import crossing_triangles

MAX_CHANGE = 0.1  # of the volume of a part, or of a side of its bounding box over the longest side
MAX_NEW = 0.25  # share of a part's area that is new triangles
TOLD_NEW = 0.1  # the same, from which on the note says so first
MAX_PARTS = 1000  # of a file that are looked at one by one
DUST = 1e-3  # share of the whole area; open parts of less are left out
SLIVER = 1e-5  # share of the size of a union; edges shorter than this are collapsed
UNITED = 1e-6  # share by which a union may be smaller than its largest part, or larger than all parts together
SECONDS, SECONDS_A_TRIANGLE = 60.0, 1e-3  # that the repair may take
BY_HAND = "Mend it by hand there (MeshLab: Filters > Cleaning and Repairing; Blender: Mesh > Clean Up)."


def read_body(
    path: str | Path, scale: float = 1.0, *, repair: bool = False, time_limit: float | None = None
) -> ClosedSurface:
    """A closed surface to be filled: it does not cut itself; with `repair` made so, with notes of what was changed.

    Args:
        path: the file.
        scale: metres per unit of length of the file.
        repair: whether the shape may be changed.
        time_limit: seconds that the repair may take; None: a minute and a millisecond for each triangle.

    Raises:
        RepairableSurfaceError: open, or it cuts itself, and `repair` is off.
        MeshError: see read_surface; a repair that changes the shape grossly, fails or takes too long.
    """
    source = f"Surface file '{path}'"
    if not repair:
        surface = read_surface(path, scale)
        _refuse_crossings(surface, source)
        return surface
    points, triangles = read_raw_triangles(Path(path), scale, source)
    check_points(points, triangles, source)
    seconds = SECONDS + SECONDS_A_TRIANGLE * len(triangles) if time_limit is None else time_limit
    try:
        points, triangles, notes = within(seconds, repaired, points, triangles, source)
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
    pairs = crossing_triangles(surface.points, surface.triangles, closed=closed)
    if len(pairs):
        where = format_midpoint(surface.points, surface.triangles[pairs[0]].ravel())
        raise RepairableSurfaceError(
            f"{source} cuts itself: {len(np.unique(pairs))} of its {len(surface.triangles)} triangles pass through "
            f"others, the first near {where}. {BY_HAND}"
        )


def repaired(points: Points, triangles: Indices, source: str) -> tuple[Points, Indices, tuple[str, ...]]:
    """Points and triangles of closed parts that do not cross, and notes of what was changed.

    Raises:
        MeshError: an edge of more than two triangles, a part with one side only; a gross change; pymeshfix or
            manifold3d is not installed.
    """
    points, triangles, mends = _mended(points, triangles, source)
    triangles, shell, _ = orient_consistently(triangles, EdgeTable(triangles), source)
    crossings = crossing_triangles(points, triangles, closed=True)
    owned = np.unique(crossings[shell[crossings[:, 0]] == shell[crossings[:, 1]]])
    opened = np.unique(find_open_edges(triangles) // 3)
    area = np.bincount(shell, areas(points, triangles))
    cut, torn = (np.bincount(shell[which], minlength=len(area)) > 0 for which in (owned, opened))
    dust = torn & (area < DUST * area.sum())
    parts, notes = [], list(mends)
    for number in np.flatnonzero(~dust):
        part = _part(points, triangles[shell == number])
        if cut[number] or torn[number]:
            part, change = _fixed(*part, int(np.count_nonzero(shell[owned] == number)), source)
            notes.append(change)
        parts.append(part)
    if dust.any():
        first = format_midpoint(points, triangles[shell == np.argmax(dust)].ravel())
        notes.append(
            f"Repair: {int(dust.sum())} open parts of the surface were left out, {area[dust].sum() / area.sum():.2g} "
            f"of its area, the first near {first}."
        )
    parts, unions = _united(parts, source)
    if not (dust.any() or cut.any() or torn.any() or unions):
        notes.append("[mesh] repair = true: the surface is closed and does not cut itself; its shape is as it was.")
    return *_together(parts), (*notes, *unions)


def _mended(points: Points, triangles: Indices, source: str) -> tuple[Points, Indices, tuple[str, ...]]:
    """As of `mending`; where an edge is in more than two triangles then, the parts of the file one by one.

    Parts that cross or touch may have points at the same place, as two boxes with a common face.
    """
    whole, original = mended(points, triangles), (points, triangles)
    points, triangles, notes = whole[:3]
    if _crowded(triangles):
        _, part = components(np.concatenate([original[1][:, :2], original[1][:, 1:]]), len(original[0]))
        of_triangle = part[original[1][:, 0]]
        numbers = np.unique(of_triangle)
        if 1 < len(numbers) <= MAX_PARTS:
            parts = [mended(*_part(original[0], original[1][of_triangle == number])) for number in numbers]
            apart = _together([(own_points, owned) for own_points, owned, *_ in parts])
            # STL does not say which triangles are connected: each would be a part, and open
            if not _crowded(apart[1]) and len(find_open_edges(apart[1])) <= len(find_open_edges(triangles)):
                points, triangles = apart
                notes = tuple(note for _, _, own_notes, *_ in parts for note in own_notes)
    check_areas(points, triangles, source)
    check_edges(points, EdgeTable(triangles), source, (2,))
    return points, triangles, notes


def _crowded(triangles: Indices) -> bool:
    """Whether an edge belongs to more than two triangles."""
    return bool((EdgeTable(triangles).counts > 2).any())


Part = tuple[Points, Indices]


def _part(points: Points, triangles: Indices) -> Part:
    used, numbered = np.unique(triangles, return_inverse=True)
    return points[used], numbered.reshape(-1, 3).astype(np.int64)


def _together(parts: list[Part]) -> Part:
    starts = np.cumsum([0] + [len(points) for points, _ in parts])
    triangles = [triangles + start for (_, triangles), start in zip(parts, starts, strict=False)]
    return np.concatenate([points for points, _ in parts]), np.concatenate(triangles)


# --- holes and self-intersections of one part -----------------------------------------------------------------------


@dataclass(frozen=True)
class _Holes:
    """Loops of open edges of a part.

    Attributes:
        count: how many.
        longest: the longest open edge [m].
        where: the middle of the first loop, in words.
        lids: (k, 3, 3) triangles from the middle of each loop to its edges, turned as the part.
    """

    count: int
    longest: float
    where: str
    lids: Points

    @classmethod
    def of(cls, points: Points, triangles: Indices) -> _Holes:
        edges = directed_edges(triangles)[find_open_edges(triangles)]
        if len(edges) == 0:
            return cls(0, 0.0, "", np.zeros((0, 3, 3)))
        nodes, numbered = np.unique(edges, return_inverse=True)
        count, loop = components(numbered.reshape(-1, 2), len(nodes))
        weight = np.bincount(loop)[:, None]
        middles = np.stack([np.bincount(loop, points[nodes, axis]) for axis in range(3)], axis=1) / weight
        of_edge = middles[loop[numbered.reshape(-1, 2)[:, 0]]]
        lids = np.stack([points[edges[:, 1]], points[edges[:, 0]], of_edge], axis=1)
        longest = float(np.linalg.norm(points[edges[:, 1]] - points[edges[:, 0]], axis=1).max())
        return cls(count, longest, format_midpoint(middles, np.array([0])), lids)


def _fixed(points: Points, triangles: Indices, cut: int, source: str) -> tuple[Part, str]:
    """A part closed and free of self-intersections, and the note; `cut`: its triangles that pass through others."""
    holes = _Holes.of(points, triangles)
    corners = np.concatenate([points[triangles], holes.lids])
    before = _volume(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
    new_points, new = _by_meshfix(points, triangles, clean=cut > 0)
    if cut == 0 and len(crossing_triangles(new_points, new)):
        new_points, new = _by_meshfix(points, triangles, clean=True)
    description = " and ".join(
        (
            [f"{holes.count} holes (longest edge {holes.longest:.3g} m, the first near {holes.where})"]
            if holes.count
            else []
        )
        + ([f"{cut} triangles that pass through others"] if cut else [])
    )
    if len(new) == 0 or len(find_open_edges(new)):
        raise MeshError(f"{source}: repair failed to mend {description}. {BY_HAND}")
    after, share = _volume(new_points, new), _new_share(points, triangles, new_points, new)
    size = float(np.ptp(points, axis=0).max())
    moved = max(
        float(np.abs(bound(new_points, axis=0) - bound(points, axis=0)).max()) / size for bound in (np.min, np.max)
    )
    figures = f"its volume went from {before:.4g} to {after:.4g} m^3, {share:.2g} of its area is new"
    if abs(after - before) > MAX_CHANGE * before or moved > MAX_CHANGE or share > MAX_NEW:
        shell = " An open surface may be a shell: [mesh] shell = ..., with a thickness." if holes.count else ""
        raise MeshError(
            f"{source}: repair would change the shape grossly. A part has {description}; repaired, {figures}, and its "
            f"bounding box has moved by {moved:.2g} of its size. Allowed are {MAX_CHANGE:g} of the volume and of the "
            f"box, and {MAX_NEW:g} of the area. {BY_HAND}{shell}"
        )
    loudly = "LOOK AT THE SHAPE: " if share > TOLD_NEW else ""
    closed_with = " (before: each hole closed with a lid from its middle)" if holes.count else ""
    return (new_points, new), f"{loudly}Repair: a part of the surface had {description}; {figures}{closed_with}."


def _volume(points: Points, triangles: Indices) -> float:
    return abs(float(enclosed_volumes(points, triangles).sum()))


def _new_share(points: Points, triangles: Indices, new_points: Points, new: Indices) -> float:
    """Share of the new triangles' area that was not in the old ones."""
    number, same = _like(points, new_points)
    number = np.where(same, number, len(points) + np.arange(len(new_points)))
    _, counts, inverse = distinct_rows(np.sort(np.concatenate([triangles, number[new]]), axis=1))
    area = areas(new_points, new)
    return float(area[counts[inverse[len(triangles) :]] == 1].sum() / area.sum())


def _like(points: Points, new_points: Points) -> tuple[Indices, Mask]:
    """For each new point the nearest of the old ones, and whether both are at the same place."""
    from scipy.spatial import cKDTree

    away, number = cKDTree(points).query(new_points)
    return np.asarray(number, np.int64), away <= JOINED * np.ptp(points, axis=0).max()


def _by_meshfix(points: Points, triangles: Indices, clean: bool) -> Part:
    """By MeshFix: holes filled and, with `clean`, self-intersecting triangles removed, and the gaps filled."""
    fixer = _needed("pymeshfix").PyTMesh()
    fixer.set_quiet(True)
    low, size = points.min(axis=0), float(np.ptp(points, axis=0).max())
    fixer.load_array(np.ascontiguousarray((points - low) / size), np.ascontiguousarray(triangles, dtype=np.int32))
    fixer.fill_small_boundaries(0, False)
    if clean:
        fixer.clean(10, 3)
    result, new = fixer.return_arrays()
    new_points = np.array(result, np.float64) * size + low
    if len(new):
        number, same = _like(points, new_points)
        new_points[same] = points[number[same]]  # `clean` rounds to single precision
    return new_points, np.array(new, np.int64)


def _needed(name: str) -> Any:
    from importlib import import_module

    try:
        return import_module(name)
    except ImportError:
        raise MeshError(
            f"[mesh] repair = true needs {name}, which this environment lacks: pip install fracsim[repair]"
        ) from None


# --- parts that cross -----------------------------------------------------------------------------------------------


def _united(parts: list[Part], source: str) -> tuple[list[Part], tuple[str, ...]]:
    """Closed parts with those that cross one another united, and a note of each union."""
    if len(parts) < 2:
        return parts, ()
    points, triangles = _together(parts)
    part = np.repeat(np.arange(len(parts)), [len(t) for _, t in parts])
    of_point = np.repeat(np.arange(len(parts)), [len(p) for p, _ in parts])
    crossings = np.concatenate(
        [part[crossing_triangles(points, triangles, closed=True)], of_point[_same_place(points)]]
    )
    crossings = np.unique(crossings[crossings[:, 0] != crossings[:, 1]], axis=0)
    count, cluster = components(crossings, len(parts))
    result, notes = [], []
    for number in range(count):
        members = np.flatnonzero(cluster == number)
        if len(members) == 1:
            result.append(parts[members[0]])
            continue
        united, note = _union([parts[i] for i in members], source)
        result.append(united)
        notes.append(note)
    return result, tuple(notes)


def _same_place(points: Points) -> Indices:
    """Pairs of points at the same place: (k, 2)."""
    from scipy.spatial import cKDTree

    reach = JOINED * float(np.ptp(points, axis=0).max())
    return np.asarray(cKDTree(points).query_pairs(reach, output_type="ndarray"), np.int64)


def _union(parts: list[Part], source: str) -> tuple[Part, str]:
    _refuse_cavities(parts, source)
    manifold3d = _needed("manifold3d")
    solids, volumes = [], [float(enclosed_volumes(*part).sum()) for part in parts]
    for (points, triangles), volume in zip(parts, volumes, strict=True):
        outwards = triangles if volume > 0 else triangles[:, ::-1]
        mesh = manifold3d.Mesh64(np.ascontiguousarray(points), np.ascontiguousarray(outwards, dtype=np.uint64))
        solids.append(manifold3d.Manifold(mesh))
    size = float(np.ptp(_together(parts)[0], axis=0).max())
    whole = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add).simplify(SLIVER * size)
    mesh = whole.to_mesh64()
    points, triangles = np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts, np.int64).reshape(-1, 3)
    position = format_midpoint(parts[1][0], np.arange(len(parts[1][0])))
    bad = [solid.status().name for solid in (*solids, whole) if solid.status() != manifold3d.Error.NoError]
    original = np.abs(volumes)
    volume = float(enclosed_volumes(points, triangles).sum()) if len(triangles) else 0.0
    if bad or not (1 - UNITED) * original.max() <= volume <= (1 + UNITED) * original.sum():
        raise MeshError(f"{source}: {len(parts)} parts cross near {position}, and their union failed. {BY_HAND}")
    note = (
        f"Repair: {len(parts)} closed parts of the surface that cross or touch were made one; their volumes, "
        f"{original.sum():.4g} m^3 together, became {volume:.4g} m^3. Names of the parts are not kept."
    )
    return (points, triangles), note


def _refuse_cavities(parts: list[Part], source: str) -> None:
    """MeshError where one of the parts that are to be one body lies within another: a cavity, which would be filled."""
    for i, (points, _) in enumerate(parts):
        for j, (remaining, triangles) in enumerate(parts):
            if i != j and (abs(winding_numbers(points[:: 1 + len(points) // 300], remaining[triangles])) > 0.5).all():
                raise MeshError(
                    f"{source}: parts that cross have another part within them, near "
                    f"{format_midpoint(points, np.arange(len(points)))}; whether it is a cavity is not known. Unite "
                    "the parts by hand (Blender: Modifier > Boolean > Union; MeshLab: Mesh Boolean: Union)."
                )
