"""Random points on faces of gmsh's models: in the plane of a 2D body, on flat and cylindrical faces of a solid.

gmsh places nodes on the curves alone: its triangles are pieces of lattices aligned with the outline.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from math import tau
from typing import Any

import numpy as np

from ..data import Indices, Points
from ..sizing import SizeField
from ..topology import Floats
from .points import Outline, scatter


class GmshElement(IntEnum):
    """gmsh's numbers for element types."""

    LINE = 1
    TRIANGLE = 2
    TETRAHEDRON = 4


def scatter_plane(gmsh: Any, sizing: SizeField, seed: int = 1) -> tuple[Points, Indices]:
    """Points (n, 2) and positive triangles (m, 3) of a plane body whose curves are meshed; MeshError: see `scatter`."""
    nodes = _Curves.of(gmsh, [tag for _, tag in gmsh.model.getEntities(1)])
    return scatter(Outline(nodes.points[:, :2], nodes.pieces), sizing.at, seed)


def scatter_faces(gmsh: Any, sizing: SizeField, seed: int = 1) -> None:
    """Remesh the flat and cylindrical faces of a meshed surface; other faces stay as gmsh made them."""
    for _, face in gmsh.model.getEntities(2):
        if gmsh.model.getType(2, face) in ("Plane", "Cylinder"):
            # each face has seeds of its own, a million for the faces of one mesh
            _remesh(gmsh, face, sizing, face + 1_000_000 * (seed - 1))


@dataclass(frozen=True)
class _Curves:
    """The nodes of some curves of a model.

    Attributes:
        tags: (n,) gmsh's number of each node.
        points: (n, 3) [m].
        pieces: (k, 2) indices in `tags` of the ends of each straight piece.
    """

    tags: Indices
    points: Points
    pieces: Indices

    @classmethod
    def of(cls, gmsh: Any, curves: list[int]) -> _Curves:
        """The nodes of curves by their tags."""
        ends = [gmsh.model.mesh.getElementsByType(GmshElement.LINE, curve)[1] for curve in curves]
        tags, pieces = np.unique(np.concatenate(ends).astype(np.int64), return_inverse=True)
        points = np.array([gmsh.model.mesh.getNode(tag)[0] for tag in tags])
        return cls(tags, points, pieces.reshape(-1, 2))


def _remesh(gmsh: Any, face: int, sizing: SizeField, seed: int) -> None:
    """Replace gmsh's triangles of a face by those between random points in its developed plane."""
    sides = [tag for _, tag in gmsh.model.getBoundary([(2, face)], combined=False, oriented=False)]
    seams = {side for side in sides if sides.count(side) == 2}
    nodes = _Curves.of(gmsh, sorted(set(sides)))
    flat = _parameters(gmsh, face, nodes.points)
    tags, pieces = nodes.tags, nodes.pieces
    if seams:  # a curve that bounds the face twice
        seam = np.isin(tags, _Curves.of(gmsh, sorted(seams)).tags)
        tags, flat, pieces = _cut_open(tags, flat, pieces, seam)
    scale = _scale(gmsh, face)
    same_orientation = _is_oriented_as_parameters(gmsh, face)

    def place(points: Points) -> Points:
        return np.array(gmsh.model.getValue(2, face, (points / scale).ravel())).reshape(-1, 3)

    points, cells = scatter(Outline(flat * scale, pieces), lambda points: sizing.at(place(points)), seed)
    # nodes of the curves stay; copies of the nodes of a seam are the same nodes
    gmsh.model.mesh.clear([(2, face)])
    last = gmsh.model.mesh.getMaxNodeTag()
    inner = points[len(tags) :]
    new = last + 1 + np.arange(len(inner))
    gmsh.model.mesh.addNodes(2, face, new, place(inner).ravel(), (inner / scale).ravel())
    corners = np.concatenate([tags, new])[cells]
    gmsh.model.mesh.addElementsByType(
        face, GmshElement.TRIANGLE, [], (corners if same_orientation else corners[:, ::-1]).ravel()
    )


def _parameters(gmsh: Any, face: int, points: Points) -> Floats:
    """(n, 2) parameters of points on a face."""
    return np.array(gmsh.model.getParametrization(2, face, points.ravel())).reshape(-1, 2)


def _scale(gmsh: Any, face: int) -> Floats:
    """(2,) metres for each unit of the parameters of a face, constant on a plane or a cylinder."""
    return np.linalg.norm(np.array(gmsh.model.getDerivative(2, face, [0.0, 0.0])).reshape(2, 3), axis=1)


def _is_oriented_as_parameters(gmsh: Any, face: int) -> bool:
    """Whether gmsh's triangles have the orientation of the face's parameters."""
    triangle = gmsh.model.mesh.getElementsByType(GmshElement.TRIANGLE, face)[1][:3]
    corners = np.array([gmsh.model.mesh.getNode(tag)[0] for tag in triangle])
    middle = _parameters(gmsh, face, corners.mean(axis=0))
    along = np.array(gmsh.model.getDerivative(2, face, middle.ravel())).reshape(2, 3)
    return bool(np.cross(corners[1] - corners[0], corners[2] - corners[0]) @ np.cross(*along) > 0)


def _cut_open(tags: Indices, flat: Floats, pieces: Indices, seam: Any) -> tuple[Indices, Floats, Indices]:
    """A closed cylindrical face cut along its seam: nodes on it at angle 0 and, a second time, at 2 pi.

    Args:
        tags: (n,) gmsh's number of each node of its curves.
        flat: (n, 2) parameters, the first an angle.
        pieces: (k, 2) pieces of the curves.
        seam: (n,) whether each node lies on the seam.
    """
    flat[seam, 0] = 0.0
    copy = np.full(len(tags), -1)
    copy[seam] = len(tags) + np.arange(seam.sum())
    along = seam[pieces].all(axis=1)
    far = seam[pieces] & (flat[pieces[:, ::-1], 0] > tau / 2)  # the other end lies near the angle 2 pi
    closed = np.where(far, copy[pieces], pieces)
    return (
        np.concatenate([tags, tags[seam]]),
        np.concatenate([flat, flat[seam] + [tau, 0.0]]),
        np.concatenate([closed, copy[pieces[along]]]),
    )
