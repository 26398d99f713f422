"""Closed surfaces filled with tetrahedra by gmsh."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import pi
from pathlib import Path
from typing import Any

import numpy as np

from ..check import check_mesh, flat_cells
from ..data import Indices, MeshData, MeshError, Points
from ..gmsh_session import cells_of_model, fill_volumes, session
from ..parameters import require, require_affordable, require_positive
from ..random_points.faces import GmshElement
from ..sizing import SizeField, estimate_cells_in_body
from ..time_limit import call_with_time_limit
from ..topology import Floats, boundary_facets, distinct_rows, facets_of, signed_measures
from .closed import ClosedSurface
from .repair import read_body
from .triangle_geometry import Triangulation, directed_edges, enclosed_volumes


@dataclass(frozen=True)
class FillLimits:
    """Tolerances of filling a surface."""

    sharp_angle: float = 40 * pi / 180  # [rad]: edges at which the normal turns by more are kept
    remeshed_volume: float = 0.10  # relative change of a shell's volume; if more, its own triangles are kept
    filled_volume: float = 1e-6  # relative difference of the volumes of tetrahedra and triangles: round-off
    sliver: float = 1e-4  # volume over longest edge cubed: flatter cells on the boundary are removed
    digits: int = 12  # of coordinates that gmsh gets
    reported_volume: float = 0.01  # relative difference to the volume of the file from which on a note tells
    seconds: float = 60.0  # of gmsh, and
    seconds_per_cell: float = 1e-3  # for each expected cell and triangle


FILL = FillLimits()


def fill_surface(
    path: str | Path, h: float, *, scale: float = 1.0, time_limit: float | None = None, repair: bool = False
) -> MeshData:
    """The checked mesh of tetrahedra of size h [m] inside a closed surface from file (STL, OBJ, PLY, ...).

    The surface is remeshed at size h, edges of more than 40 degrees kept; if that fails, its own triangles are kept.
    Closed parts inside another are cavities. Facet group: surface, the whole boundary.

    Args:
        path: the file.
        h: size of the cells [m].
        scale: metres per unit of length of the file.
        time_limit: of gmsh [s]; None: a minute and a millisecond for each expected cell.
        repair: whether holes are filled and self-intersections removed (see repair).

    Raises:
        MeshError: h is out of range; the surface is not closed or is damaged (see read_body); gmsh fails or takes
            too long; the volume of the cells is not that of the surface.
    """
    surface = read_body(path, scale, repair=repair, time_limit=time_limit)
    return fill_closed(surface, h, f"Surface file '{path}'", time_limit)


def fill_closed(surface: ClosedSurface, h: float, source: str, time_limit: float | None = None) -> MeshData:
    """The checked mesh of tetrahedra inside a surface; `source` begins the message of an error (see fill_surface)."""
    expected = expected_cells(surface, h)
    seconds = (
        FILL.seconds + FILL.seconds_per_cell * (expected + len(surface.triangles)) if time_limit is None else time_limit
    )
    try:
        mesh = call_with_time_limit(seconds, _fill, surface, h, source)
    except TimeoutError:
        raise MeshError(
            f"{source}: gmsh had not filled it within {seconds:.0f} s (about {expected:,} cells of h = {h:g} m in a "
            f"body of {surface.extent}). Take a larger h, mend or simplify the surface, or give gmsh more seconds with "
            "[mesh] time_limit."
        ) from None
    checked = check_mesh(mesh)
    # the notes of the surface report separate bodies already
    return replace(checked, notes=tuple(note for note in checked.notes if "share no node" not in note))


def expected_cells(surface: ClosedSurface, h: float) -> int:
    """Approximate number of cells of size h [m] that fill the surface.

    Raises:
        MeshError: too many cells, or cells larger than the body.
    """
    require_positive("surface", h=h)
    units = f"The body measures {surface.extent}: a file in millimetres needs [mesh] scale = 1e-3."
    require(h <= max(surface.sides), f"surface: h = {h!r} m is larger than the whole body. {units}")
    wall = 2 * surface.volume / surface.area  # [m] of a thin body; of a solid about a third of its thickness
    expected = estimate_cells_in_body(surface.volume, wall, h)
    require_affordable("surface", h, expected, units)
    return expected


def _fill(surface: ClosedSurface, h: float, source: str) -> MeshData:
    """The mesh of tetrahedra inside a surface, not checked."""
    shells, notes = _remeshed_shells(surface, h)
    scaling = _UnitScaling.of([points for points, _ in shells])
    scaled = [(scaling.to_unit(points), triangles) for points, triangles in shells]
    points, cells, volume = fill_shells(scaled, surface.bodies, scaling.length(h), source)
    notes = surface.notes + notes + _volume_note(surface.volume, volume * scaling.size**3)
    return MeshData(scaling.from_unit(points), cells, {"surface": boundary_facets(cells)}, notes=notes)


def fill_shells(
    shells: list[Triangulation], bodies: list[list[int]], h: float, source: str
) -> tuple[Points, Indices, float]:
    """Points, tetrahedra and their volume [m^3] inside shells, whose triangles are kept.

    Args:
        shells: points and triangles of each.
        bodies: for each body its outer shell, then the shells of its cavities.
        h: size of the cells [m].
        source: begins the message of an error.
    """
    points, cells = _tetrahedra(shells, bodies, _inner_size(shells, h), source)
    volume = float(signed_measures(points, cells).sum())
    _check_volume(shells, bodies, volume, source)
    return points, remove_boundary_slivers(points, cells), volume


def _remeshed_shells(surface: ClosedSurface, h: float) -> tuple[list[Triangulation], tuple[str, ...]]:
    """Each shell with triangles of size h, or with its own triangles and a note."""
    shells, notes = [], []
    for number in range(int(surface.shell.max()) + 1):
        points, triangles = surface.part(number)
        try:
            shells.append(_remeshed(points, triangles, h))
        except MeshError as error:
            shells.append((points, triangles))
            notes.append(f"Part {number} of the surface keeps its own {len(triangles)} triangles, whatever h: {error}")
    return shells, tuple(notes)


def _remeshed(points: Points, triangles: Indices, h: float) -> Triangulation:
    """One shell remeshed by gmsh at size h, cut into patches at its sharp edges."""
    scaling = _UnitScaling.of([points])
    with session() as gmsh:
        _add_shell(gmsh, 1, scaling.to_unit(points), triangles)
        gmsh.model.mesh.classifySurfaces(FILL.sharp_angle, True, True, pi)
        gmsh.model.mesh.createGeometry()
        SizeField(scaling.length(h)).apply(gmsh)
        gmsh.model.mesh.generate(2)
        tags, coordinates, _ = gmsh.model.mesh.getNodes()
        _, nodes = gmsh.model.mesh.getElementsByType(GmshElement.TRIANGLE)
    index = np.zeros(int(tags.max()) + 1, np.int64)
    index[tags] = np.arange(len(tags))
    used, new = np.unique(index[nodes], return_inverse=True)
    new_points = scaling.from_unit(coordinates.reshape(-1, 3)[used])
    return _oriented_as(points, triangles, new_points, new.reshape(-1, 3))


def _oriented_as(points: Points, triangles: Indices, new_points: Points, new: Indices) -> Triangulation:
    """The new shell with the orientation of the old one; MeshError if it is open or encloses another volume."""
    directed = directed_edges(new)
    _, counts, _ = distinct_rows(np.sort(directed, axis=1))
    _, repeats, _ = distinct_rows(directed)
    if (counts != 2).any() or (repeats != 1).any():
        raise MeshError("remeshed it was not closed.")
    old_volume, new_volume = (float(enclosed_volumes(p, t).sum()) for p, t in ((points, triangles), (new_points, new)))
    if abs(abs(new_volume) - abs(old_volume)) > FILL.remeshed_volume * abs(old_volume):
        raise MeshError(
            f"remeshed it enclosed {abs(new_volume):.4g} m^3 in place of {abs(old_volume):.4g} m^3; take a smaller h."
        )
    return new_points, new if old_volume * new_volume > 0 else new[:, ::-1]


def _inner_size(shells: list[Triangulation], h: float) -> float:
    """Size of the cells inside: h, or the median edge of the finest shell if that is below h / 2."""
    # a shell that kept fine triangles may be slender: larger cells would be flat there
    edges = [np.linalg.norm(points[tri] - points[np.roll(tri, 1, axis=1)], axis=2) for points, tri in shells]
    finest = min(float(np.median(lengths)) for lengths in edges)
    return finest if finest < h / 2 else h


def _tetrahedra(shells: list[Triangulation], bodies: list[list[int]], h: float, source: str) -> tuple[Points, Indices]:
    """Points and tetrahedra that gmsh makes inside shells."""
    try:
        with session() as gmsh:
            for number, shell in enumerate(shells, start=1):
                _add_shell(gmsh, number, *shell)
            for body in bodies:
                loops = [gmsh.model.geo.addSurfaceLoop([shell + 1]) for shell in body]
                gmsh.model.geo.addVolume(loops)
            gmsh.model.geo.synchronize()
            fill_volumes(gmsh, SizeField(h))
            points, cells = cells_of_model(gmsh, 3)
    except MeshError as error:
        raise MeshError(
            f"{source} could not be filled with tetrahedra ({error}) Does the surface cut itself? [mesh] repair "
            "= true mends that in many cases."
        ) from error
    return points, cells


@dataclass(frozen=True)
class _UnitScaling:
    """The map of a body to the unit cube, since gmsh's size bounds and tolerances are absolute.

    Attributes:
        low: (3,) lower corner of the bounding box [m].
        size: longest side of the bounding box [m].
    """

    # gmsh takes 1 for the size of a model of discrete surfaces, and makes no cell larger than the model. Coordinates
    # are rounded, so that their last digits, which depend on the unit of length, do not change the mesh.
    low: Floats
    size: float

    @classmethod
    def of(cls, shells: list[Points]) -> _UnitScaling:
        """The map of the bounding box of some points."""
        points = np.concatenate(shells)
        return cls(points.min(axis=0), float(np.ptp(points, axis=0).max()))

    def to_unit(self, points: Points) -> Points:
        """Points of the body in the unit cube."""
        return np.round((points - self.low) / self.size, FILL.digits)

    def length(self, h: float) -> float:
        """A length of the body in the unit cube."""
        return float(f"{h / self.size:.{FILL.digits}g}")

    def from_unit(self, points: Points) -> Points:
        """Points of the unit cube in the body [m]."""
        return points * self.size + self.low


def _add_shell(gmsh: Any, tag: int, points: Points, triangles: Indices) -> None:
    """Add a discrete surface with its own nodes to gmsh's model."""
    first = int(gmsh.model.mesh.getMaxNodeTag()) + 1
    numbers = np.arange(first, first + len(points))
    gmsh.model.addDiscreteEntity(2, tag)
    gmsh.model.mesh.addNodes(2, tag, numbers, points.ravel())
    gmsh.model.mesh.addElementsByType(tag, GmshElement.TRIANGLE, [], numbers[triangles].ravel())


def remove_boundary_slivers(points: Points, cells: Indices, thin: float = FILL.sliver) -> Indices:
    """Cells without the flat ones on the boundary; `thin`: bound of volume over longest edge cubed.

    Such a cell has its four nodes on one face of the body, almost in a plane; without it the face is cut along the
    other diagonal.
    """
    while True:  # cells behind a removed one are on the boundary then
        facets = np.sort(facets_of(cells), axis=2)
        _, counts, inverse = distinct_rows(facets.reshape(-1, 3))
        outside = (counts[inverse].reshape(-1, 4) == 1).any(axis=1)
        slivers = outside & flat_cells(points, cells, thin)
        if not slivers.any():
            return cells
        cells = cells[~slivers]


def _check_volume(shells: list[Triangulation], bodies: list[list[int]], volume: float, source: str) -> None:
    """Raise MeshError unless the cells have the volume [m^3] that the shells enclose."""
    # gmsh keeps the triangles of the shells, so that both volumes agree to round-off
    volumes = [float(enclosed_volumes(*shell).sum()) for shell in shells]
    enclosed = sum(volumes[shell] for body in bodies for shell in body)
    if abs(volume - enclosed) > FILL.filled_volume * enclosed:
        raise MeshError(
            f"{source}: tetrahedra fill {volume / enclosed:.4%} of the volume it encloses; mend it where it cuts "
            "itself."
        )


def _volume_note(enclosed: float, filled: float) -> tuple[str, ...]:
    """A note if the volume [m^3] of the cells differs from that of the surface."""
    if abs(filled - enclosed) <= FILL.reported_volume * enclosed:
        return ()
    return (f"The tetrahedra fill {filled:.4g} m^3, the surface encloses {enclosed:.4g} m^3.",)
