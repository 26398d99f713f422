"""Contact points of convex polyhedra that touch with parallel faces.

MuJoCo takes at most four corners of the polygon in which two faces overlap, by a search for the largest quadrilateral
(version 4.0.1, `polygonQuad`). Corners that nearly coincide, or lie nearly on a line, end this search early, as where
equal blocks are stacked. Then a corner that supports a body is left out, and the body tips about the others. Here the
polygon is found again: the face of the second polyhedron, clipped by that of the first one. Corners are left out only
if the polygon hardly changes, or if there are too many.
"""

from __future__ import annotations

from ctypes import c_double, c_int64
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from ..mesh.c_library import load_library

SOURCE = Path(__file__).with_suffix(".c")
Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]

# Corners of a box, by signs of its half sides, and of its faces, in order around each.
BOX_CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
BOX_FACES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
BOX_NORMALS = np.array([[-1.0, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]])


@dataclass(frozen=True)
class FaceContactSettings:
    """Numbers of the choice of contact points.

    Attributes:
        mujoco_points: points of two faces in MuJoCo, which may have left out others.
        max_points: points of two faces.
        least_share: of the polygon's area; a corner is left out if its triangle with its neighbours is smaller.
    """

    mujoco_points: int = 4
    max_points: int = 8
    least_share: float = 1e-3


SETTINGS = FaceContactSettings()


@dataclass(frozen=True)
class FaceContacts:
    """Faces (f) of the polyhedra of a MuJoCo model.

    Attributes:
        is_box: (geoms,) boxes; MuJoCo takes up to eight points of two of them.
        faces: (geoms, 2) the first face of each geom, and the one after its last; equal for round ones.
        normals: (f, 3) outwards, in the axes of the geoms.
        first_corner: (f + 1,) where the corners of each face begin.
        corners: numbers of the vertices around each face.
        vertices: (v, 3) in the axes of the geoms, m.
    """

    is_box: npt.NDArray[np.bool_]
    faces: Ints
    normals: Values
    first_corner: Ints
    corners: Ints
    vertices: Values

    @classmethod
    def from_model(cls, compiled: Any) -> FaceContacts:
        """Return the faces of the meshes and boxes of a compiled model."""
        is_box = compiled.geom_type == mujoco.mjtGeom.mjGEOM_BOX
        is_mesh = compiled.geom_type == mujoco.mjtGeom.mjGEOM_MESH
        boxes, mesh = np.flatnonzero(is_box), compiled.geom_dataid
        faces = np.zeros((compiled.ngeom, 2), np.int64)
        faces[is_mesh, 0] = compiled.mesh_polyadr[mesh[is_mesh]]
        faces[is_mesh, 1] = faces[is_mesh, 0] + compiled.mesh_polynum[mesh[is_mesh]]
        # meshes first, then boxes
        mesh_of_face = np.repeat(np.arange(compiled.nmesh), compiled.mesh_polynum)
        sizes = compiled.mesh_polyvertnum.astype(np.int64)
        corners = compiled.mesh_polyvert + np.repeat(compiled.mesh_vertadr[mesh_of_face], sizes)
        of_boxes = BOX_FACES + len(compiled.mesh_vert) + len(BOX_CORNERS) * np.arange(len(boxes))[:, None, None]
        faces[boxes] = len(sizes) + len(BOX_FACES) * np.arange(len(boxes))[:, None] + [0, len(BOX_FACES)]
        sizes = np.concatenate([sizes, np.full(len(BOX_FACES) * len(boxes), BOX_FACES.shape[1])])
        vertices = np.concatenate([compiled.mesh_vert, (BOX_CORNERS * compiled.geom_size[boxes, None]).reshape(-1, 3)])
        normals = np.concatenate([compiled.mesh_polynormal.reshape(-1, 3), np.tile(BOX_NORMALS, (len(boxes), 1))])
        first_corner, corners = np.cumsum([0, *sizes]), np.concatenate([corners, of_boxes.ravel()])
        return cls(is_box, faces, normals.astype(float), first_corner, corners.astype(np.int64), vertices.astype(float))

    def complete(self, contacts: list[Any], position: Values, rotation: Values) -> list[Any]:
        """Return MuJoCo's contacts with all points of the faces of which MuJoCo may have left out some.

        Args:
            contacts: geoms (k, 2), points (k, 3), axes (k, 3, 3), gaps (k,) and friction (k,), which are overwritten;
                those of a pair follow one another.
            position: (geoms, 3) m.
            rotation: (geoms, 9) from the axes of the geoms.
        """
        geoms, points, axes, gaps, _ = contacts
        rows = self._first_rows(geoms)
        if not len(rows):
            return contacts
        max_points, mujoco_points = SETTINGS.max_points, SETTINGS.mujoco_points
        count, point, gap = (
            np.empty(len(rows), np.int64),
            np.empty((len(rows), max_points, 3)),
            np.empty((len(rows), max_points)),
        )
        load_library(SOURCE).face_contacts(
            c_int64(len(rows)), geoms[rows], axes[rows], self.faces, self.normals, self.first_corner, self.corners,
            self.vertices, np.ascontiguousarray(position), np.ascontiguousarray(rotation), c_int64(max_points),
            c_double(SETTINGS.least_share), count, point, gap,
        )  # fmt: skip
        is_point = np.arange(max_points) < count[:, None]
        # the first points take the rows of MuJoCo's, and others follow at the end
        pair, number = np.nonzero(is_point[:, :mujoco_points])
        points[rows[pair] + number], gaps[rows[pair] + number] = point[pair, number], gap[pair, number]
        if np.all((count == mujoco_points) | (count == 0)):
            return contacts
        pair, number = np.nonzero((np.arange(mujoco_points) >= count[:, None]) & (count[:, None] > 0))
        retained = np.delete(np.arange(len(geoms)), rows[pair] + number)
        pair, number = np.nonzero(is_point[:, mujoco_points:])
        result = [values[np.concatenate([retained, rows[pair]])] for values in contacts]
        result[1][len(retained) :], result[3][len(retained) :] = (
            point[pair, mujoco_points + number],
            gap[pair, mujoco_points + number],
        )
        return result

    def _first_rows(self, geoms: Ints) -> Ints:
        """Return the first contacts of the pairs of geoms (k, 2) of which MuJoCo may have left out points."""
        count, code = SETTINGS.mujoco_points, geoms[:, 0] * len(self.is_box) + geoms[:, 1]
        rows = (
            np.flatnonzero(code[count - 1 :] == code[: len(code) - count + 1]) if len(code) >= count else geoms[:0, 0]
        )
        if not len(rows):
            return rows
        # neither before nor after them is one of the same pair
        bounds = np.concatenate([[-1], code, [-1]])
        rows = rows[(bounds[rows] != code[rows]) & (bounds[rows + count + 1] != code[rows])]
        return np.asarray(rows[~(self.is_box[geoms[rows, 0]] & self.is_box[geoms[rows, 1]])])
