"""Shells: triangles in space with a thickness, as one layer of prisms of three tetrahedra each.

    x = X - h/2 n, X + h/2 n

of a node at X, n the mean of its triangles' normals weighted by their angles there, longer where they differ so that
the thickness stays. Nodes i (below) and i + N (above), cells 3 t, 3 t + 1 and 3 t + 2 of triangle t; the side of a
prism between nodes i < j is cut from i below to j above, so that neighbours agree.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .data import Indices, MeshData, MeshError, Points, Shell, format_midpoint
from .topology import Floats, boundary_facets, signed_measures

LONGEST = 2.0  # times the thickness that a normal at a fold may be long


def extrude_shell(
    points: Points, triangles: Indices, thickness: float, source: str = "shell", notes: tuple[str, ...] = ()
) -> MeshData:
    """The shell of triangles (m, 3), turned alike, between points (n, 3), m. Groups: inner, outer, and rim where it is
    open; outer is where the normals of the triangles point.

    Raises:
        MeshError: folds leave no room for the thickness; the message begins with `source`.
    """
    normal = _normals(points, triangles)
    combined = np.concatenate([points - thickness / 2 * normal, points + thickness / 2 * normal])
    order = np.argsort(triangles, axis=1)
    odd = np.linalg.det(np.eye(3)[order]) < 0
    a, b, c = np.take_along_axis(triangles, order, axis=1).T
    A, B, C = (item + len(points) for item in (a, b, c))
    prism = [[a, b, c, C], [a, b, C, B], [a, A, B, C]]
    cells = np.stack([np.stack(item, axis=1) for item in prism], axis=1)
    cells[odd] = cells[odd][:, :, [0, 1, 3, 2]]
    cells = cells.reshape(-1, 4)
    inside_out = np.flatnonzero(signed_measures(combined, cells) <= 0)
    if len(inside_out):
        where = format_midpoint(combined, cells[inside_out[0]])
        raise MeshError(f"{source}: {thickness:g} m is too thick for its folds near {where}: take a smaller thickness.")
    facets = boundary_facets(cells)
    above = (facets >= len(points)).sum(axis=1)
    groups = {"inner": facets[above == 0], "outer": facets[above == 3]}
    if len(rim := facets[(above > 0) & (above < 3)]):
        groups["rim"] = rim
    shell = Shell(np.concatenate([points, points]), triangles, thickness)
    return MeshData(combined, cells, groups, notes=notes, shell=shell)


def _normals(points: Points, triangles: Indices) -> Floats:
    """(n, 3) along the mean normal, as long as the thickness needs."""
    sides = points[np.roll(triangles, -1, axis=1)] - points[triangles]
    of_triangle = np.cross(sides[:, 0], sides[:, 1])
    of_triangle /= np.linalg.norm(of_triangle, axis=1)[:, None]
    back = -np.roll(sides, 1, axis=1)
    cosine = np.einsum("nki,nki->nk", sides, back) / np.linalg.norm(sides, axis=2) / np.linalg.norm(back, axis=2)
    angle = np.arccos(np.clip(cosine, -1, 1))
    mean = np.zeros_like(points)
    np.add.at(mean, triangles, angle[:, :, None] * of_triangle[:, None])
    whole = np.bincount(triangles.ravel(), angle.ravel(), len(points))[:, None]
    length = np.linalg.norm(mean, axis=1)[:, None]
    return np.asarray(mean / length * np.minimum(whole / length, LONGEST))


def read_shell(path: str | Path, thickness: float, scale: float = 1.0) -> MeshData:
    """A shell from a file of triangles or quads, closed or open; `scale`: metres per unit of it.

    Raises:
        MeshError: the file cannot be read or holds no surface; an edge of more than two triangles, or triangles that
            cannot be turned alike; a thickness that its folds leave no room for.
    """
    from .surfaces.closed import read_triangles  # shells of builders need no reader

    path = Path(path)
    source = f"Shell file '{path}'"
    points, triangles, notes = read_triangles(path, scale, source)
    return extrude_shell(points, triangles, thickness, source, notes)
