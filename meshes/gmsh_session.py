"""Meshes by gmsh: a session for each, without output, with the same result each time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import IntEnum
from typing import Any

import numpy as np

from .data import Indices, MeshError, Points
from .quality import POOR, radius_ratios
from .random_points.faces import GmshElement, scatter_faces, scatter_plane
from .sizing import SizeField
from .topology import orient_cells


class Algorithm(IntEnum):
    """gmsh's numbers for algorithms that fill volumes (Mesh.Algorithm3D)."""

    DELAUNAY = 1
    HXT = 10


@contextmanager
def session() -> Iterator[Any]:
    """The module gmsh with an empty model; a failure inside gmsh becomes a MeshError with gmsh's reason."""
    try:
        import gmsh
    except OSError as error:
        raise MeshError(
            f"gmsh cannot be loaded: {error}; install the libraries that it needs, on Debian and Ubuntu by apt-get "
            "install libgl1 libglu1-mesa libxcursor1 libxft2 libxinerama1 libxrender1"
        ) from None

    local = not gmsh.isInitialized()
    if local:
        gmsh.initialize(readConfigFiles=False, interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    gmsh.option.setNumber("General.NumThreads", 1)
    gmsh.option.setNumber("Mesh.RandomSeed", 1)
    gmsh.model.add("fracsim")
    try:
        yield gmsh
    except Exception as error:
        if not _is_from_gmsh(error):
            raise
        raise MeshError(f"gmsh could not make the mesh: {str(error).strip() or 'it gave no reason'}.") from error
    finally:
        if local:
            gmsh.finalize()
        else:
            gmsh.model.remove()


def _is_from_gmsh(error: Exception) -> bool:
    """Whether gmsh raised the error."""
    # gmsh raises plain Exception; a subclass may come from the handler of a signal, which ends the run
    return type(error) is Exception


def mesh_with_gmsh(
    draw: Callable[[Any], None],
    dim: int,
    sizing: SizeField,
    move: Callable[[Points], Points] | None = None,
    seed: int = 1,
) -> tuple[Points, Indices]:
    """Points (n, d) and positive cells (m, d + 1) of a body.

    A plane body, and the flat and cylindrical faces of a solid, have random points (see random_points).

    Args:
        draw: adds the body to gmsh's OpenCASCADE model.
        dim: of the body.
        sizing: cell size.
        move: maps the nodes (k, 3) of the surface mesh before the volume is filled.
        seed: of the random points.

    Raises:
        MeshError: gmsh failed; the message has its reason.
    """
    with session() as gmsh:
        draw(gmsh)
        gmsh.model.occ.synchronize()
        sizing.apply(gmsh)
        if dim == 2:
            gmsh.model.mesh.generate(1)
            return scatter_plane(gmsh, sizing, seed)
        gmsh.model.mesh.generate(2)
        scatter_faces(gmsh, sizing, seed)
        if move:
            _move_nodes(gmsh, move)
        fill_volumes(gmsh, sizing)
        return _relocated(gmsh)


def _move_nodes(gmsh: Any, move: Callable[[Points], Points]) -> None:
    tags, coordinates, _ = gmsh.model.mesh.getNodes()
    for tag, point in zip(tags, move(coordinates.reshape(-1, 3)), strict=True):
        gmsh.model.mesh.setNode(tag, point, [])


def fill_volumes(gmsh: Any, sizing: SizeField) -> None:
    """Fill the volumes of a model whose surfaces are meshed with tetrahedra."""
    # For a size h gmsh makes surface edges of length h, but inner edges of 1.3 h: its criterion is on the circumsphere.
    # With the factor 0.7 inside, the median edge is h within 2 % (boxes of 3 000 to 340 000 cells, algorithm HXT).
    sizing.apply(gmsh, 0.7)
    # HXT is several times as fast as gmsh's Delaunay algorithm, but may fail
    for algorithm in (Algorithm.HXT, Algorithm.DELAUNAY):
        gmsh.option.setNumber("Mesh.Algorithm3D", algorithm)
        try:
            gmsh.model.mesh.generate(3)
            break
        except Exception as error:
            if algorithm == Algorithm.DELAUNAY or not _is_from_gmsh(error):
                raise
    gmsh.model.mesh.optimize("", True)  # HXT leaves a few cells with a radius ratio below 0.3


def _relocated(gmsh: Any) -> tuple[Points, Indices]:
    """Points and tetrahedra; if a few cells are poor, as between random points, inner nodes are moved first."""
    points, cells = cells_of_model(gmsh, 3)
    if radius_ratios(points, cells).min() >= POOR:
        return points, cells
    gmsh.model.mesh.optimize("Relocate3D", True, 2)
    gmsh.model.mesh.optimize("", True)
    return cells_of_model(gmsh, 3)


def cells_of_model(gmsh: Any, dim: int) -> tuple[Points, Indices]:
    """Points (n, d) and positive cells (m, d + 1) of the current model of gmsh, without nodes outside cells."""
    tags, coordinates, _ = gmsh.model.mesh.getNodes()
    _, connectivity = gmsh.model.mesh.getElementsByType(GmshElement.TETRAHEDRON if dim == 3 else GmshElement.TRIANGLE)
    if len(connectivity) == 0:
        raise MeshError("gmsh made no cells; is the body larger than zero and h small enough?")
    index = np.zeros(int(tags.max()) + 1, np.int64)
    index[tags] = np.arange(len(tags))
    used, cells = np.unique(index[connectivity], return_inverse=True)
    points = np.ascontiguousarray(coordinates.reshape(-1, 3)[used, :dim])
    cells, _ = orient_cells(points, cells.reshape(-1, dim + 1).astype(np.int64))
    return points, cells
