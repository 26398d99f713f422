"""A closed surface from file, filled with tetrahedra."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import pi
from pathlib import Path
from typing import Any

import numpy as np

from ..check import check_mesh, flat_cells
from ..data import Indices, MeshData, MeshError, Points
from ..gmsh_session import TRIANGLE, cells_of_model, fill_volumes, session
from ..parameters import positive, require, require_affordable
from ..sizing import SizeField, estimate_cells_in_body
from ..time_limit import within
from ..topology import Floats, boundary_facets, distinct_rows, facets_of, signed_measures
from .closed import ClosedSurface
from .enclosed import enclosed_volumes
from .repair import read_body

SHARP = 40 * pi / 180  # edges where the normal turns by more than this are kept
REMESHED = 0.10  # a remeshed surface may enclose this much more or less of its volume, or its own triangles are taken
FILLED = 1e-6  # share by which tetrahedra may miss the volume of the triangles that they fill
SLIVER = 1e-4  # cells on the boundary thinner than this (volume over longest edge cubed) are left out
DIGITS = 12  # of coordinates handed to gmsh
TOLD = 0.01  # share of the file's volume from which on a difference is told


Shell = tuple[Points, Indices]


def fill_surface(
    path: str | Path, h: float, *, scale: float = 1.0, time_limit: float | None = None, repair: bool = False
) -> MeshData:
    """Tetrahedra of size h [m] inside a closed surface (STL, OBJ, PLY, ...), checked.

    The surface is meshed anew at size h, edges of more than 40 degrees kept; where that fails its own triangles are
    taken. Closed parts inside another are cavities. Facet group: surface, the whole boundary.

    Args:
        path: the file.
        h: size of the cells [m].
        scale: metres per unit of length of the file.
        time_limit: seconds that gmsh may take; None: a minute and a millisecond for each cell expected.
        repair: whether holes are filled, and what cuts itself is mended (see repair).

    Raises:
        MeshError: h is out of range; the surface is not closed or is damaged (see read_body); gmsh fails or takes
            too long; the volume of the cells is not that of the surface.
    """
    surface = read_body(path, scale, repair=repair, time_limit=time_limit)
    return fill_closed(surface, h, f"Surface file '{path}'", time_limit)


def fill_closed(surface: ClosedSurface, h: float, source: str, time_limit: float | None = None) -> MeshData:
    """Tetrahedra inside a surface that has been read; `source` begins the message of an error (see fill_surface)."""
    expected = expected_cells(surface, h)
    seconds = 60 + 1e-3 * (expected + len(surface.triangles)) if time_limit is None else time_limit
    try:
        result = within(seconds, _made, surface, h, source)
    except TimeoutError:
        raise MeshError(
            f"{source}: gmsh had not filled it within {seconds:.0f} s (about {expected:,} cells of h = {h:g} m in a "
            f"body of {surface.extent}). Take a larger h, mend or simplify the surface, or give gmsh more seconds with "
            "[mesh] time_limit."
        ) from None
    checked = check_mesh(result)
    # The surface's own notes tell of separate bodies already.
    return replace(checked, notes=tuple(note for note in checked.notes if "share no node" not in note))


def expected_cells(surface: ClosedSurface, h: float) -> int:
    """About how many cells of size h [m] will fill the surface.

    Raises:
        MeshError: more than can be held, or cells larger than the body.
    """
    positive("surface", h=h)
    units = f"The body measures {surface.extent}: a file in millimetres needs [mesh] scale = 1e-3."
    require(h <= max(surface.sides), f"surface: h = {h!r} m is larger than the whole body. {units}")
    wall = 2 * surface.volume / surface.area  # of a shell; of a solid body some third of its thickness, which is more
    expected = estimate_cells_in_body(surface.volume, wall, h)
    require_affordable("surface", h, expected, units)
    return expected


def _made(surface: ClosedSurface, h: float, source: str) -> MeshData:
    """What gmsh makes of the surface."""
    shells, notes = _remeshed_shells(surface, h)
    unit = _Unit.of([points for points, _ in shells])
    small = [(unit.into(points), triangles) for points, triangles in shells]
    points, cells, volume = fill_shells(small, surface.bodies, unit.length(h), source)
    notes = surface.notes + notes + _volume_note(surface.volume, volume * unit.size**3)
    return MeshData(unit.back(points), cells, {"surface": boundary_facets(cells)}, notes=notes)


def fill_shells(shells: list[Shell], bodies: list[list[int]], h: float, source: str) -> tuple[Points, Indices, float]:
    """Points, tetrahedra and their volume [m^3] between shells as they are; `source` begins the message of an error."""
    points, cells = _filled(shells, bodies, _inner_size(shells, h), source)
    volume = float(signed_measures(points, cells).sum())
    _check_filled(shells, bodies, volume, source)
    return points, remove_boundary_slivers(points, cells), volume


def _remeshed_shells(surface: ClosedSurface, h: float) -> tuple[list[Shell], tuple[str, ...]]:
    """Each shell with triangles of size h, or as it is with a note."""
    shells, notes = [], []
    for number in range(int(surface.shell.max()) + 1):
        points, triangles = surface.part(number)
        try:
            shells.append(_remeshed(points, triangles, h))
        except MeshError as error:
            shells.append((points, triangles))
            notes.append(f"Part {number} of the surface keeps its own {len(triangles)} triangles, whatever h: {error}")
    return shells, tuple(notes)


def _remeshed(points: Points, triangles: Indices, h: float) -> Shell:
    """One shell meshed anew by gmsh, cut into patches at its sharp edges."""
    unit = _Unit.of([points])
    with session() as gmsh:
        _add_shell(gmsh, 1, unit.into(points), triangles)
        gmsh.model.mesh.classifySurfaces(SHARP, True, True, pi)
        gmsh.model.mesh.createGeometry()
        SizeField(unit.length(h)).apply(gmsh)
        gmsh.model.mesh.generate(2)
        tags, coordinates, _ = gmsh.model.mesh.getNodes()
        _, nodes = gmsh.model.mesh.getElementsByType(TRIANGLE)
    position = np.zeros(int(tags.max()) + 1, np.int64)
    position[tags] = np.arange(len(tags))
    used, new = np.unique(position[nodes], return_inverse=True)
    return _same_body(points, triangles, unit.back(coordinates.reshape(-1, 3)[used]), new.reshape(-1, 3))


def _same_body(points: Points, triangles: Indices, new_points: Points, new: Indices) -> Shell:
    """The new shell, facing as the old one; MeshError where it is not closed or encloses another volume."""
    directed = np.stack([new, np.roll(new, -1, axis=1)], axis=2).reshape(-1, 2)
    _, counts, _ = distinct_rows(np.sort(directed, axis=1))
    _, repeats, _ = distinct_rows(directed)
    if (counts != 2).any() or (repeats != 1).any():
        raise MeshError("remeshed it was not closed.")
    old_volume, new_volume = (float(enclosed_volumes(p, t).sum()) for p, t in ((points, triangles), (new_points, new)))
    if abs(abs(new_volume) - abs(old_volume)) > REMESHED * abs(old_volume):
        raise MeshError(
            f"remeshed it enclosed {abs(new_volume):.4g} m^3 in place of {abs(old_volume):.4g} m^3; take a smaller h."
        )
    return new_points, new if old_volume * new_volume > 0 else new[:, ::-1]


def _inner_size(shells: list[Shell], h: float) -> float:
    """h, or the size of the finest shell that kept its triangles: larger cells would be flat where it is slender."""
    edges = [np.linalg.norm(points[tri] - points[np.roll(tri, 1, axis=1)], axis=2) for points, tri in shells]
    finest = min(float(np.median(lengths)) for lengths in edges)
    return finest if finest < h / 2 else h


def _filled(shells: list[Shell], bodies: list[list[int]], h: float, source: str) -> tuple[Points, Indices]:
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
class _Unit:
    """A body shrunk or blown up to the size of one for gmsh, whose bounds of a size and tolerances are absolute.

    Discrete surfaces do not tell gmsh how large their model is: it goes on taking 1 for that, and no cell is larger
    than the model. Twelve digits are kept, so that the last ones, which change with the unit of length, decide nothing.
    """

    low: Floats
    size: float

    @classmethod
    def of(cls, shells: list[Points]) -> _Unit:
        points = np.concatenate(shells)
        return cls(points.min(axis=0), float(np.ptp(points, axis=0).max()))

    def into(self, points: Points) -> Points:
        return np.round((points - self.low) / self.size, DIGITS)

    def length(self, h: float) -> float:
        return float(f"{h / self.size:.{DIGITS}g}")

    def back(self, points: Points) -> Points:
        return points * self.size + self.low


def _add_shell(gmsh: Any, tag: int, points: Points, triangles: Indices) -> None:
    """A discrete surface of gmsh's model with its own nodes."""
    first = int(gmsh.model.mesh.getMaxNodeTag()) + 1
    numbers = np.arange(first, first + len(points))
    gmsh.model.addDiscreteEntity(2, tag)
    gmsh.model.mesh.addNodes(2, tag, numbers, points.ravel())
    gmsh.model.mesh.addElementsByType(tag, TRIANGLE, [], numbers[triangles].ravel())


def remove_boundary_slivers(points: Points, cells: Indices, thin: float = SLIVER) -> Indices:
    """Cells without the flat ones on the boundary: four nodes of one face, almost in a plane, that nobody misses.

    Without such a cell the face is cut along its other diagonal.
    """
    while True:
        facets = np.sort(facets_of(cells), axis=2)
        _, counts, inverse = distinct_rows(facets.reshape(-1, 3))
        outside = (counts[inverse].reshape(-1, 4) == 1).any(axis=1)
        peel = outside & flat_cells(points, cells, thin)
        if not peel.any():
            return cells
        cells = cells[~peel]


def _check_filled(shells: list[Shell], bodies: list[list[int]], made: float, source: str) -> None:
    """gmsh keeps the shells' triangles as they are, so that cells and shells enclose the same volume to rounding."""
    volumes = [float(enclosed_volumes(*shell).sum()) for shell in shells]
    wanted = sum(volumes[shell] for body in bodies for shell in body)
    if abs(made - wanted) > FILLED * wanted:
        raise MeshError(
            f"{source}: tetrahedra fill {made / wanted:.4%} of the volume it encloses; mend it where it cuts itself."
        )


def _volume_note(wanted: float, made: float) -> tuple[str, ...]:
    if abs(made - wanted) <= TOLD * wanted:
        return ()
    return (f"The tetrahedra fill {made:.4g} m^3, the surface encloses {wanted:.4g} m^3.",)
