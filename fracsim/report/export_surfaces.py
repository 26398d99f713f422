"""Surfaces of fragments and obstacles with normals and materials, and the motion of those that stay rigid."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import InputError
from .pictures.colour_maps import rgb
from .pictures.frames import FrameSource, is_crack, load_grid, with_normals, without_single_nodes
from .pictures.picture_options import MaterialLook
from .pictures.surroundings import OBSTACLE_COLOUR, PLANE_COLOUR, obstacle_surface

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
# materials by their number: original boundary, crack faces, obstacles, and obstacles that are planes
MATERIALS = ("skin", "inside", "obstacle", "plane")
SKIN, INSIDE, OBSTACLE, PLANE = range(len(MATERIALS))
# largest deviation of a rigid motion, as a share of the distances: round-off of frames in single precision
_RIGID_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Surface:
    """Closed surface of a fragment or an obstacle.

    Attributes:
        name: name such as piece_000012, or of the obstacle.
        points: positions (n, 3), m.
        triangles: triangles (k, 3), oriented outwards.
        material: material (k,) of each triangle, see `MATERIALS`.
        normals: unit normals (k, 3, 3) at the corners of each triangle. They differ at sharp edges and at rims.
        velocity: velocities (n, 3) of the points, m/s; zero for obstacles.
    """

    name: str
    points: Values
    triangles: Ints
    material: Ints
    normals: Values
    velocity: Values

    def part(self, name: str, chosen: Ints) -> Surface:
        """Surface of some of the triangles, with its own points only."""
        used, renumbered = np.unique(self.triangles[chosen], return_inverse=True)
        points, velocity, corners = self.points[used], self.velocity[used], renumbered.reshape(-1, 3)
        return Surface(name, points, corners, self.material[chosen], self.normals[chosen], velocity)

    def split_corners(self, material: int) -> tuple[Values, Values, Ints]:
        """Points (m, 3), their normals (m, 3) and triangles of one material; a point has a copy for each normal."""
        chosen = self.material == material
        normals = np.round(self.normals[chosen].reshape(-1, 3), 5)
        corners = np.column_stack([self.triangles[chosen].reshape(-1), normals])
        vertices, number = np.unique(corners, axis=0, return_inverse=True)
        lengths = np.linalg.norm(vertices[:, 1:], axis=1, keepdims=True)
        return self.points[vertices[:, 0].astype(int)], vertices[:, 1:] / lengths, number.reshape(-1, 3)


def material_colours(look: MaterialLook) -> npt.NDArray[np.uint8]:
    """Colours (4, 3) of `MATERIALS` as they are shown (sRGB)."""
    return np.array(
        [rgb(c) for c in (look.boundary_colour, look.crack_colour, OBSTACLE_COLOUR, PLANE_COLOUR)], np.uint8
    )


def linear_colours(look: MaterialLook) -> list[tuple[float, float, float]]:
    """Colours of `MATERIALS` in linear light, 0 to 1 (IEC 61966-2-1), as glTF, USD and MTL have them."""
    shown = material_colours(look) / 255
    linear = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    return [(float(red), float(green), float(blue)) for red, green, blue in np.round(linear, 6)]


def material_roughness(look: MaterialLook) -> tuple[float, ...]:
    """Roughness of `MATERIALS`, 0 (mirror) to 1 (dull)."""
    return 1 - look.gloss, 1 - look.gloss, 1.0, 1.0


# --- surfaces of a frame ---


def read_fragments(frame: FrameSource, dust: bool = True) -> list[Surface]:
    """Fragments of a frame, in the order of their names.

    Args:
        frame: the frame.
        dust: with single-node fragments.

    Raises:
        InputError: the body is in 2D and has no closed surface.
    """
    import pyvista

    grid = load_grid(frame) if dust else without_single_nodes(load_grid(frame))
    if not np.all(grid.celltypes == pyvista.CellType.TRIANGLE):
        raise InputError(f"{frame.folder}: a body in 2D has no closed surface to export")
    triangles = np.asarray(grid.cell_connectivity).reshape(-1, 3)
    material = np.where(is_crack(grid), INSIDE, SKIN)
    points, fragment = np.asarray(grid.points, float), np.asarray(grid.cell_data["piece"])
    body = Surface("body", points, triangles, material, corner_normals(points, triangles, material), _velocity(grid))
    order = np.argsort(fragment, kind="stable")
    names, first = np.unique(fragment[order], return_index=True)
    parts = zip(names, np.split(order, first[1:]), strict=True)
    return [body.part(f"piece_{name:06d}", part) for name, part in parts]


def read_obstacles(frame: FrameSource, planes: Collection[str]) -> list[Surface]:
    """Obstacles of a frame; `planes` are the names of those that are planes."""
    surfaces = []
    for file, name in zip(frame.obstacle_files, frame.obstacle_names, strict=True):
        grid = obstacle_surface(file)
        points, triangles = np.asarray(grid.points, float), np.asarray(grid.regular_faces)
        material = np.full(len(triangles), PLANE if name in planes else OBSTACLE)
        normals = corner_normals(points, triangles, material)
        surfaces.append(Surface(name, points, triangles, material, normals, np.zeros_like(points)))
    return surfaces


def join_surfaces(surfaces: list[Surface]) -> Surface:
    """One surface of all fragments, named body."""
    start = np.cumsum([0, *(len(part.points) for part in surfaces)])
    triangles = np.concatenate([part.triangles + n for part, n in zip(surfaces, start[:-1], strict=True)])
    points, material, normals, velocity = (
        np.concatenate([getattr(part, name) for part in surfaces])
        for name in ("points", "material", "normals", "velocity")
    )
    return Surface("body", points, triangles, material, normals, velocity)


def _velocity(grid: Any) -> Values:
    return np.asarray(grid.point_data["velocity"], float)


def corner_normals(points: Values, triangles: Ints, material: Ints) -> Values:
    """Unit normals (k, 3, 3) at corners: smooth over edges that are not sharp, among triangles of one material."""
    import pyvista

    normals = np.zeros((len(triangles), 3, 3))
    for number in np.unique(material):
        chosen = material == number
        shaded = with_normals(pyvista.PolyData.from_regular_faces(points, triangles[chosen]))
        normals[chosen] = np.asarray(shaded.point_data["Normals"], float)[shaded.regular_faces]
    # a triangle without area has no normal
    normals[np.linalg.norm(normals, axis=2) < 0.5] = (0.0, 0.0, 1.0)
    return normals


# --- rigid motion ---


@dataclass(frozen=True)
class RigidTrack:
    """Motion of a surface that stays the same up to rotation and translation.

    Attributes:
        surface: surface in its own axes, its origin at the centroid of the enclosed volume.
        first: number of the first frame that has the surface; the others follow.
        translation: positions of the origin, m, a vector (3,) per frame.
        rotation: unit quaternions w, x, y, z, a vector (4,) per frame.
    """

    surface: Surface
    first: int
    translation: list[Values] = field(default_factory=list)
    rotation: list[Values] = field(default_factory=list)

    @property
    def frames(self) -> range:
        """Numbers of the frames that have the surface."""
        return range(self.first, self.first + len(self.translation))

    @property
    def moves(self) -> bool:
        """Whether the surface moves, beyond round-off."""
        steps = [np.ptp(np.array(values), axis=0).max() for values in (self.translation, self.rotation)]
        size = np.abs(self.surface.points).max() + np.abs(self.translation[0]).max()
        return bool(steps[0] > _RIGID_TOLERANCE * size or steps[1] > _RIGID_TOLERANCE)

    def follow(self, surface: Surface) -> bool:
        """Add the pose of a surface in the next frame; False if it is not this surface in another pose."""
        before = self.surface
        if not (
            np.array_equal(before.triangles, surface.triangles)
            and np.array_equal(before.material, surface.material)
            and len(before.points) == len(surface.points)
        ):
            return False
        middle = before.points.mean(axis=0)
        origin = surface.points.mean(axis=0)
        u, v = before.points - middle, surface.points - origin
        matrix = _rotation_between(u, v)
        size = np.abs(surface.points).max() + np.abs(before.points).max()
        if np.abs(u @ matrix.T - v).max() > _RIGID_TOLERANCE * size:
            return False
        self._append(origin - matrix @ middle, matrix)
        return True

    def _append(self, translation: Values, matrix: Values) -> None:
        from scipy.spatial.transform import Rotation

        quaternion = np.roll(Rotation.from_matrix(matrix).as_quat(), 1)
        if self.rotation and quaternion @ self.rotation[-1] < 0:
            quaternion = -quaternion  # the same rotation, on the short way from the one before
        self.translation.append(translation)
        self.rotation.append(quaternion)


class RigidTracks:
    """Tracks of all surfaces, from frame to frame. A surface whose shape changes begins another track.

    Attributes:
        tracks: tracks, in the order of their first frames.
    """

    def __init__(self) -> None:
        """Start without a frame."""
        self.tracks: list[RigidTrack] = []
        self._count = 0
        self._present: dict[str, RigidTrack] = {}
        # name -> number of shapes that it had
        self._shapes: dict[str, int] = {}

    def add_frame(self, surfaces: list[Surface]) -> None:
        """Add the surfaces of the next frame."""
        earlier, self._present = self._present, {}
        for surface in surfaces:
            track = earlier.get(surface.name)
            if track is None or not track.follow(surface):
                track = self._begin(surface)
            self._present[surface.name] = track
        self._count += 1

    def _begin(self, surface: Surface) -> RigidTrack:
        """New track of a surface. Of a second shape the name ends with _2."""
        shape = self._shapes[surface.name] = self._shapes.get(surface.name, 0) + 1
        name = surface.name if shape == 1 else f"{surface.name}_{shape}"
        centre = _centroid(surface)
        track = RigidTrack(replace(surface, name=name, points=surface.points - centre), self._count)
        track._append(centre, np.eye(3))
        self.tracks.append(track)
        return track


def _centroid(surface: Surface) -> Values:
    """Centroid (3,) of the enclosed volume, by the divergence theorem; the mean point if there is no volume."""
    mean = surface.points.mean(axis=0)
    corners = (surface.points - mean)[surface.triangles]
    volumes = np.linalg.det(corners) / 6
    box = np.ptp(surface.points, axis=0)
    if volumes.sum() < 1e-9 * box.max() ** 3:
        return np.asarray(mean)
    return np.asarray(mean + volumes @ corners.sum(axis=1) / (4 * volumes.sum()))


def _rotation_between(u: Values, v: Values) -> Values:
    """Rotation matrix (3, 3) that turns the vectors u (n, 3) into v (n, 3) with the least square error.

    W. Kabsch, A solution for the best rotation to relate two sets of vectors, Acta Cryst. A32, 1976.
    """
    left, _, right = np.linalg.svd(v.T @ u)
    left[:, -1] *= np.linalg.det(left) * np.linalg.det(right)
    return np.asarray(left @ right)
