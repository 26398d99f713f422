"""Closed surfaces of triangles: read from file, merged, oriented outwards, sorted into bodies and cavities."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..data import Indices, MeshError, Points, format_midpoint
from ..mesh_conversion import Block
from ..parameters import check_extent
from ..topology import Floats, Mask, components
from .mending import EdgeTable, mend_closed_surface, mend_open_surface
from .triangle_geometry import (
    Triangulation,
    areas,
    concatenate,
    enclosed_volumes,
    has_no_area,
    probes_inside,
    triangles_of_faces,
    winding_numbers,
    without_unused_points,
)


class RepairableSurfaceError(MeshError):
    """A surface that is open, cuts itself or has edges of more than two triangles, which `repair` may mend."""


@dataclass(frozen=True)
class ClosedSurface:
    """Triangles that enclose one or more bodies.

    Attributes:
        points: (n, 3) [m].
        triangles: (k, 3), each edge in exactly two of them, normals out of the material (into cavities).
        shell: (k,) the connected part that each triangle belongs to.
        bodies: for each body its outer shell, followed by the shells of its cavities.
        notes: what was mended.
    """

    points: Points
    triangles: Indices
    shell: Indices
    bodies: list[list[int]]
    notes: tuple[str, ...]

    @property
    def volume(self) -> float:
        """Volume of the material [m^3]."""
        return float(enclosed_volumes(self.points, self.triangles).sum())

    @property
    def area(self) -> float:
        """Area of the whole boundary [m^2]."""
        return float(areas(self.points, self.triangles).sum())

    @property
    def sides(self) -> tuple[float, ...]:
        """(3,) sides of the bounding box [m]."""
        return tuple(np.ptp(self.points, axis=0).tolist())

    @property
    def extent(self) -> str:
        """The sides as text."""
        return " x ".join(f"{side:.4g}" for side in self.sides) + " m"

    def part(self, shell: int) -> Triangulation:
        """Points and triangles of one shell."""
        return without_unused_points(self.points, self.triangles[self.shell == shell])


def read_surface(path: str | Path, scale: float = 1.0) -> ClosedSurface:
    """A closed surface from STL, OBJ, PLY or another format with triangles or quads.

    Args:
        path: the file.
        scale: metres per unit of length of the file.

    Raises:
        MeshError: the file cannot be read, holds no surface, or the surface is not closed, not orientable, has
            triangles without an area or points that are no numbers, or parts that cut each other.
    """
    path = Path(path)
    return closed_surface(*read_raw_triangles(path, scale, f"Surface file '{path}'"), f"Surface file '{path}'")


def read_triangles(path: Path, scale: float, source: str) -> tuple[Points, Indices, tuple[str, ...]]:
    """Points [m] and triangles of a surface, closed or open, mended (see mending) and oriented alike; and notes.

    Args:
        path: the file.
        scale: metres per unit of length of the file.
        source: begins the message of an error.

    Raises:
        MeshError: see read_surface; an edge of more than two triangles.
    """
    points, triangles = read_raw_triangles(path, scale, source)
    check_points(points, triangles, source)
    points, triangles, notes, _, may_be_flat = mend_open_surface(points, triangles)
    if may_be_flat:
        check_areas(points, triangles, source)
    table = EdgeTable(triangles)
    check_edges(points, table, source, (2,))
    triangles, _, turned = orient_consistently(triangles, table, source)
    if turned:
        notes = (*notes, f"{turned} of {len(triangles)} triangles of the shell faced the other way; turned.")
    return points, triangles, notes


def read_raw_triangles(path: Path, scale: float, source: str) -> tuple[Points, Indices]:
    """Points [m] and triangles as they are in a file; arguments and errors as of `read_triangles`."""
    from ..read import read_contents  # the bodies of builders need no readers

    contents = read_contents(path)
    triangles = np.concatenate(
        [np.zeros((0, 3), np.int64), *(_triangles(contents.points, block) for block in contents.blocks)]
    )
    if len(triangles) == 0 or contents.points.shape[1] != 3:
        raise MeshError(f"{source} holds no triangles in space.")
    return scale * contents.points, triangles


def combine_shells(shells: list[Triangulation], source: str) -> ClosedSurface:
    """Closed shells, one inside another or apart, as one surface."""
    return closed_surface(*concatenate(shells), source)


def _triangles(points: Points, block: Block) -> Indices:
    """The triangles of a block; quads and polygons are cut, other cells left out."""
    if block.shape == "triangle":
        return block.corners
    faces = block.corners if block.shape == "quad" else block.nodes
    if block.dim != 2 or len(faces) == 0:
        return np.zeros((0, 3), np.int64)
    if faces.shape[1] < 4 or faces.min() < 0 or faces.max() >= len(points) or points.shape[1] != 3:
        raise MeshError(
            f"The surface has {len(faces)} faces of kind {block.kind} with fewer than three corners, or with corners "
            "that do not exist; export it again, as triangles."
        )
    with np.errstate(all="ignore"):  # check_points refuses coordinates that overflow
        return triangles_of_faces(points, faces)


def closed_surface(points: Points, triangles: Indices, source: str) -> ClosedSurface:
    """A surface of triangles, mended (see mending), checked, oriented outwards and sorted into bodies.

    Raises:
        MeshError: see read_surface; `source` begins the message.
    """
    check_points(points, triangles, source)
    points, triangles, mended_notes, _, may_be_flat = mend_closed_surface(points, triangles)
    if may_be_flat:
        check_areas(points, triangles, source)
    table = EdgeTable(triangles)
    check_edges(points, table, source, (1, 2))
    triangles, shell, turned = orient_consistently(triangles, table, source)
    triangles, bodies, inside_out = _orient_outwards(points, triangles, shell, source)
    notes = list(mended_notes)
    if turned:
        notes.append(f"{turned} of {len(triangles)} surface triangles faced the other way than the rest; turned.")
    if inside_out:
        notes.append(f"{inside_out} parts of the surface were inside out and have been turned.")
    cavities = sum(len(body) - 1 for body in bodies)
    if len(bodies) > 1:
        notes.append(f"The surface encloses {len(bodies)} separate bodies; each needs its own supports.")
    if cavities:
        notes.append(f"{cavities} closed parts of the surface lie inside another and are taken as cavities.")
    return ClosedSurface(points, triangles, shell, bodies, tuple(notes))


def check_points(points: Points, triangles: Indices, source: str) -> None:
    """Raise MeshError if a corner does not exist, or a coordinate or the size is out of range."""
    if triangles.min() < 0 or triangles.max() >= len(points):
        raise MeshError(f"{source} names points that do not exist (there are {len(points)}); it is damaged.")
    is_used = np.zeros(len(points), bool)
    is_used[triangles] = True
    check_extent(points, source, is_used)


def check_areas(points: Points, triangles: Indices, source: str) -> None:
    """Raise MeshError if a triangle has no area."""
    if len(triangles) == 0:
        raise MeshError(f"{source} has no triangle that is larger than a point.")
    flat = np.flatnonzero(has_no_area(points, triangles))
    if len(flat):
        raise MeshError(
            f"{source} has {len(flat)} triangles without an area, the first at "
            f"{format_midpoint(points, triangles[flat[0]])}; remesh the surface there."
        )


def check_edges(points: Points, table: EdgeTable, source: str, which: tuple[int, ...]) -> None:
    """Raise MeshError if edges belong to one triangle only (`which` has 1) or to more than two (2)."""
    faults = {
        1: (table.edges[table.counts == 1], "is open: {} edges belong to one triangle only"),
        2: (table.edges[table.counts > 2], "is not the surface of a body: {} edges belong to more than two triangles"),
    }
    for kind in which:
        wrong, description = faults[kind]
        if len(wrong):
            refused = RepairableSurfaceError if 1 in which else MeshError
            raise refused(
                f"{source} {description.format(len(wrong))}, the first at {format_midpoint(points, wrong[0])}; "
                "close or mend it there (MeshLab: Filters > Remeshing > Close Holes; Blender: Mesh > Clean Up > Fill "
                "Holes)."
            )


def orient_consistently(triangles: Indices, table: EdgeTable, source: str) -> tuple[Indices, Indices, int]:
    """Triangles oriented like their neighbours; the connected part of each; how many were turned.

    Raises:
        MeshError: a part has one side only.
    """
    # Each triangle t has two states, as given (t) and turned (t + k). States of neighbours that agree are linked; a
    # part has two mirrored sets of linked states, or one if it has one side only (Moebius).
    count = len(triangles)
    directed, counts, edge = table.directed, table.counts, table.edge_of
    order = np.argsort(edge, kind="stable")
    order = order[counts[edge[order]] == 2]  # an open surface has edges of one triangle
    first, second = order[0::2], order[1::2]
    disagree = directed[first, 0] == directed[second, 0]
    a, b = first // 3, second // 3
    if not disagree.any():  # as in most files
        return triangles, components(np.stack([a, b], axis=1), count)[1], 0
    # two triangles that pass their common edge in the same direction disagree
    links = np.concatenate([np.stack([a, b + count * disagree], 1), np.stack([a + count, b + count * ~disagree], 1)])
    _, state = components(links, 2 * count)
    as_given, turned = state[:count], state[count:]
    if (as_given == turned).any():
        raise MeshError(f"{source} has one side only, like a Moebius strip; it encloses no body.")
    _, shell = np.unique(np.minimum(as_given, turned), return_inverse=True)
    flip = turned < as_given
    # of the two consistent orientations of a part the one that turns fewer triangles
    size, flips = np.bincount(shell), np.bincount(shell, weights=flip)
    flip ^= (2 * flips > size)[shell]
    return _flipped(triangles, flip), shell, int(flip.sum())


def _flipped(triangles: Indices, which: Mask) -> Indices:
    """Triangles (k, 3), the marked ones with reversed orientation."""
    return np.where(which[:, None], triangles[:, ::-1], triangles)


def _orient_outwards(
    points: Points, triangles: Indices, shell: Indices, source: str
) -> tuple[Indices, list[list[int]], int]:
    """Triangles with normals out of the material; shells of each body, the outer first; number of turned shells."""
    volumes = np.bincount(shell, weights=enclosed_volumes(points, triangles))
    inside = _nesting(points, triangles, shell, source)
    depth = inside.sum(axis=1)
    # shells inside an even number of others are outer ones, all others are cavities
    wrong = (volumes > 0) != (depth % 2 == 0)
    bodies = [[int(outer), *_cavities(outer, inside, depth)] for outer in np.flatnonzero(depth % 2 == 0)]
    return _flipped(triangles, wrong[shell]), bodies, int(wrong.sum())


def _cavities(outer: np.int64, inside: Mask, depth: Indices) -> list[int]:
    """Shells directly within an outer shell; `inside` as of `_nesting`, `depth`: number of shells around each."""
    return [int(shell) for shell in np.flatnonzero(inside[:, outer] & (depth == depth[outer] + 1))]


def _nesting(points: Points, triangles: Indices, shell: Indices, source: str) -> Mask:
    """(s, s) whether shell i lies inside shell j; MeshError if only some of its points do."""
    count = int(shell.max()) + 1
    inside = np.zeros((count, count), bool)
    if count == 1:
        return inside
    corners = [points[triangles[shell == j]] for j in range(count)]
    for i, j in _overlapping_boxes(corners):
        within = probes_inside(np.unique(corners[i].reshape(-1, 3), axis=0), corners[j])
        # corners of parts with faces in common planes lie on the other part, neither inside nor outside
        within = np.append(within, probes_inside(_points_within(corners[i]), corners[j]))
        if within.any() and not within.all():
            raise RepairableSurfaceError(
                f"{source} has parts that cut each other, near "
                f"{format_midpoint(points, triangles[shell == i].ravel())}; "
                "join them into one surface, or move them apart."
            )
        inside[i, j] = within.all()
    return inside


def _points_within(corners: Floats) -> Points:
    """Points (n, 3) within a closed shell (k, 3, 3), off the centres of some triangles by a hundredth of their size."""
    chosen = corners[:: 1 + len(corners) // 150]
    normals = np.cross(chosen[:, 1] - chosen[:, 0], chosen[:, 2] - chosen[:, 0])
    length = np.sqrt(np.linalg.norm(normals, axis=1, keepdims=True))
    offset = 1e-2 * normals / np.where(length > 0, length, 1.0)
    points = np.concatenate([chosen.mean(axis=1) - offset, chosen.mean(axis=1) + offset])
    return points[abs(winding_numbers(points, corners)) > 0.5]


def _overlapping_boxes(corners: list[Floats]) -> list[tuple[int, int]]:
    """Pairs of different shells whose bounding boxes overlap."""
    low = np.array([c.min(axis=(0, 1)) for c in corners])
    high = np.array([c.max(axis=(0, 1)) for c in corners])
    overlap = (low[:, None] < high[None]).all(axis=2) & (low[None] < high[:, None]).all(axis=2)
    return [(int(i), int(j)) for i, j in np.argwhere(overlap) if i != j]
