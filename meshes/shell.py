"""Shells: triangles in space with a thickness t, as one layer of prisms of three tetrahedra each.

Node i of N at X in the middle surface becomes node i at X - t/2 n and node i + N at X + t/2 n. The vector n is the mean
of the normals of its triangles weighted by their angles; at folds it is longer, so that the thickness stays. Triangle k
becomes cells 3 k, 3 k + 1 and 3 k + 2; the side of a prism between nodes i < j is cut from i below to j above, so that
neighbours agree.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .data import Indices, MeshData, MeshError, Points, Shell, format_midpoint
from .topology import Floats, boundary_facets, signed_measures


def extrude_shell(
    points: Points, triangles: Indices, thickness: float, source: str = "shell", notes: tuple[str, ...] = ()
) -> MeshData:
    """The mesh of a shell. Facet groups: inner, outer (where the normals point), and rim if the surface is open.

    Args:
        points: (n, 3) of the middle surface [m].
        triangles: (m, 3) with consistent orientation.
        thickness: [m].
        source: begins the message of an error.
        notes: of the mesh.

    Raises:
        MeshError: the surface is folded too sharply for the thickness.
    """
    normal = _offset_normals(points, triangles)
    combined = np.concatenate([points - thickness / 2 * normal, points + thickness / 2 * normal])
    # prisms are cut by their sorted nodes; an odd permutation reverses the orientation
    order = np.argsort(triangles, axis=1)
    odd = np.linalg.det(np.eye(3)[order]) < 0
    a, b, c = np.take_along_axis(triangles, order, axis=1).T
    A, B, C = (nodes + len(points) for nodes in (a, b, c))
    prism = [[a, b, c, C], [a, b, C, B], [a, A, B, C]]
    cells = np.stack([np.stack(tetrahedron, axis=1) for tetrahedron in prism], axis=1)
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


def _offset_normals(points: Points, triangles: Indices) -> Floats:
    """(n, 3) mean normal of each node, longer than 1 at folds so that the thickness stays."""
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
    return np.asarray(mean / length * np.minimum(whole / length, 2.0))  # sharper folds become thinner


def read_shell(path: str | Path, thickness: float, scale: float = 1.0) -> MeshData:
    """The mesh of a shell from a file of triangles or quads, closed or open.

    Args:
        path: the file.
        thickness: [m].
        scale: metres per unit of length of the file.

    Raises:
        MeshError: the file cannot be read or holds no surface; an edge belongs to more than two triangles; triangles
            cannot be oriented consistently; the surface is folded too sharply for the thickness.
    """
    from .surfaces.closed import read_triangles  # shells of builders need no readers

    path = Path(path)
    source = f"Shell file '{path}'"
    points, triangles, notes = read_triangles(path, scale, source)
    return extrude_shell(points, triangles, thickness, source, notes)
